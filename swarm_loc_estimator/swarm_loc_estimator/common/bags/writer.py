"""Writing bags: rosbag2 folders with MCAP inside, as `ros2 bag record` leaves them.

Equal input gives equal bytes, so that a bag can be compared and kept in version control. The library
`rosbags` writes the folder, `mcap` the file inside: chunks with checksums, channels with their types' hashes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from typing_extensions import Self

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.bags.bag_file import BagError
from swarm_loc_estimator.common.files import naming, temporary_folder
from swarm_loc_estimator.common.messages.cdr import EVENT_PACKETS, FOREIGN, MESSAGE_PACKAGE, message_folder

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2.writer import StorageWriter
    from rosbags.typesys.store import Typestore

_FOREVER = QosTime(sec=9223372036, nsec=854775807)
RELIABLE = Qos(
    history=QosHistory.KEEP_LAST,
    depth=10,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.VOLATILE,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)
"""Odometry, detections and estimates: reliable, small depth."""
LATCHED = RELIABLE._replace(depth=1, durability=QosDurability.TRANSIENT_LOCAL)
"""A map: who subscribes later gets the newest."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """The types of ROS 2 Jazzy and of this workspace; raises DefinitionsNotFoundError without the latter."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for path in sorted(message_folder().glob("*.msg")):
        name = f"{MESSAGE_PACKAGE}/msg/{path.stem}"
        types.update(get_types_from_msg(path.read_text(encoding="utf-8"), name))
    for line in FOREIGN.split("\n")[1:-1]:
        name, _, fields = line.partition(": ")
        types.update(get_types_from_msg(fields.replace(", ", "\n"), name.replace("/", "/msg/")))
    types[EVENT_PACKETS[0]] = types[EVENT_PACKETS[1]]
    store.register(types)
    return store


class _McapStorage:
    """The file inside the folder: a storage plug-in of rosbags."""

    def __init__(self, folder: Path, compression: CompressionMode) -> None:
        self.path = folder / f"{folder.name}.mcap"
        self._file = self.path.open("xb")
        packed = CompressionType.ZSTD if compression == CompressionMode.STORAGE else CompressionType.NONE
        self._writer = McapWriter(self._file, compression=packed)
        self._writer.start("ros2", "swarm_loc_estimator")
        self._schemas: dict[str, int] = {}
        self._channels: dict[int, int] = {}

    def add_msgtype(self, connection: Connection) -> None:
        schema = self._writer.register_schema(connection.msgtype, "ros2msg", connection.msgdef.data.encode())
        self._schemas[connection.msgtype] = schema

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        metadata = {"offered_qos_profiles": offered_qos_profiles, "topic_type_hash": connection.digest}
        schema = self._schemas[connection.msgtype]
        number = self._writer.register_channel(connection.topic, "cdr", schema, metadata)
        self._channels[connection.id] = number

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        self._writer.add_message(self._channels[connection.id], timestamp, bytes(data), timestamp)

    def close(self, version: int, metadata: str) -> None:
        del version
        with self._file:
            self._writer.add_metadata("rosbag2", {"serialized_metadata": metadata})
            self._writer.finish()  # type: ignore[no-untyped-call]

    def abort(self) -> None:
        self._file.close()


class _Rosbag2Writer(Writer):
    """A writer of folders with such a file."""

    STORAGE_PLUGINS: Mapping[StoragePlugin, type[StorageWriter]] = {StoragePlugin.MCAP: _McapStorage}


class BagWriter:
    """A new bag, as a context manager, after whose end without an error it is there.

    With `compress`, chunks are compressed with zstd. Other files of it go to `folder` before the end.

    Raises:
        BagError: The folder is there already, or cannot be created.
        FileError: It cannot be written, later.
    """

    def __init__(self, path: Path, *, compress: bool = False) -> None:
        self._path = path
        self._connections: dict[str, Connection] = {}
        if os.path.lexists(path):
            raise BagError(f"The bag '{path}' cannot be created: it exists already.")
        with ExitStack() as stack:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self.folder = stack.enter_context(temporary_folder(parent=path.parent)) / path.name
                self._writer = _Rosbag2Writer(self.folder, version=9, storage_plugin=StoragePlugin.MCAP)
                if compress:
                    self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
                self._writer.open()
            except (WriterError, OSError) as error:
                raise BagError(f"The bag '{path}' cannot be created: {error}") from error
            self._stack = stack.pop_all()

    def add_topic(self, name: str, message_type: str, *, is_latched: bool = False) -> None:
        """Announce a topic, such as robot1/odom; of a latched one late subscribers get the newest message."""
        topic = "/" + name.lstrip("/")
        self._connections[name] = self._writer.add_connection(
            topic,
            message_type,
            typestore=typestore(),
            offered_qos_profiles=[LATCHED if is_latched else RELIABLE],
        )

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Add a serialized message of an announced topic."""
        with naming(self._path):
            self._writer.write(self._connections[topic], log_ns, data)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        with self._stack, naming(self._path):
            if kind is None:
                self._writer.close()
                self.folder.rename(self._path)
            else:
                self._writer.abort()


class Stream(NamedTuple):
    """The messages of one topic with their log times."""

    topic: str
    type: str
    log_ns: IntArray
    data: list[bytes]


_REPORT_EVERY = 5000


def write_streams(
    folder: Path,
    streams: Sequence[Stream],
    progress: Callable[[float], None] = lambda _: None,
    add: Callable[[Path], object] = lambda _: None,
) -> int:
    """Write messages as a new, compressed bag by log time, equal times in the order of the streams.

    `progress` is called now and then with the share done, `add` with the folder for other files. Returns the
    number of messages. Raises BagError if the folder is there already, or cannot be created.
    """
    log_ns = np.concatenate([stream.log_ns for stream in streams])
    owner = np.repeat(np.arange(len(streams)), [len(stream.data) for stream in streams])
    place = np.concatenate([np.arange(len(stream.data)) for stream in streams])
    order = np.argsort(log_ns, kind="stable")
    columns = (column[order].tolist() for column in (log_ns, owner, place))
    with BagWriter(folder, compress=True) as bag:
        with naming(folder):
            add(bag.folder)
        for stream in streams:
            bag.add_topic(stream.topic, stream.type)
        for done, (at_ns, which, one) in enumerate(zip(*columns, strict=True)):
            bag.write(streams[which].topic, at_ns, streams[which].data[one])
            if done % _REPORT_EVERY == 0:
                progress(done / len(order))
    return len(order)
