"""Pairing of what lasers measure with odometry: single distances, and sweeps of lidars."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import between
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.mapping.messages import ScanMessage
from swarm_loc_estimator.mapping.scans import UNSEEN, Readings, Scan
from swarm_loc_estimator.mapping.stops import ScanStop
from swarm_loc_estimator.mapping.sweeps import LidarSweep, read_sweep
from swarm_loc_estimator.swarm.error_models import LidarModel

MAX_WAITING = 500  # Maximum numbers of queued odometry messages and distances; the oldest are dropped
MAX_GAP_NS = 500_000_000  # Maximum gap over which odometry is interpolated
_MAX_SWEEPS = 50  # Maximum number of queued scans
_SIGMAS = 301  # Number of distances over which the median sigma is taken


class OdometryQueue:
    """The newest odometry of one robot.

    Attributes:
        drops: Reason -> number of dropped messages.
        dropped_beams: Reason -> number of dropped beams of scans.
    """

    def __init__(self) -> None:
        self.drops: Counter[str] = Counter()
        self.dropped_beams: Counter[str] = Counter()
        self._odometry: deque[tuple[int, FloatArray]] = deque(maxlen=MAX_WAITING)

    @property
    def newest_ns(self) -> float:
        """Stamp of the newest odometry; -inf before the first."""
        return self._odometry[-1][0] if self._odometry else -math.inf

    def add_odometry(self, stamp_ns: int, pose: FloatArray) -> None:
        """Add a pose (3,) by odometry."""
        if not np.isfinite(pose).all():
            self.drops["odometry_not_finite"] += 1
        elif stamp_ns <= self.newest_ns:
            self.drops["odometry_too_old"] += 1
        else:
            self._odometry.append((stamp_ns, np.asarray(pose, dtype=float)))

    def poses_at(self, stamp_ns: IntArray) -> tuple[FloatArray, BoolArray]:
        """Poses (n, 3) by odometry at times (n,) up to the newest stamp, and whether they are known.

        No later call may ask for a time before the first of these.
        """
        while len(self._odometry) > 1 and self._odometry[1][0] <= stamp_ns[0]:
            self._odometry.popleft()
        stamps, poses = zip(*self._odometry, strict=True)
        return interpolate(Trajectory(np.array(stamps), np.array(poses)), stamp_ns, MAX_GAP_NS)


class ReadingPairer(OdometryQueue):
    """Interpolates odometry at the stamp of each distance of one robot."""

    def __init__(self) -> None:
        super().__init__()
        self._distances: deque[tuple[int, float]] = deque()
        self._sigmas: deque[float] = deque(maxlen=_SIGMAS)

    def add_distance(self, stamp_ns: int, distance: float, sigma: float) -> None:
        """Add a distance [m] with its standard deviation; NaN: no reflection."""
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
        """The readings with known odometry, in order; None if there are none."""
        rows: list[tuple[int, float]] = []
        while self._distances and self._distances[0][0] <= self.newest_ns:
            rows.append(self._distances.popleft())
        if not rows:
            return None
        stamps, inverses = (np.array(column) for column in zip(*rows, strict=True))
        poses, known = self.poses_at(stamps)
        if not known.all():
            self.drops["laser_without_odometry"] += int((~known).sum())
        return Readings(stamps[known], poses[known], inverses[known], self._sigma()) if known.any() else None

    def _sigma(self) -> float:
        """Median standard deviation of recent inverse distances; NaN if there are none."""
        return float(np.median(self._sigmas)) if self._sigmas else math.nan


class SweepPairer(OdometryQueue):
    """Takes a robot's motion during each sweep of its lidar out of it.

    Args:
        lidar: Mount and noise of the lidar.
    """

    def __init__(self, lidar: LidarModel) -> None:
        super().__init__()
        self._lidar = lidar
        self._sweeps: deque[LidarSweep] = deque()
        self._newest_ns = -math.inf

    def add_scan(self, scan: ScanMessage) -> None:
        """Add a scan; what cannot be used of it is counted."""
        sweep = read_sweep(scan, self._lidar, self.drops, self.dropped_beams)
        if sweep is None:
            return
        if scan.stamp_ns <= self._newest_ns:
            self.drops["scan_too_old"] += 1
            return
        self._newest_ns = scan.stamp_ns
        if len(self._sweeps) == _MAX_SWEEPS:
            self._sweeps.popleft()
            self.drops["scan_without_odometry"] += 1
        self._sweeps.append(sweep)

    def ready(self) -> Iterator[ScanStop]:
        """The sweeps with known odometry, in order."""
        while self._sweeps and self._sweeps[0].beam_ns[-1] <= self.newest_ns:
            sweep = self._sweeps.popleft()
            poses, known = self.poses_at(np.concatenate([[sweep.stamp_ns], sweep.beam_ns]))
            if known.all():
                yield self._stop(sweep, poses[0], between(poses[0], poses[1:]))
            else:
                self.drops["scan_without_odometry"] += 1

    def _stop(self, sweep: LidarSweep, pose: FloatArray, motion: FloatArray) -> ScanStop:
        """The sweep from a pose (3,) of the robot, which had moved by `motion` (n, 3) at each beam."""
        lidar, seen = self._lidar, sweep.seen
        distance = np.where(seen, sweep.distance, sweep.reach)
        x, y = sweep.ends(lidar, motion).T
        noise = (lidar.range_sigma + lidar.range_sigma_per_m * distance) / distance**2
        sigma = (lidar.range_sigma + lidar.range_sigma_per_m * sweep.reach) / sweep.reach**2
        scan = Scan(
            motion[:, 2],
            np.where(seen, 1.0 / np.hypot(x, y), UNSEEN),
            np.arctan2(y, x) - motion[:, 2],
            (sigma / noise) ** 2,
        )
        return ScanStop.of_sweep(sweep.stamp_ns, pose, scan, sigma, sweep.reach)
