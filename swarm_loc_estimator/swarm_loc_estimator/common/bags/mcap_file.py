"""MCAP files, whole or cut off, in order of log time.

The library `mcap` reads the records: those of the summary if it agrees with the heads of all chunks, else all
from the first to where the file was cut off. Chunks are then loaded in order of time; only those that overlap
are in memory together. The messages of a chunk are found here, in 0.7 us each (`make bench-reading`,
odometry), where the library takes 5.7 us and `rosbags`, which refuses cut files, 1.8 us. A file without
a whole summary is read once more when it is opened; messages outside chunks take 5 us each then.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from io import BytesIO
from itertools import islice, zip_longest
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Footer, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import StreamReader

from swarm_loc_estimator.common.bags.bag_file import MAX_LOG_NS, BagError, BagTopic, ReadErrors
from swarm_loc_estimator.common.messages.streams import MessageBatch, merged

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK = 1 << 30  # Unpacked chunks are at most so large [byte]; writers close them at a megabyte or so

_RECORD = struct.Struct("<BQ")  # Opcode and length
_MESSAGE = struct.Struct("<H4xQ8x")  # Channel and log time
_IS_MESSAGE = int(Opcode.MESSAGE)
_DEFINITIONS: dict[int, type[Schema | Channel]] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}
_TIMES = struct.Struct("<QQ")  # First and last log time of a chunk
_CHUNK_HEAD = 40  # Bytes of a chunk's record before what is packed, without the name of the compression
_RUN_BYTES = 1 << 20
_DAMAGE = (McapError, struct.error, ValueError, OverflowError, MemoryError, OSError)
"""What the library raises where a file is damaged."""


class Stretch(NamedTuple):
    """Where messages lie in a file: in a chunk, or one after the other outside chunks."""

    offset: int  # Of its first record, or of the content of the chunk's record
    size: int  # How many bytes that is
    first_ns: int = 0  # Log time of its first message
    last_ns: int = 0  # Log time of its last message
    is_chunk: bool = True
    is_cut: bool = False  # Whether the file ends within the chunk


class McapFile:
    """One open MCAP file."""

    def __init__(self, path: Path) -> None:
        """Open it; raises BagError if it is no MCAP file."""
        self._path = path
        self._stretches: list[Stretch] = []  # In order of time
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, BagTopic] = {}
        self._statistics: Statistics | None = None
        self._bytes_read = 0
        self._skipped: Counter[str] = Counter()
        self.losses = ReadErrors(path.name)  # What could not be read; more may come while reading
        self.message_count = 0  # Number of messages, as far as they can be counted before reading
        if path.exists() and not path.is_file():
            raise BagError(f"{path} is no file.")  # opening a pipe would never return
        try:
            self._file: BinaryIO = path.open("rb")
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
        stretches = [one for one in self._stretches if one.last_ns]
        if not stretches:
            return 0, 0
        return min(one.first_ns for one in stretches), max(one.last_ns for one in stretches)

    @property
    def progress(self) -> float:
        """Share of the stored bytes that were read."""
        total = sum(one.size for one in self._stretches)
        return min(self._bytes_read / total, 1.0) if total else 1.0

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

    def batches(self, number_of: Mapping[BagTopic, int]) -> Iterator[MessageBatch]:
        """The messages of some topics in order of log time, numbered by `number_of`."""
        self._bytes_read = count = 0
        self._skipped.clear()
        waiting: dict[int, MessageBatch] = {}
        for stretch, following in zip_longest(self._stretches, islice(self._stretches, 1, None)):
            waiting[stretch.offset] = self._load(stretch, number_of).in_order_of_time()
            count += waiting[stretch.offset].size
            yield _take_before(following, waiting)
        self._report_skipped(count)

    # Opening

    def _open(self) -> None:
        size = self._path.stat().st_size
        if self._file.read(len(MAGIC)) != MAGIC:
            raise BagError(f"{self._path} is empty." if size == 0 else f"{self._path} is no MCAP file.")
        if not self._read_summary():
            end = self._walk()
            self._count()
            if end is not None:
                self.losses.add(
                    f"it was cut off at byte {end} of {size}: the {self.message_count} messages before that"
                    " were kept, what was written behind them is lost."
                )
        self._stretches.sort(key=lambda one: (one.first_ns, one.offset))

    def _read_summary(self) -> bool:
        """Take topics, chunks and the number of messages from the summary, if all chunks are as it says."""
        self._file.seek(0)
        try:
            summary = SeekingReader(self._file).get_summary()
            if summary is None or summary.statistics is None:
                return False
            agree = all(map(self._agrees, summary.chunk_indexes))
        except _DAMAGE:
            return False
        chunks, counts = summary.chunk_indexes, summary.statistics
        is_complete = len(chunks) == counts.chunk_count and len(summary.channels) >= counts.channel_count
        has_times = all(one.message_end_time <= MAX_LOG_NS for one in chunks)
        if not agree or not is_complete or not has_times or (not chunks and counts.message_count):
            return False
        for record in (*summary.schemas.values(), *summary.channels.values(), counts):
            self._define(record)
        self._stretches = [
            Stretch(
                one.chunk_start_offset + _RECORD.size,
                one.compressed_size,
                one.message_start_time,
                one.message_end_time,
            )
            for one in chunks
        ]
        self.message_count = counts.message_count
        return True

    def _agrees(self, index: ChunkIndex) -> bool:
        """Whether a chunk and its entry in the index name the same first and last log times."""
        self._file.seek(index.chunk_start_offset + _RECORD.size)
        times: tuple[int, int] = _TIMES.unpack(self._file.read(_TIMES.size))
        return times == (index.message_start_time, index.message_end_time)

    def _walk(self) -> int | None:
        """Note all records; return the offset after the last whole one, None if the file is whole."""
        self._file.seek(0)
        end = len(MAGIC)
        times: dict[type[McapRecord], list[tuple[int, int]]] = {Chunk: [], ChunkIndex: []}
        try:
            for record in StreamReader(self._file, emit_chunks=True).records:
                if isinstance(record, Chunk | ChunkIndex):
                    times[type(record)].append((record.message_start_time, record.message_end_time))
                elif isinstance(record, Footer):
                    if times[ChunkIndex] and sorted(times[Chunk]) != sorted(times[ChunkIndex]):
                        self.losses.add("its chunks and its index disagree: one of them is damaged.")
                    return None
                begin, end = end, self._file.tell()
                if isinstance(record, Chunk | Message):
                    self._add_stretch(record, begin, end)
                self._define(record)
        except _DAMAGE:
            pass
        self._file.seek(end)
        if self._file.read(1) == bytes([Opcode.CHUNK]):  # what there is of the chunk
            self._stretches.append(Stretch(end + _RECORD.size, self._path.stat().st_size - end, is_cut=True))
        return end

    def _define(self, record: McapRecord) -> None:
        """Take what a record says about topics and numbers; others say nothing."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record.name
        elif isinstance(record, Channel):
            message_type = self._schemas.get(record.schema_id, "")
            topic = BagTopic(record.topic.lstrip("/"), message_type, record.message_encoding)
            self._channels[record.id] = topic
        elif isinstance(record, Statistics):
            self._statistics = record

    def _add_stretch(self, record: Chunk | Message, begin: int, end: int) -> None:
        """Note a record that begins at an offset, after unknown ones, and ends at another."""
        last = self._stretches[-1] if self._stretches else None
        if isinstance(record, Chunk):
            size = _CHUNK_HEAD + len(record.compression.encode()) + len(record.data)
            self._stretches.append(Stretch(end - size, size))
        elif last and not last.is_chunk and last.size < _RUN_BYTES:
            self._stretches[-1] = last._replace(size=end - last.offset)
        else:
            self._stretches.append(Stretch(begin, end - begin, is_chunk=False))

    def _count(self) -> None:
        """Count the messages by reading them, and note the log times that they have."""
        for k, stretch in enumerate(self._stretches):
            log_ns = self._load(stretch, None).log_ns
            self.message_count += log_ns.size
            if log_ns.size:
                self._stretches[k] = stretch._replace(first_ns=int(log_ns.min()), last_ns=int(log_ns.max()))

    # Reading

    def _load(self, stretch: Stretch, number_of: Mapping[BagTopic, int] | None) -> MessageBatch:
        """The messages of a stretch in their stored order; of all topics, unnumbered, when none are named."""
        self._bytes_read += stretch.size
        self._file.seek(stretch.offset)
        if not stretch.is_chunk:
            return self._find_messages(self._file.read(stretch.size), number_of)[0]
        chunk_name = f"the chunk at byte {stretch.offset}"
        try:
            chunk = Chunk.read(ReadDataStream(self._file))
            data = unpack(chunk)
        except (*_DAMAGE, zstandard.ZstdError, RuntimeError) as error:
            if not stretch.is_cut:
                self.losses.add(f"{chunk_name} is damaged ({str(error) or 'it ends early'}).")
            return MessageBatch.of([])
        size = chunk.uncompressed_size
        if len(data) > size:
            self.losses.add(f"{chunk_name} holds more than its {size} bytes.")
            data = data[:size]
        elif len(data) < size and not stretch.is_cut:
            self.losses.add(f"{chunk_name} holds {len(data)} of {size} bytes.")
        elif chunk.uncompressed_crc not in {0, zlib.crc32(data)} and not stretch.is_cut:
            self.losses.add(f"{chunk_name} is damaged, its checksum is wrong.")
            return MessageBatch.of([])
        messages, end = self._find_messages(data, number_of)
        if end != len(data) and not stretch.is_cut:
            self.losses.add(f"{chunk_name} is damaged behind its byte {end}.")
        return messages

    def _find_messages(
        self, data: bytes, number_of: Mapping[BagTopic, int] | None
    ) -> tuple[MessageBatch, int]:
        """The messages of unpacked records, and the offset after the last whole record."""
        numbers, offset, size = self._numbers(number_of), 0, len(data)
        rows: list[tuple[int, int, int, int]] = []
        while offset + _RECORD.size <= size:
            opcode, length = _RECORD.unpack_from(data, offset)
            begin, end = offset + _RECORD.size, offset + _RECORD.size + length
            if end > size or opcode == 0 or (opcode == _IS_MESSAGE and length < _MESSAGE.size):
                break
            offset = end
            if opcode == _IS_MESSAGE:
                channel, log_ns = _MESSAGE.unpack_from(data, begin)
                number = numbers.get(channel, "unknown")
                if log_ns > MAX_LOG_NS and number != "unknown":
                    self._skipped["untimed"] += 1
                elif isinstance(number, str):
                    self._skipped[number] += 1
                else:
                    rows.append((number, log_ns, begin + _MESSAGE.size, length - _MESSAGE.size))
            elif opcode in _DEFINITIONS:
                try:
                    self._define(_DEFINITIONS[opcode].read(ReadDataStream(BytesIO(data[begin:end]))))
                except _DAMAGE:
                    self.losses.add("a damaged record that names a topic was skipped.")
                numbers = self._numbers(number_of)
        columns = np.array(rows, dtype=np.int64).reshape(-1, 4).T.copy()
        return MessageBatch(np.frombuffer(data, dtype=np.uint8), *columns), offset

    def _numbers(self, number_of: Mapping[BagTopic, int] | None) -> dict[int, int | str]:
        """Channel -> number of its topic, or "others" if that is not asked for."""
        return {
            channel: 0 if number_of is None else number_of.get(topic, "others")
            for channel, topic in self._channels.items()
        }

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


def unpack(chunk: Chunk) -> bytes:
    """The records of a chunk, one byte more than it should hold at most; of one cut off, what can be had.

    The library would unpack whatever the content says, however large.

    Raises:
        ValueError, RuntimeError, zstandard.ZstdError: It is damaged.
    """
    size = chunk.uncompressed_size
    if chunk.compression == "":
        return chunk.data
    if size > MAX_CHUNK:
        raise ValueError(f"it should unpack to {size} bytes")
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
    if chunk.compression != "zstd":
        raise ValueError(f"its compression {chunk.compression!r} is not known")
    with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
        return reader.read(size + 1)


def _take_before(following: Stretch | None, waiting: dict[int, MessageBatch]) -> MessageBatch:
    """Take what comes before the following stretch out of the loaded ones; equal times in recorded order."""
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
