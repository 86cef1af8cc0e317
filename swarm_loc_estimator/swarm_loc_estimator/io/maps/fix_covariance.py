"""How sure a mapper says that a robot is where it has it, and what a fix adds to the one before."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.core.mapping.exploration.goal import Goal
from swarm_loc_estimator.core.mapping.mapper import SCAN_TURN
from swarm_loc_estimator.core.mapping.settings import MapperSettings
from swarm_loc_estimator.numerics.arrays import FloatArray

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

    Args:
        settings: Of the mapper, whose odometry is meant.
    """

    def __init__(self, settings: MapperSettings) -> None:
        self._settings = settings
        self._last: tuple[FloatArray, FloatArray] | None = None

    def told(self, goal: Goal, covariance: FloatArray) -> FloatArray:
        """Covariance (3, 3) to be told of the newest fix.

        Args:
            goal: With the pose.
            covariance: (3, 3) of its stop in the graph [m, rad].
        """
        now = pose_covariance(covariance)
        before, self._last = self._last, (goal.pose, now)
        if before is None or goal.number == 1:  # the first, or the first since odometry began anew
            return now
        known = self._carried_on(*before, goal.pose)
        return _new_alone(now, known)

    def _carried_on(self, pose: FloatArray, covariance: FloatArray, to: FloatArray) -> FloatArray:
        """Covariance (3, 3) at another pose by that of one before and the odometry between them."""
        noise = self._settings
        dx, dy = (to - pose)[:2].tolist()
        path = math.hypot(dx, dy)
        effect = np.eye(3)
        effect[0, 2], effect[1, 2] = -dy, dx
        turns = SCAN_TURN / (2.0 * math.pi)
        heading = math.hypot(
            noise.heading_noise,
            noise.course_noise * math.sqrt(path),
            2.0 * math.pi * noise.turn_noise * math.sqrt(turns),
        )
        moved = noise.distance_noise * path + _LEAST_SIGMA_MOVED
        carried: FloatArray = effect @ covariance @ effect.T + np.diag([moved**2, moved**2, heading**2])
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
