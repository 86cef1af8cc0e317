"""How sure a mapper says that a robot is where it has it."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.numerics.arrays import FloatArray

_LEAST_SIGMA = np.array([0.02, 0.02, 0.01])
"""Errors of the map that all fixes share are no noise: no fix is told better than this [m, m, rad]."""


def fix_covariance(covariance: FloatArray) -> FloatArray:
    """Covariance (3, 3) that is told of a stop whose covariance in the graph is (3, 3) [m, rad]."""
    told: FloatArray = covariance + np.diag(_LEAST_SIGMA**2)
    return told
