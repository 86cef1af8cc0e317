"""Sweeps of lidars: the beams of a LaserScan that are used, and where they end."""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import compose, transform_points
from swarm_loc_estimator.mapping.messages import ScanMessage
from swarm_loc_estimator.swarm.error_models import LidarModel

_MAX_SWEEP_S, _MAX_SWEEP_TURN = 2.0, 6.5
"""Longest time [s] and greatest angle [rad] from the first to the last beam of a scan."""


class LidarSweep(NamedTuple):
    """Beams (n,) of a scan that are used."""

    stamp_ns: int  # Time of the first beam of the scan
    beam_ns: IntArray  # (n,) times of the beams
    angle: FloatArray  # (n,) directions in the frame of the lidar [rad]
    distance: FloatArray  # (n,) [m]; infinite: nothing up to `reach`
    reach: float  # Range of the lidar [m]

    @property
    def seen(self) -> BoolArray:
        """(n,) True for beams that met something."""
        return np.isfinite(self.distance)

    def ends(self, lidar: LidarModel, motion: FloatArray) -> FloatArray:
        """Ends (n, 2) of the beams, at `reach` where they met nothing.

        Args:
            lidar: Its mount.
            motion: (n, 3) pose of the robot at each beam, in the frame of the ends.
        """
        distance = np.minimum(self.distance, self.reach)
        ray = distance[:, None] * np.stack([np.cos(self.angle), np.sin(self.angle)], axis=-1)
        return transform_points(compose(motion, np.array([lidar.x, lidar.y, lidar.yaw])), ray)


def read_sweep(
    scan: ScanMessage, lidar: LidarModel, drops: Counter[str], dropped_beams: Counter[str]
) -> LidarSweep | None:
    """The valid beams of a scan, by REP 117: what met nothing is infinitely far.

    Args:
        scan: The message.
        lidar: Its range.
        drops: Counts unusable scans by reason.
        dropped_beams: Counts unusable beams by reason.

    Returns:
        The sweep; None if the scan cannot be used.
    """
    # geometry: angles and times of the beams
    count, step = len(scan.ranges), scan.angle_increment
    numbers = (scan.angle_min, scan.angle_max, step, scan.time_increment)
    is_finite = all(map(math.isfinite, numbers))
    duration_s = scan.time_increment * (count - 1) if is_finite else 0.0
    if not is_finite or step == 0.0 or not 0.0 <= duration_s <= _MAX_SWEEP_S:
        drops["scan_bad_geometry"] += 1
        return None
    if abs((scan.angle_max - scan.angle_min) / step + 1.0 - count) > 1.5 or not count:
        drops["scan_wrong_length"] += 1  # many drivers are one off
        return None
    if abs(step) * (count - 1) > _MAX_SWEEP_TURN:
        drops["scan_bad_geometry"] += 1
        return None
    # ranges that can be true
    far = scan.range_max if math.isfinite(scan.range_max) and scan.range_max > 0.0 else math.inf
    reach = min(far, lidar.max_range)
    near = max(scan.range_min, lidar.min_range) if math.isfinite(scan.range_min) else 0.0
    # beams without such a range are counted and left out
    wrong = {
        "beam_not_a_number": np.isnan(scan.ranges),
        "beam_too_near": (scan.ranges < near) | (scan.ranges <= 0.0),
        "beam_too_far": np.isfinite(scan.ranges) & (scan.ranges > far),
    }
    for reason, beams in wrong.items():
        dropped_beams[reason] += int(beams.sum())
    used = np.flatnonzero(~np.logical_or.reduce(list(wrong.values())))
    if not len(used):
        drops["scan_without_beams"] += 1
        return None
    # the others, each with its own time
    beam_ns = scan.stamp_ns + np.round(used * (scan.time_increment * 1e9)).astype(np.int64)
    distance = np.where(scan.ranges[used] > reach, math.inf, scan.ranges[used])
    angle = scan.angle_min + used.astype(float) * step
    return LidarSweep(scan.stamp_ns, beam_ns, angle, distance, reach)
