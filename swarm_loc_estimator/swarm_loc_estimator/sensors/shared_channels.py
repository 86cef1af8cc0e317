"""Decode messages that carry what many robots have sent; one bad reading does not take the others with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Generic, TypeVar

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.messages.cdr import CdrError
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    SharedMessage,
    decode_shared_detections,
    decode_shared_numbers,
)
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.sensors.channels import FOREIGN_FRAME, CreateChannel, Known, Read, has_heading
from swarm_loc_estimator.sensors.messages import (
    NO_DETECTIONS,
    NO_FIXES,
    NO_ODOMETRY,
    DetectionRows,
    FixRows,
    OdometryRows,
    chosen,
    joined,
)
from swarm_loc_estimator.sensors.topics import InputKind

MAX_READINGS = 100_000
"""A message with more readings is dropped whole: no swarm sends so many at once."""
MAX_OF_ONE = 1_000
"""Likewise one with more of the same robot: as many as of its own topic wait for a tick."""
TOO_MANY = "shared_too_many"
"""Why."""
OTHER_SWARM = "other_swarm"
"""Why readings are dropped whose sender has robots other than these, or in another order."""
UNKNOWN_ROBOT = "unknown_robot"
"""Why a reading is dropped whose index is no robot's."""
BAD_STAMP = "bad_stamp"
"""Why one is whose stamp has a second and more of nanoseconds."""

Rows = TypeVar("Rows", OdometryRows, DetectionRows, FixRows)


class _SharedChannel(Generic[Rows]):
    """Readings of many robots in each message.

    Args:
        topics: Not used: there is one.
        known: The swarm.
        decode: Reads a message.
        rows_of: Makes rows of readings and their arrivals (n,).
        nothing: No rows.
        in_map: Whether readings must be in the frame `map`.
    """

    def __init__(
        self,
        _topics: int,
        known: Known,
        *,
        decode: Callable[[bytes], SharedMessage],
        rows_of: Callable[[SharedMessage, IntArray], Rows],
        nothing: Rows,
        in_map: bool = False,
    ) -> None:
        self._known = known
        self._decode = decode
        self._rows_of: Callable[[SharedMessage, IntArray], Rows] = rows_of
        self._nothing: Rows = nothing
        self._in_map = in_map
        self._frame_id = ""

    def frame_id(self, _topic: int) -> str:
        return self._frame_id

    def read(self, batch: MessageBatch, _robot: IntArray) -> Read:
        stamp_ns, valid = np.zeros(batch.size, dtype=np.int64), np.ones(batch.size, dtype=bool)
        parts = [self._nothing]
        dropped: Counter[str] = Counter()
        for k, (_, arrival_ns, data) in enumerate(batch.messages()):
            try:
                message = self._decode(data)
            except CdrError:
                valid[k] = False
                continue
            stamp_ns[k], self._frame_id = message.stamp_ns, message.frame_id
            if fault := self._fault(message):
                dropped[fault] += message.robot.size
            else:
                rows = self._rows_of(message, np.full(message.robot.size, arrival_ns))
                parts.append(self._sound(rows, dropped))
        return Read(joined(parts), stamp_ns, valid, +dropped)

    def _fault(self, message: SharedMessage) -> str:
        """Why no reading of a message can be used; "" when they can."""
        if message.swarm != self._known.swarm:
            return OTHER_SWARM
        robot = message.robot[message.robot < self._known.robots]
        if message.robot.size > MAX_READINGS or np.bincount(robot).max(initial=0) > MAX_OF_ONE:
            return TOO_MANY
        return FOREIGN_FRAME if self._in_map and message.frame_id != self._known.map_frame else ""

    def _sound(self, rows: Rows, dropped: Counter[str]) -> Rows:
        """The readings of robots that there are, with stamps that are some."""
        unknown, unstamped = rows.robot >= self._known.robots, rows.stamp_ns < 0
        dropped[UNKNOWN_ROBOT] += int(np.sum(unknown))
        dropped[BAD_STAMP] += int(np.sum(unstamped & ~unknown))
        return chosen(rows, ~(unknown | unstamped))


def _odometry_rows(message: SharedMessage, arrival_ns: IntArray) -> OdometryRows:
    return OdometryRows(message.robot, message.reading_ns, message.columns[0], arrival_ns)


def _detection_rows(message: SharedMessage, arrival_ns: IntArray) -> DetectionRows:
    return DetectionRows(message.robot, message.reading_ns, message.columns[0], arrival_ns)


def _fix_rows(message: SharedMessage, arrival_ns: IntArray) -> FixRows:
    pose, covariance = message.columns[0], message.columns[1].reshape(-1, 3, 3)
    pose[~has_heading(covariance), 2] = np.nan
    return FixRows(message.robot, message.reading_ns, pose, covariance, arrival_ns)


SHARED_CHANNELS: dict[InputKind, CreateChannel] = {
    InputKind.SWARM_ODOMETRY: partial(
        _SharedChannel,
        decode=partial(decode_shared_numbers, widths=(3,)),
        rows_of=_odometry_rows,
        nothing=NO_ODOMETRY,
    ),
    InputKind.SWARM_DETECTIONS: partial(
        _SharedChannel,
        decode=decode_shared_detections,
        rows_of=_detection_rows,
        nothing=NO_DETECTIONS._replace(detection=np.zeros(0, DETECTION_DTYPE)),
    ),
    InputKind.SWARM_FIXES: partial(
        _SharedChannel,
        decode=partial(decode_shared_numbers, widths=(3, 9)),
        rows_of=_fix_rows,
        nothing=NO_FIXES,
        in_map=True,
    ),
}
"""How the topics are read that carry the same of many robots."""
