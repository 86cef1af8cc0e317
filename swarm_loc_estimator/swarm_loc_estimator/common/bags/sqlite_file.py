"""sqlite3 bag files, whole or damaged, in order of log time.

The readable part of a damaged file is copied to a temporary one first, so that there is one way of reading
and memory does not grow with the bag. `rosbags` refuses such files, and does not look into a journal that a
crash has left; whole files it reads in 1.3 us a message, this reader in 1.5 us (`make bench-reading`,
odometry).
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import quote

from swarm_loc_estimator.common.bags.bag_file import MAX_LOG_NS, BagError, BagTopic, ReadErrors
from swarm_loc_estimator.common.files import temporary_folder
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage

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
            raise BagError(
                f"{path} is empty." if path.is_file() else f"{path} cannot be opened: no such file."
            )
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
        self._topics = {
            number: BagTopic(str(name).lstrip("/"), str(kind), str(encoding))
            for number, name, kind, encoding in rows
        }
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
        """Copy what can be read to a new file and open that."""
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
        self.losses.add(
            f"the database is damaged ({error}): {self.message_count} messages were kept, the rest is lost."
        )


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
    next_id, step, last = 0, 1, _last_id(source)
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


def _last_id(source: sqlite3.Connection) -> int:
    """The last message's id; what a damaged page claims to be beyond it is no message."""
    try:
        (last,) = source.execute("SELECT max(id) FROM messages").fetchone()
    except sqlite3.Error:
        return _MAX_ID
    return int(last) if isinstance(last, int) else 0
