"""Segmentation of a stream of readings into stops, at which a robot scans, and drives."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.mapping.scans import Readings, Scan

MIN_TURN = 0.5  # Minimum turn of a scan [rad]
_STAND_SPEED = 0.02  # Maximum speed of a stopped robot [m/s]
_DEPARTED = 0.01  # Maximum distance from the arrival position within a stop [m]
_MAX_READINGS = 4096  # Maximum number of readings per stop; if exceeded, every second one is dropped
_REST_NS, _REST_TURN = 1_000_000_000, 0.01  # A robot rests if it turns less than this [rad] within this time
_DRIVES, _STANDS, _ARRIVES, _JUMPS = 0, 1, 2, 3
_MAX_SPEED, _MAX_STEP, _MAX_RATE, _MAX_TURN = 3.0, 0.05, 20.0, 0.3
"""Limits beyond which odometry counts as restarted: rate and offset of position, and of heading."""


class ScanStop:
    """A stop of a robot with its readings.

    Args:
        arrival: (3,) pose by odometry on arrival.

    Attributes:
        arrival: (3,) pose by odometry on arrival.
        departure: (3,) pose by odometry at the last reading.
        stamp_ns: (n,) of its readings.
        turn: (n,) turn by odometry since arrival [rad].
        inverse: (n,) inverse distances [1/m].
        sigma: Standard deviation of an inverse distance [1/m]; undefined before the first reflection.
        begin: Number of readings that belong to earlier nodes.
        looked: Number of readings when it became a node; 0: not a node yet.
        total: Number of all readings, including dropped ones.
        reach: Range of the lidar of which this is a sweep [m]; 0: readings of a laser pointer.
    """

    bearing: FloatArray | float = 0.0
    weight: FloatArray | float = 1.0
    reach = 0.0

    def __init__(self, arrival: FloatArray) -> None:
        self.arrival = self.departure = arrival
        self.stamp_ns: IntArray = np.zeros(0, dtype=np.int64)
        self.turn = np.zeros(0)
        self.inverse = np.zeros(0)
        self.sigma = 1.0
        self.begin = self.looked = self.total = 0

    @classmethod
    def of_sweep(cls, stamp_ns: int, pose: FloatArray, scan: Scan, sigma: float, reach: float) -> ScanStop:
        """A sweep of a lidar as a stop of no duration.

        Args:
            stamp_ns: Time of the first beam.
            pose: (3,) by odometry then.
            scan: Its beams, from where the robot was then.
            sigma: Standard deviation of an inverse distance with a weight of 1 [1/m].
            reach: Range of the lidar [m].
        """
        stop = cls(pose)
        stop.turn, stop.inverse, stop.bearing, stop.weight = scan
        stop.stamp_ns = np.full(len(scan.turn), stamp_ns)
        stop.sigma, stop.reach = sigma, reach
        return stop

    def scan(self, first: int, last: int) -> Scan:
        """The beams from `first` on and before `last`, with turns since the one before."""
        before = self.turn[first - 1] if first else 0.0
        turn, inverse = self.turn[first:last] - before, self.inverse[first:last]
        return Scan(turn, inverse, self.bearing, self.weight)

    def extend(self, readings: Readings) -> None:
        """Append readings."""
        headings = np.concatenate([self.departure[2:], readings.odometry[:, 2]])
        turned = self.turn[-1:] if len(self.turn) else np.zeros(1)
        steps = np.concatenate([turned, wrap_angle(np.diff(headings))])
        self.turn = np.concatenate([self.turn, np.cumsum(steps)[1:]])  # independent of how readings are split
        self.stamp_ns = np.concatenate([self.stamp_ns, readings.stamp_ns])
        self.inverse = np.concatenate([self.inverse, readings.inverse])
        self.departure = readings.odometry[-1]
        self.total += len(readings.stamp_ns)
        if not math.isnan(readings.sigma):
            self.sigma = readings.sigma
        if len(self.turn) > _MAX_READINGS:
            self.turn, self.stamp_ns, self.inverse = (
                np.concatenate([one[:-1:2], one[-1:]]) for one in (self.turn, self.stamp_ns, self.inverse)
            )
            self.begin, self.looked = (self.begin + 1) // 2, (self.looked + 1) // 2

    @property
    def turned(self) -> float:
        """Maximum turn by odometry [rad]."""
        return float(np.abs(self.turn).max(initial=0.0))

    @property
    def begin_turn(self) -> float:
        """Turn by odometry at which its node begins [rad]."""
        return float(self.turn[self.begin - 1]) if self.begin else 0.0

    def split(self, around: float) -> ScanStop | None:
        """Split off the readings since it became a node as a new stop, if they turn by `around` [rad]."""
        if not self.looked or self.looked == len(self.turn):
            return None
        before = float(self.turn[self.looked - 1])
        if np.abs(self.turn[self.looked :] - before).max() < around:
            return None
        heading = wrap_angle(self.arrival[2] + before)
        other = ScanStop(np.array([*self.arrival[:2], heading]))
        other.departure, other.sigma = self.departure, self.sigma
        other.turn = self.turn[self.looked :] - before
        other.stamp_ns, other.inverse = self.stamp_ns[self.looked :], self.inverse[self.looked :]
        other.total = len(other.turn)
        self.total -= other.total
        self.turn, self.inverse = self.turn[: self.looked], self.inverse[: self.looked]
        self.stamp_ns = self.stamp_ns[: self.looked]
        self.departure = other.arrival
        return other

    def completed(self, full: float) -> int:
        """Number of readings until the turn reached `full` [rad], or rested after a scan; 0: not yet."""
        return _completed(self.stamp_ns, self.turn, full)

    def turn_at(self, stamp_ns: int) -> float:
        """Turn by odometry at an instant during the stop [rad]."""
        since = (self.stamp_ns - self.stamp_ns[0]) * 1e-9
        return float(np.interp((stamp_ns - self.stamp_ns[0]) * 1e-9, since, self.turn))


class Run(NamedTuple):
    """Consecutive readings with the same motion state."""

    stands: bool  # Whether the robot is stopped
    arrives: bool  # Whether it has just arrived
    jumps: bool  # Whether odometry has restarted, so that the motion to this place is unknown
    readings: Readings  # The readings


class MotionTracker:
    """Classifies the readings of one robot as stopped or driving."""

    def __init__(self) -> None:
        self._state = np.full(6, np.nan)  # anchor x, y; previous x, y; whether stopped; previous heading
        self._before_ns = 0

    def runs(self, readings: Readings) -> Iterator[Run]:
        """Split readings (n,) at arrivals and departures."""
        labels = _labels(readings.stamp_ns, readings.odometry, self._state, self._before_ns)
        self._before_ns = int(readings.stamp_ns[-1])
        changes = (labels[1:] >= _ARRIVES) | ((labels[1:] == _DRIVES) != (labels[:-1] == _DRIVES))
        bounds = [0, *(np.flatnonzero(changes) + 1).tolist(), len(labels)]
        for begin, end in pairwise(bounds):
            part = slice(begin, end)
            chosen = Readings(
                readings.stamp_ns[part], readings.odometry[part], readings.inverse[part], readings.sigma
            )
            label = int(labels[begin])
            yield Run(label != _DRIVES, label >= _ARRIVES, label == _JUMPS, chosen)


@cached_njit
def _labels(stamp_ns: IntArray, odometry: FloatArray, state: FloatArray, before_ns: int) -> IntArray:
    """Label each reading as driving, stopped, arriving or jump; updates the state."""
    labels = np.zeros(len(stamp_ns), dtype=np.int64)
    for k in range(len(stamp_ns)):
        x, y = odometry[k, 0], odometry[k, 1]
        elapsed_s = (stamp_ns[k] - before_ns) * 1e-9
        step = math.hypot(x - state[2], y - state[3])
        turn = abs((odometry[k, 2] - state[5] + math.pi) % (2.0 * math.pi) - math.pi)
        if step > _MAX_SPEED * elapsed_s + _MAX_STEP or turn > _MAX_RATE * elapsed_s + _MAX_TURN:
            labels[k] = _JUMPS
            state[0], state[1], state[4] = x, y, 1.0
        elif state[4] == 1.0 and math.hypot(x - state[0], y - state[1]) <= _DEPARTED:
            labels[k] = _STANDS
        elif math.isnan(state[4]) or (state[4] == 0.0 and step < _STAND_SPEED * elapsed_s):
            labels[k] = _ARRIVES
            state[0], state[1], state[4] = x, y, 1.0
        else:
            labels[k] = _DRIVES
            state[4] = 0.0
        state[2], state[3], state[5] = x, y, odometry[k, 2]
        before_ns = stamp_ns[k]
    return labels


@cached_njit
def _completed(stamp_ns: IntArray, turn: FloatArray, full: float) -> int:
    """See `ScanStop.completed`."""
    furthest, rest_turn, rest_ns = 0.0, math.inf, 0
    for k in range(len(turn)):
        furthest = max(furthest, abs(turn[k]))
        if abs(turn[k] - rest_turn) > _REST_TURN:
            rest_turn, rest_ns = turn[k], stamp_ns[k]
        if furthest >= full or (furthest >= MIN_TURN and stamp_ns[k] - rest_ns >= _REST_NS):
            return k + 1
    return 0
