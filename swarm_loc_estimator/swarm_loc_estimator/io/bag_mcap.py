"""MCAP files, whole or cut off, in order of log time and faster than the libraries' readers.

The file's top-level records are walked once when it is opened: each chunk tells its time range in its head,
so the index at the end is not needed, and a file that a crash left without one is read like any other. Chunks
are then loaded one after another in order of time; only those that overlap are in memory together.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from io import BytesIO
from itertools import zip_longest
from typing import TYPE_CHECKING, Literal

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

from swarm_loc_estimator.core.compiled import compiled
from swarm_loc_estimator.io.bag_file import BagError, BagTopic, Losses
from swarm_loc_estimator.io.message_batch import MessageBatch, merged

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, checksum, length of the compression's name
_LENGTH = struct.Struct("<Q")
_RECORD_HEAD = 9  # opcode, length
_MESSAGE_HEAD = 22  # channel, sequence, log time, publish time
_IS_MESSAGE = int(Opcode.MESSAGE)
_UNWANTED, _UNKNOWN = -1, -2
_OPCODES = frozenset({*map(int, Opcode), *range(0x80, 0x100)})  # these are applications' own, to be skipped
_RUN_BYTES = 1 << 20
_MAX_RECORD = 1 << 31


@dataclass
class _Chunk:
    """Where a run of messages lies, and how to unpack it."""

    offset: int
    stored: int
    first_ns: int
    last_ns: int
    compression: str = ""
    size: int = 0
    checksum: int = 0
    whole: bool = True
    is_run: bool = False  # messages outside any chunk


class McapFile:
    """One open MCAP file; see `BagFile`."""

    def __init__(self, path: Path) -> None:
        """Open it.

        Raises:
            BagError: It is no MCAP file.
        """
        self._path = path
        self._chunks: list[_Chunk] = []
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, BagTopic] = {}
        self._statistics: Statistics | None = None
        self._whole = False
        self._bytes_read = 0
        self._counted = 0
        self._unknown_channels = 0
        self.losses = Losses(path.name)
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
    def message_count(self) -> int:
        """Number of messages."""
        return self._statistics.message_count if self._statistics else self._counted

    @property
    def time_range_ns(self) -> tuple[int, int]:
        """First and last log time."""
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
        """The messages of some topics in order of log time, numbered as told."""
        self._bytes_read = 0
        self._unknown_channels = 0
        chunks = sorted(self._chunks, key=lambda chunk: (chunk.first_ns, chunk.offset))
        waiting: dict[int, MessageBatch] = {}
        for chunk, following in zip_longest(chunks, chunks[1:]):
            waiting[chunk.offset] = self._load(chunk, number_of).in_order_of_time()
            yield _take_before(following, waiting)
        if self._unknown_channels:
            self.losses.say(f"{self._unknown_channels} messages of no known topic were skipped.")

    # Opening

    def _open(self) -> None:
        """Walk the top-level records; count by reading everything when the end is missing."""
        size = os.fstat(self._file).st_size
        if os.pread(self._file, len(_MAGIC), 0) != _MAGIC:
            raise BagError(f"{self._path} is empty." if size == 0 else f"{self._path} is no MCAP file.")
        end = self._walk_file(size)
        if not self._whole or not self._statistics or len(self._channels) < self._statistics.channel_count:
            self._count()
        if not self._whole:
            self.losses.say(
                f"it was cut off at byte {end} of {size}: the {self._counted} messages before that"
                " were kept, what was written behind them is lost."
            )

    def _walk_file(self, size: int) -> int:
        """Note all chunks, topics and statistics; returns the offset behind the last whole record."""
        offset = len(_MAGIC)
        while offset + _RECORD.size <= size:
            head = os.pread(self._file, _RECORD.size, offset)
            opcode, length = int(head[0]), int.from_bytes(head[1:], "little")
            begin = offset + _RECORD.size
            if opcode not in _OPCODES or length > _MAX_RECORD:
                return offset
            if begin + length > size:
                if opcode == Opcode.CHUNK:
                    self._note_chunk(begin, size - begin, whole=False)
                return offset
            self._note(opcode, begin, length)
            offset = begin + length
            if opcode == Opcode.FOOTER:
                self._whole = True
                return offset
        return offset

    def _note(self, opcode: int, begin: int, length: int) -> None:
        """Remember what a top-level record says."""
        if opcode == Opcode.CHUNK:
            self._note_chunk(begin, length, whole=True)
        elif opcode == Opcode.MESSAGE:
            self._note_message(begin, length)
        elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS}:
            self._define(opcode, os.pread(self._file, length, begin))

    def _note_chunk(self, begin: int, length: int, *, whole: bool) -> None:
        """Remember a chunk; of one that was cut off, what is there."""
        head = os.pread(self._file, min(length, 128), begin)
        if len(head) < _CHUNK.size:
            return
        first_ns, last_ns, size, checksum, name_length = _CHUNK.unpack_from(head)
        behind_name = _CHUNK.size + name_length
        if behind_name + _LENGTH.size > len(head):
            return
        compression = head[_CHUNK.size : behind_name].decode("ascii", "replace")
        (stored,) = _LENGTH.unpack_from(head, behind_name)
        data = behind_name + _LENGTH.size
        stored = min(stored, length - data)
        self._chunks.append(
            _Chunk(begin + data, stored, first_ns, last_ns, compression, size, checksum, whole)
        )

    def _note_message(self, begin: int, length: int) -> None:
        """Messages outside chunks: neighbours form a run that is read like a chunk."""
        (log_ns,) = _LENGTH.unpack(os.pread(self._file, _LENGTH.size, begin + 6))
        offset, end = begin - _RECORD.size, begin + length
        last = self._chunks[-1] if self._chunks else None
        is_run = last is not None and last.is_run and last.stored < _RUN_BYTES
        if last and is_run and last.offset + last.stored == offset:
            last.stored = end - last.offset
            last.first_ns, last.last_ns = min(last.first_ns, log_ns), max(last.last_ns, log_ns)
            return
        self._chunks.append(_Chunk(offset, end - offset, log_ns, log_ns, is_run=True))

    def _define(self, opcode: int, content: bytes) -> None:
        """A schema, a channel or the statistics; damaged ones define nothing."""
        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema.name
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self._channels[channel.id] = BagTopic(
                    channel.topic.lstrip("/"), self._schemas.get(channel.schema_id, "")
                )
            else:
                self._statistics = Statistics.read(stream)
        except (McapError, struct.error, UnicodeDecodeError, ValueError):
            self.losses.say("a damaged record that names a topic was skipped.")

    def _count(self) -> None:
        """Count by reading: without the end, only the chunks themselves know their topics and messages."""
        self._statistics = None
        for chunk in self._chunks:
            messages = self._load(chunk, None)
            self._counted += messages.size
            if messages.size:
                chunk.first_ns, chunk.last_ns = int(messages.log_ns.min()), int(messages.log_ns.max())

    # Reading

    def _load(self, chunk: _Chunk, number_of: Mapping[BagTopic, int] | None) -> MessageBatch:
        """The messages of a chunk in their stored order; of all topics, unnumbered, when none are named."""
        self._bytes_read += chunk.stored
        stored = os.pread(self._file, chunk.stored, chunk.offset)
        try:
            data = _unpack(stored, chunk.compression)
        except (zstandard.ZstdError, RuntimeError, ValueError) as error:
            self.losses.say(f"the chunk at byte {chunk.offset} is damaged ({error}).")
            return MessageBatch.of([])
        if chunk.whole and chunk.size and len(data) != chunk.size:
            self.losses.say(f"the chunk at byte {chunk.offset} holds {len(data)} of {chunk.size} bytes.")
        elif chunk.whole and chunk.checksum and zlib.crc32(data) != chunk.checksum:
            self.losses.say(f"the chunk at byte {chunk.offset} is damaged, its checksum is wrong.")
            return MessageBatch.of([])
        messages, end = self._walk_chunk(data, number_of)
        if chunk.whole and end != len(data):
            self.losses.say(f"the chunk at byte {chunk.offset} is damaged behind its byte {end}.")
        return messages

    def _walk_chunk(self, data: bytes, number_of: Mapping[BagTopic, int] | None) -> tuple[MessageBatch, int]:
        """The messages of unpacked records, and the offset behind the last whole one."""
        content = np.frombuffer(data, dtype=np.uint8)
        columns = np.empty((4, len(data) // (_RECORD_HEAD + _MESSAGE_HEAD) + 1), dtype=np.int64)
        numbers, count, offset = self._numbers(number_of), 0, 0
        while offset + _RECORD_HEAD <= len(data):
            count, unknown, offset = _walk(content, offset, numbers, columns, count)
            self._unknown_channels += unknown
            if offset + _RECORD_HEAD > len(data):
                break
            opcode, length = _RECORD.unpack_from(data, offset)  # no whole message
            end = offset + _RECORD_HEAD + length
            if opcode == _IS_MESSAGE or end > len(data) or opcode not in _OPCODES:
                break
            if opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
                self._define(opcode, data[offset + _RECORD_HEAD : end])
                numbers = self._numbers(number_of)
            offset = end
        return MessageBatch(content, *columns[:, :count].copy()), offset

    def _numbers(self, number_of: Mapping[BagTopic, int] | None) -> npt.NDArray[np.int64]:
        """Channel -> number of its topic."""
        numbers = np.full(1 << 16, _UNKNOWN)
        for channel, topic in self._channels.items():
            numbers[channel] = 0 if number_of is None else number_of.get(topic, _UNWANTED)
        return numbers


@compiled
def _walk(
    data: npt.NDArray[np.uint8],
    offset: int,
    numbers: npt.NDArray[np.int64],
    columns: npt.NDArray[np.int64],
    count: int,
) -> tuple[int, int, int]:
    """Note the messages from an offset on up to a record that is none, or is not whole.

    Args:
        data: Records.
        offset: Where to begin.
        numbers: Channel -> number of its topic, or _UNWANTED, or _UNKNOWN.
        columns: (4, n) written: topic, log time, offset and length of each message.
        count: How many stand there already.

    Returns:
        How many stand there now, how many messages were of unknown topics, and the offset reached.
    """
    unknown = 0
    while offset + _RECORD_HEAD + _MESSAGE_HEAD <= data.size and data[offset] == _IS_MESSAGE:
        length = _number(data, offset + 1, 8)
        if length < _MESSAGE_HEAD or length > data.size - offset - _RECORD_HEAD:
            break
        topic = numbers[_number(data, offset + _RECORD_HEAD, 2)]
        if topic >= 0:
            columns[0, count] = topic
            columns[1, count] = _number(data, offset + _RECORD_HEAD + 6, 8)
            columns[2, count] = offset + _RECORD_HEAD + _MESSAGE_HEAD
            columns[3, count] = length - _MESSAGE_HEAD
            count += 1
        elif topic == _UNKNOWN:
            unknown += 1
        offset += _RECORD_HEAD + length
    return count, unknown, offset


@compiled
def _number(data: npt.NDArray[np.uint8], offset: int, size: int) -> int:
    """A little-endian number; one beyond 63 bits is negative."""
    number: int = np.int64(0)
    for k in range(size):
        number |= np.int64(data[offset + k]) << np.int64(8 * k)
    return number


def _unpack(stored: bytes, compression: str) -> bytes:
    """The records of a chunk; of one that was cut off, those that can be had."""
    if compression == "":
        return stored
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj().decompress(stored)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(stored))
    raise ValueError(f"its compression {compression!r} is not known")


def _take_before(following: _Chunk | None, waiting: dict[int, MessageBatch]) -> MessageBatch:
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
