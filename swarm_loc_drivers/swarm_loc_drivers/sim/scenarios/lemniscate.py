"""Bernoulli's lemniscate, the paper's eight, travelled at constant speed."""

from __future__ import annotations

import numpy as np
from scipy.special import ellipk, ellipkinc

from swarm_loc_estimator.common.arrays import FloatArray

_TABLE_SIZE = 20001


class Lemniscate:
    """x = a cos t / (1 + sin^2 t), y = x sin t, by the length travelled from its right end.

    Args:
        half_width: a [m].
    """

    def __init__(self, half_width: float) -> None:
        self.half_width = half_width
        self.length = 4.0 * half_width * float(ellipk(-1.0))
        """Once around [m]."""
        self._parameter = np.linspace(0.0, 2.0 * np.pi, _TABLE_SIZE)
        self._travelled = half_width * ellipkinc(self._parameter, -1.0)

    def at(self, travelled: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pose (..., 3) and curvature (...) [1/m], positive to the left, at lengths `travelled` (...) [m]."""
        t = np.interp(np.mod(travelled, self.length), self._travelled, self._parameter)
        sin, cos = np.sin(t), np.cos(t)
        scale = 1.0 / (1.0 + sin * sin)
        x, y = self.half_width * cos * scale, self.half_width * sin * cos * scale
        dx = -sin * (3.0 - sin * sin)  # direction of travel, up to a positive factor
        dy = 1.0 - 3.0 * sin * sin
        curvature = 3.0 * cos * np.sqrt(scale) / self.half_width
        return np.stack([x, y, np.arctan2(dy, dx)], axis=-1), curvature
