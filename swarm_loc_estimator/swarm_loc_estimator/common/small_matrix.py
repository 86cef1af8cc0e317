"""Matrices of three rows inside compiled code: copies, Cholesky factors, solutions."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit


@cached_njit
def assign(target: FloatArray, source: FloatArray) -> None:
    """Copy a vector; each slice assignment would cost seconds of compilation."""
    for i in range(target.size):
        target[i] = source[i]


@cached_njit
def assign_matrix(target: FloatArray, source: FloatArray) -> None:
    """Copy a matrix."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@cached_njit
def add_scaled(target: FloatArray, source: FloatArray, factor: float) -> None:
    """Add `factor` times a matrix."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] += factor * source[i, j]


@inlined_njit
def factor_numbers(matrix: FloatArray) -> tuple[float, float, float, float, float, float]:
    """The rows of the lower Cholesky factor of a positive definite matrix (3, 3), one behind the other."""
    a = math.sqrt(matrix[0, 0])
    b = matrix[1, 0] / a
    c = math.sqrt(matrix[1, 1] - b * b)
    d = matrix[2, 0] / a
    e = (matrix[2, 1] - d * b) / c
    return a, b, c, d, e, math.sqrt(matrix[2, 2] - d * d - e * e)


@cached_njit
def cholesky3(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor (3, 3) of a positive definite matrix (3, 3)."""
    factor = np.zeros((3, 3))
    factor[0, 0], factor[1, 0], factor[1, 1], factor[2, 0], factor[2, 1], factor[2, 2] = factor_numbers(
        matrix
    )
    return factor


@cached_njit
def solve3(factor: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write the solution (3,) of L L^T x = right for a lower factor L (3, 3)."""
    a = right[0] / factor[0, 0]
    b = (right[1] - factor[1, 0] * a) / factor[1, 1]
    c = (right[2] - factor[2, 0] * a - factor[2, 1] * b) / factor[2, 2]
    c = c / factor[2, 2]
    b = (b - factor[2, 1] * c) / factor[1, 1]
    out[0] = (a - factor[1, 0] * b - factor[2, 0] * c) / factor[0, 0]
    out[1], out[2] = b, c
