"""How far the tracked row of a laser's spot is off within its pixels, and the fit of it.

The centre of all events of a spot that is hardly larger than a pixel is drawn to and fro between the middles
of pixels (pixel locking), the more as their thresholds differ. The spot runs along one line of the image as
the distance changes, so this error is a function of the row: a robot that turns before a wall makes it the
same way for many readings, and it does not average out over a scan as noise does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray

STEP_PX = 0.2
"""Between two knots: the bias has a period of one pixel and some harmonics."""
_BEND_PX = 0.05
"""Prior standard deviation of a knot off the line between its neighbours [px]."""
_SIZE_PX = 0.3
"""Prior standard deviation of a knot [px]."""
_LEAST_SAMPLES = 4
"""Between two knots; nearer to the wall, where rows run fast, they are fewer, and matter least."""
_EDGE_SIGMAS = 2.0
"""So near to the farthest reading the rows tell of their noise alone: only low ones lie there."""
_OUTLIER_SIGMAS = 10.0
_ITERATIONS = 5
_CAUCHY_SIGMAS = 2.4


@dataclass(frozen=True)
class RowBias:
    """Tracked row minus true row, linear between knots.

    Attributes:
        first_row: Row of the first knot [px].
        step: From knot to knot [px].
        offsets: (K,) bias at each [px]; none: nothing is known of it.
    """

    first_row: float = 0.0
    step: float = STEP_PX
    offsets: tuple[float, ...] = ()

    def reaches(self, row: float) -> bool:
        """Whether a tracked row [px] lies between knots."""
        return 0.0 <= (row - self.first_row) / self.step < len(self.offsets) - 1

    def at(self, row: float) -> float:
        """The bias at a tracked row [px]; zero beyond the knots."""
        if not self.reaches(row):
            return 0.0
        place = (row - self.first_row) / self.step
        k = math.floor(place)
        share = place - k
        return (1.0 - share) * self.offsets[k] + share * self.offsets[k + 1]

    def at_each(self, rows: FloatArray) -> FloatArray:
        """The bias (N,) at tracked rows (N,) [px]."""
        return np.array([self.at(row) for row in rows.tolist()])


def fit_row_bias(rows: FloatArray, residuals: FloatArray, sigma: float) -> RowBias:
    """The bias that residuals show over the rows, where it also lowers those that it was not fitted to.

    Args:
        rows: (N,) tracked [px].
        residuals: (N,) tracked rows minus those of the hyperbola [px].
        sigma: Scale of the residuals [px]; those that are far off count little (Cauchy loss).
    """
    edge = float((rows - residuals).min()) + _EDGE_SIGMAS * sigma
    usual = (np.abs(residuals) < _OUTLIER_SIGMAS * sigma) & (rows >= edge)
    rows, residuals = rows[usual], residuals[usual]
    knots = _knots(edge, rows)
    if len(knots) < 2:
        return RowBias()
    is_even = np.arange(len(rows)) % 2 == 0
    gained = 0.0
    for chosen in (is_even, ~is_even):
        half = _fit(knots, rows, residuals, chosen, sigma)
        others = residuals[~chosen]
        gained += _loss(others, sigma) - _loss(others - half.at_each(rows[~chosen]), sigma)
    return _fit(knots, rows, residuals, np.ones(len(rows), dtype=bool), sigma) if gained > 0.0 else RowBias()


def _knots(first: float, rows: FloatArray) -> FloatArray:
    """Rows (K,) of knots from the first on, up to where there are too few samples between two."""
    counts = np.bincount(((rows - first) / STEP_PX).astype(np.int64))
    sparse = np.flatnonzero(counts < _LEAST_SAMPLES)
    cells = int(sparse[0]) if len(sparse) else len(counts)
    return np.asarray(first + STEP_PX * np.arange(cells + 1))


def _fit(
    knots: FloatArray, rows: FloatArray, residuals: FloatArray, chosen: BoolArray, sigma: float
) -> RowBias:
    """Knots that are likeliest under their prior and chosen residuals."""
    inside = chosen & (rows < knots[-1])
    place: FloatArray = (rows[inside] - knots[0]) / STEP_PX
    below = np.minimum(place.astype(np.int64), len(knots) - 2)
    design = np.zeros((len(place), len(knots)))
    index = np.arange(len(place))
    design[index, below], design[index, below + 1] = 1.0 - (place - below), place - below
    bends = np.diff(np.eye(len(knots)), 2, axis=0) / _BEND_PX
    prior = bends.T @ bends + np.eye(len(knots)) / _SIZE_PX**2
    offsets = np.zeros(len(knots))
    for _ in range(_ITERATIONS):
        off = (residuals[inside] - design @ offsets) / (_CAUCHY_SIGMAS * sigma)
        weighted = design / (sigma**2 * (1.0 + off * off))[:, None]
        offsets = np.linalg.solve(prior + weighted.T @ design, weighted.T @ residuals[inside])
    return RowBias(float(knots[0]), STEP_PX, tuple(offsets.tolist()))


def _loss(residuals: FloatArray, sigma: float) -> float:
    return float(np.log1p((residuals / (_CAUCHY_SIGMAS * sigma)) ** 2).sum())
