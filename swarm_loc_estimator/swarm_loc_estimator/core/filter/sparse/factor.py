"""The factor: how each front's pivots depend on its border, and the covariances that follow from it.

    x_J = A^T x_B + e,    cov e = D,

for every front, in which all that is known of the bodies is said. A factor is never written to: what is
derived from it, or comes after it, is another one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.core.filter.sparse.symbolic import Pattern
from swarm_loc_estimator.numerics.arrays import FloatArray, IntArray
from swarm_loc_estimator.numerics.jit import compiled


class Derived(NamedTuple):
    """A body that has come since, whose error follows from those of others.

    Attributes:
        others: (s,) bodies of the factor, or derived before; none: it is independent.
        gain: (3 s, 3) A.
        spread: (3, 3) D.
    """

    others: IntArray
    gain: FloatArray
    spread: FloatArray


class Factor(NamedTuple):
    """A Gaussian over bodies.

    Attributes:
        pattern: Its fronts.
        gain: Of each front A (3 b, 3 j).
        spread: Of each front D (3 j, 3 j).
    """

    pattern: Pattern
    gain: tuple[FloatArray, ...]
    spread: tuple[FloatArray, ...]

    @property
    def bodies(self) -> int:
        """How many numbers of bodies there are."""
        return self.pattern.front.size


_NONE: IntArray = np.zeros(0, dtype=np.int64)
_FIRST: IntArray = np.zeros(1, dtype=np.int64)
EMPTY = Factor(Pattern(_NONE, _FIRST, _NONE, _FIRST, _NONE), (), ())
"""Of no bodies."""


def with_derived(factor: Factor, derived: tuple[Derived, ...]) -> Factor:
    """The factor with more bodies, numbered behind those it has; each is eliminated before all others."""
    if not derived:
        return factor
    old, count = factor.pattern, len(derived)
    newest = derived[::-1]
    bodies = factor.bodies + np.arange(count)
    borders = np.cumsum([one.others.size for one in newest])
    pattern = Pattern(
        np.concatenate([bodies[::-1], old.pivot]),
        np.concatenate([np.arange(count), count + old.pivot_begin]),
        np.concatenate([*(one.others for one in newest), old.border]),
        np.concatenate([[0], borders[:-1], borders[-1] + old.border_begin]),
        np.concatenate([np.where(old.front >= 0, old.front + count, -1), np.arange(count)[::-1]]),
    )
    gain, spread = (one.gain for one in newest), (one.spread for one in newest)
    return Factor(pattern, (*gain, *factor.gain), (*spread, *factor.spread))


def write_covariances(factor: Factor, rows: tuple[IntArray, IntArray], covariance: FloatArray) -> None:
    """Write the covariances within all fronts, and those of wanted rows, from the last front to the first.

    Takahashi et al., "Formation of a sparse bus impedance matrix and its application to short circuit study"
    (1973), for fronts and extended to rows outside of the pattern.

    Args:
        factor: Of n bodies.
        rows: As `symbolic.wanted_rows` gives them.
        covariance: (n, n, 3, 3) written; what is not wanted stays as it is.
    """
    pattern = factor.pattern
    for f in range(pattern.fronts - 1, -1, -1):
        pivots, border = pattern.pivots_of(f), pattern.border_of(f)
        beside = np.concatenate([border, rows[0][rows[1][f] : rows[1][f + 1]]])
        own, gain = factor.spread[f], factor.gain[f]
        across = np.zeros((3 * beside.size, 3 * pivots.size))
        if border.size:
            across = gathered(covariance, beside, border) @ gain
            own = own + gain.T @ across[: 3 * border.size]
        scatter(covariance, beside, pivots, across)
        _scatter_own(covariance, pivots, np.ascontiguousarray(own))


@compiled
def gathered(covariance: FloatArray, rows: IntArray, columns: IntArray) -> FloatArray:
    """Covariances (3 r, 3 c) of bodies (r,) with bodies (c,)."""
    out = np.empty((3 * rows.size, 3 * columns.size))
    for r in range(rows.size):
        for c in range(columns.size):
            block = covariance[rows[r], columns[c]]
            for i in range(3):
                for j in range(3):
                    out[3 * r + i, 3 * c + j] = block[i, j]
    return out


@compiled
def scatter(covariance: FloatArray, rows: IntArray, columns: IntArray, values: FloatArray) -> None:
    """Write covariances (3 r, 3 c) of bodies (r,) with bodies (c,), either way."""
    for r in range(rows.size):
        for c in range(columns.size):
            block, other = covariance[rows[r], columns[c]], covariance[columns[c], rows[r]]
            for i in range(3):
                for j in range(3):
                    block[i, j] = other[j, i] = values[3 * r + i, 3 * c + j]


@compiled
def _scatter_own(covariance: FloatArray, bodies: IntArray, values: FloatArray) -> None:
    """Write covariances (3 k, 3 k) among bodies (k,), symmetric to the last bit."""
    for r in range(bodies.size):
        for c in range(bodies.size):
            block = covariance[bodies[r], bodies[c]]
            for i in range(3):
                for j in range(3):
                    a, b = 3 * r + i, 3 * c + j
                    block[i, j] = 0.5 * (values[a, b] + values[b, a])
