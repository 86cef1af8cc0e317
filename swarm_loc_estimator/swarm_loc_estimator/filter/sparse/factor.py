"""The factor: the pivots of each front given its border, and the covariances that follow.

    x_J = A^T x_B + e,    cov e = D,

for every front, which determines the whole Gaussian. Factors are immutable.

Elimination: the factor of a prior, projected on a pattern, and of measurements.

Of each front the prior's p(x_J | x_B) is kept. This is the projection on the pattern with the smallest
Kullback-Leibler divergence. As information it is V V^T with V the last columns of C^-T, where C is the
Cholesky factor of the front's covariance, borders first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.filter.sparse.ordering import Pattern
from swarm_loc_estimator.filter.sparse.parameters import Information

_FEW = 2  # Up to this number of pivots, products with many columns are faster as loops than by BLAS


class Derived(NamedTuple):
    """A body appended to a factor, whose error is a function of those of others."""

    others: IntArray  # (s,) bodies of the factor, or appended before; empty: independent
    gain: FloatArray  # (3 s, 3) A
    spread: FloatArray  # (3, 3) D


class Factor(NamedTuple):
    """A Gaussian over bodies."""

    pattern: Pattern  # Its fronts
    gain: FloatArray  # A (3 b, 3 j) of all fronts, concatenated
    gain_begin: IntArray  # (F + 1,) start of each front's A
    spread: FloatArray  # D (3 j, 3 j) of all fronts, concatenated
    spread_begin: IntArray  # (F + 1,)


_NONE: IntArray = np.zeros(0, dtype=np.int64)
_FIRST: IntArray = np.zeros(1, dtype=np.int64)
EMPTY = Factor(Pattern(_NONE, _FIRST, _NONE, _FIRST, _NONE), np.zeros(0), _FIRST, np.zeros(0), _FIRST)
"""A factor without bodies."""


def new_factor(pattern: Pattern) -> Factor:
    """A factor with uninitialized values."""
    pivots, border = 3 * np.diff(pattern.pivot_begin), 3 * np.diff(pattern.border_begin)
    gain_begin, spread_begin = _begins(border * pivots), _begins(pivots * pivots)
    return Factor(pattern, np.empty(gain_begin[-1]), gain_begin, np.empty(spread_begin[-1]), spread_begin)


def with_derived(factor: Factor, derived: tuple[Derived, ...]) -> Factor:
    """The factor with more bodies, numbered last and eliminated first."""
    if not derived:
        return factor
    old, count = factor.pattern, len(derived)
    newest = derived[::-1]
    bodies = old.front.size + np.arange(count)
    borders = _begins(np.array([one.others.size for one in newest]))
    pattern = Pattern(
        np.concatenate([bodies[::-1], old.pivot]),
        np.concatenate([np.arange(count), count + old.pivot_begin]),
        np.concatenate([*(one.others for one in newest), old.border]),
        np.concatenate([borders[:-1], borders[-1] + old.border_begin]),
        np.concatenate([np.where(old.front >= 0, old.front + count, -1), np.arange(count)[::-1]]),
    )
    return Factor(
        pattern,
        np.concatenate([*(one.gain.reshape(-1) for one in newest), factor.gain]),
        np.concatenate([9 * borders[:-1], 9 * borders[-1] + factor.gain_begin]),
        np.concatenate([*(one.spread.reshape(-1) for one in newest), factor.spread]),
        np.concatenate([9 * np.arange(count), 9 * count + factor.spread_begin]),
    )


def _begins(sizes: IntArray) -> IntArray:
    """Starts of consecutive parts of these sizes (k,), and the end of the last one (k + 1,)."""
    return np.concatenate([[0], np.cumsum(sizes)])


@cached_njit
def _front(factor: Factor, f: int) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """The pivots (j,) and the border (b,) of front f, its A (3 b, 3 j) and D (3 j, 3 j)."""
    pattern = factor.pattern
    pivots = pattern.pivot[pattern.pivot_begin[f] : pattern.pivot_begin[f + 1]]
    border = pattern.border[pattern.border_begin[f] : pattern.border_begin[f + 1]]
    size = 3 * pivots.size
    gain = factor.gain[factor.gain_begin[f] : factor.gain_begin[f + 1]].reshape(3 * border.size, size)
    spread = factor.spread[factor.spread_begin[f] : factor.spread_begin[f + 1]].reshape(size, size)
    return pivots, border, gain, spread


@cached_njit
def write_fronts(factor: Factor, covariance: FloatArray) -> None:
    """Write the covariances (n, n, 3, 3) within all fronts of n bodies, from the last front to the first.

    No body is appended; other entries do not change. Takahashi et al., "Formation of a sparse bus impedance
    matrix and its application to short circuit study" (1973), for fronts.
    """
    for f in range(factor.pattern.pivot_begin.size - 2, -1, -1):
        _write_front(factor, f, covariance)


@cached_njit
def _write_front(factor: Factor, f: int, covariance: FloatArray) -> None:
    """Write the covariances of the pivots of front f, from those of its border."""
    pivots, border, gain, own = _front(factor, f)
    if border.size:
        across = np.dot(gathered(covariance, border, border), gain)
        own = own + np.dot(gain.T, across)
        _scatter(covariance, border, pivots, across)
    for r in range(pivots.size):  # symmetric to the last bit
        for c in range(pivots.size):
            for i in range(3):
                for j in range(3):
                    a, b = 3 * r + i, 3 * c + j
                    covariance[pivots[r], pivots[c], i, j] = 0.5 * (own[a, b] + own[b, a])


@cached_njit
def write_rows(
    factor: Factor, derived: int, rows: IntArray, rows_begin: IntArray, covariance: FloatArray
) -> None:
    """Write the covariances (n, n, 3, 3) of wanted rows and appended bodies, from those within other fronts.

    The first fronts, `derived` in number, are of appended bodies; pairs of their borders may be in no front.
    For `rows` and their start in each front (F + 1,) see `wanted_rows`. Other entries do not change.
    """
    for f in range(factor.pattern.pivot_begin.size - 2, -1, -1):
        if f < derived:
            _write_front(factor, f, covariance)
        wanted = rows[rows_begin[f] : rows_begin[f + 1]]
        if not wanted.size:
            continue
        pivots, border, gain, _ = _front(factor, f)
        across = np.zeros((3 * wanted.size, 3 * pivots.size))
        if border.size:
            np.dot(gathered(covariance, wanted, border), gain, across)
        _scatter(covariance, wanted, pivots, across)


@cached_njit
def solve(factor: Factor, right: FloatArray) -> None:
    """Multiply the factor's covariance by columns (3 n, c), in place."""
    fronts = factor.pattern.pivot_begin.size - 1
    for f in range(fronts):
        _substitute(factor, f, right)
    for f in range(fronts - 1, -1, -1):
        _substitute_back(factor, f, right)


@cached_njit
def _substitute(factor: Factor, f: int, right: FloatArray) -> None:
    """Forward substitution of front f: add the contribution of its pivots to its border."""
    pivots, border, gain, _ = _front(factor, f)
    rows = 3 * border.size
    if pivots.size <= _FEW:
        for r in range(rows):
            out = right[3 * border[r // 3] + r % 3]
            for p in range(0, 3 * pivots.size, 3):
                of_pivot = right[3 * pivots[p // 3] : 3 * pivots[p // 3] + 3]
                add_rows(of_pivot, gain[r, p], gain[r, p + 1], gain[r, p + 2], out)
    elif border.size:
        added = np.dot(gain, _rows_of(right, pivots))
        for r in range(rows):
            row = 3 * border[r // 3] + r % 3
            for c in range(right.shape[1]):
                right[row, c] += added[r, c]


@cached_njit
def _substitute_back(factor: Factor, f: int, right: FloatArray) -> None:
    """Back substitution of front f: solve for its pivots, given its border."""
    pivots, border, gain, spread = _front(factor, f)
    rows, size, own = 3 * border.size, 3 * pivots.size, _rows_of(right, pivots)
    if pivots.size <= _FEW:
        for p in range(size):
            out = right[3 * pivots[p // 3] + p % 3]
            out[:] = 0.0
            for q in range(0, size, 3):
                add_rows(own[q : q + 3], spread[p, q], spread[p, q + 1], spread[p, q + 2], out)
            for r in range(0, rows, 3):
                of_border = right[3 * border[r // 3] : 3 * border[r // 3] + 3]
                add_rows(of_border, gain[r, p], gain[r + 1, p], gain[r + 2, p], out)
        return
    solved = np.dot(spread, own)
    if border.size:
        solved += np.dot(gain.T, _rows_of(right, border))
    for r in range(pivots.size):
        right[3 * pivots[r] : 3 * pivots[r] + 3] = solved[3 * r : 3 * r + 3]


@inlined_njit
def add_rows(rows: FloatArray, first: float, second: float, third: float, out: FloatArray) -> None:
    """Add three rows (3, k), each times a factor, to one (k,)."""
    for c in range(out.size):
        out[c] += first * rows[0, c] + second * rows[1, c] + third * rows[2, c]


@cached_njit
def _rows_of(matrix: FloatArray, bodies: IntArray) -> FloatArray:
    """The rows (3 k, c) of bodies (k,)."""
    out = np.empty((3 * bodies.size, matrix.shape[1]))
    for r in range(bodies.size):
        out[3 * r : 3 * r + 3] = matrix[3 * bodies[r] : 3 * bodies[r] + 3]
    return out


@cached_njit
def gathered(covariance: FloatArray, rows: IntArray, columns: IntArray) -> FloatArray:
    """Covariances (3 r, 3 c) of bodies (r,) with bodies (c,)."""
    out = np.empty((3 * rows.size, 3 * columns.size))
    for c in range(columns.size):  # most are rows: those of one column are contiguous
        for r in range(rows.size):
            for i in range(3):
                for j in range(3):
                    out[3 * r + i, 3 * c + j] = covariance[columns[c], rows[r], j, i]
    return out


@cached_njit
def _scatter(covariance: FloatArray, rows: IntArray, columns: IntArray, values: FloatArray) -> None:
    """Write covariances (3 r, 3 c) of bodies (r,) with bodies (c,), and their transposes."""
    for c in range(columns.size):
        for r in range(rows.size):
            for i in range(3):
                for j in range(3):
                    covariance[columns[c], rows[r], j, i] = values[3 * r + i, 3 * c + j]
    for r in range(rows.size):
        for c in range(columns.size):
            for i in range(3):
                for j in range(3):
                    covariance[rows[r], columns[c], i, j] = values[3 * r + i, 3 * c + j]


_LOOSER = (0.0, 1e-10, 1e-8, 1e-6, 1e-4)
"""Relative increases of the variances, tried in turn where rounding has made a covariance indefinite."""
_PANEL = 24  # Rows solved at once


class Prior(NamedTuple):
    """Covariances before the measurements, on a pattern."""

    covariance: FloatArray  # (s, s, 3, 3) by the bodies' numbers there
    place: IntArray  # (n,) numbers of the pattern's bodies in `covariance`


def eliminate(pattern: Pattern, prior: Prior, measured: Information) -> Factor:
    """The factor of a prior and measurements; raises LinAlgError if the prior is not positive definite."""
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
    factor: Factor, prior: Prior, measured: Information, order: IntArray, begin: IntArray, looser: float
) -> None:
    """Write a factor; the measured blocks of front f are order[begin[f]:begin[f + 1]]."""
    pattern = factor.pattern
    fronts = pattern.pivot_begin.size - 1
    updates = [np.empty((0, 0)) for _ in range(fronts)]
    child, sibling = np.full(fronts, -1, dtype=np.int64), np.full(fronts, -1, dtype=np.int64)
    local = np.zeros(pattern.front.size, dtype=np.int64)
    for f in range(fronts):
        # the bodies of the front, its border first
        pivots, border, gain, spread = _front(factor, f)
        bodies = np.concatenate((border, pivots))
        split, size = 3 * border.size, 3 * pivots.size
        for k in range(bodies.size):
            local[bodies[k]] = k
        # information: p(x_J | x_B) of the prior, measurements, and what earlier fronts leave of theirs
        places = prior.place[bodies]
        covariance = gathered(prior.covariance, places, places)
        for k in range(split + size):
            covariance[k, k] *= 1.0 + looser
        lower: FloatArray = np.linalg.cholesky(np.ascontiguousarray(covariance))
        columns = _last_columns(lower, size)
        information = np.dot(columns, columns.T)
        _add_blocks(information, local, measured, order[begin[f] : begin[f + 1]])
        below = child[f]
        while below >= 0:
            left = pattern.border[pattern.border_begin[below] : pattern.border_begin[below + 1]]
            _add_update(information, local, left, updates[below])
            updates[below] = np.empty((0, 0))
            below = sibling[below]
        # D and A of the pivots, and what they leave to the front of the border's first body
        own: FloatArray = np.linalg.cholesky(np.ascontiguousarray(information[split:, split:]))
        root = _last_columns(own, size)
        np.dot(root, root.T, spread)
        if split:
            across = -information[:split, split:]
            np.dot(across, spread, gain)
            updates[f] = information[:split, :split] - np.dot(gain, across.T)
            parent = pattern.front[border].min()
            sibling[f], child[parent] = child[parent], f


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
