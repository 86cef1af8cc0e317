"""Elimination: a prior projected on a pattern, measurements added, and the factor of both.

Of each front the prior's p(x_J | x_B) is kept, which is the projection on the pattern that loses least in
Kullback and Leibler's measure. As information it is V V^T with V the last columns of C^-T, where C is the
Cholesky factor of the front's covariance, borders first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import blas, lapack

from swarm_loc_estimator.core.filter.sparse.factor import Factor, gathered
from swarm_loc_estimator.core.filter.sparse.levers import Information
from swarm_loc_estimator.core.filter.sparse.symbolic import Pattern
from swarm_loc_estimator.numerics.arrays import FloatArray, IntArray
from swarm_loc_estimator.numerics.jit import compiled

_LOOSER, _ATTEMPTS = 1e-10, 5


class Prior(NamedTuple):
    """What is known before, on a pattern.

    Attributes:
        covariance: (s, s, 3, 3) by the bodies' numbers there.
        place: (n,) the numbers of the pattern's bodies there.
    """

    covariance: FloatArray
    place: IntArray


def eliminate(pattern: Pattern, prior: Prior, measured: Information) -> tuple[Factor, FloatArray]:
    """The factor of a prior and measurements, and the correction (n, 3) that they make."""
    gains, spreads = [], []
    updates: list[tuple[IntArray, FloatArray] | None] = [None] * pattern.fronts
    children: list[list[int]] = [[] for _ in range(pattern.fronts)]
    earlier = np.minimum(pattern.front[measured.first], pattern.front[measured.second])
    order = np.argsort(earlier, kind="stable")
    begin = np.searchsorted(earlier[order], np.arange(pattern.fronts + 1))
    local, gradient = np.zeros(pattern.front.size, dtype=np.int64), measured.gradient.copy()
    for f in range(pattern.fronts):
        border, pivots = pattern.border_of(f), pattern.pivots_of(f)
        bodies, split = np.concatenate([border, pivots]), 3 * border.size
        local[bodies] = np.arange(bodies.size)
        places = prior.place[bodies]
        information = _conditional(gathered(prior.covariance, places, places), split)
        _add_blocks(information, local, measured, order[begin[f] : begin[f + 1]])
        for child in children[f]:
            update = updates[child]
            if update is not None:
                _add_update(information, local, *update)
                updates[child] = None
        spread = _inverse(information[split:, split:])
        across = np.ascontiguousarray(information[:split, split:])
        gain = -across @ spread
        gains.append(gain)
        spreads.append(spread)
        if border.size:
            updates[f] = border, information[:split, :split] + gain @ across.T
            children[int(pattern.front[border].min())].append(f)
            gradient[border] += (gain @ gradient[pivots].reshape(-1)).reshape(-1, 3)
    factor = Factor(pattern, tuple(gains), tuple(spreads))
    return factor, _solved(factor, gradient)


def _solved(factor: Factor, gradient: FloatArray) -> FloatArray:
    """The correction (n, 3), from the last front to the first, of gradients (n, 3) gathered upwards."""
    correction, pattern = np.zeros_like(gradient), factor.pattern
    for f in range(pattern.fronts - 1, -1, -1):
        border, pivots = pattern.border_of(f), pattern.pivots_of(f)
        moved = factor.spread[f] @ gradient[pivots].reshape(-1)
        moved += factor.gain[f].T @ correction[border].reshape(-1)
        correction[pivots] = moved.reshape(-1, 3)
    return correction


def _conditional(covariance: FloatArray, split: int) -> FloatArray:
    """Information (d, d) of p(x_J | x_B) for a covariance (d, d), its border being the first `split` rows."""
    upper = _cholesky(covariance)
    root, info = lapack.dtrtri(np.asfortranarray(upper[split:, split:]), lower=0)  # (C_J^-1)^T
    if info:
        raise np.linalg.LinAlgError("the covariance of a front is singular")
    root = np.triu(root)
    columns = np.empty((covariance.shape[0], root.shape[0]), order="F")
    columns[split:] = root
    if split:
        inner = -upper[:split, split:] @ root
        columns[:split] = blas.dtrsm(1.0, upper[:split, :split], np.asfortranarray(inner), overwrite_b=1)
    information: FloatArray = columns @ columns.T
    return information


def _cholesky(matrix: FloatArray) -> FloatArray:
    """Upper factor U (d, d), anything below, of a symmetric matrix U^T U; rounding is made up for."""
    for attempt in range(_ATTEMPTS):
        upper, info = lapack.dpotrf(matrix.T, lower=0, clean=0)
        if not info:
            factor: FloatArray = upper
            return factor
        matrix = matrix + np.diag(_LOOSER * 100.0**attempt * np.diag(matrix))
    raise np.linalg.LinAlgError("the covariance of a front is not positive definite")


def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a symmetric positive definite matrix."""
    inverse, info = lapack.dpotri(_cholesky(matrix), lower=0, overwrite_c=1)
    if info:
        raise np.linalg.LinAlgError("the information of a front is singular")
    upper = np.triu(inverse)
    whole: FloatArray = upper + np.triu(inverse, 1).T
    return whole


@compiled
def _add_blocks(information: FloatArray, local: IntArray, measured: Information, which: IntArray) -> None:
    """Add some blocks of what was measured to a front's information, those of two bodies either way."""
    for k in which:
        row, column = 3 * local[measured.first[k]], 3 * local[measured.second[k]]
        for i in range(3):
            for j in range(3):
                information[row + i, column + j] += measured.block[k, i, j]
                if row != column:
                    information[column + j, row + i] += measured.block[k, i, j]


@compiled
def _add_update(information: FloatArray, local: IntArray, bodies: IntArray, update: FloatArray) -> None:
    """Add what a front before says of its border (b,)."""
    for r in range(bodies.size):
        row = 3 * local[bodies[r]]
        for c in range(bodies.size):
            column = 3 * local[bodies[c]]
            for i in range(3):
                for j in range(3):
                    information[row + i, column + j] += update[3 * r + i, 3 * c + j]
