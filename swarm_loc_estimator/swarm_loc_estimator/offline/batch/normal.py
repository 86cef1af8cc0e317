"""Normal equations of a chain with a border: a banded part of poses in the order of time, and all the rest.

Poses that follow each other, and poses of one time, are near each other in that order, so the matrix is
banded. Landmarks and parameters are seen at all times; they are its border. The band is factored by LAPACK,
the border by its Schur complement.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit

_LEAST_DAMPING = 1e-14
_AT_ONCE = 50  # Residuals whose variances are computed together


class ChainEquations:
    """J^T J x = -J^T r.

    Args:
        band: Number of unknowns of the banded part, the first ones.
        width: Largest distance of two of them that share a residual.
        border: Number of the others.
    """

    def __init__(self, band: int, width: int, border: int) -> None:
        self._band = np.zeros((width + 1, band))  # [d, j]: row j + d of column j
        self._border = np.zeros((border, band))
        self._corner = np.zeros((border, border))
        self.gradient = np.zeros(band + border)  # (n,) -J^T r

    def add(self, jacobian: FloatArray, columns: IntArray, residual: FloatArray) -> None:
        """Add residuals (k, r) with Jacobians (k, r, c) by unknowns (k, c); -1: fixed."""
        _add(
            np.ascontiguousarray(jacobian),
            np.ascontiguousarray(columns, dtype=np.int64),
            np.ascontiguousarray(residual),
            self._band,
            self._border,
            self._corner,
            self.gradient,
        )

    def diagonal(self) -> FloatArray:
        """Diagonal (n,) of the matrix."""
        return np.concatenate([self._band[0], np.diag(self._corner)])

    def factored(self, damping: float) -> ChainFactor:
        """The factor, with the diagonal enlarged by a share, or by as much as makes the matrix regular."""
        while True:
            band, corner = self._band.copy(), self._corner.copy()
            for diagonal in (band[0], np.einsum("ii->i", corner)):
                # what has no information stays as it is
                diagonal[:] = np.where(diagonal > 0.0, diagonal * (1.0 + damping), 1.0)
            try:
                return ChainFactor(band, self._border, corner)
            except LinAlgError:
                damping = max(100.0 * damping, _LEAST_DAMPING)


class ChainFactor:
    """Solves normal equations, see there."""

    def __init__(self, band: FloatArray, border: FloatArray, corner: FloatArray) -> None:
        self._size, self._border = band.shape[1], border
        self._band = cholesky_banded(band, lower=True, overwrite_ab=True) if self._size else band
        self._by_border = self._in_band(border.T)
        self._corner = cho_factor(corner - border @ self._by_border, lower=True) if len(corner) else None

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self._size + len(self._border))

    def _in_band(self, right: FloatArray) -> FloatArray:
        return cho_solve_banded((self._band, True), right) if right.size else np.zeros_like(right)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve for one (n,) or several (n, c) right-hand sides."""
        first, rest = self._in_band(right[: self._size]), right[self._size :]
        if self._corner is None:
            return first
        last = cho_solve(self._corner, rest - self._border @ first)
        return np.concatenate([first - self._by_border @ last, last])

    def variances(self, jacobian: FloatArray, columns: IntArray) -> FloatArray:
        """Variances (k, r) of linear functions (k, r, c) of unknowns (k, c); -1: none."""
        found, rows = np.zeros(jacobian.shape[:2]), jacobian.shape[1]
        for begin in range(0, len(found), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            right = np.zeros((self.size, found[part].size))
            for place, (by, unknowns) in enumerate(zip(jacobian[part], columns[part], strict=True)):
                known = unknowns >= 0
                np.add.at(right[:, place * rows : (place + 1) * rows], unknowns[known], by[:, known].T)
            found[part] = np.sum(right * self.solve(right), axis=0).reshape(-1, rows)
        return found

    def covariance(self, unknowns: IntArray) -> FloatArray:
        """Covariance (c, c) of unknowns (c,)."""
        right = np.zeros((self.size, unknowns.size))
        right[unknowns, np.arange(unknowns.size)] = 1.0
        found = self.solve(right)[unknowns]
        return np.asarray(0.5 * (found + found.T))

    def inverse_band(self) -> FloatArray:
        """The inverse (width + 1, n) within the band: row d has its elements [j + d, j].

        By the recursion of Takahashi, from the last column to the first.
        """
        inverse = np.zeros_like(self._band)
        _invert_in_band(np.ascontiguousarray(self._band), inverse)
        if self._corner is not None:
            back = cho_solve(self._corner, self._by_border.T)
            for d in range(min(len(inverse), self._size)):
                inverse[d, : self._size - d] += np.sum(
                    self._by_border[d:].T * back[:, : self._size - d], axis=0
                )
        return inverse


@cached_njit
def _invert_in_band(factor: FloatArray, inverse: FloatArray) -> None:
    """Write the inverse (w + 1, n) of L L^T within the band of the factor L (w + 1, n)."""
    width, size = factor.shape[0] - 1, factor.shape[1]
    for j in range(size - 1, -1, -1):
        last = min(width, size - 1 - j)
        for d in range(last, -1, -1):
            total = 1.0 / factor[0, j] if d == 0 else 0.0
            for e in range(1, last + 1):  # the element [j + d, j + e]
                total -= factor[e, j] * inverse[abs(d - e), j + min(d, e)]
            inverse[d, j] = total / factor[0, j]


@cached_njit
def _add(
    jacobian: FloatArray,
    columns: IntArray,
    residual: FloatArray,
    band: FloatArray,
    border: FloatArray,
    corner: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add J^T J and -J^T r of all residuals."""
    size = band.shape[1]
    for k in range(jacobian.shape[0]):
        for a in range(jacobian.shape[2]):
            row = columns[k, a]
            if row < 0:
                continue
            for i in range(jacobian.shape[1]):
                gradient[row] -= jacobian[k, i, a] * residual[k, i]
            for b in range(jacobian.shape[2]):
                column = columns[k, b]
                if column < 0 or (row < size and column > row):
                    continue
                product = 0.0
                for i in range(jacobian.shape[1]):
                    product += jacobian[k, i, a] * jacobian[k, i, b]
                if row < size:
                    band[row - column, column] += product
                elif column < size:
                    border[row - size, column] += product
                else:
                    corner[row - size, column - size] += product
