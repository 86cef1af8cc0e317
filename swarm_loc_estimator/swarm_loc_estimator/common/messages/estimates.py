"""Messages that the estimator publishes, swarm/poses and transforms, without a loop over robots.

Names hardly ever change from one message to the next: a message is laid out once, then only its numbers are
read or replaced. To read or build message objects would cost 20 us and more per robot and message.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.messages.cdr import ENCAPSULATION, SECOND_NS, CdrError, decode, encode
from swarm_loc_estimator.common.messages.definitions import SWARM_POSES, TRANSFORMS
from swarm_loc_estimator.common.messages.poses import (
    POSE_DOUBLES,
    STAMP_SIZE,
    position_and_quaternion,
    stamp_bytes,
)

_DOUBLES = 3 + 9 + 1  # Numbers of a robot in swarm/poses: pose, covariance and age of the fix
_STAMP = slice(ENCAPSULATION, ENCAPSULATION + STAMP_SIZE)


class EstimateMessage(NamedTuple):
    """One swarm/poses."""

    stamp_ns: int  # The instant
    frame_id: str  # Frame of the poses
    names: tuple[str, ...]  # N robots
    pose: FloatArray  # (N, 3) x [m], y [m], theta [rad]; NaN: not located
    covariance: FloatArray  # (N, 3, 3); NaN: not located
    fix_age_s: FloatArray  # (N,) [s]; -1: never
    status: NDArray[np.uint8]  # (N,) of `Status`


def _bytes_from(offsets: Sequence[int], size: int) -> NDArray[np.intp]:
    """Indices (n, size) of the bytes from each offset on."""
    return np.array(offsets, dtype=np.intp).reshape(-1, 1) + np.arange(size)


class _Layout:
    """Where the numbers stand in a SwarmPoses, as long as its other bytes are the same.

    Attributes:
        frame_id: Frame of the poses.
        names: N robots.
        numbers: (N, 104) indices of the bytes of each robot's numbers.
        status: (N,) indices of the status.
        others: (m,) indices of all bytes but these and the stamp.
        expected: (m,) these bytes.
    """

    def __init__(self, data: bytes) -> None:
        places: dict[str, list[int]] = {}
        message = decode(data, SWARM_POSES, places)
        self.frame_id: str = message.header.frame_id
        self.names = tuple(robot.name for robot in message.robots)
        self.numbers = _bytes_from(places.get("robots.x", []), 8 * _DOUBLES)
        self.status = np.array(places.get("robots.status", []), dtype=np.intp)
        is_other = np.ones(len(data), dtype=np.bool_)
        is_other[_STAMP] = is_other[self.numbers] = is_other[self.status] = False
        self.others = np.flatnonzero(is_other)
        self.expected = np.frombuffer(data, np.uint8)[self.others]


class SwarmPosesReader:
    """Reads serialized SwarmPoses."""

    def __init__(self) -> None:
        self._layout = _Layout(encode({}, SWARM_POSES))
        self._length = -1

    def read(self, data: bytes) -> EstimateMessage:
        """The columns of a message.

        Raises:
            CdrError: It is not a whole SwarmPoses of little-endian CDR.
        """
        raw, layout = np.frombuffer(data, dtype=np.uint8), self._layout
        if len(data) != self._length or not np.array_equal(raw[layout.others], layout.expected):
            if bytes(data[:2]) != b"\x00\x01":
                raise CdrError("the message is not plain little-endian CDR.")
            layout = self._layout = _Layout(data)
            self._length = len(data)
        seconds, rest_ns = struct.unpack_from("<iI", data, ENCAPSULATION)
        numbers = raw[layout.numbers].view("<f8").reshape(-1, _DOUBLES)
        return EstimateMessage(
            seconds * SECOND_NS + rest_ns,
            layout.frame_id,
            layout.names,
            numbers[:, :3],
            numbers[:, 3:12].reshape(-1, 3, 3),
            numbers[:, 12],
            raw[layout.status],
        )


class SwarmPosesEncoder:
    """Serializes swarm_loc_msgs/SwarmPoses.

    Args:
        names: The robots'.
        frame_id: Frame of the poses.
    """

    def __init__(self, names: list[str], frame_id: str) -> None:
        robots = [{"name": name} for name in names]
        message = encode({"header": {"frame_id": frame_id}, "robots": robots}, SWARM_POSES)
        self._layout = _Layout(message)
        self._message = np.frombuffer(bytearray(message), dtype=np.uint8)

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
        message[_STAMP] = stamp_bytes(np.array([stamp_ns]))
        numbers = np.column_stack([poses, covariances.reshape(-1, 9), fix_age_s])
        message[self._layout.numbers] = np.ascontiguousarray(numbers, "<f8").view(np.uint8)
        message[self._layout.status] = status
        return message.tobytes()


class TransformsEncoder:
    """Serializes tf2_msgs/TFMessage from one frame to those of some robots.

    Args:
        frame_id: The parent.
        children: All robots' child frames.
    """

    def __init__(self, frame_id: str, children: list[str]) -> None:
        self._header = {"frame_id": frame_id}
        self._children = children
        self._lay_out(np.zeros(len(children), dtype=np.bool_))

    def encode(self, stamp_ns: int, included: BoolArray, transforms: FloatArray) -> bytes:
        """The message for those robots that are `included` (N,) among transforms (N, 3)."""
        if not np.array_equal(included, self._included):
            self._lay_out(included)
        message, numbers = self._message, position_and_quaternion(transforms[included])
        message[self._stamps] = stamp_bytes(np.array([stamp_ns]))
        message[self._numbers] = np.ascontiguousarray(numbers, "<f8").view(np.uint8)
        return message.tobytes()

    def _lay_out(self, included: BoolArray) -> None:
        children = [self._children[index] for index in np.flatnonzero(included)]
        transforms = [{"header": self._header, "child_frame_id": child} for child in children]
        message = encode({"transforms": transforms}, TRANSFORMS)
        places: dict[str, list[int]] = {}
        decode(message, TRANSFORMS, places)
        self._included = included.copy()
        self._message = np.frombuffer(bytearray(message), dtype=np.uint8)
        self._stamps = _bytes_from(places.get("transforms.header.stamp.sec", []), STAMP_SIZE)
        self._numbers = _bytes_from(places.get("transforms.transform.translation.x", []), 8 * POSE_DOUBLES)
