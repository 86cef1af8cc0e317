"""Matrices of three rows inside compiled code: copies, Cholesky factors, solutions."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.numerics.arrays import FloatArray
from swarm_loc_estimator.numerics.jit import compiled


@compiled
def assign(target: FloatArray, source: FloatArray) -> None:
    """Copy a vector; a slice assignment would cost seconds of compilation at every place it stands."""
    for i in range(target.size):
        target[i] = source[i]


@compiled
def assign_matrix(target: FloatArray, source: FloatArray) -> None:
    """Copy a matrix."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@compiled
def add_scaled(target: FloatArray, source: FloatArray, factor: float) -> None:
    """Add `factor` times a matrix."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] += factor * source[i, j]


@compiled
def cholesky3(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor (3, 3) of a positive definite matrix (3, 3)."""
    factor = np.zeros((3, 3))
    for i in range(3):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(value) if i == j else value / factor[j, j]
    return factor


@compiled
def solve3(factor: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write the solution (3,) of L L^T x = right for a lower factor L (3, 3)."""
    a = right[0] / factor[0, 0]
    b = (right[1] - factor[1, 0] * a) / factor[1, 1]
    c = (right[2] - factor[2, 0] * a - factor[2, 1] * b) / factor[2, 2]
    c = c / factor[2, 2]
    b = (b - factor[2, 1] * c) / factor[1, 1]
    out[0] = (a - factor[1, 0] * b - factor[2, 0] * c) / factor[0, 0]
    out[1], out[2] = b, c
