"""Motion of one robot between the goals of a mapper: it turns to scan, waits, and drives straight.

All motion is controlled by odometry. Slipping wheels turn the robot less than odometry reports; the ratio is
estimated from the headings of two fixes and the odometry between them.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.common.robot_driver import STILL, Velocity
from swarm_loc_estimator import SCAN_TURN, START_TURN
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import number
from swarm_loc_estimator.common.se2 import wrap_angle

# Checked by test_stop_and_go.py.
_SLOW_TURN = 0.5 * math.pi  # Beginning of the first scan, which defines the heading of the whole map [rad]
_SLOW_SHARE, _FIRST_SHARE = 1.0 / 6.0, 0.5
"""Shares of the turn rate at that beginning and in the rest of the first scan."""
_GAIN, _MIN_RATE, _MIN_SPEED, _COURSE_GAIN = 2.0, 0.15, 0.04, 1.5
"""[1/s], [rad/s], [m/s], [1/s]: slower towards the end, but fast enough to turn the wheels."""
_TURNED, _ARRIVED = 0.01, 0.002
_MAX_REMEMBERED = 1000
_BLIND_DRIVE, _STRAIGHT, _OFF = 0.4, 4, 2.4
"""Drives of a lost robot that gets no goal, ahead or to where it is farthest: length [m], number after which
it turns off, as it does where something holds it, and by how much [rad]."""
_HELD_WAY, _MAX_SHRINK, _MIN_READINGS = 0.05, 0.15, 10
"""A body is held if over this way of its wheels [m], which grows with the squared distance as noise does, the
distance ahead shrinks by less than this share; and minimum number of distances on that way."""
_MAX_JUMP, _MAX_PAUSE_NS = 0.5, 2_000_000_000
"""Odometry that jumps further [m], or that pauses or steps back for longer, has restarted."""
_MIN_RATIO_TURN = math.pi
_LOW_RATIO, _HIGH_RATIO = 0.7, 1.1


@dataclass(frozen=True)
class StopAndGoSettings:
    """Motion of robots between goals."""

    speed: float = number(0.2, "m/s", 0.0, 2.0, "of drives", above=True)
    turn_rate: float = number(1.0, "rad/s", 0.0, 10.0, "of turns; first scans are slower", above=True)
    clearance: float = number(0.18, "m", 0.0, 1.0, "a drive ends at this distance to an obstacle")
    patience_s: float = number(5.0, "s", 1.5, 600.0, "time without a goal until the robot scans again")


class MapGoal(NamedTuple):
    """A goal of a mapper for a robot."""

    stamp_ns: int  # Time of the decision
    pose: FloatArray  # (3,) pose of the robot in map at that time
    position: FloatArray  # (2,) goal in map [m]


class _Turn(NamedTuple):
    """Turn to a heading by odometry [rad, not wrapped], or by an angle [rad], at a rate [rad/s]."""

    angle: float
    rate: float
    is_heading: bool = False


class _Drive(NamedTuple):
    """Drive ahead for a length [m]."""

    length: float


class StopAndGo:
    """Motion of one robot."""

    def __init__(self, settings: StopAndGoSettings) -> None:
        self._settings = settings
        self.goals = 0  # Number of accepted goals
        self.halts = 0  # Number of drives that ended at an obstacle
        self.restarts = 0  # Number of restarts of odometry
        self._begin()

    def _begin(self) -> None:
        """Reset and begin with the first scan."""
        rate = self._settings.turn_rate
        self.ratio = 1.0  # Estimated true turn per turn by odometry
        self._moves: deque[_Turn | _Drive] = deque(
            [_Turn(_SLOW_TURN, _SLOW_SHARE * rate), _Turn(START_TURN - _SLOW_TURN, _FIRST_SHARE * rate)]
        )
        self._track: deque[tuple[int, float, float, float]] = deque(maxlen=_MAX_REMEMBERED)
        self._anchor: FloatArray | None = None
        self._since_ns = 0
        self._goal_ns = -1
        self._is_lost = self.restarts > 0  # or a scan brought no goal, so that the mapper may have lost it
        self._fixed: tuple[float, float] | None = None
        self._is_near = False
        self._distances: deque[float] = deque(maxlen=3)
        # Path by odometry since the drive began [m], and distance ahead [m]
        self._ahead: deque[tuple[float, float]] = deque(maxlen=200)
        self._farthest = self._open_heading = 0.0
        self._blind_drives, self._was_halted = 0, False  # Since it turned off; the last drive ended early

    def take_distance(self, distance: float) -> None:
        """Take a distance of the laser [m]; NaN: no detection."""
        self._is_near = distance < self._settings.clearance
        self._distances.append(distance)
        if self._track and self._anchor is not None and math.isfinite(distance):
            self._ahead.append((math.dist(self._track[-1][1:3], self._anchor[:2]), distance))
        if self._track and (least := min(self._distances)) > self._farthest:  # one may be an outlier
            self._farthest, self._open_heading = least, self._track[-1][3]

    def take_goal(self, goal: MapGoal) -> bool:
        """Take a goal; it replaces the remaining scan.

        Returns:
            Whether the goal is accepted: it must be newer than the last one and within this odometry.
        """
        is_new, track = goal.stamp_ns > self._goal_ns, self._track
        if not is_new or not track or not track[0][0] <= goal.stamp_ns <= track[-1][0]:
            return False
        since_ns = np.array([row[0] - goal.stamp_ns for row in track], dtype=float)
        poses = np.array([row[1:] for row in track])
        there = np.array([np.interp(0.0, since_ns, column) for column in poses.T])
        self.goals += 1
        self._goal_ns, self._is_lost = goal.stamp_ns, False
        # estimate the wheel slip from the headings of two fixes and the odometry between them
        heading, by_odometry = float(goal.pose[2]), float(there[2])
        if self._fixed is not None and abs(turned := by_odometry - self._fixed[1]) > _MIN_RATIO_TURN:
            wrong = float(wrap_angle(heading - self._fixed[0] - self.ratio * turned))
            self.ratio = min(max(self.ratio + wrong / turned, _LOW_RATIO), _HIGH_RATIO)
        self._fixed = (heading, by_odometry)
        # turn to the goal, drive there, and scan
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
            self._moves += [_Turn(heading, self._settings.turn_rate, is_heading=True), _Drive(length)]
        self._moves.append(_Turn(SCAN_TURN, self._settings.turn_rate))
        return True

    def command(self, stamp_ns: int, pose: FloatArray) -> Velocity:
        """Velocity at a time [ns] and a pose (3,) by odometry."""
        now = self._remember(stamp_ns, pose)
        while self._moves:
            if self._anchor is None:
                self._anchor = now
                self._ahead.clear()
            velocity = self._towards(self._moves[0], now, self._anchor)
            if velocity is not None:
                return velocity
            self._moves.popleft()
            self._anchor, self._since_ns = None, stamp_ns
        if stamp_ns - self._since_ns > 1e9 * self._settings.patience_s:
            # scans of several places tell a mapper that has lost it where it is
            if self._is_lost:
                if self._distances and self._distances[-1] < _BLIND_DRIVE + self._settings.clearance:
                    self._moves.append(_Turn(self._open_heading, self._settings.turn_rate, is_heading=True))
                elif self._was_halted or self._blind_drives >= _STRAIGHT:
                    self._moves.append(_Turn(_OFF, self._settings.turn_rate))
                    self._blind_drives = 0
                self._moves.append(_Drive(_BLIND_DRIVE))
                self._blind_drives += 1
            self._farthest, self._is_lost = 0.0, True
            self._moves.append(_Turn(SCAN_TURN, self._settings.turn_rate))
        return STILL

    def _remember(self, stamp_ns: int, pose: FloatArray) -> FloatArray:
        """Record a pose (3,) by odometry; returns it with an unwrapped heading."""
        x, y, theta = (float(value) for value in pose)
        if self._track:
            before_ns, last_x, last_y, last = self._track[-1]
            jumps = math.hypot(x - last_x, y - last_y) > _MAX_JUMP
            if jumps or not -_MAX_PAUSE_NS <= stamp_ns - before_ns <= _MAX_PAUSE_NS:
                self.restarts += 1
                self._begin()
            elif stamp_ns <= before_ns:  # late: the driver's clock has found a smaller delay
                return np.array(self._track[-1][1:])
            else:
                theta = last + float(wrap_angle(theta - last))
        if not self._track:
            self._since_ns = stamp_ns
        self._track.append((stamp_ns, x, y, theta))
        return np.array([x, y, theta])

    def _is_held(self) -> bool:
        """Whether an obstacle that the laser does not meet holds the body, whose wheels turn on."""
        way, distance = np.array(self._ahead).reshape(-1, 2).T
        needed = _HELD_WAY * (1.0 + distance[-1] ** 2) if len(way) else math.inf
        newest = way > way[-1:] - needed
        if newest.all() or newest.sum() < _MIN_READINGS:
            return False
        before, after = np.array_split(distance[newest], 2)
        return bool(abs(np.median(before) - np.median(after)) < _MAX_SHRINK * needed)

    def _towards(self, move: _Turn | _Drive, now: FloatArray, begin: FloatArray) -> Velocity | None:
        """Velocity of a move at a pose (3,) by odometry; None when the move is done."""
        if isinstance(move, _Drive):
            left = move.length - math.dist(now[:2], begin[:2])
            if left >= _ARRIVED and not self._is_near and not self._is_held():
                speed = min(max(_GAIN * left, _MIN_SPEED), self._settings.speed)
                return speed, 0.0, _COURSE_GAIN * float(begin[2] - now[2])
            self._was_halted = left >= _ARRIVED
            self.halts += self._was_halted
            return None
        heading = move.angle if move.is_heading else begin[2] + move.angle
        left = heading - now[2]
        is_beyond = (heading - begin[2]) * left <= 0.0
        if abs(left) < _TURNED or is_beyond:
            return None
        return 0.0, 0.0, math.copysign(min(max(_GAIN * abs(left), _MIN_RATE), move.rate), left)
