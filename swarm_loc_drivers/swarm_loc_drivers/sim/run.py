"""Data of a simulated run, the same for every simulated swarm: true tracks, odometry, images, delays.

Sensor data is kept as flat structured arrays, because a run of a thousand robots has a million entries.
`stamp_ns` is the time of measurement, `arrival_ns` the time of reception; data is sorted by arrival.
Ground truth is separate and only for evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Trajectories:
    """Poses of N robots at T common stamps; between two stamps a robot keeps its twist."""

    stamp_ns: IntArray  # (T,) int64, evenly spaced
    poses: FloatArray  # (T, N, 3), x [m], y [m], theta [rad] in map

    def at(self, robot: NDArray[np.integer] | int, stamp_ns: IntArray) -> FloatArray:
        """The pose (..., 3) of each `robot` at each `stamp_ns` (broadcast together).

        Raises:
            ValueError: A stamp lies outside the simulated time.
        """
        index, share = self._locate(stamp_ns)
        return _interpolate(self.poses[index, robot], self.poses[index + 1, robot], share)

    def all_at(self, stamp_ns: IntArray) -> FloatArray:
        """The poses (M, N, 3) of all robots at stamps (M,).

        Raises ValueError if a stamp lies outside the simulated time.
        """
        index, share = self._locate(stamp_ns)
        return _interpolate(self.poses[index], self.poses[index + 1], share[:, None])

    def _locate(self, stamp_ns: IntArray) -> tuple[IntArray, FloatArray]:
        """Index of the stamp before each time, and its fraction of the interval to the next, in [0, 1]."""
        stamp_ns = np.asarray(stamp_ns, dtype=np.int64)
        if stamp_ns.size and (stamp_ns.min() < self.stamp_ns[0] or stamp_ns.max() > self.stamp_ns[-1]):
            raise ValueError(
                f"stamps {stamp_ns.min()}..{stamp_ns.max()} ns leave the simulated time "
                f"{self.stamp_ns[0]}..{self.stamp_ns[-1]} ns."
            )
        step_ns = int(self.stamp_ns[1] - self.stamp_ns[0])
        index = np.minimum((stamp_ns - self.stamp_ns[0]) // step_ns, len(self.stamp_ns) - 2)
        return index, (stamp_ns - self.stamp_ns[index]) / step_ns


def _interpolate(before: FloatArray, after: FloatArray, share: FloatArray) -> FloatArray:
    """The pose (..., 3) at the fraction `share` (...) of the constant twist between two poses."""
    return se2.compose(before, se2.exp(share[..., None] * se2.log(se2.between(before, after))))


START_NS = 1_000 * 10**9  # Start time of simulated runs
