"""Elimination: the factor of a prior, projected on a pattern, and of measurements.

Of each front the prior's p(x_J | x_B) is kept. This is the projection on the pattern with the smallest
Kullback-Leibler divergence. As information it is V V^T with V the last columns of C^-T, where C is the
Cholesky factor of the front's covariance, borders first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.filter.sparse.factor import Factor, gathered, new_factor
from swarm_loc_estimator.filter.sparse.symbolic import Pattern
from swarm_loc_estimator.filter.sparse.translation_adjoint import Information

_LOOSER = (0.0, 1e-10, 1e-8, 1e-6, 1e-4)
"""Relative increases of the variances, tried in turn where rounding has made a covariance indefinite."""
_PANEL = 24  # Rows solved at once


class Prior(NamedTuple):
    """Covariances before the measurements, on a pattern."""

    covariance: FloatArray  # (s, s, 3, 3) by the bodies' numbers there
    place: IntArray  # (n,) numbers of the pattern's bodies in `covariance`


def eliminate(pattern: Pattern, prior: Prior, measured: Information) -> Factor:
    """The factor of a prior and measurements.

    Raises:
        LinAlgError: The prior is not positive definite.
    """
    earlier = np.minimum(pattern.front[measured.first], pattern.front[measured.second])
    order = np.argsort(earlier, kind="stable")
    begin = np.searchsorted(earlier[order], np.arange(pattern.fronts + 1))
    factor = new_factor(pattern)
    for looser in _LOOSER:
        try:
            _eliminate(factor, prior, measured, order, begin, looser)
        except np.linalg.LinAlgError:
            continue
        return factor
    raise np.linalg.LinAlgError("the covariance of a front is not positive definite")


@cached_njit
def _eliminate(
    factor: Factor,
    prior: Prior,
    measured: Information,
    order: IntArray,
    begin: IntArray,
    looser: float,
) -> None:
    """Write a factor; the measured blocks of front f are order[begin[f]:begin[f + 1]]."""
    pattern = factor.pattern
    fronts = pattern.pivot_begin.size - 1
    updates = [np.empty((0, 0)) for _ in range(fronts)]
    child, sibling = np.full(fronts, -1, dtype=np.int64), np.full(fronts, -1, dtype=np.int64)
    local = np.zeros(pattern.front.size, dtype=np.int64)
    for f in range(fronts):
        border = pattern.border[pattern.border_begin[f] : pattern.border_begin[f + 1]]
        bodies = np.concatenate((border, pattern.pivot[pattern.pivot_begin[f] : pattern.pivot_begin[f + 1]]))
        split, size = 3 * border.size, 3 * (bodies.size - border.size)
        for k in range(bodies.size):
            local[bodies[k]] = k
        places = prior.place[bodies]
        information = _conditional(gathered(prior.covariance, places, places), size, looser)
        _add_blocks(information, local, measured, order[begin[f] : begin[f + 1]])
        below = child[f]
        while below >= 0:
            left = pattern.border[pattern.border_begin[below] : pattern.border_begin[below + 1]]
            _add_update(information, local, left, updates[below])
            updates[below] = np.empty((0, 0))
            below = sibling[below]
        spread = factor.spread[factor.spread_begin[f] : factor.spread_begin[f + 1]].reshape(size, size)
        own: FloatArray = np.linalg.cholesky(np.ascontiguousarray(information[split:, split:]))
        root = _last_columns(own, size)
        np.dot(root, root.T, spread)
        if split:
            gain = factor.gain[factor.gain_begin[f] : factor.gain_begin[f + 1]].reshape(split, size)
            across = -information[:split, split:]
            np.dot(across, spread, gain)
            updates[f] = information[:split, :split] - np.dot(gain, across.T)
            parent = pattern.front[border].min()
            sibling[f], child[parent] = child[parent], f


@cached_njit
def _conditional(covariance: FloatArray, size: int, looser: float) -> FloatArray:
    """Information (d, d) of p(x_J | x_B) from a covariance (d, d) whose last `size` rows are the pivots."""
    for k in range(covariance.shape[0]):
        covariance[k, k] *= 1.0 + looser
    lower: FloatArray = np.linalg.cholesky(np.ascontiguousarray(covariance))
    columns = _last_columns(lower, size)
    information: FloatArray = np.dot(columns, columns.T)
    return information


@cached_njit
def _last_columns(lower: FloatArray, size: int) -> FloatArray:
    """The last columns (d, size) of the inverse of the transpose of a lower triangular matrix (d, d)."""
    rows = lower.shape[0]
    out = np.zeros((rows, size))
    for k in range(size):
        out[rows - size + k, k] = 1.0
    end = rows
    while end > 0:
        begin = max(0, end - _PANEL)
        if end < rows:
            out[begin:end] -= np.dot(np.ascontiguousarray(lower[end:, begin:end].T), out[end:])
        for r in range(end - 1, begin - 1, -1):
            for q in range(r + 1, end):
                factor = lower[q, r]
                for c in range(size):
                    out[r, c] -= factor * out[q, c]
            scale = 1.0 / lower[r, r]
            for c in range(size):
                out[r, c] *= scale
        end = begin
    return out


@cached_njit
def _add_blocks(information: FloatArray, local: IntArray, measured: Information, which: IntArray) -> None:
    """Add measured blocks to the information of a front, symmetrically."""
    for k in which:
        row, column = 3 * local[measured.first[k]], 3 * local[measured.second[k]]
        for i in range(3):
            for j in range(3):
                information[row + i, column + j] += measured.block[k, i, j]
                if row != column:
                    information[column + j, row + i] += measured.block[k, i, j]


@cached_njit
def _add_update(information: FloatArray, local: IntArray, bodies: IntArray, update: FloatArray) -> None:
    """Add the update of an earlier front with this border (b,)."""
    for r in range(bodies.size):
        row = 3 * local[bodies[r]]
        for c in range(bodies.size):
            column = 3 * local[bodies[c]]
            for i in range(3):
                for j in range(3):
                    information[row + i, column + j] += update[3 * r + i, 3 * c + j]
