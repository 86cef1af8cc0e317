"""What one robot does between a mapper's goals: it looks around by turning, waits, and drives straight on.

Everything is steered by odometry. Wheels that slip turn the robot less than odometry says; by how much, the
headings of two fixes and the odometry between them tell.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.common.velocity_command import STILL, Velocity
from swarm_loc_estimator import SCAN_TURN, START_TURN
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import number
from swarm_loc_estimator.common.se2 import wrap_angle

_SLOW_TURN = 0.5 * math.pi
"""The begin of a first scan, which holds the heading of the whole map [rad]."""
_SLOW_SHARE, _FIRST_SHARE = 1.0 / 6.0, 0.5
"""Of the turn rate: at that begin, and in the rest of a first scan."""
_GAIN, _MIN_RATE, _MIN_SPEED, _COURSE_GAIN = 2.0, 0.15, 0.04, 1.5
"""[1/s], [rad/s], [m/s], [1/s]: slower towards the end, but never so slow that wheels do not turn."""
_TURNED, _ARRIVED = 0.01, 0.002
_MAX_REMEMBERED = 1000
_MAX_JUMP, _MAX_PAUSE_NS = 0.5, 2_000_000_000
"""Odometry that goes further [m] at once, or that paused or stepped back for longer, has begun anew."""
_MIN_RATIO_TURN = math.pi
_LOW_RATIO, _HIGH_RATIO = 0.7, 1.1


@dataclass(frozen=True)
class StopAndGoSettings:
    """How robots move between goals."""

    speed: float = number(0.2, "m/s", 0.0, 2.0, "of drives", above=True)
    turn_rate: float = number(1.0, "rad/s", 0.0, 10.0, "of turns; first scans are slower", above=True)
    clearance: float = number(0.18, "m", 0.0, 1.0, "a drive ends where the laser is so close to something")
    patience_s: float = number(
        5.0, "s", 1.5, 600.0, "without a goal for so long after a scan, the robot looks around again"
    )


class MapGoal(NamedTuple):
    """Where a mapper sends a robot.

    Attributes:
        stamp_ns: When that was decided.
        pose: (3,) of the robot in map then.
        position: (2,) where it should come in map [m].
    """

    stamp_ns: int
    pose: FloatArray
    position: FloatArray


@dataclass
class _Turn:
    """Turn to a heading by odometry [rad, not wrapped], at a rate [rad/s]."""

    heading: float
    rate: float


@dataclass
class _Look:
    """Turn by an angle [rad] at a rate [rad/s]."""

    angle: float
    rate: float


@dataclass
class _Drive:
    """Drive ahead for a length [m]."""

    length: float


class StopAndGo:
    """One robot.

    Args:
        settings: How it moves.

    Attributes:
        goals: How many goals it has gone to.
        halts: How many drives ended because something was in the way.
        restarts: How often odometry has begun anew.
        ratio: True turn over turn by odometry, as far as it is known.
    """

    def __init__(self, settings: StopAndGoSettings) -> None:
        self._settings = settings
        self.goals = self.halts = self.restarts = 0
        self._begin()

    def _begin(self) -> None:
        """Look around for the first time, and know nothing."""
        rate = self._settings.turn_rate
        self.ratio = 1.0
        self._moves: deque[_Turn | _Look | _Drive] = deque(
            [_Look(_SLOW_TURN, _SLOW_SHARE * rate), _Look(START_TURN - _SLOW_TURN, _FIRST_SHARE * rate)]
        )
        self._track: deque[tuple[int, float, float, float]] = deque(maxlen=_MAX_REMEMBERED)
        self._anchor: FloatArray | None = None
        self._since_ns = 0
        self._goal_ns = -1
        self._fixed: tuple[float, float] | None = None
        self._is_near = False

    def take_distance(self, distance: float) -> None:
        """The laser has measured a distance ahead [m]; NaN: nothing was seen."""
        self._is_near = distance < self._settings.clearance

    def take_goal(self, goal: MapGoal) -> bool:
        """A goal has come: what the robot had still to look at, the mapper does not need.

        Returns:
            Whether it counts; one from before the last one, or before this odometry, does not.
        """
        there = self._odometry_at(goal.stamp_ns)
        if there is None or goal.stamp_ns <= self._goal_ns:
            return False
        self.goals += 1
        self._goal_ns = goal.stamp_ns
        self._learn_ratio(float(goal.pose[2]), float(there[2]))
        way = goal.position - goal.pose[:2]
        length = math.hypot(way[0], way[1])
        self._moves.clear()
        self._anchor = None
        if length > _ARRIVED:
            course = math.atan2(way[1], way[0])
            heading = there[2] + float(wrap_angle(course - goal.pose[2])) / self.ratio
            around = 2.0 * math.pi / self.ratio
            now = self._track[-1][3]
            heading += around * round((now - heading) / around)
            self._moves += [_Turn(heading, self._settings.turn_rate), _Drive(length)]
        self._moves.append(_Look(SCAN_TURN, self._settings.turn_rate))
        return True

    def command(self, stamp_ns: int, pose: FloatArray) -> Velocity:
        """What the robot should do at a time [ns] and pose (3,) by odometry."""
        now = self._remember(stamp_ns, pose)
        while self._moves:
            if self._anchor is None:
                self._anchor = now
            velocity = self._towards(self._moves[0], now, self._anchor)
            if velocity is not None:
                return velocity
            self._moves.popleft()
            self._anchor, self._since_ns = None, stamp_ns
        if stamp_ns - self._since_ns > 1e9 * self._settings.patience_s:
            self._moves.append(_Look(SCAN_TURN, self._settings.turn_rate))
        return STILL

    def _remember(self, stamp_ns: int, pose: FloatArray) -> FloatArray:
        """The pose (3,) by odometry with a heading that is not wrapped."""
        x, y, theta = (float(value) for value in pose)
        if self._track:
            before_ns, last_x, last_y, last = self._track[-1]
            jumps = math.hypot(x - last_x, y - last_y) > _MAX_JUMP
            if jumps or not -_MAX_PAUSE_NS <= stamp_ns - before_ns <= _MAX_PAUSE_NS:
                self.restarts += 1
                self._begin()
            elif stamp_ns <= before_ns:  # late, as others of a driver whose clock has found a shorter way
                return np.array(self._track[-1][1:])
            else:
                theta = last + float(wrap_angle(theta - last))
        if not self._track:
            self._since_ns = stamp_ns
        self._track.append((stamp_ns, x, y, theta))
        return np.array([x, y, theta])

    def _odometry_at(self, stamp_ns: int) -> FloatArray | None:
        """The pose (3,) by odometry at a time [ns]; None: it is not remembered."""
        if not self._track or not self._track[0][0] <= stamp_ns <= self._track[-1][0]:
            return None
        since_ns = np.array([row[0] - stamp_ns for row in self._track], dtype=float)
        poses = np.array([row[1:] for row in self._track])
        return np.array([np.interp(0.0, since_ns, column) for column in poses.T])

    def _learn_ratio(self, heading: float, by_odometry: float) -> None:
        """What the headings of two fixes [rad] and the odometry between them tell of the wheels' slip."""
        if self._fixed is not None and abs(turned := by_odometry - self._fixed[1]) > _MIN_RATIO_TURN:
            wrong = float(wrap_angle(heading - self._fixed[0] - self.ratio * turned))
            self.ratio = min(max(self.ratio + wrong / turned, _LOW_RATIO), _HIGH_RATIO)
        self._fixed = (heading, by_odometry)

    def _towards(self, move: _Turn | _Look | _Drive, now: FloatArray, begin: FloatArray) -> Velocity | None:
        """The velocity that a move needs at a pose (3,) by odometry; None: it is done."""
        if isinstance(move, _Drive):
            return self._ahead(move, now, begin)
        heading = move.heading if isinstance(move, _Turn) else begin[2] + move.angle
        left = heading - now[2]
        is_beyond = (heading - begin[2]) * left <= 0.0
        if abs(left) < _TURNED or is_beyond:
            return None
        return 0.0, 0.0, math.copysign(min(max(_GAIN * abs(left), _MIN_RATE), move.rate), left)

    def _ahead(self, move: _Drive, now: FloatArray, begin: FloatArray) -> Velocity | None:
        left = move.length - math.dist(now[:2], begin[:2])
        if left < _ARRIVED:
            return None
        if self._is_near:
            self.halts += 1
            return None
        speed = min(max(_GAIN * left, _MIN_SPEED), self._settings.speed)
        return speed, 0.0, _COURSE_GAIN * float(begin[2] - now[2])
