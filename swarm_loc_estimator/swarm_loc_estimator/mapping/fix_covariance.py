"""How sure a mapper says that a robot is where it has it, and what a fix adds to the one before."""

from __future__ import annotations

import math
from dataclasses import astuple
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.process_noise import OdometryStep, add_step_noise
from swarm_loc_estimator.mapping.exploration.goal import Goal
from swarm_loc_estimator.mapping.mapper import SCAN_TURN
from swarm_loc_estimator.odometry.preintegration import MODEL_DTYPE
from swarm_loc_estimator.swarm.swarm import OdometryModel

_LEAST_SIGMA = np.array([0.02, 0.02, 0.01])
"""Errors of the map that all fixes share are no noise: no fix is told better than this [m, m, rad]."""
_OPTIMISM = 2.5
"""Variances over what the graph says: wheels slip unevenly during a scan, which it takes for rigid."""
_LEAST_SIGMA_MOVED = 0.003
_LEAST_NEW = 0.02
"""Share of what the mapper knows that each fix counts for at least, however little it adds."""


class FixCovariances:
    """Covariances of the fixes of one robot, one after the other.

    What is wrong with a map is wrong with all poses in it, so successive fixes err alike. Whoever fuses them
    as independent takes the same scans into account again and again. So each is told with the information by
    which the mapper's pose exceeds that of the fix before carried on by odometry (what is known to both is
    subtracted, as in the information graphs of Chong, Mori and Chang, "Distributed multitarget multisensor
    tracking", 1990): together they make as sure as the mapper is.

    The odometry is that of whoever fuses the fixes: the coarser it takes that to be, the more it has
    forgotten of the fix before.

    Args:
        odometry: Of the robot, as the swarm description has it.
    """

    def __init__(self, odometry: OdometryModel) -> None:
        self._odometry: Any = np.array(astuple(odometry), MODEL_DTYPE)[()]  # as the compiled code takes it
        self._last: tuple[Goal, FloatArray] | None = None

    def told(self, goal: Goal, covariance: FloatArray) -> FloatArray:
        """Covariance (3, 3) to be told of the newest fix.

        Args:
            goal: With pose and stamp.
            covariance: (3, 3) of its stop in the graph [m, rad].
        """
        now = pose_covariance(covariance)
        before, self._last = self._last, (goal, now)
        if before is None or goal.number == 1:  # the first, or the first since odometry began anew
            return now
        known = self._carried_on(*before, goal)
        return _new_alone(now, known)

    def _carried_on(self, before: Goal, covariance: FloatArray, goal: Goal) -> FloatArray:
        """Covariance (3, 3) at a goal by that at the one before, the drive between and the scan after it."""
        dx, dy = (goal.pose - before.pose)[:2].tolist()
        path, duration_s = math.hypot(dx, dy), 1e-9 * (goal.stamp_ns - before.stamp_ns)
        effect = np.eye(3)
        effect[0, 2], effect[1, 2] = -dy, dx
        carried: FloatArray = effect @ covariance @ effect.T + _LEAST_SIGMA_MOVED**2 * np.diag(
            [1.0, 1.0, 0.0]
        )
        drive = OdometryStep(path, 0.0, 0.0, 0.0, 0.0, -0.5 * dx, -0.5 * dy, math.atan2(dy, dx))
        scan = OdometryStep(0.0, 0.0, SCAN_TURN, 0.0, duration_s, 0.0, 0.0, 0.0)
        for step in (drive, scan):
            add_step_noise(self._odometry, step, carried)
        return carried


def pose_covariance(covariance: FloatArray) -> FloatArray:
    """Covariance (3, 3) of a pose whose stop has this one (3, 3) in the graph [m, rad]."""
    whole: FloatArray = _OPTIMISM * covariance + np.diag(_LEAST_SIGMA**2)
    return whole


def _new_alone(now: FloatArray, known: FloatArray) -> FloatArray:
    """The covariance (3, 3) that turns what was known (3, 3) into what is known now (3, 3)."""
    root = np.linalg.cholesky(now)
    inverse = np.linalg.inv(root)
    ratio, axes = np.linalg.eigh(inverse @ known @ inverse.T)  # of variances: known over now
    new = np.maximum(1.0 - 1.0 / ratio, _LEAST_NEW)
    basis = root @ axes
    told = (basis / new) @ basis.T
    symmetric: FloatArray = 0.5 * (told + told.T)
    return symmetric
