"""Fit a laser calibration to a drive at a wall: the hyperbola, then the bias of tracked rows within pixels.

The centre of all events of a spot that is hardly larger than a pixel is pulled towards the middles of pixels
(pixel locking). The spot runs along one line of the image as the distance changes, so this error is a
function of the row: a robot that turns in front of a wall makes the same error in many readings, and
averaging over a scan does not remove it as it removes noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_vision.laser.calibration import STEP_PX, LaserCalibration, RowBias

MIN_SAMPLES = 50
_MIN_SPREAD = 2.0
"""Least ratio of the largest to the smallest depth; with less, f b and p_inf cannot be separated."""
_MAX_RESIDUAL_PX = 1.0
_START_PX = 0.1
_BEND_PX = 0.05  # Prior standard deviation of a knot off the line between its neighbours [px]
_SIZE_PX = 0.3  # Prior standard deviation of a knot [px]
_LEAST_SAMPLES = 4
"""Least number of samples between two knots. Near the wall rows change fast, samples are few and matter
least."""
_EDGE_SIGMAS = 2.0
"""Rows so close to that of the farthest reading are left out: only those with low noise lie there."""
_OUTLIER_SIGMAS = 10.0
_ITERATIONS = 5
_CAUCHY_SIGMAS = 2.4


class CalibrationError(UserError):
    """A drive that does not determine a calibration; the message is one sentence."""


@dataclass(frozen=True)
class Drive:
    """A drive straight at a wall."""

    start_distance: float  # From base_link to the wall at the start, measured by hand [m]
    start_sigma: float  # Its standard deviation [m]
    driven: FloatArray  # (N,) path since the start, by odometry [m]
    rows: FloatArray  # (N,) rows of the laser's spot at the same instants [px]
    camera_x: float  # Position of the camera ahead of base_link [m]

    @property
    def depths(self) -> FloatArray:
        """(N,) from the camera to the wall [m]."""
        depths: FloatArray = self.start_distance - self.camera_x - self.driven
        return depths


def fit_hyperbola(drive: Drive) -> LaserCalibration:
    """The most likely calibration, with a Cauchy loss against outliers.

    The start distance is estimated as well, with its measured value as prior: close to the wall, millimetres
    are pixels. The residuals as a function of the row then give the bias of the tracker within pixels.

    Raises:
        CalibrationError: Too few samples, too short a drive, or rows that do not follow a hyperbola.
    """
    depths = drive.depths
    _check(depths)
    weight = _START_PX / max(drive.start_sigma, 1e-6)

    def residuals(parameters: FloatArray) -> FloatArray:
        row_at_infinity, focal_base, shift = parameters
        wrong = drive.rows - row_at_infinity - focal_base / np.maximum(depths + shift, 1e-3)
        return np.append(wrong, shift * weight)

    design = np.column_stack([np.ones_like(depths), 1.0 / depths])
    begin = np.append(np.linalg.lstsq(design, drive.rows, rcond=None)[0], 0.0)
    scale = _START_PX
    for _ in range(3):  # the loss depends on the noise, which depends on the fit
        found = least_squares(residuals, begin, loss="cauchy", f_scale=scale, x_scale=[1.0, 1.0, 0.01])
        begin = found.x
        scale = _scale_of(residuals(begin)[:-1])
    row_at_infinity, focal_base, shift = (float(value) for value in begin)
    if scale > _MAX_RESIDUAL_PX or focal_base <= 0.0:
        raise CalibrationError(
            f"the spot's rows follow no hyperbola: {scale:.2g} px off with f b = {focal_base:.3g} px m."
        )
    wrong = residuals(begin)[:-1]
    bias = fit_row_bias(drive.rows, wrong, scale)
    noise = _scale_of(wrong - bias.at_each(drive.rows))
    near, far = float(depths.min() + shift), float(depths.max() + shift)
    return LaserCalibration(row_at_infinity, focal_base, noise, drive.camera_x, 0.95 * near, 1.05 * far, bias)


def _scale_of(residuals: FloatArray) -> float:
    """Robust standard deviation of residuals [px], from their median magnitude."""
    return max(1.4826 * float(np.median(np.abs(residuals))), 1e-3)


def _check(depths: FloatArray) -> None:
    if len(depths) < MIN_SAMPLES:
        raise CalibrationError(
            f"the laser was seen {len(depths)} times on the way to the wall, {MIN_SAMPLES} are needed."
        )
    nearest, farthest = float(depths.min()), float(depths.max())
    if nearest <= 0.0:
        raise CalibrationError(
            f"the robot drove {-nearest:.2g} m farther than to the wall: start_distance is too small."
        )
    if farthest < _MIN_SPREAD * nearest:
        raise CalibrationError(
            f"the way from {farthest:.2g} to {nearest:.2g} m is too short: it must halve the distance."
        )


def fit_row_bias(rows: FloatArray, residuals: FloatArray, sigma: float) -> RowBias:
    """Fit the bias to residuals; empty unless a fit to either half lowers the residuals of the other half.

    Args:
        rows: (N,) tracked [px].
        residuals: (N,) tracked rows minus those of the hyperbola [px].
        sigma: Scale of the residuals for the Cauchy loss [px].
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
    """Rows (K,) of the knots from the first one up to where samples are too few."""
    counts = np.bincount(((rows - first) / STEP_PX).astype(np.int64))
    sparse = np.flatnonzero(counts < _LEAST_SAMPLES)
    cells = int(sparse[0]) if len(sparse) else len(counts)
    return np.asarray(first + STEP_PX * np.arange(cells + 1))


def _fit(
    knots: FloatArray, rows: FloatArray, residuals: FloatArray, chosen: BoolArray, sigma: float
) -> RowBias:
    """The most likely offsets of the knots, given their prior and the chosen residuals."""
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
