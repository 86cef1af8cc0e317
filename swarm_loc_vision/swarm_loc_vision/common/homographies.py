"""Homographies from the unit square to quadrangles."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray


def homographies(quads: FloatArray) -> FloatArray:
    """(N, 3, 3) from the unit square, clockwise from its upper left (0, 0), to quadrangles (N, 4, 2)."""
    first, second, third, fourth = np.moveaxis(quads, 1, 0)
    uneven = first - second + third - fourth
    a, b = second - third, fourth - third
    determinant = _cross(a, b)
    g, h = _cross(uneven, b) / determinant, _cross(a, uneven) / determinant
    result = np.empty((len(quads), 3, 3))
    result[:, :2, 0] = second - first + g[:, None] * second
    result[:, :2, 1] = fourth - first + h[:, None] * fourth
    result[:, :2, 2] = first
    result[:, 2, 0], result[:, 2, 1], result[:, 2, 2] = g, h, 1.0
    return result


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """(N,) cross products of plane vectors (N, 2)."""
    product: FloatArray = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    return product
