"""Detection of odometry that is constant while measurements say that its robot moves.

Drivers that fill only the twist are recognised by it, see `odometry/continuity.py`; readings without a twist,
as those of shared topics, and dead encoders only by poses that move nevertheless.
"""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray
from swarm_loc_estimator.timeline.estimate import Estimate

_MOVES = 3
"""Number of moves that prove motion; one or two may be the correction of a wrong start or calibration."""
_MOVE_M, _MOVE_SIGMAS = 0.05, 3.0
"""Minimum displacement of a move: a length, and a multiple of the standard deviation of both ends."""
_MEMORY_NS = 30_000_000_000  # Time within which these moves happen, and for which they are remembered
_LONG_AGO_NS = np.iinfo(np.int64).min // 2


class ConstantOdometry:
    """Moves of estimated poses of robots whose odometry has never changed.

    Args:
        robots: Number of robots.
    """

    def __init__(self, robots: int) -> None:
        self._from = np.full((robots, 2), np.nan)
        self._from_variance = np.zeros(robots)
        self._moves_ns = np.full((robots, _MOVES), _LONG_AGO_NS)

    def forget(self, robot: int) -> None:
        """Forget the moves of a robot whose pose was set."""
        self._from[robot] = np.nan
        self._moves_ns[robot] = _LONG_AGO_NS

    def add(self, constant: BoolArray, estimate: Estimate) -> None:
        """Take note of poses; `constant` (N,) tells whose odometry has never changed."""
        variance = 0.5 * np.trace(estimate.covariances[:, :2, :2], axis1=1, axis2=2)
        position = np.where(constant[:, None], estimate.poses[:, :2], np.nan)
        reach = np.maximum(_MOVE_M, _MOVE_SIGMAS * np.sqrt(variance + self._from_variance))
        moved = np.hypot(*(position - self._from).T) > reach  # False for NaN
        self._moves_ns[moved] = np.roll(self._moves_ns[moved], 1, axis=1)
        self._moves_ns[moved, 0] = estimate.stamp_ns
        self._moves_ns[~constant] = _LONG_AGO_NS  # such as a robot that was carried before it drove
        changed = moved | np.isnan(self._from[:, 0]) | np.isnan(position[:, 0])
        self._from[changed], self._from_variance[changed] = position[changed], variance[changed]

    def contradicted(self, now_ns: int) -> BoolArray:
        """Whether measurements contradict the constant odometry of each robot (N,)."""
        return np.asarray(now_ns - self._moves_ns[:, -1] < _MEMORY_NS)
