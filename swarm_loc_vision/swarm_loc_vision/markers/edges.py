"""Sub-pixel refinement of corners: lines are fitted to the edges of each side and intersected.

The spread of the crossings around their line gives the covariance of the lines and of the corners.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.common.images import Gray
from swarm_loc_vision.common.sampling import MAX_PROFILES, profile_crossings
from swarm_loc_vision.markers.side_pixels import side_pixels
from swarm_loc_vision.markers.sides import fit_sides

_MIN_CROSSINGS = 3
_MIN_SINE = 0.1  # Minimum sine of the angle between neighbouring sides
_MIN_SIGMA_PX = 0.004  # Standard deviation of a line without noise, from print, lens and pixels
_NEIGHBOUR_PX3 = 0.25
"""Bias by neighbouring edges that blur into the side, times the square of a cell's width [px]."""
_SHARE_FRESH = 0.5  # Share of independent information of crossings, which share pixels


class Corners(NamedTuple):
    """Refined quadrangles."""

    corners: FloatArray  # (N, 4, 2) [ideal px]
    covariance: FloatArray  # (N, 8, 8) of u0 v0 u1 v1 ... [px^2]; neighbours share a side.
    # (N,) light minus dark across the weakest side [counts]; 0 where a side was not found
    contrast: FloatArray


def refine(image: Gray, lens: FloatArray, quads: FloatArray, cells: int, spacing: float = 1.0) -> Corners:
    """Refine quadrangles by lines fitted to their edges.

    Args:
        image: (height, width).
        lens: See `camera.Camera`.
        quads: (N, 4, 2) clockwise, dark inside [ideal px].
        cells: Cells along a side; profiles reach one cell to each side.
        spacing: Distance of profiles along a side [px].
    """
    corners = quads.copy()
    covariance = np.zeros((len(quads), 8, 8))
    contrast = np.ones(len(quads))
    crossings = np.empty((len(quads), 4, MAX_PROFILES, 3))
    lengths = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2)
    reaches = _narrower(lengths) / cells
    profile_crossings(image, lens, corners, reaches, spacing, crossings)
    ends, of_ends = np.empty((len(quads), 8)), np.empty((len(quads), 8, 8))
    _fit(crossings, reaches, lengths, ends, of_ends, contrast)
    _intersect(corners, ends, of_ends, covariance, contrast)
    return Corners(corners, covariance, contrast)


def refine_read(
    image: Gray, lens: FloatArray, quads: FloatArray, strips: NDArray[np.uint8], border: int
) -> Corners:
    """Move the corners of decoded markers to their edges by a fit to pixels, see `sides`.

    Args:
        image: (height, width).
        lens: See `camera.Camera`.
        quads: (N, 4, 2) clockwise from each marker's own upper left, within a pixel [ideal px].
        strips: (N, 4, cells) the row of cells behind the border along each side; 1 is white.
        border: Width of the border [cells].
    """
    cells = strips.shape[2]
    corners, covariance = quads.copy(), np.zeros((len(quads), 8, 8))
    ends, of_ends, contrast = np.zeros((len(quads), 8)), np.zeros((len(quads), 8, 8)), np.empty(len(quads))
    pixels = side_pixels(image, lens, quads, cells, border)
    fit_sides(pixels, strips, border, ends, of_ends, contrast)
    _intersect(corners, ends, of_ends, covariance, contrast)
    lost = np.flatnonzero(contrast == 0.0)
    if len(lost):
        again = refine(image, lens, quads[lost], cells)
        corners[lost], covariance[lost], contrast[lost] = again
    return Corners(corners, covariance, contrast)


def _narrower(lengths: FloatArray) -> FloatArray:
    """(N,) the shorter of two mean opposite sides, of lengths (N, 4) [px]."""
    narrower: FloatArray = 0.5 * np.minimum(lengths[:, 0] + lengths[:, 2], lengths[:, 1] + lengths[:, 3])
    return narrower


@cached_njit
def _fit(
    crossings: FloatArray,
    widths: FloatArray,
    lengths: FloatArray,
    ends: FloatArray,
    covariance: FloatArray,
    contrast: FloatArray,
) -> None:
    """Fit a line to the crossings of each side; fills the last three arguments as `sides.fit_sides`."""
    line = np.empty(5)
    for n in range(len(crossings)):
        min_variance = _MIN_SIGMA_PX**2 + (_NEIGHBOUR_PX3 / widths[n] ** 2) ** 2
        contrast[n] = 1e9
        covariance[n] = 0.0
        for k in range(4):
            contrast[n] = min(contrast[n], _fit_line(crossings[n, k], min_variance, line))
            length, i, j = lengths[n, k], 2 * k, 2 * k + 1
            ends[n, i], ends[n, j] = line[0], line[0] + length * line[1]
            covariance[n, i, i] = line[2]
            covariance[n, i, j] = covariance[n, j, i] = line[2] + length * line[3]
            covariance[n, j, j] = line[2] + length * (2.0 * line[3] + length * line[4])


@cached_njit
def _fit_line(crossings: FloatArray, min_variance: float, line: FloatArray) -> float:
    """Fit a line by least squares, repeated without outliers.

    Args:
        crossings: (M, 3) along, outside, contrast.
        min_variance: Variance of the offset without noise [px^2].
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
        if n < _MIN_CROSSINGS:
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
    of_one = (variance + min_variance) / _SHARE_FRESH
    determinant = sxx - sx * sx / n
    line[0], line[1] = offset, slope
    line[2] = of_one * sxx / (n * determinant) + min_variance
    line[3] = -of_one * sx / (n * determinant)
    line[4] = of_one / determinant
    return mean_contrast


@cached_njit
def _intersect(
    corners: FloatArray, ends: FloatArray, of_ends: FloatArray, covariance: FloatArray, contrast: FloatArray
) -> None:
    """Intersect the lines along the sides of quadrangles.

    Args:
        corners: (N, 4, 2) the quadrangles; moved.
        ends: (N, 8) distance of each line outside of its side at the first and the last corner [px].
        of_ends: (N, 8, 8) their covariance [px^2].
        covariance: (N, 8, 8) of the corners, filled.
        contrast: (N,) set to 0 where lines do not meet; such corners stay.
    """
    moved = np.empty((4, 2))
    jacobian = np.empty((8, 8))
    for n in range(len(corners)):
        if contrast[n] > 0.0 and _meet(corners[n], ends[n], moved, jacobian):
            corners[n] = moved
            covariance[n] = jacobian @ of_ends[n] @ jacobian.T
        else:
            contrast[n] = 0.0


@cached_njit
def _meet(corners: FloatArray, ends: FloatArray, moved: FloatArray, jacobian: FloatArray) -> bool:
    """Intersect the lines along the sides of one quadrangle; False where they do not meet.

    Args:
        corners: (4, 2) the quadrangle.
        ends: (8,) distance of each line outside of its side at the first and the last corner.
        moved: (4, 2) filled with the new corners.
        jacobian: (8, 8) filled with their derivatives by `ends`.
    """
    normal, direction = np.empty((4, 2)), np.empty((4, 2))
    rest, lengths = np.empty(4), np.empty(4)
    for k in range(4):
        du = corners[(k + 1) % 4, 0] - corners[k, 0]
        dv = corners[(k + 1) % 4, 1] - corners[k, 1]
        lengths[k] = math.hypot(du, dv)
        du, dv = du / lengths[k], dv / lengths[k]
        direction[k, 0], direction[k, 1] = du, dv
        # a point p of the line has out - slope * along = offset, where along = (p - c) . (du, dv)
        # and out = (p - c) . (dv, -du); so normal . p = rest
        slope = (ends[2 * k + 1] - ends[2 * k]) / lengths[k]
        normal[k, 0], normal[k, 1] = dv - slope * du, -du - slope * dv
        rest[k] = ends[2 * k] + normal[k, 0] * corners[k, 0] + normal[k, 1] * corners[k, 1]
    jacobian[:] = 0.0
    for k in range(4):
        a = (k + 3) % 4
        determinant = normal[a, 0] * normal[k, 1] - normal[k, 0] * normal[a, 1]
        if abs(determinant) < _MIN_SINE:
            return False
        u = (rest[a] * normal[k, 1] - rest[k] * normal[a, 1]) / determinant
        v = (normal[a, 0] * rest[k] - normal[k, 0] * rest[a]) / determinant
        moved[k, 0], moved[k, 1] = u, v
        # moving a line outwards by 1 shifts the corner along the other line, shared by the ends of the line
        for line, other, sign in ((a, k, 1.0), (k, a, -1.0)):
            along = (u - corners[line, 0]) * direction[line, 0] + (v - corners[line, 1]) * direction[line, 1]
            share = along / lengths[line]
            for axis in range(2):
                by_line = sign * (normal[other, 1] if axis == 0 else -normal[other, 0]) / determinant
                jacobian[2 * k + axis, 2 * line] = (1.0 - share) * by_line
                jacobian[2 * k + axis, 2 * line + 1] = share * by_line
    return True
