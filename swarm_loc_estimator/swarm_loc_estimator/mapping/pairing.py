"""Pairing of what lasers measure with odometry: single distances, and sweeps of lidars."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import between, compose, transform_points
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.mapping.messages import ScanMessage
from swarm_loc_estimator.mapping.scans import UNSEEN, Readings, Scan
from swarm_loc_estimator.mapping.stops import ScanStop
from swarm_loc_estimator.swarm.error_models import LidarModel

MAX_WAITING = 500
"""Maximum numbers of queued odometry messages and distances; the oldest are dropped."""
MAX_GAP_NS = 500_000_000
"""Maximum gap over which odometry is interpolated."""
_MAX_SWEEPS = 50
"""Maximum number of queued scans."""
_SIGMAS = 301
"""Number of distances over which the median sigma is taken."""


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


_MAX_SWEEP_S, _MAX_SWEEP_TURN = 2.0, 6.5
"""Longest time [s] and greatest angle [rad] from the first to the last beam of a scan."""


class _Sweep(NamedTuple):
    """Beams (n,) of a scan that are used.

    Attributes:
        stamp_ns: Time of the first beam of the scan.
        beam_ns: (n,) times of the beams.
        angle: (n,) directions in the frame of the lidar [rad].
        distance: (n,) [m]; infinite: nothing up to `reach`.
        reach: Range of the lidar [m].
    """

    stamp_ns: int
    beam_ns: IntArray
    angle: FloatArray
    distance: FloatArray
    reach: float


class SweepPairer(OdometryQueue):
    """Checks the scans of one robot's lidar and takes the robot's motion during each sweep out of them.

    Args:
        lidar: Mount and noise of the lidar.
    """

    def __init__(self, lidar: LidarModel) -> None:
        super().__init__()
        self._lidar = lidar
        self._sweeps: deque[_Sweep] = deque()
        self._newest_ns = -math.inf

    def add_scan(self, scan: ScanMessage) -> None:
        """Add a scan; what cannot be used of it is counted."""
        count, step, duration_s = len(scan.ranges), scan.angle_increment, 0.0
        numbers = (scan.angle_min, scan.angle_max, step, scan.time_increment)
        if all(map(math.isfinite, numbers)):
            duration_s = scan.time_increment * (count - 1)
        if not all(map(math.isfinite, numbers)) or step == 0.0 or not 0.0 <= duration_s <= _MAX_SWEEP_S:
            self.drops["scan_bad_geometry"] += 1
        elif abs((scan.angle_max - scan.angle_min) / step + 1.0 - count) > 1.5 or not count:
            self.drops["scan_wrong_length"] += 1  # many drivers are one off
        elif abs(step) * (count - 1) > _MAX_SWEEP_TURN:
            self.drops["scan_bad_geometry"] += 1
        elif scan.stamp_ns <= self._newest_ns:
            self.drops["scan_too_old"] += 1
        else:
            self._newest_ns = scan.stamp_ns
            self._queue(scan)

    def _queue(self, scan: ScanMessage) -> None:
        """Queue the valid beams of a scan, by REP 117: what met nothing is infinitely far."""
        far = scan.range_max if math.isfinite(scan.range_max) and scan.range_max > 0.0 else math.inf
        reach = min(far, self._lidar.max_range)
        near = max(scan.range_min, self._lidar.min_range) if math.isfinite(scan.range_min) else 0.0
        wrong = {
            "beam_not_a_number": np.isnan(scan.ranges),
            "beam_too_near": (scan.ranges < near) | (scan.ranges <= 0.0),
            "beam_too_far": np.isfinite(scan.ranges) & (scan.ranges > far),
        }
        for reason, beams in wrong.items():
            self.dropped_beams[reason] += int(beams.sum())
        used = np.flatnonzero(~np.logical_or.reduce(list(wrong.values())))
        if not len(used):
            self.drops["scan_without_beams"] += 1
            return
        if len(self._sweeps) == _MAX_SWEEPS:
            self._sweeps.popleft()
            self.drops["scan_without_odometry"] += 1
        beam_ns = scan.stamp_ns + np.round(used * (scan.time_increment * 1e9)).astype(np.int64)
        distance = np.where(scan.ranges[used] > reach, math.inf, scan.ranges[used])
        angle = scan.angle_min + used.astype(float) * scan.angle_increment
        self._sweeps.append(_Sweep(scan.stamp_ns, beam_ns, angle, distance, reach))

    def ready(self) -> Iterator[ScanStop]:
        """The sweeps with known odometry, in order."""
        while self._sweeps and self._sweeps[0].beam_ns[-1] <= self.newest_ns:
            sweep = self._sweeps.popleft()
            poses, known = self.poses_at(np.concatenate([[sweep.stamp_ns], sweep.beam_ns]))
            if known.all():
                yield self._stop(sweep, poses[0], between(poses[0], poses[1:]))
            else:
                self.drops["scan_without_odometry"] += 1

    def _stop(self, sweep: _Sweep, pose: FloatArray, motion: FloatArray) -> ScanStop:
        """The sweep from a pose (3,) of the robot, which had moved by `motion` (n, 3) at each beam."""
        lidar, seen = self._lidar, np.isfinite(sweep.distance)
        distance = np.where(seen, sweep.distance, sweep.reach)
        ray = distance[:, None] * np.stack([np.cos(sweep.angle), np.sin(sweep.angle)], axis=-1)
        x, y = transform_points(compose(motion, np.array([lidar.x, lidar.y, lidar.yaw])), ray).T
        noise = (lidar.range_sigma + lidar.range_sigma_per_m * distance) / distance**2
        sigma = (lidar.range_sigma + lidar.range_sigma_per_m * sweep.reach) / sweep.reach**2
        scan = Scan(
            motion[:, 2],
            np.where(seen, 1.0 / np.hypot(x, y), UNSEEN),
            np.arctan2(y, x) - motion[:, 2],
            (sigma / noise) ** 2,
        )
        return ScanStop.of_sweep(sweep.stamp_ns, pose, scan, sigma, sweep.reach)
