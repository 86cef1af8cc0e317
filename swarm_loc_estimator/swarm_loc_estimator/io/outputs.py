"""What the estimator publishes, as ready bytes: the numbers are written into a serialized message at once.

Building and serializing message objects costs 20 us and more per robot and message; this is a few. The layout
is that of plain little-endian CDR, which every DDS reader accepts.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.io.planar import PLANE, POSE_DOUBLES, planar_covariance, position_and_quaternion

_ENCAPSULATION = b"\x00\x01\x00\x00"
_NANOSECONDS = 1_000_000_000
_STAMP_SIZE = 8
_COVARIANCE = POSE_DOUBLES + np.arange(36).reshape(6, 6)[PLANE].ravel()
"""Where a planar covariance stands behind a pose."""

Bytes = NDArray[np.uint8]


class _Writer:
    """A message with zeros for numbers, and where these are."""

    def __init__(self) -> None:
        self._data = bytearray(_ENCAPSULATION)

    def stamp(self) -> int:
        """Add a builtin_interfaces/Time; its offset."""
        return self._room(4, _STAMP_SIZE)

    def text(self, value: str) -> None:
        """Add a string."""
        raw = value.encode() + b"\x00"
        self.count(len(raw))
        self._data += raw

    def count(self, value: int) -> None:
        """Add a uint32, such as the length of a sequence."""
        offset = self._room(4, 4)
        struct.pack_into("<I", self._data, offset, value)

    def doubles(self, count: int) -> int:
        """Add so many float64; the offset of the first."""
        return self._room(8, 8 * count)

    def byte(self) -> int:
        """Add a uint8; its offset."""
        return self._room(1, 1)

    def finish(self) -> Bytes:
        """The message."""
        return np.array(self._data, dtype=np.uint8)

    def _room(self, alignment: int, size: int) -> int:
        self._data += bytes(-(len(self._data) - len(_ENCAPSULATION)) % alignment)
        offset = len(self._data)
        self._data += bytes(size)
        return offset


def _stamp_bytes(stamp_ns: int) -> Bytes:
    sec, nanosec = divmod(stamp_ns, _NANOSECONDS)
    raw: Bytes = np.frombuffer(struct.pack("<iI", sec, nanosec), np.uint8)
    return raw


def _places(offsets: list[int], size: int) -> NDArray[np.intp]:
    """Indices (n, size) of the bytes from each offset on."""
    return np.array(offsets, dtype=np.intp).reshape(-1, 1) + np.arange(size)


def _as_bytes(values: FloatArray) -> Bytes:
    """(n, 8 k) the bytes of (n, k) numbers."""
    raw: Bytes = np.ascontiguousarray(values, dtype="<f8").view(np.uint8)
    return raw


class SwarmPosesEncoder:
    """Serializes swarm_loc_msgs/SwarmPoses.

    Args:
        names: The robots'.
        frame_id: Frame of the poses.
    """

    def __init__(self, names: list[str], frame_id: str) -> None:
        writer = _Writer()
        self._stamp = writer.stamp()
        writer.text(frame_id)
        writer.count(len(names))
        numbers, status = [], []
        for name in names:
            writer.text(name)
            numbers.append(writer.doubles(3 + 9 + 1))
            status.append(writer.byte())
        self._message = writer.finish()
        self._numbers = _places(numbers, 8 * 13)
        self._status = np.array(status, dtype=np.intp)

    def encode(
        self,
        stamp_ns: int,
        poses: FloatArray,
        covariances: FloatArray,
        fix_age_s: FloatArray,
        status: NDArray[np.uint8],
    ) -> bytes:
        """The message for poses (N, 3), covariances (N, 3, 3), ages (N,) and status (N,)."""
        message = self._message
        message[self._stamp : self._stamp + _STAMP_SIZE] = _stamp_bytes(stamp_ns)
        flat = np.column_stack([poses, covariances.reshape(-1, 9), fix_age_s])
        message[self._numbers] = _as_bytes(flat)
        message[self._status] = status
        return message.tobytes()


class PoseEncoder:
    """Serializes geometry_msgs/PoseWithCovarianceStamped, one per robot.

    Args:
        frame_id: Frame of the poses.
    """

    def __init__(self, frame_id: str) -> None:
        writer = _Writer()
        self._stamp = writer.stamp()
        writer.text(frame_id)
        self._start = writer.doubles(POSE_DOUBLES + 36)
        self._message = writer.finish()
        self._plane = planar_covariance(0.0, 0.0, 0.0).reshape(36)

    def encode(self, stamp_ns: int, poses: FloatArray, covariances: FloatArray) -> list[bytes]:
        """N messages for poses (N, 3) with covariances (N, 3, 3) of x, y, theta."""
        self._message[self._stamp : self._stamp + _STAMP_SIZE] = _stamp_bytes(stamp_ns)
        rows = np.tile(self._message, (len(poses), 1))
        numbers = np.zeros((len(poses), POSE_DOUBLES + 36))
        numbers[:, :POSE_DOUBLES] = position_and_quaternion(poses)
        numbers[:, POSE_DOUBLES:] = self._plane
        numbers[:, _COVARIANCE] = covariances.reshape(-1, 9)
        rows[:, self._start :] = _as_bytes(numbers)
        length, joined = rows.shape[1], rows.tobytes()
        return [joined[begin : begin + length] for begin in range(0, len(joined), length)]


class TransformsEncoder:
    """Serializes tf2_msgs/TFMessage from one frame to those of some robots.

    Args:
        frame_id: The parent.
        children: All robots' child frames.
    """

    def __init__(self, frame_id: str, children: list[str]) -> None:
        self._frame_id = frame_id
        self._children = children
        self._chosen = np.zeros(0, dtype=bool)
        self._message: Bytes = np.zeros(0, dtype=np.uint8)
        self._stamps = self._numbers = _places([], 0)

    def encode(self, stamp_ns: int, chosen: NDArray[np.bool_], transforms: FloatArray) -> bytes:
        """The message for those robots that are `chosen` (N,) among transforms (N, 3)."""
        if not np.array_equal(chosen, self._chosen):
            self._lay_out(chosen)
        message = self._message
        message[self._stamps] = _stamp_bytes(stamp_ns)
        message[self._numbers] = _as_bytes(position_and_quaternion(transforms[chosen]))
        return message.tobytes()

    def _lay_out(self, chosen: NDArray[np.bool_]) -> None:
        writer = _Writer()
        writer.count(int(chosen.sum()))
        stamps, numbers = [], []
        for index in np.flatnonzero(chosen):
            stamps.append(writer.stamp())
            writer.text(self._frame_id)
            writer.text(self._children[index])
            numbers.append(writer.doubles(POSE_DOUBLES))
        self._chosen, self._message = chosen.copy(), writer.finish()
        self._stamps, self._numbers = _places(stamps, _STAMP_SIZE), _places(numbers, 8 * POSE_DOUBLES)
