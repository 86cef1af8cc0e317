"""How the PushBot paper draws a beam: -0.3 up to the obstacle, and an ellipse of a Gaussian around it."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit

_FREE = -0.3
_ACROSS, _ALONG = 0.1, 0.05
"""Standard deviations of the ellipse, per distance."""
_REACH = 2.0
"""The ellipse ends after so many of them."""
_CAP = 1.0


@cached_njit
def draw_beam(values: FloatArray, corner: FloatArray, cell: float, pose: FloatArray, distance: float) -> None:
    """Draw a beam of some length [m] from a pose (3,) into a grid (nx, ny)."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    along, across = _ALONG * distance, _ACROSS * distance
    step, travelled = 0.7 * cell, 0.0
    last_i, last_j = -1, -1
    while travelled < distance - _REACH * along:
        i = math.floor((pose[0] + travelled * cos - corner[0]) / cell)
        j = math.floor((pose[1] + travelled * sin - corner[1]) / cell)
        inside = 0 <= i < values.shape[0] and 0 <= j < values.shape[1]
        if inside and (i != last_i or j != last_j):
            values[i, j] = max(_FREE, values[i, j] + _FREE)
        last_i, last_j = i, j
        travelled += step
    end_x, end_y = pose[0] + distance * cos, pose[1] + distance * sin
    reach = math.ceil(_REACH * across / cell)
    middle_i, middle_j = math.floor((end_x - corner[0]) / cell), math.floor((end_y - corner[1]) / cell)
    for i in range(max(0, middle_i - reach), min(values.shape[0], middle_i + reach + 1)):
        for j in range(max(0, middle_j - reach), min(values.shape[1], middle_j + reach + 1)):
            x, y = corner[0] + (i + 0.5) * cell - end_x, corner[1] + (j + 0.5) * cell - end_y
            ahead, left = (cos * x + sin * y) / along, (-sin * x + cos * y) / across
            square = ahead * ahead + left * left
            if square < _REACH * _REACH:
                values[i, j] = min(_CAP, values[i, j] + math.exp(-0.5 * square))


@cached_njit
def values_at_ends(
    values: FloatArray, corner: FloatArray, cell: float, poses: FloatArray, distance: float
) -> FloatArray:
    """Values (p,) of a grid (nx, ny) where beams of some length [m] from poses (p, 3) end; 0 outside."""
    found = np.zeros(len(poses))
    for k in range(len(poses)):
        i = math.floor((poses[k, 0] + distance * math.cos(poses[k, 2]) - corner[0]) / cell)
        j = math.floor((poses[k, 1] + distance * math.sin(poses[k, 2]) - corner[1]) / cell)
        if 0 <= i < values.shape[0] and 0 <= j < values.shape[1]:
            found[k] = values[i, j]
    return found
