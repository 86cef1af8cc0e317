"""Innovation covariance: the prediction's part H P H^T."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.numerics.arrays import FloatArray, IntArray
from swarm_loc_estimator.numerics.jit import compiled


@compiled
def add_uncertainty(
    p: FloatArray, bodies: tuple[int, int], camera: IntArray, chain: FloatArray, s: FloatArray
) -> None:
    """Add H P H^T (3, 3), eq. (13) of the e-puck paper, where H is `chain` (3, 5) by xi_target - xi_observer.

    The difference is taken first: a third of the work.

    Args:
        p: (n, n) covariance.
        bodies: First column of the observer and of the target, or -1.
        camera: (2,) columns of its parameters, or -1.
        chain: (3, 5).
        s: (3, 3) added to.
    """
    o, t = max(bodies[0], 0), max(bodies[1], 0)
    of_observer, of_target = 1.0 if bodies[0] >= 0 else 0.0, 1.0 if bodies[1] >= 0 else 0.0
    difference, half = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            across = of_target * of_observer * (p[t + i, o + j] + p[o + i, t + j])
            difference[i, j] = of_target * p[t + i, t + j] + of_observer * p[o + i, o + j] - across
    _turned(chain, difference, half)
    for i in range(3):
        for j in range(3):
            for a in range(3):
                s[i, j] += half[i, a] * chain[j, a]
    for k in range(2):
        if camera[k] >= 0:
            for a in range(3):
                of_side = of_target * p[t + a, camera[k]] - of_observer * p[o + a, camera[k]]
                difference[a, 0] = of_side
            for i in range(3):
                beside = chain[i, 0] * difference[0, 0] + chain[i, 1] * difference[1, 0]
                beside += chain[i, 2] * difference[2, 0]
                for other in range(2):  # its own variance, and its covariance with the other parameter
                    if camera[other] >= 0:
                        beside += 0.5 * chain[i, 3 + other] * p[camera[other], camera[k]]
                for j in range(3):
                    s[i, j] += beside * chain[j, 3 + k]
                    s[j, i] += beside * chain[j, 3 + k]


@compiled
def _turned(chain: FloatArray, matrix: FloatArray, out: FloatArray) -> None:
    """Write the product of the first three columns of `chain` and a matrix (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = chain[i, 0] * matrix[0, j] + chain[i, 1] * matrix[1, j] + chain[i, 2] * matrix[2, j]
