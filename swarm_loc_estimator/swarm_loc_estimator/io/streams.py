"""The messages of one topic, one after the other, read as fast as Python can.

Frame names and byte order hardly ever change from message to message. So they are compared with those of the
message before, and only the numbers are read; a message that differs takes the complete reader of `io.cdr`.
That is 1 us instead of 25 us, which decides how many robots one process can listen to.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.io.cdr import (
    DETECTION_DTYPE,
    DETECTION_GAP,
    ENCAPSULATION,
    decode_detections,
    decode_odometry,
)

Pose2 = tuple[float, float, float]

_LITTLE_ENDIAN = b"\x00\x01"
_NANOSECONDS = 1_000_000_000
_STAMP = struct.Struct("<iI")
_COUNT = struct.Struct("<I")
_POSE = struct.Struct("<7d")
_NAMES = ENCAPSULATION + 8
"""Offset of the first frame name's length, behind the stamp."""
_DETECTION_SIZE = DETECTION_DTYPE.itemsize
_MAX_PADDING = 7


@dataclass(frozen=True)
class _Alike:
    """What messages have in common that only differ in stamp and numbers.

    Attributes:
        first: Their first two bytes.
        names: Their bytes from `_NAMES` to `end`.
        end: Offset behind the frame names.
        start: Offset of the numbers.
        size: Length of the message; -1 where it varies, or none has come.
    """

    first: bytes
    names: bytes
    end: int
    start: int
    size: int = -1


_NONE = _Alike(b"", b"", 0, 0)


class OdometryStream:
    """Reads nav_msgs/Odometry.

    Attributes:
        frame_id: Frame of the newest pose, "" before the first message.
    """

    def __init__(self) -> None:
        self.frame_id = ""
        self._alike = _NONE

    def read(self, data: bytes) -> tuple[int, Pose2]:
        """The stamp [ns] and the pose x [m], y [m], yaw [rad] in the robot's odom frame.

        Raises:
            CdrError: The bytes are not one whole message.
        """
        alike = self._alike
        if len(data) == alike.size and data[_NAMES : alike.end] == alike.names and data[:2] == alike.first:
            sec, nanosec = _STAMP.unpack_from(data, ENCAPSULATION)
            if nanosec < _NANOSECONDS:
                x, y, _, qx, qy, qz, qw = _POSE.unpack_from(data, alike.start)
                sine, cosine = 2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz
                yaw = math.atan2(sine, cosine) if sine or cosine else math.nan
                return sec * _NANOSECONDS + nanosec, (x, y, yaw)
        message = decode_odometry(data)
        self.frame_id = message.frame_id
        self._alike = _NONE
        if data[:2] == _LITTLE_ENDIAN:
            end = _behind_string(data, _behind_string(data, _NAMES))
            start = end + -(end - ENCAPSULATION) % 8
            self._alike = _Alike(_LITTLE_ENDIAN, bytes(data[_NAMES:end]), end, start, len(data))
        return message.stamp_ns, message.pose


class DetectionStream:
    """Reads swarm_loc_msgs/MarkerDetectionArray.

    Attributes:
        frame_id: Frame of the newest detections, "" before the first message.
    """

    def __init__(self) -> None:
        self.frame_id = ""
        self._alike = _NONE

    def read(self, data: bytes) -> tuple[int, NDArray[np.void]]:
        """The stamp [ns] and (d,) detections of `DETECTION_DTYPE`.

        Raises:
            CdrError: The bytes are not one whole message.
        """
        alike = self._alike
        start = alike.start
        if len(data) >= start > 0 and data[_NAMES : alike.end] == alike.names and data[:2] == alike.first:
            sec, nanosec = _STAMP.unpack_from(data, ENCAPSULATION)
            (count,) = _COUNT.unpack_from(data, start - 4)
            gap = 4 if count and start % 8 == ENCAPSULATION else 0
            end = start + count * _DETECTION_SIZE + gap
            if nanosec < _NANOSECONDS and end <= len(data) <= end + _MAX_PADDING:
                packed = (
                    data[start : start + DETECTION_GAP] + data[start + DETECTION_GAP + 4 :] if gap else data
                )
                found = np.frombuffer(packed, DETECTION_DTYPE, count, 0 if gap else start)
                return sec * _NANOSECONDS + nanosec, found
        message = decode_detections(data)
        self.frame_id = message.frame_id
        self._alike = _NONE
        if data[:2] == _LITTLE_ENDIAN:
            end = _behind_string(data, _NAMES)
            self._alike = _Alike(_LITTLE_ENDIAN, bytes(data[_NAMES:end]), end, end + -end % 4 + 4)
        return message.stamp_ns, message.detections


def _behind_string(data: bytes, offset: int) -> int:
    """Offset behind the string field at or after `offset`, in bytes that are known to be whole."""
    offset += -offset % 4
    (length,) = _COUNT.unpack_from(data, offset)
    return offset + 4 + int(length)
