"""Inverses of covariance and information matrices."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.lapack import invert_positive


def inverse(matrix: FloatArray) -> FloatArray:
    """Inverse (n, n) of a symmetric positive definite matrix; exactly symmetric.

    Raises:
        LinAlgError: The matrix is not positive definite.
    """
    inverted: FloatArray = matrix.copy()
    invert(inverted)
    return inverted


def invert(matrix: FloatArray) -> None:
    """Invert a matrix (n, n) in place; see `inverse`."""
    if not invert_positive(matrix.reshape(-1), matrix.shape[0]):
        raise np.linalg.LinAlgError("the covariance is not positive definite")
    _mirror(matrix)


@cached_njit
def _mirror(matrix: FloatArray) -> None:
    """Copy the upper triangle, the lower one in Fortran order, to the other triangle."""
    for i in range(matrix.shape[0]):
        for j in range(i):
            matrix[i, j] = matrix[j, i]
