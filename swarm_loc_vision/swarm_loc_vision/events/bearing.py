"""From a light's place in the image to its direction."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray


def direction(u: float, v: float, focal_px: float) -> tuple[float, float]:
    """Bearing to the left and elevation [rad] of a place (u, v) [px] beside a level camera's optical axis."""
    x, y = -u / focal_px, -v / focal_px
    return math.atan(x), math.atan2(y, math.hypot(1.0, x))


def direction_jacobian(u: float, v: float, focal_px: float) -> FloatArray:
    """(2, 2) derivatives of bearing and elevation by u and v [rad/px]."""
    x, y = -u / focal_px, -v / focal_px
    ground = 1.0 + x * x
    length = ground + y * y
    root = math.sqrt(ground)
    by_xy = np.array([[1.0 / ground, 0.0], [-x * y / (root * length), root / length]])
    jacobian: FloatArray = -by_xy / focal_px
    return jacobian
