"""Pair laser distances with the odometry of the same instants, whichever comes first."""

from __future__ import annotations

import math
from collections import Counter, deque

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import between, compose, exp, log
from swarm_loc_estimator.mapping.scans import UNSEEN, Readings

MAX_WAITING = 500
"""Of either kind: what is older than so many is dropped."""
MAX_GAP_NS = 500_000_000
"""Odometry is not interpolated over longer gaps."""
_SIGMAS = 301
"""Of so many distances the median sigma counts."""


class ReadingPairer:
    """Waits for the odometry on both sides of each distance of one robot.

    Attributes:
        drops: Reason -> how many messages were not used.
    """

    def __init__(self) -> None:
        self.drops: Counter[str] = Counter()
        self._odometry: deque[tuple[int, FloatArray]] = deque(maxlen=MAX_WAITING)
        self._distances: deque[tuple[int, float]] = deque()
        self._sigmas: deque[float] = deque(maxlen=_SIGMAS)

    @property
    def newest_ns(self) -> float:
        """Stamp of the newest odometry; before the first less than any."""
        return self._odometry[-1][0] if self._odometry else -math.inf

    def add_odometry(self, stamp_ns: int, pose: FloatArray) -> None:
        """Take a pose (3,) by odometry."""
        if not np.isfinite(pose).all():
            self.drops["odometry_not_finite"] += 1
        elif stamp_ns <= self.newest_ns:
            self.drops["odometry_too_old"] += 1
        else:
            self._odometry.append((stamp_ns, np.asarray(pose, dtype=float)))

    def add_distance(self, stamp_ns: int, distance: float, sigma: float) -> None:
        """Take a distance [m] with its sigma; NaN: nothing was seen."""
        seen = math.isfinite(distance) and distance > 0.0 and math.isfinite(sigma) and sigma > 0.0
        if self._distances and stamp_ns <= self._distances[-1][0]:
            self.drops["laser_too_old"] += 1
            return
        if not seen and not math.isnan(distance):
            self.drops["laser_bad_value"] += 1
            return
        if seen:
            self._sigmas.append(sigma / (distance * distance))
        if len(self._distances) == MAX_WAITING:
            self._distances.popleft()
            self.drops["laser_without_odometry"] += 1
        self._distances.append((stamp_ns, 1.0 / distance if seen else UNSEEN))

    def ready(self) -> Readings | None:
        """The readings whose odometry is known now, in order; None: there are none yet."""
        rows: list[tuple[int, FloatArray, float]] = []
        while self._distances and self._distances[0][0] <= self.newest_ns:
            stamp_ns, inverse = self._distances.popleft()
            pose = self._pose_at(stamp_ns)
            if pose is None:
                self.drops["laser_without_odometry"] += 1
            else:
                rows.append((stamp_ns, pose, inverse))
        if not rows:
            return None
        stamps, poses, inverses = zip(*rows, strict=True)
        return Readings(np.array(stamps, dtype=np.int64), np.array(poses), np.array(inverses), self._sigma())

    def _sigma(self) -> float:
        """Standard deviation of an inverse distance as usual lately: a dim spot is no measure of others."""
        return float(np.median(self._sigmas)) if self._sigmas else math.nan

    def _pose_at(self, stamp_ns: int) -> FloatArray | None:
        """Pose (3,) by odometry at an instant up to the newest; None: not known."""
        while len(self._odometry) > 1 and self._odometry[1][0] <= stamp_ns:
            self._odometry.popleft()
        begin_ns, begin = self._odometry[0]
        if begin_ns == stamp_ns or len(self._odometry) == 1:
            return begin if begin_ns == stamp_ns else None
        end_ns, end = self._odometry[1]
        if stamp_ns < begin_ns or end_ns - begin_ns > MAX_GAP_NS:
            return None
        share = (stamp_ns - begin_ns) / (end_ns - begin_ns)
        return compose(begin, exp(share * log(between(begin, end))))
