"""What the Droplets' own firmware of 2018 makes of a brightness matrix.

The method of correlllab/cu-droplet (range_algs.c) from its description: directions are those of sums of the
readings as vectors; the range is a fitted function of the sum of readings weighed by the cosines at both
ends; a matrix whose shape differs much from that of cosines is refused.
"""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle

_RADIUS_MM = 22.0
_NEAREST_MM = 46.0
_FIRST_SUM = 2.0739212652  # Divides the plain sum, for want of the cosines, before the first range
_REACH, _GAP, _RATE, _SHIFT = 778.0270114700, 528.0270114700, 24.3675811184, 0.0259969683
_LIMITS = ((110.0, 1.0), (200.0, 1.5))
"""Below a range [mm] a matrix may differ by so much; beyond all of them it is refused."""


def solve(readings: FloatArray, angles: FloatArray) -> FloatArray:
    """Range [m], bearing and heading [rad] (k, 3) of readings (k, n, n) [sensor, emitter]; NaN: refused.

    Args:
        readings: Of exchanges.
        angles: (n,) directions of the elements [rad].
    """
    poses = np.full((len(readings), 3), np.nan)
    for k, matrix in enumerate(np.nan_to_num(readings)):
        poses[k] = _solve_one(matrix, angles)
    return poses


def _solve_one(matrix: FloatArray, angles: FloatArray) -> FloatArray:
    units = np.exp(1j * angles)
    bearing = float(np.angle(units @ matrix.sum(axis=1)))
    heading = float(np.angle(-(units @ matrix @ units.conj())))
    first = _range_mm(matrix.sum() / _FIRST_SUM)
    if not np.isfinite(first) or first == 0.0:
        return np.full(3, np.nan)
    sensor, emitter = _cosines(first, bearing, heading, angles)
    distance = _range_mm(float(np.sum(matrix * sensor * np.maximum(emitter, 0.0))))
    if not np.isfinite(distance):
        return np.full(3, np.nan)
    distance = _NEAREST_MM if distance < 2.0 * _RADIUS_MM else distance
    sensor, emitter = _cosines(max(distance, _NEAREST_MM), bearing, heading, angles)
    shape = np.maximum(sensor, 0.0) * np.maximum(emitter, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        differs = np.abs(matrix / matrix.sum() - shape / shape.sum()).sum()
    allowed = next((limit for below, limit in _LIMITS if distance < below), -1.0)
    if not differs <= allowed:
        return np.full(3, np.nan)
    return np.array([1e-3 * distance, float(wrap_angle(bearing)), float(wrap_angle(heading))])


def _cosines(
    distance: float, bearing: float, heading: float, angles: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Cosines (n, n) at sensors and emitters, whose centres are so far apart [mm]."""
    sensors, emitters = np.exp(1j * angles), np.exp(1j * (angles + heading))
    way = distance * np.exp(1j * bearing) + _RADIUS_MM * (emitters[None] - sensors[:, None])
    way /= np.abs(way)
    return np.real(way * sensors.conj()[:, None]), -np.real(way * emitters.conj()[None])


def _range_mm(light: float) -> float:
    """The range by the light that is left of cosines; NaN where there is none."""
    if light <= 0.0:
        return float("nan")
    return float(_REACH / (1.0 + np.exp(-_RATE * (_SHIFT + light**-0.5))) - _GAP)
