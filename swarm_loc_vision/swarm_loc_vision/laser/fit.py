"""Fits of the laser's hyperbola to a drive at a wall, in the pixel domain."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.errors import UserError
from swarm_loc_vision.laser.calibration import LaserCalibration
from swarm_loc_vision.laser.row_bias import fit_row_bias

MIN_SAMPLES = 50
_MIN_SPREAD = 2.0
"""The largest depth over the smallest: less does not tell f b from p_inf."""
_MAX_RESIDUAL_PX = 1.0
_START_PX = 0.1


class CalibrationError(UserError):
    """A drive from which nothing can be calibrated; the message is one sentence."""


@dataclass(frozen=True)
class Drive:
    """A drive straight at a wall.

    Attributes:
        start_distance: From base_link to the wall at the begin, as measured by hand [m].
        start_sigma: Its standard deviation [m].
        driven: (N,) path since the begin, by odometry [m].
        rows: (N,) rows of the laser's spot at the same instants [px].
        camera_x: The camera before base_link [m].
    """

    start_distance: float
    start_sigma: float
    driven: FloatArray
    rows: FloatArray
    camera_x: float

    @property
    def depths(self) -> FloatArray:
        """(N,) from the camera to the wall [m]."""
        depths: FloatArray = self.start_distance - self.camera_x - self.driven
        return depths


def fit_hyperbola(drive: Drive) -> LaserCalibration:
    """The calibration under which the rows are likeliest; outliers count little (Cauchy loss).

    The start is estimated besides, within what it was measured to: close to the wall millimetres are pixels.
    What then remains as a function of the row is the bias of the tracker within pixels.

    Raises:
        CalibrationError: Too few samples, too little of the way, or rows that follow no hyperbola.
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
    for _ in range(3):  # the loss needs the noise, and the noise the fit
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


def fit_logarithm(drive: Drive) -> tuple[float, float]:
    """Fit a and b of p = a + b ln d, the relation that the PushBot paper names; for comparison."""
    design = np.column_stack([np.ones_like(drive.depths), np.log(drive.depths)])
    a, b = np.linalg.lstsq(design, drive.rows, rcond=None)[0].tolist()
    return float(a), float(b)


def logarithm_depth(a: float, b: float, row: float) -> float:
    """Depth [m] at a row by the paper's relation."""
    return math.exp((row - a) / b)
