"""Sparse normal equations of linearised constraints, and their solution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.mapping.pose_graph.constraints import Linearised

_DAMPING = 1e-6


class NormalEquations:
    """Sums of normal equations over the unknowns (u,) that are free.

    Args:
        free: (u,) which unknowns may change.
    """

    def __init__(self, free: BoolArray) -> None:
        self._place: IntArray = np.where(free, np.cumsum(free) - 1, -1)
        self._size = int(free.sum())
        self._free = free
        self._gradient = np.zeros(self._size)
        self._values: list[FloatArray] = []
        self._rows: list[IntArray] = []
        self._columns: list[IntArray] = []

    def add(self, constraints: Sequence[Linearised]) -> None:
        """Add constraints."""
        for one in constraints:
            weighted = one.jacobian * one.weight[:, :, None]
            squares = np.einsum("mea,meb->mab", weighted, one.jacobian)
            self.add_blocks(one.unknowns, squares, -np.einsum("mea,me->ma", weighted, one.residual))

    def add_blocks(self, index: IntArray, squares: FloatArray, gradient: FloatArray) -> None:
        """Add blocks (m, c, c) with right sides (m, c) on unknowns (m, c)."""
        place = self._place[index]
        kept = place >= 0
        np.add.at(self._gradient, place[kept], gradient[kept])
        rows = np.broadcast_to(place[:, :, None], squares.shape)
        columns = np.broadcast_to(place[:, None, :], squares.shape)
        both = kept[:, :, None] & kept[:, None, :]
        self._values.append(squares[both])
        self._rows.append(rows[both])
        self._columns.append(columns[both])

    def solve(self) -> tuple[FloatArray, Factor]:
        """The step (u,), zero where an unknown is not free, and the factor that gives covariances."""
        diagonal = np.arange(self._size)
        values = np.concatenate([*self._values, np.full(self._size, _DAMPING)])
        rows = np.concatenate([*self._rows, diagonal])
        columns = np.concatenate([*self._columns, diagonal])
        matrix = csc_matrix((values, (rows, columns)), shape=(self._size, self._size))
        factor = splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        step = np.zeros(len(self._free))
        step[self._free] = factor.solve(self._gradient)
        return step, Factor(factor, self._place)


class Factor:
    """The factor of normal equations.

    Args:
        factor: Of the sparse matrix.
        place: (u,) of each unknown among those that were free, -1: it was not.
    """

    def __init__(self, factor: SuperLU, place: IntArray) -> None:
        self._factor = factor
        self._place = place

    def covariance(self, index: IntArray, directions: FloatArray | None = None) -> FloatArray:
        """Covariance (d, d) of free unknowns (c,), or of combinations (d, c) of them."""
        chosen = np.eye(len(index)) if directions is None else directions
        columns = np.zeros((self._factor.shape[0], len(chosen)))
        for number, direction in enumerate(chosen):
            np.add.at(columns[:, number], self._place[index], direction)
        covariance: NDArray[np.float64] = columns.T @ self._factor.solve(columns)
        symmetric: FloatArray = 0.5 * (covariance + covariance.T)
        return symmetric
