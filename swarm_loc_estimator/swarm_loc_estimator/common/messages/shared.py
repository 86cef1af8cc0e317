"""Messages that carry what many robots have sent: columns of equal length, read without a loop."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import (
    ENCAPSULATION,
    CdrError,
    Layout,
    check_end,
    layout_of,
    read_detections,
    read_header,
)
from swarm_loc_estimator.common.messages.cdr_writer import CdrWriter, stamp_bytes
from swarm_loc_estimator.common.messages.encoders import add_detections

_NANOSECONDS = 1_000_000_000


class SharedMessage(NamedTuple):
    """Readings (n,) of many robots.

    Attributes:
        stamp_ns: When the message was sent.
        frame_id: Frame of all readings.
        swarm: Which swarm's indices these are, see `swarm_key`.
        robot: (n,) indices as sent.
        reading_ns: (n,) when each was acquired; -1 where the stamp has a second and more of nanoseconds.
        columns: (n, k) numbers of each, or (n,) detections.
    """

    stamp_ns: int
    frame_id: str
    swarm: int
    robot: IntArray
    reading_ns: IntArray
    columns: tuple[NDArray[Any], ...]


def swarm_key(names: Iterable[str]) -> int:
    """The number that tells swarms apart whose robots are not the same, or not in the same order."""
    return zlib.crc32("".join(f"{name}\n" for name in names).encode())


@dataclass
class _Cursor:
    """Where in a message to read on."""

    data: bytes
    layout: Layout
    offset: int

    def count(self) -> int:
        """A uint32."""
        self.offset += -self.offset % 4
        if self.offset + 4 > len(self.data):
            raise CdrError(f"cut off after {len(self.data)} bytes.")
        (value,) = self.layout.count.unpack_from(self.data, self.offset)
        self.offset += 4
        return int(value)

    def sequence(self, kind: str, n: int | None = None) -> NDArray[Any]:
        """A sequence of numbers; where its length `n` is known, that must be it."""
        dtype = np.dtype(kind).newbyteorder(self.layout.double.byteorder)
        count = self.count()
        if n is not None and count != n:
            raise CdrError(f"a column has {count} numbers in place of {n}.")
        if count:
            self.offset += -(self.offset - ENCAPSULATION) % dtype.itemsize
        end = self.offset + count * dtype.itemsize
        if end > len(self.data):
            raise CdrError(f"cut off after {len(self.data)} bytes.")
        numbers = np.frombuffer(self.data, dtype, count, self.offset)
        self.offset = end
        return numbers


def decode_shared_numbers(data: bytes, widths: tuple[int, ...]) -> SharedMessage:
    """Read a swarm_loc_msgs/SwarmOdometry or SwarmFixes.

    Args:
        data: The serialized message.
        widths: How many numbers a reading has in each column.

    Raises:
        CdrError: The bytes are not one whole message, or its columns differ in length.
    """
    message, cursor = _begin(data)
    n = message.robot.size
    columns = tuple(cursor.sequence("f8", n * width).reshape(n, width).astype(np.float64) for width in widths)
    check_end(data, cursor.offset)
    return message._replace(columns=columns)


def decode_shared_detections(data: bytes) -> SharedMessage:
    """Read a swarm_loc_msgs/SwarmDetections.

    Raises:
        CdrError: The bytes are not one whole message, or its columns differ in length.
    """
    message, cursor = _begin(data)
    count = cursor.count()
    if count != message.robot.size:
        raise CdrError(f"a column has {count} detections in place of {message.robot.size}.")
    return message._replace(columns=(read_detections(data, cursor.layout, cursor.offset, count),))


def _begin(data: bytes) -> tuple[SharedMessage, _Cursor]:
    """What all of them begin with."""
    layout = layout_of(data)
    stamp_ns, frame_id, offset = read_header(data, layout)
    cursor = _Cursor(data, layout, offset)
    swarm = cursor.count()
    robot = cursor.sequence("u4").astype(np.int64)
    seconds = _times(cursor, robot.size)
    nanoseconds = seconds[:, 1].view(np.uint32).astype(np.int64)
    reading_ns = seconds[:, 0].astype(np.int64) * _NANOSECONDS + nanoseconds
    reading_ns[nanoseconds >= _NANOSECONDS] = -1
    return SharedMessage(stamp_ns, frame_id, swarm, robot, reading_ns, ()), cursor


def _times(cursor: _Cursor, n: int) -> NDArray[np.int32]:
    """A sequence of builtin_interfaces/Time as (n, 2) numbers in the machine's order of bytes."""
    if cursor.count() != n:
        raise CdrError("there are not as many stamps as robots.")
    end = cursor.offset + 8 * n
    if end > len(cursor.data):
        raise CdrError(f"cut off after {len(cursor.data)} bytes.")
    times = np.frombuffer(cursor.data, cursor.layout.reading, 2 * n, cursor.offset).astype(np.int32)
    cursor.offset = end
    return times.reshape(n, 2)


class SharedHead(NamedTuple):
    """What all messages to encode begin with; see `SharedMessage`."""

    stamp_ns: int
    frame_id: str
    swarm: int
    robot: IntArray
    reading_ns: IntArray


def encode_shared_numbers(head: SharedHead, *columns: FloatArray) -> bytes:
    """Serialize a SwarmOdometry from poses (n, 3), or SwarmFixes from these and covariances (n, 9)."""
    writer = _written(head)
    for column in columns:
        writer.count(column.size)
        if column.size:
            writer.raw(8, np.ascontiguousarray(column, dtype="<f8").tobytes())
    return writer.message()


def encode_shared_detections(head: SharedHead, detections: NDArray[np.void]) -> bytes:
    """Serialize a SwarmDetections from (n,) detections of `DETECTION_DTYPE`."""
    writer = _written(head)
    add_detections(writer, detections)
    return writer.message()


def _written(head: SharedHead) -> CdrWriter:
    writer = CdrWriter.with_header(head.frame_id, head.stamp_ns)
    writer.count(head.swarm)
    writer.count(head.robot.size)
    writer.raw(4, head.robot.astype("<u4").tobytes())
    writer.count(head.reading_ns.size)
    writer.raw(4, stamp_bytes(head.reading_ns).tobytes())
    return writer
