"""Sub-pixel corners: a straight line through where the brightness crosses each side, and where lines meet.

The spread of the crossings around their line says how sure the line is, and so how sure the corners are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.compiled import compiled
from swarm_loc_vision.core.sampling import MOST_PROFILES, profile_crossings

FloatArray = NDArray[np.float64]
Gray = NDArray[np.uint8]

_LEAST_CROSSINGS = 3
_LEAST_SINE = 0.1
"""Of the angle between neighbouring sides."""
_LEAST_SIGMA_PX = 0.004
"""What a line is unsure of even without noise: print, lens and pixels are not perfect."""
_NEIGHBOUR_PX3 = 0.25
"""Over the square of a cell's width [px]: the bias where the next edges blur into the one looked for."""
_SHARE_FRESH = 0.5
"""Crossings a pixel apart share pixels: so much of each one's information is its own."""


class Corners(NamedTuple):
    """Refined quadrangles.

    Attributes:
        corners: (N, 4, 2) [ideal px].
        covariance: (N, 8, 8) of u0 v0 u1 v1 ... [px^2]; neighbours share a side.
        contrast: (N,) light minus dark across the weakest side [counts]; 0 where a side was not found.
    """

    corners: FloatArray
    covariance: FloatArray
    contrast: FloatArray


def refine(image: Gray, lens: FloatArray, quads: FloatArray, cells: int, spacing: float = 1.5) -> Corners:
    """Move quadrangles onto their edges.

    Args:
        image: (height, width).
        lens: See `camera.Camera`.
        quads: (N, 4, 2) clockwise, dark inside [ideal px].
        cells: Along a side; a profile looks no further than one cell.
        spacing: Of the places along a side where the edge is looked for [px].
    """
    corners = quads.copy()
    covariance = np.zeros((len(quads), 8, 8))
    contrast = np.ones(len(quads))
    crossings = np.empty((len(quads), 4, MOST_PROFILES, 3))
    reaches = _sides(corners) / cells
    profile_crossings(image, lens, corners, reaches, spacing, crossings)
    _fit(crossings, reaches, corners, covariance, contrast)
    return Corners(corners, covariance, contrast)


def _sides(quads: FloatArray) -> FloatArray:
    """(N,) the shorter of two mean opposite sides [px]."""
    lengths = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2)
    shorter: FloatArray = 0.5 * np.minimum(lengths[:, 0] + lengths[:, 2], lengths[:, 1] + lengths[:, 3])
    return shorter


@compiled
def _fit(
    crossings: FloatArray,
    widths: FloatArray,
    corners: FloatArray,
    covariance: FloatArray,
    contrast: FloatArray,
) -> None:
    """Fit lines and intersect them; a quadrangle with a side that cannot be fitted keeps its corners."""
    lines = np.empty((4, 5))  # offset and slope of each side's crossings, and their covariance
    moved = np.empty((4, 2))
    jacobian = np.empty((8, 8))
    for n in range(len(corners)):
        least_variance = _LEAST_SIGMA_PX**2 + (_NEIGHBOUR_PX3 / widths[n] ** 2) ** 2
        weakest = 1e9
        for k in range(4):
            weakest = min(weakest, _fit_line(crossings[n, k], least_variance, lines[k]))
        if weakest <= 0.0 or not _intersect(corners[n], lines, moved, jacobian):
            contrast[n] = 0.0
            continue
        contrast[n] = weakest
        corners[n] = moved
        for i in range(8):
            for j in range(8):
                total = 0.0
                for k in range(4):
                    a, b = jacobian[i, 2 * k], jacobian[i, 2 * k + 1]
                    c, d = jacobian[j, 2 * k], jacobian[j, 2 * k + 1]
                    total += a * c * lines[k, 2] + (a * d + b * c) * lines[k, 3] + b * d * lines[k, 4]
                covariance[n, i, j] = total


@compiled
def _fit_line(crossings: FloatArray, least_variance: float, line: FloatArray) -> float:
    """Least squares, twice: the second time without what lies far off the first line.

    Args:
        crossings: (M, 3) along, outside, contrast.
        least_variance: Of the offset, without noise [px^2].
        line: (5,) filled with the offset at `along` = 0, the slope, and var, cov, var of both.

    Returns:
        The mean contrast, 0 when there are too few crossings.
    """
    offset, slope, limit = 0.0, 0.0, 1e9
    variance, mean_contrast = 0.0, 0.0
    n, sx, sxx = 0.0, 0.0, 0.0
    for _ in range(3):
        n, sx, sy, sxx, sxy, syy, sc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for m in range(len(crossings)):
            x, y, contrast = crossings[m, 0], crossings[m, 1], crossings[m, 2]
            if contrast <= 0.0 or abs(y - offset - slope * x) > limit:
                continue
            n += 1.0
            sx += x
            sy += y
            sxx += x * x
            sxy += x * y
            syy += y * y
            sc += contrast
        if n < _LEAST_CROSSINGS:
            return 0.0
        determinant = sxx - sx * sx / n
        if determinant <= 1e-9:
            return 0.0
        slope = (sxy - sx * sy / n) / determinant
        offset = (sy - slope * sx) / n
        rest = max(syy - sy * sy / n - slope * (sxy - sx * sy / n), 0.0)
        variance = rest / max(n - 2.0, 1.0)
        limit = max(2.5 * math.sqrt(variance), 0.1)
        mean_contrast = sc / n
    of_one = (variance + least_variance) / _SHARE_FRESH
    determinant = sxx - sx * sx / n
    line[0], line[1] = offset, slope
    line[2] = of_one * sxx / (n * determinant) + least_variance
    line[3] = -of_one * sx / (n * determinant)
    line[4] = of_one / determinant
    return mean_contrast


@compiled
def _intersect(corners: FloatArray, lines: FloatArray, moved: FloatArray, jacobian: FloatArray) -> bool:
    """Where lines given relative to the sides of a quadrangle meet.

    Args:
        corners: (4, 2) the quadrangle.
        lines: (4, 5) of `_fit_line`.
        moved: (4, 2) filled with the new corners.
        jacobian: (8, 8) filled with their derivatives by offset and slope of each line.
    """
    normal = np.empty((4, 2))
    direction = np.empty((4, 2))
    rest = np.empty(4)
    for k in range(4):
        du = corners[(k + 1) % 4, 0] - corners[k, 0]
        dv = corners[(k + 1) % 4, 1] - corners[k, 1]
        length = math.hypot(du, dv)
        du, dv = du / length, dv / length
        direction[k, 0], direction[k, 1] = du, dv
        # a point p of the line has out - slope * along = offset, where along = (p - c) . (du, dv)
        # and out = (p - c) . (dv, -du); so normal . p = rest
        slope = lines[k, 1]
        normal[k, 0], normal[k, 1] = dv - slope * du, -du - slope * dv
        rest[k] = lines[k, 0] + normal[k, 0] * corners[k, 0] + normal[k, 1] * corners[k, 1]
    jacobian[:] = 0.0
    for k in range(4):
        a = (k + 3) % 4
        determinant = normal[a, 0] * normal[k, 1] - normal[k, 0] * normal[a, 1]
        if abs(determinant) < _LEAST_SINE:
            return False
        u = (rest[a] * normal[k, 1] - rest[k] * normal[a, 1]) / determinant
        v = (normal[a, 0] * rest[k] - normal[k, 0] * rest[a]) / determinant
        moved[k, 0], moved[k, 1] = u, v
        # a line moved out by 1 shifts the corner along the other line; its slope moves it out by `along`
        along = (u - corners[a, 0]) * direction[a, 0] + (v - corners[a, 1]) * direction[a, 1]
        jacobian[2 * k, 2 * a] = normal[k, 1] / determinant
        jacobian[2 * k + 1, 2 * a] = -normal[k, 0] / determinant
        jacobian[2 * k, 2 * a + 1] = along * jacobian[2 * k, 2 * a]
        jacobian[2 * k + 1, 2 * a + 1] = along * jacobian[2 * k + 1, 2 * a]
        along = (u - corners[k, 0]) * direction[k, 0] + (v - corners[k, 1]) * direction[k, 1]
        jacobian[2 * k, 2 * k] = -normal[a, 1] / determinant
        jacobian[2 * k + 1, 2 * k] = normal[a, 0] / determinant
        jacobian[2 * k, 2 * k + 1] = along * jacobian[2 * k, 2 * k]
        jacobian[2 * k + 1, 2 * k + 1] = along * jacobian[2 * k + 1, 2 * k]
    return True
