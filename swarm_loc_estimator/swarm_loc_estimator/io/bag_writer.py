"""Writing bags: rosbag2 directories with MCAP inside, as `ros2 bag record` leaves them.

Equal input gives equal bytes, so that a bag can be compared and kept in version control.
"""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from typing_extensions import Self

from swarm_loc_estimator.io.bag_file import BagError
from swarm_loc_estimator.io.typestore import typestore

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from rosbags.interfaces import Connection

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


class BagWriter:
    """A new bag; use it as a context manager, an error inside leaves no bag behind.

    Args:
        path: Folder to create; must not exist.
        compress: Whether chunks are compressed with zstd.

    Raises:
        BagError: The folder is there already, or cannot be created.
    """

    def __init__(self, path: Path, *, compress: bool = False) -> None:
        self._path = path
        self._connections: dict[str, Connection] = {}
        try:
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
            if compress:
                self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise BagError(f"The bag '{path}' cannot be created: {error}") from error

    def add_topic(self, name: str, message_type: str) -> None:
        """Announce a topic, such as robot1/odom of nav_msgs/msg/Odometry.

        Names are written fully qualified, as a recorder writes them.
        """
        topic = "/" + name.lstrip("/")
        self._connections[name] = self._writer.add_connection(
            topic, message_type, typestore=typestore(), offered_qos_profiles=[RELIABLE]
        )

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Add a serialized message of an announced topic."""
        self._writer.write(self._connections[topic], log_ns, data)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._writer.close()
        else:
            self._writer.abort()
            shutil.rmtree(self._path, ignore_errors=True)
