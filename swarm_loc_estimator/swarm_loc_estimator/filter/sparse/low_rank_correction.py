"""Low-rank correction: errors that far bodies share, through copies of the errors of some bodies.

    x_i = G_i a + y_i,

where a are independent combinations, of unit variance, of the errors of the copies, and y is independent of a
and represented by the factor. Measurements of x have information T about y, T G about both, and G^T T G about
a: y is eliminated with T G on the right-hand side, and a is one dense block at the end.
"""

from __future__ import annotations

import numpy as np
import scipy

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, reassociated_njit
from swarm_loc_estimator.common.lapack import invert_factor
from swarm_loc_estimator.filter.sparse.factor import Derived, Factor, add_rows, solve
from swarm_loc_estimator.filter.sparse.symbolic import Pattern
from swarm_loc_estimator.filter.sparse.translation_adjoint import Information

_COPY_SPREAD = np.diag(np.square([3e-5, 3e-5, 3e-4]))
"""Variance of a copy given its body [m^2], [m^2], [rad^2]."""
_PANELS = 4


def with_derived(shares: FloatArray, derived: tuple[Derived, ...]) -> FloatArray:
    """G (n, 3, k) with the shares of more bodies appended."""
    if not derived:
        return shares
    out = np.concatenate([shares, np.zeros((len(derived), *shares.shape[1:]))])
    for k, one in enumerate(derived):
        others = out[one.others].reshape(3 * one.others.size, shares.shape[2])
        out[len(shares) + k] = one.gain.T @ others
    return out


def renewed(factor: Factor, shares: FloatArray, copied: IntArray) -> FloatArray:
    """G (n, 3, k) of new copies of bodies (m,), which replace the old copies.

    k is 3 m: with fewer combinations, covariances of robots with a single landmark are too small.
    """
    count, size = factor.pattern.front.size, 3 * copied.size
    columns = (3 * copied[:, None] + np.arange(3)).reshape(-1)
    across = np.zeros((3 * count, size))
    across[columns, np.arange(size)] = 1.0
    solve(factor, across)
    before = shares.reshape(3 * count, -1)
    across += before @ before[columns].T
    covariance = across[columns] + np.kron(np.eye(copied.size), _COPY_SPREAD)
    _whiten(across, covariance)
    return across.reshape(count, 3, size)


def updated(factor: Factor, shares: FloatArray, measured: Information) -> tuple[FloatArray, FloatArray]:
    """G after measurements, and their correction (n, 3).

    Args:
        factor: Of y, after the measurements.
        shares: (n, 3, k) G before them.
        measured: Information of the measurements.
    """
    count, _, size = shares.shape
    before, gradient = shares.reshape(3 * count, size), measured.gradient.reshape(-1)
    right = np.empty((3 * count, size + 1))
    right[:, size] = gradient
    _weigh(measured, before, right)
    weighted = right[:, :size].copy()
    solve(factor, right)
    after, correction = before - right[:, :size], right[:, size]
    if size:
        _whiten(after, np.eye(size) + _lower_product(weighted, after))
        correction = correction + after @ (after.T @ gradient)
    return after.reshape(count, 3, size), correction.reshape(count, 3)


def _lower_product(left: FloatArray, right: FloatArray) -> FloatArray:
    """The lower triangle of left^T right for columns (n, k), in panels that skip part of the upper one."""
    size = left.shape[1]
    out = np.zeros((size, size))
    for panel in np.array_split(np.arange(size), min(_PANELS, size)):
        begin, end = panel[0], panel[-1] + 1
        np.matmul(left[:, begin:].T, right[:, begin:end], out=out[begin:, begin:end])
    return out


def _whiten(columns: FloatArray, matrix: FloatArray) -> None:
    """Multiply columns (n, k) by K^-T, in place, where K K^T is a matrix (k, k) by its lower triangle.

    Uses the inverse of K: the product takes half the time of solving with this many columns.

    Raises:
        LinAlgError: The matrix is not positive definite.
    """
    if matrix.size:
        inverse = np.array(matrix, order="F")
        if not invert_factor(inverse.reshape(-1, order="F"), len(inverse)):
            raise np.linalg.LinAlgError("the covariance of the copies is not positive definite")
        scipy.linalg.blas.dtrmm(1.0, inverse, columns.T, lower=1, overwrite_b=1)


@cached_njit
def _weigh(measured: Information, shares: FloatArray, out: FloatArray) -> None:
    """Write T G to the first columns of `out` (3 n, k + 1) for G (3 n, k)."""
    size = shares.shape[1]
    out[:, :size] = 0.0
    for k in range(measured.first.size):
        row, column, block = 3 * measured.first[k], 3 * measured.second[k], measured.block[k]
        for i in range(3):
            add_rows(shares[column : column + 3], block[i, 0], block[i, 1], block[i, 2], out[row + i, :size])
            if row != column:
                other = out[column + i, :size]
                add_rows(shares[row : row + 3], block[0, i], block[1, i], block[2, i], other)


@reassociated_njit
def shared(shares: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """Covariances (m, 3, 3) of pairs of bodies (m,) through the copies."""
    out = np.zeros((first.size, 3, 3))
    for k in range(first.size):
        for i in range(3):
            for j in range(3):
                total = 0.0
                for c in range(shares.shape[2]):
                    total += shares[first[k], i, c] * shares[second[k], j, c]
                out[k, i, j] = total
    return out


@cached_njit
def change_shared(
    covariance: FloatArray, pattern: Pattern, place: IntArray, old: FloatArray, new: FloatArray
) -> None:
    """Change the covariances of y from old to new copies, for all pairs of a pattern.

    Args:
        covariance: (n, n, 3, 3) of y, changed.
        pattern: Pairs to change.
        place: Numbers of the pattern's bodies in `covariance`.
        old: (n, 3, k) G of the old copies.
        new: (n, 3, k) G of the new copies.
    """
    for f in range(pattern.pivot_begin.size - 1):
        pivots = place[pattern.pivot[pattern.pivot_begin[f] : pattern.pivot_begin[f + 1]]]
        border = place[pattern.border[pattern.border_begin[f] : pattern.border_begin[f + 1]]]
        bodies = np.concatenate((border, pivots))
        change = np.dot(_rows(old, bodies), _rows(old, pivots).T)
        change -= np.dot(_rows(new, bodies), _rows(new, pivots).T)
        for r in range(bodies.size):
            for c in range(pivots.size):
                for i in range(3):
                    for j in range(3):
                        value = covariance[bodies[r], pivots[c], i, j] + change[3 * r + i, 3 * c + j]
                        covariance[bodies[r], pivots[c], i, j] = value
                        if r < border.size:
                            covariance[pivots[c], bodies[r], j, i] = value


@cached_njit
def _rows(shares: FloatArray, bodies: IntArray) -> FloatArray:
    """The shares (3 m, k) of some bodies (m,)."""
    out = np.empty((3 * bodies.size, shares.shape[2]))
    for r in range(bodies.size):
        out[3 * r : 3 * r + 3] = shares[bodies[r]]
    return out
