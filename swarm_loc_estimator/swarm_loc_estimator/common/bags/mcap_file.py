"""MCAP files, whole or cut off, in order of log time.

The top-level records are walked once when a file is opened. The head of each chunk has its time range, so a
file that a crash left without the index at its end is read like any other; an index is compared with the
heads. Chunks are then loaded in order of time; only those that overlap are in memory together.

The libraries' readers fail on cut files and take longer: 1.8 us (`rosbags`) and 5.6 us (`mcap`) a message,
where this one takes 0.16 us (`make bench-reading`, odometry). The library `mcap` parses all records but
chunks and messages.

The records of an MCAP file: unpacking a chunk, and finding the messages in it.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from itertools import zip_longest
from pathlib import Path
from typing import Literal, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.bags.bag_file import MAX_LOG_NS, BagError, BagTopic, ReadErrors
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages.streams import MessageBatch, merged

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # Opcode and length
MESSAGE_HEAD = 22  # Bytes of channel, sequence, log time and publish time
OPCODES = frozenset({*map(int, Opcode), *range(0x80, 0x100)})
"""Of records; the last ones are applications' own, to be skipped."""
UNWANTED, UNKNOWN = -1, -2  # In place of the number of a topic: it is not asked for, or the channel has none
MAX_CHUNK = 1 << 30  # Unpacked chunks are at most so large [byte]; writers close them at a megabyte or so

_HEAD = struct.Struct("<QQQII")  # first and last time, size, checksum, length of the compression's name
_LENGTH = struct.Struct("<Q")
_RECORD_HEAD = RECORD.size
_IS_MESSAGE = int(Opcode.MESSAGE)
_STEP = 1 << 20


@dataclass
class Chunk:
    """Where a run of messages lies, and how to unpack it."""

    offset: int  # Where its content begins
    stored: int  # How long that is
    first_ns: int  # Log time of its first message
    last_ns: int  # Log time of its last message
    compression: str = ""  # "", "zstd" or "lz4"
    size: int = 0  # Length of the content unpacked
    checksum: int = 0  # CRC32 of the content unpacked; 0: none
    whole: bool = True  # Whether nothing of it was cut off
    is_run: bool = False  # Whether its messages lie in no chunk, but one after the other in the file


class MessageScan(NamedTuple):
    """How far the messages of a chunk were read."""

    wanted: int  # Messages of the topics that are asked for, those before included
    others: int  # Messages of other topics
    unknown: int  # Messages of channels without a topic
    untimed: int  # Messages whose log time cannot be
    offset: int  # After the last message


def parse_chunk(head: bytes, begin: int, length: int, *, whole: bool) -> Chunk | None:
    """What the head of a chunk's record says, whose content begins at `begin`; None: it is damaged."""
    if len(head) < _HEAD.size:
        return None
    first_ns, last_ns, size, checksum, name_length = _HEAD.unpack_from(head)
    after_name = _HEAD.size + name_length
    if after_name + _LENGTH.size > len(head):
        return None
    compression = head[_HEAD.size : after_name].decode("ascii", "replace")
    (stored,) = _LENGTH.unpack_from(head, after_name)
    data = after_name + _LENGTH.size
    stored = min(stored, length - data)
    return Chunk(begin + data, stored, first_ns, last_ns, compression, size, checksum, whole)


def unpack(stored: bytes, chunk: Chunk) -> bytes:
    """The records of a chunk, one byte more than it should hold at most; of one cut off, what can be had.

    Raises:
        ValueError, RuntimeError, zstandard.ZstdError: It is damaged.
    """
    if chunk.compression == "" or chunk.is_run:
        return stored
    if chunk.size > MAX_CHUNK:
        raise ValueError(f"it should unpack to {chunk.size} bytes")
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=chunk.size + 1))
    if chunk.compression != "zstd":
        raise ValueError(f"its compression {chunk.compression!r} is not known")
    data = bytearray()
    with zstandard.ZstdDecompressor().stream_reader(stored) as reader:
        while part := reader.read(min(_STEP, chunk.size + 1 - len(data))):
            data += part
    return bytes(data)


@cached_njit
def find_messages(
    data: NDArray[np.uint8], begin: int, numbers: IntArray, columns: IntArray, count: int
) -> MessageScan:
    """Note the messages from `begin` on up to a record that is none, or is not whole.

    `numbers` has of each channel the number of its topic, or UNWANTED, or UNKNOWN. `columns` (4, n) are
    written: topic, log time, offset and length of each message; `count` of them stand there already.
    """
    offset, others, unknown, untimed = begin, 0, 0, 0
    while offset + _RECORD_HEAD + MESSAGE_HEAD <= data.size and data[offset] == _IS_MESSAGE:
        length = _number(data, offset + 1, 8)
        if length < MESSAGE_HEAD or length > data.size - offset - _RECORD_HEAD:
            break
        topic = numbers[_number(data, offset + _RECORD_HEAD, 2)]
        log_ns = _number(data, offset + _RECORD_HEAD + 6, 8)
        if topic == UNKNOWN:
            unknown += 1
        elif not 0 <= log_ns <= MAX_LOG_NS:
            untimed += 1
        elif topic == UNWANTED:
            others += 1
        else:
            columns[0, count] = topic
            columns[1, count] = log_ns
            columns[2, count] = offset + _RECORD_HEAD + MESSAGE_HEAD
            columns[3, count] = length - MESSAGE_HEAD
            count += 1
        offset += _RECORD_HEAD + length
    return MessageScan(count, others, unknown, untimed, offset)


@cached_njit
def _number(data: NDArray[np.uint8], offset: int, size: int) -> int:
    """A little-endian number; one beyond 63 bits is negative."""
    number: int = np.int64(0)
    for k in range(size):
        number |= np.int64(data[offset + k]) << np.int64(8 * k)
    return number


_RUN_BYTES = 1 << 20
_MAX_RECORD = 1 << 31
_CHUNK_HEAD = 128
_DEFINITIONS = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX}


class McapFile:
    """One open MCAP file."""

    def __init__(self, path: Path) -> None:
        """Open it; raises BagError if it is no MCAP file."""
        self._path = path
        self._chunks: list[Chunk] = []
        self._index: list[tuple[int, int]] = []
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, BagTopic] = {}
        self._statistics: Statistics | None = None
        self._whole = False
        self._bytes_read = 0
        self._skipped: Counter[str] = Counter()
        self.losses = ReadErrors(path.name)  # What could not be read; more may come while reading
        self.message_count = 0  # Number of messages, as far as they can be counted before reading
        if path.exists() and not path.is_file():
            raise BagError(f"{path} is no file.")  # opening a pipe would never return
        try:
            self._file = os.open(path, os.O_RDONLY)
        except OSError as error:
            raise BagError(f"{path} cannot be opened: {error.strerror}.") from error
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    @property
    def topics(self) -> list[BagTopic]:
        """The topics, in the order of their channels."""
        return list(dict.fromkeys(self._channels.values()))

    @property
    def time_range_ns(self) -> tuple[int, int]:
        """First and last log time; (0, 0) without messages."""
        chunks = [chunk for chunk in self._chunks if chunk.last_ns]
        if not chunks:
            return 0, 0
        return min(chunk.first_ns for chunk in chunks), max(chunk.last_ns for chunk in chunks)

    @property
    def progress(self) -> float:
        """Share of the stored bytes that were read."""
        total = sum(chunk.stored for chunk in self._chunks)
        return min(self._bytes_read / total, 1.0) if total else 1.0

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1

    def batches(self, number_of: Mapping[BagTopic, int]) -> Iterator[MessageBatch]:
        """The messages of some topics in order of log time, numbered by `number_of`."""
        self._bytes_read = 0
        self._skipped.clear()
        count = 0
        chunks = sorted(self._chunks, key=lambda chunk: (chunk.first_ns, chunk.offset))
        waiting: dict[int, MessageBatch] = {}
        for chunk, following in zip_longest(chunks, chunks[1:]):
            waiting[chunk.offset] = self._load(chunk, number_of).in_order_of_time()
            count += waiting[chunk.offset].size
            yield _take_before(following, waiting)
        self._report_skipped(count)

    # Opening

    def _open(self) -> None:
        """Walk the top-level records; count by reading everything where they cannot be trusted."""
        size = os.fstat(self._file).st_size
        if os.pread(self._file, len(MAGIC), 0) != MAGIC:
            raise BagError(f"{self._path} is empty." if size == 0 else f"{self._path} is no MCAP file.")
        end = self._walk_file(size)
        statistics = self._statistics
        times = [(chunk.first_ns, chunk.last_ns) for chunk in self._chunks if not chunk.is_run]
        contradicted = self._whole and bool(self._index) and sorted(times) != sorted(self._index)
        absurd = any(chunk.last_ns > MAX_LOG_NS for chunk in self._chunks)
        trusted = self._whole and not contradicted and not absurd
        if trusted and statistics and len(self._channels) >= statistics.channel_count:
            self.message_count = statistics.message_count
        else:
            self._count()
        if contradicted:
            self.losses.add("its chunks and its index disagree: one of them is damaged.")
        if not self._whole:
            self.losses.add(
                f"it was cut off at byte {end} of {size}: the {self.message_count} messages before that"
                " were kept, what was written behind them is lost."
            )

    def _walk_file(self, size: int) -> int:
        """Record all chunks, topics and statistics; return the offset after the last whole record."""
        offset = len(MAGIC)
        while offset + RECORD.size <= size:
            head: tuple[int, int] = RECORD.unpack(os.pread(self._file, RECORD.size, offset))
            opcode, length = head
            begin = offset + RECORD.size
            if opcode not in OPCODES or length > _MAX_RECORD:
                return offset
            if begin + length > size:
                if opcode == Opcode.CHUNK:
                    self._note_chunk(begin, size - begin, whole=False)
                return offset
            self._note(opcode, begin, length)
            offset = begin + length
            if opcode == Opcode.FOOTER and size - offset <= len(MAGIC):
                self._whole = True
                return offset
        return offset

    def _note(self, opcode: int, begin: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            self._note_chunk(begin, length, whole=True)
        elif opcode == Opcode.MESSAGE:
            self._note_message(begin, length)
        elif opcode in _DEFINITIONS:
            self._define(opcode, os.pread(self._file, length, begin))

    def _note_chunk(self, begin: int, length: int, *, whole: bool) -> None:
        """Record a chunk; of one that was cut off, the part that is there."""
        chunk = parse_chunk(os.pread(self._file, min(length, _CHUNK_HEAD), begin), begin, length, whole=whole)
        if chunk:
            self._chunks.append(chunk)
        elif whole:
            self.losses.add(f"the head of the chunk at byte {begin} is damaged.")

    def _note_message(self, begin: int, length: int) -> None:
        """Record a message outside chunks: neighbours form a run that is read like a chunk."""
        if length < MESSAGE_HEAD:
            self.losses.add(f"the message at byte {begin} is damaged.")
            return
        log_ns = int.from_bytes(os.pread(self._file, 8, begin + 6), "little")
        offset, end = begin - RECORD.size, begin + length
        last = self._chunks[-1] if self._chunks else None
        is_run = last is not None and last.is_run and last.stored < _RUN_BYTES
        if last and is_run and last.offset + last.stored == offset:
            last.stored = end - last.offset
            last.first_ns, last.last_ns = min(last.first_ns, log_ns), max(last.last_ns, log_ns)
            return
        self._chunks.append(Chunk(offset, end - offset, log_ns, log_ns, is_run=True))

    def _define(self, opcode: int, content: bytes) -> None:
        """A schema, a channel, the statistics or an entry of the index; damaged ones define nothing."""
        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema.name
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                message_type = self._schemas.get(channel.schema_id, "")
                topic = BagTopic(channel.topic.lstrip("/"), message_type, channel.message_encoding)
                self._channels[channel.id] = topic
            elif opcode == Opcode.CHUNK_INDEX:
                chunk = ChunkIndex.read(stream)
                self._index.append((chunk.message_start_time, chunk.message_end_time))
            else:
                self._statistics = Statistics.read(stream)
        except (McapError, struct.error, UnicodeDecodeError, ValueError):
            self.losses.add("a damaged record that names a topic, or counts messages, was skipped.")

    def _count(self) -> None:
        """Count the messages by reading them, where heads and statistics cannot be trusted."""
        for chunk in self._chunks:
            messages = self._load(chunk, None)
            self.message_count += messages.size
            log_ns = messages.log_ns if messages.size else np.zeros(1, dtype=np.int64)
            chunk.first_ns, chunk.last_ns = int(log_ns.min()), int(log_ns.max())

    # Reading

    def _load(self, chunk: Chunk, number_of: Mapping[BagTopic, int] | None) -> MessageBatch:
        """The messages of a chunk in their stored order; of all topics, unnumbered, when none are named."""
        self._bytes_read += chunk.stored
        stored = os.pread(self._file, chunk.stored, chunk.offset)
        try:
            data = unpack(stored, chunk)
        except (zstandard.ZstdError, RuntimeError, ValueError) as error:
            self.losses.add(f"the chunk at byte {chunk.offset} is damaged ({error}).")
            return MessageBatch.of([])
        if not chunk.is_run and len(data) > chunk.size:
            self.losses.add(f"the chunk at byte {chunk.offset} holds more than its {chunk.size} bytes.")
            data = data[: chunk.size]
        elif chunk.whole and len(data) < chunk.size:
            self.losses.add(f"the chunk at byte {chunk.offset} holds {len(data)} of {chunk.size} bytes.")
        elif chunk.whole and chunk.checksum and zlib.crc32(data) != chunk.checksum:
            self.losses.add(f"the chunk at byte {chunk.offset} is damaged, its checksum is wrong.")
            return MessageBatch.of([])
        messages, end = self._walk_chunk(data, number_of)
        if chunk.whole and end != len(data):
            self.losses.add(f"the chunk at byte {chunk.offset} is damaged behind its byte {end}.")
        return messages

    def _walk_chunk(self, data: bytes, number_of: Mapping[BagTopic, int] | None) -> tuple[MessageBatch, int]:
        """The messages of unpacked records, and the offset after the last whole one."""
        content = np.frombuffer(data, dtype=np.uint8)
        columns = np.empty((4, len(data) // (RECORD.size + MESSAGE_HEAD) + 1), dtype=np.int64)
        numbers, count, offset = self._numbers(number_of), 0, 0
        while offset + RECORD.size <= len(data):
            found = find_messages(content, offset, numbers, columns, count)
            count, offset = found.wanted, found.offset
            self._skipped.update(others=found.others, unknown=found.unknown, untimed=found.untimed)
            if offset + RECORD.size > len(data):
                break
            opcode, length = RECORD.unpack_from(data, offset)  # no whole message
            end = offset + RECORD.size + length
            if opcode == Opcode.MESSAGE or end > len(data) or opcode not in OPCODES:
                break
            if opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
                self._define(opcode, data[offset + RECORD.size : end])
                numbers = self._numbers(number_of)
            offset = end
        return MessageBatch(content, *columns[:, :count].copy()), offset

    def _numbers(self, number_of: Mapping[BagTopic, int] | None) -> IntArray:
        """Channel -> number of its topic."""
        numbers = np.full(1 << 16, UNKNOWN)
        for channel, topic in self._channels.items():
            numbers[channel] = 0 if number_of is None else number_of.get(topic, UNWANTED)
        return numbers

    def _report_skipped(self, count: int) -> None:
        """Report messages that were skipped, after the last one was read."""
        if self._skipped["unknown"]:
            self.losses.add(f"{self._skipped['unknown']} messages of no known topic were skipped.")
        if self._skipped["untimed"]:
            self.losses.add(f"{self._skipped['untimed']} messages whose log time cannot be were skipped.")
        found = count + self._skipped.total()
        if self._statistics and not self.losses and found != self._statistics.message_count:
            self.losses.add(
                f"it holds {found} messages, but its statistics count {self._statistics.message_count}."
            )


def _take_before(following: Chunk | None, waiting: dict[int, MessageBatch]) -> MessageBatch:
    """Take what comes before the following chunk out of the loaded ones; equal times in recorded order."""
    ready = []
    for offset in sorted(waiting):
        batch = waiting.pop(offset)
        count = batch.size
        if following is not None:
            side: Literal["left", "right"] = "right" if offset < following.offset else "left"
            count = int(np.searchsorted(batch.log_ns, following.first_ns, side=side))
        ready.append(batch.chosen(slice(count)))
        if count < batch.size:
            waiting[offset] = batch.chosen(slice(count, None))
    return merged(ready)
