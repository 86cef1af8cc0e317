"""Trajectories: poses over time, and their interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray

DEFAULT_GAP_NS = 500_000_000  # Ground truth is not interpolated over longer gaps than this


class TrajectoryError(ValueError):
    """Inconsistent stamps and poses."""


@dataclass(frozen=True)
class Trajectory:
    """Poses over time.

    Raises:
        TrajectoryError: The lengths differ, or time goes back.
    """

    stamp_ns: IntArray  #: (N,) not decreasing
    pose: FloatArray  #: (N, 3) x [m], y [m], theta [rad] in map
    left_out: int = 0  #: Number of poses of its source that are not finite

    def __post_init__(self) -> None:
        if self.pose.shape != (len(self.stamp_ns), 3):
            raise TrajectoryError(f"{len(self.stamp_ns)} stamps do not fit poses of shape {self.pose.shape}.")
        if np.any(np.diff(self.stamp_ns) < 0):
            raise TrajectoryError("the stamps of a trajectory go back in time.")


def interpolate(trajectory: Trajectory, query_ns: IntArray, max_gap_ns: int) -> tuple[FloatArray, BoolArray]:
    """Poses of a trajectory at other times (M,), along the arc between neighbours at most `max_gap_ns` apart.

    Returns poses (M, 3), NaN if undefined, and whether they are defined (M,): there is no extrapolation
    beyond the ends nor interpolated across longer gaps; at its own stamps it is always defined.
    """
    poses = np.full((len(query_ns), 3), np.nan)
    if len(trajectory.stamp_ns) == 0:
        return poses, np.zeros(len(query_ns), np.bool_)
    after = np.searchsorted(trajectory.stamp_ns, query_ns, side="left")
    inside = np.minimum(after, len(trajectory.stamp_ns) - 1)
    exact = trajectory.stamp_ns[inside] == query_ns
    before = np.maximum(after - 1, 0)
    gap_ns = trajectory.stamp_ns[inside] - trajectory.stamp_ns[before]
    between = (after > 0) & (after < len(trajectory.stamp_ns)) & (gap_ns <= max_gap_ns) & ~exact
    poses[exact] = trajectory.pose[inside[exact]]
    start, end = trajectory.pose[before[between]], trajectory.pose[inside[between]]
    share = (query_ns[between] - trajectory.stamp_ns[before[between]]) / gap_ns[between]
    poses[between] = se2.compose(start, se2.exp(share[:, None] * se2.log(se2.between(start, end))))
    valid: BoolArray = exact | between
    return poses, valid
