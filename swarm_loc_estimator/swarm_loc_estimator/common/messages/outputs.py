"""Serialize what the estimator publishes: the numbers are written into a message laid out once.

Building and serializing message objects costs 20 us and more per robot and message; this is a few.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr_writer import (
    STAMP_SIZE,
    Bytes,
    CdrWriter,
    double_bytes,
    stamp_bytes,
)
from swarm_loc_estimator.common.messages.planar import POSE_DOUBLES, position_and_quaternion


def _places(offsets: list[int], size: int) -> NDArray[np.intp]:
    """Indices (n, size) of the bytes from each offset on."""
    return np.array(offsets, dtype=np.intp).reshape(-1, 1) + np.arange(size)


def _laid_out(writer: CdrWriter) -> Bytes:
    """The message, whose numbers may be written."""
    return np.frombuffer(bytearray(writer.message()), dtype=np.uint8)


class SwarmPosesEncoder:
    """Serializes swarm_loc_msgs/SwarmPoses.

    Args:
        names: The robots'.
        frame_id: Frame of the poses.
    """

    def __init__(self, names: list[str], frame_id: str) -> None:
        writer = CdrWriter()
        self._stamp = _places([writer.stamp()], STAMP_SIZE)
        writer.text(frame_id)
        writer.count(len(names))
        numbers, status = [], []
        for name in names:
            writer.text(name)
            numbers.append(writer.doubles(3 + 9 + 1))
            status.append(writer.raw(1, bytes(1)))
        self._message = _laid_out(writer)
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
        message[self._stamp] = stamp_bytes(np.array([stamp_ns]))
        flat = np.column_stack([poses, covariances.reshape(-1, 9), fix_age_s])
        message[self._numbers] = double_bytes(flat)
        message[self._status] = status
        return message.tobytes()


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
        message[self._stamps] = stamp_bytes(np.array([stamp_ns]))
        message[self._numbers] = double_bytes(position_and_quaternion(transforms[chosen]))
        return message.tobytes()

    def _lay_out(self, chosen: NDArray[np.bool_]) -> None:
        writer = CdrWriter()
        writer.count(int(chosen.sum()))
        stamps, numbers = [], []
        for index in np.flatnonzero(chosen):
            stamps.append(writer.stamp())
            writer.text(self._frame_id)
            writer.text(self._children[index])
            numbers.append(writer.doubles(POSE_DOUBLES))
        self._chosen, self._message = chosen.copy(), _laid_out(writer)
        self._stamps, self._numbers = _places(stamps, STAMP_SIZE), _places(numbers, 8 * POSE_DOUBLES)
