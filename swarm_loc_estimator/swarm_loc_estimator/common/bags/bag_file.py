"""Bag files of both storages, whole or damaged, in order of log time.

MCAP: the library `mcap` reads the records: those of the summary if it agrees with the heads of all chunks,
else all from the first to where the file was cut off. Chunks are then loaded in order of time; only those
that overlap are in memory together. The messages of a chunk are found here, in 0.7 us each
(`make bench-reading`, odometry), where the library takes 5.7 us and `rosbags`, which refuses cut files,
1.8 us. A file without a whole summary is read once more when it is opened; messages outside chunks take 5 us
each then. Format: https://mcap.dev/spec

sqlite3: the readable part of a damaged file is copied to a temporary one first, so that there is one way of
reading and memory does not grow with the bag. `rosbags` refuses such files, and does not look into a journal
that a crash has left; whole files it reads in 1.3 us a message, this reader in 1.5 us.
"""

from __future__ import annotations

import shutil
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from io import BytesIO
from itertools import islice, zip_longest
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple
from urllib.parse import quote

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Footer, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import StreamReader

from swarm_loc_estimator.common.files import temporary_folder
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage, merged
from swarm_loc_estimator.common.parameters import UserError

RawMessage = tuple[str, str, int, bytes]  # Topic, type, log time [ns], serialized message

MAX_LOG_NS = 2**62  # Log times lie between 0 and here [ns], the year 2116: differences are numbers, too


class BagError(UserError):
    """A bag of which nothing can be read."""


class BagTopic(NamedTuple):
    """A topic of a bag."""

    name: str  # Such as robot1/odom
    type: str  # Such as nav_msgs/msg/Odometry
    encoding: str = "cdr"  # How its messages are serialized: cdr in ROS 2; "" if nothing is said


class ReadErrors(list[str]):
    """One sentence for each thing that could not be read of a file, each once however often it is read."""

    def __init__(self, file: str) -> None:
        super().__init__()
        self._file = file

    def add(self, sentence: str) -> None:
        """Add a sentence about the file."""
        sentence = f"{self._file}: {sentence}"
        if sentence not in self:
            self.append(sentence)


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
            # take what comes before the following stretch; equal times in recorded order
            ready = []
            for offset in sorted(waiting):
                batch = waiting.pop(offset)
                ends = batch.size
                if following is not None:
                    side: Literal["left", "right"] = "right" if offset < following.offset else "left"
                    ends = int(np.searchsorted(batch.log_ns, following.first_ns, side=side))
                ready.append(batch.chosen(slice(ends)))
                if ends < batch.size:
                    waiting[offset] = batch.chosen(slice(ends, None))
            yield merged(ready)
        # what was skipped
        unknown, untimed, found = self._skipped["unknown"], self._skipped["untimed"], self._skipped.total()
        if unknown:
            self.losses.add(f"{unknown} messages of no known topic were skipped.")
        if untimed:
            self.losses.add(f"{untimed} messages whose log time cannot be were skipped.")
        counted = self._statistics.message_count if self._statistics else count + found
        if not self.losses and count + found != counted:
            self.losses.add(f"it holds {count + found} messages, but its statistics count {counted}.")

    # Opening

    def _open(self) -> None:
        size = self._path.stat().st_size
        if self._file.read(len(MAGIC)) != MAGIC:
            raise BagError(f"{self._path} is empty." if size == 0 else f"{self._path} is no MCAP file.")
        if not self._read_summary():
            end = self._walk()
            # count the messages by reading them, and note the log times that they have
            for k, stretch in enumerate(self._stretches):
                log_ns = self._load(stretch, None).log_ns
                self.message_count += log_ns.size
                if log_ns.size:
                    first_ns, last_ns = int(log_ns.min()), int(log_ns.max())
                    self._stretches[k] = stretch._replace(first_ns=first_ns, last_ns=last_ns)
            if end is not None:
                kept = f"the {self.message_count} messages before that were kept"
                lost = "what was written behind them is lost"
                self.losses.add(f"it was cut off at byte {end} of {size}: {kept}, {lost}.")
        self._stretches.sort(key=lambda one: (one.first_ns, one.offset))

    def _read_summary(self) -> bool:
        """Take topics, chunks and the number of messages from the summary, if all chunks are as it says."""
        self._file.seek(0)
        stretches = []
        try:
            summary = SeekingReader(self._file).get_summary()
            if summary is None or summary.statistics is None:
                return False
            for one in summary.chunk_indexes:
                offset = one.chunk_start_offset + _RECORD.size
                times = one.message_start_time, one.message_end_time
                self._file.seek(offset)
                if _TIMES.unpack(self._file.read(_TIMES.size)) != times or times[1] > MAX_LOG_NS:
                    return False
                stretches.append(Stretch(offset, one.compressed_size, *times))
        except _DAMAGE:
            return False
        counts = summary.statistics
        is_complete = len(stretches) == counts.chunk_count and len(summary.channels) >= counts.channel_count
        if not is_complete or (not stretches and counts.message_count):
            return False
        for record in (*summary.schemas.values(), *summary.channels.values(), counts):
            self._define(record)
        self._stretches, self.message_count = stretches, counts.message_count
        return True

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
                last = self._stretches[-1] if self._stretches else None
                if isinstance(record, Chunk):
                    size = _CHUNK_HEAD + len(record.compression.encode()) + len(record.data)
                    self._stretches.append(Stretch(end - size, size))
                elif isinstance(record, Message) and last and not last.is_chunk and last.size < _RUN_BYTES:
                    self._stretches[-1] = last._replace(size=end - last.offset)
                elif isinstance(record, Message):
                    self._stretches.append(Stretch(begin, end - begin, is_chunk=False))
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

    # Reading

    def _load(self, stretch: Stretch, number_of: Mapping[BagTopic, int] | None) -> MessageBatch:
        """The messages of a stretch in their stored order; of all topics, unnumbered, when none are named."""
        self._bytes_read += stretch.size
        self._file.seek(stretch.offset)
        if not stretch.is_chunk:
            return self._messages(self._file.read(stretch.size), number_of)[0]
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
        messages, end = self._messages(data, number_of)
        if end != len(data) and not stretch.is_cut:
            self.losses.add(f"{chunk_name} is damaged behind its byte {end}.")
        return messages

    def _messages(self, data: bytes, number_of: Mapping[BagTopic, int] | None) -> tuple[MessageBatch, int]:
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
        topics = self._channels.items()
        return {key: 0 if number_of is None else number_of.get(topic, "others") for key, topic in topics}


def unpack(chunk: Chunk) -> bytes:
    """The records of a chunk, one byte more than it should hold at most; of one cut off, what can be had.

    The library would unpack whatever the content says, however large. Raises ValueError, RuntimeError or
    zstandard.ZstdError where it is damaged.
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


_BATCH = 500
_UNWANTED = -1
_MAX_ID = 2**63 - 1
_TIMED = f"WHERE typeof(timestamp) = 'integer' AND timestamp BETWEEN 0 AND {MAX_LOG_NS}"
_MESSAGES = f"SELECT topic_id, timestamp, data FROM messages {_TIMED} ORDER BY timestamp, id"  # noqa: S608
_VIEWS = """SELECT name FROM sqlite_master
WHERE type = 'view' AND lower(name) IN ('topics', 'messages')"""  # they may never end
_TOPICS = "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
_TABLES = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
"""


class SqliteFile:
    """One open sqlite3 bag file; its attributes are those of `McapFile`."""

    def __init__(self, path: Path) -> None:
        """Open it; raises BagError if it is no bag, or nothing of it can be read."""
        self._path = path
        self._rescue = ExitStack()
        self._done = 0
        self.losses = ReadErrors(path.name)
        self.message_count = 0
        self.time_range_ns = (0, 0)
        self._topics: dict[int, BagTopic] = {}
        if not path.is_file() or path.stat().st_size == 0:
            fault = "is empty" if path.is_file() else "cannot be opened: no such file"
            raise BagError(f"{path} {fault}.")
        self._connection = _connect(path)
        try:
            self._open()
        except sqlite3.Error as error:
            self._open_rescued(error)

    @property
    def topics(self) -> list[BagTopic]:
        """The topics, in the order of their ids."""
        return list(dict.fromkeys(self._topics.values()))

    @property
    def progress(self) -> float:
        """Share of the messages that were read."""
        return min(self._done / self.message_count, 1.0) if self.message_count else 1.0

    def close(self) -> None:
        """Close the file and forget what was rescued of it; may be called twice."""
        self._connection.close()
        self._rescue.close()

    def batches(self, number_of: Mapping[BagTopic, int]) -> Iterator[MessageBatch]:
        """The messages of some topics in order of log time, equal ones in order of recording."""
        self._done = skipped = 0
        numbers = {topic_id: number_of.get(topic, _UNWANTED) for topic_id, topic in self._topics.items()}
        cursor = self._connection.execute(_MESSAGES)
        while rows := cursor.fetchmany(_BATCH):
            self._done += len(rows)
            valid = [
                (numbers[topic_id], data, log_ns)
                for topic_id, log_ns, data in rows
                if topic_id in numbers and type(data) is bytes
            ]
            skipped += len(rows) - len(valid)
            yield MessageBatch.of([SerializedMessage(*row) for row in valid if row[0] != _UNWANTED])
        if skipped:
            self.losses.add(f"{skipped} messages without a known topic or data were skipped.")

    def _open(self) -> None:
        """Read topics, count and times; raises when a page is damaged, or a column's name."""
        rows = self._connection.execute(_TOPICS).fetchall()
        if self._connection.execute("PRAGMA integrity_check(1)").fetchone() != ("ok",):
            raise sqlite3.DatabaseError("database disk image is malformed")
        columns = ((number, str(name).lstrip("/"), str(kind), str(code)) for number, name, kind, code in rows)
        self._topics = {number: BagTopic(*topic) for number, *topic in columns}
        self._connection.execute(f"EXPLAIN {_MESSAGES}")
        (stored,) = self._connection.execute("SELECT count(*) FROM messages").fetchone()
        query = f"SELECT count(*), min(timestamp), max(timestamp) FROM messages {_TIMED}"  # noqa: S608
        self.message_count, first, last = self._connection.execute(query).fetchone()
        if stored > self.message_count:
            self.losses.add(f"{stored - self.message_count} messages whose log time cannot be were skipped.")
        self.time_range_ns = (first or 0, last or 0)

    def _leave_half_page(self, folder: Path) -> None:
        """Read only whole pages: sqlite would silently fill the last one of a cut off file with zeros."""
        with self._path.open("rb") as source:
            page = int.from_bytes(source.read(18)[16:], "big")
        size = self._path.stat().st_size
        if page < 512 or size % page == 0:
            return
        whole = folder / "whole_pages.db3"
        with self._path.open("rb") as source, whole.open("wb") as target:
            shutil.copyfileobj(source, target)
            target.truncate(size - size % page)
        self._connection.close()
        self._connection = _connect(whole)

    def _open_rescued(self, error: sqlite3.Error) -> None:
        folder = self._rescue.enter_context(temporary_folder("rescued_bag_"))
        self._leave_half_page(folder)
        rescued = sqlite3.connect(folder / "rescued.db3", isolation_level=None)
        try:
            rescued.executescript("PRAGMA journal_mode=OFF; PRAGMA synchronous=OFF;" + _TABLES)
            _copy_readable(self._connection, rescued)
            rescued.execute("CREATE INDEX by_time ON messages(timestamp)")
        except sqlite3.Error:
            rescued.close()
            self.close()
            raise BagError(f"{self._path} is no readable sqlite3 bag: {error}.") from error
        self._connection.close()
        self._connection = rescued
        self._open()
        kept = f"{self.message_count} messages were kept, the rest is lost"
        self.losses.add(f"the database is damaged ({error}): {kept}.")


def _connect(path: Path) -> sqlite3.Connection:
    """Open without ever writing; a database whose journal cannot be shared is read as it lies there."""
    name = f"file:{quote(str(path.resolve()))}"
    for mode in ("?mode=ro", "?immutable=1"):
        connection = sqlite3.connect(name + mode, uri=True, isolation_level=None)
        connection.text_factory = lambda data: data.decode(errors="replace")
        try:
            # a file shorter than its head says would otherwise be refused as a whole
            connection.execute("PRAGMA writable_schema=ON")
            views = connection.execute(_VIEWS).fetchone()
        except sqlite3.Error:
            connection.close()
            continue
        if not views:
            return connection
        connection.close()
        raise BagError(f"{path} is no sqlite3 bag: its {views[0]} are computed, not stored.")
    raise BagError(f"{path} is no sqlite3 bag.")


def _copy_readable(source: sqlite3.Connection, target: sqlite3.Connection) -> None:
    """Copy topics and messages; after damaged pages, up to an eighth as many as they had are lost as well."""
    target.execute("BEGIN")
    target.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", source.execute(_TOPICS).fetchall())
    try:  # what a damaged page claims to be beyond the last message is no message
        (found,) = source.execute("SELECT max(id) FROM messages").fetchone()
        last = int(found) if isinstance(found, int) else 0
    except sqlite3.Error:
        last = _MAX_ID
    next_id, step = 0, 1
    while next_id <= last:
        query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id >= ? ORDER BY id"
        try:
            for row in source.execute(query, (next_id,)):
                if not next_id <= row[0] <= last:
                    break
                next_id, step = row[0] + 1, 1
                if isinstance(row[2], int) and isinstance(row[3], bytes):
                    target.execute("INSERT INTO messages VALUES (?, ?, ?, ?)", row)
            else:
                break
        except sqlite3.Error:
            pass
        next_id += step
        step += 1 + step // 8
    target.execute("COMMIT")
