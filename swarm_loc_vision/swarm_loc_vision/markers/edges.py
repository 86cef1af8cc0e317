"""Sub-pixel refinement of corners: lines along the sides of a marker, which are intersected.

`fit_sides` fits the four sides of a decoded marker, its blur and its light to the raw pixels. The image of a
decoded marker depends on few unknowns: the sides, the brightness of ink and paper, the gradient of the light,
and the blur of optics, pixels and motion, an ellipse. Their least-squares fit to raw pixels needs no
interpolation, which would shift edges along rows or columns by up to a tenth of a pixel. The white cells
behind the border, known from the word of the marker, are part of the model, because their light blurs into
the border. The fit gives the covariance, which is larger for blurred markers.

Tone curves and sharpening of cameras displace edges, which the edge itself does not show. How far the inner
edge of the border is off the place that the outer one predicts, in recent pictures, measures the trust.

Before a marker is decoded, and where that fit fails, lines are fitted to the edges that profiles across each
side cross. The spread of the crossings around their line gives the covariance of the lines and corners.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.common.images import Gray
from swarm_loc_vision.common.sampling import MAX_PROFILES, profile_crossings
from swarm_loc_vision.markers.side_pixels import (
    DU,
    DV,
    FAR,
    INNER,
    INNER_REACH_PX,
    LENGTH,
    NEAR,
    REACH_PX,
    SHEAR,
    SidePixels,
    side_pixels,
)

Bits = NDArray[np.uint8]

_ENDS = 8
"""The first parameters: distance of each line outside of its side at the first and the last corner [px]."""
_DARK, _CONTRAST, _LIGHT_X, _LIGHT_Y, _BLUR_XX, _BLUR_YY, _BLUR_XY = range(_ENDS, _ENDS + 7)
_PARAMETERS = _ENDS + 7
_OF_SIDE = 2 + _PARAMETERS - _ENDS
"""Parameters of a pixel: the two ends of its side, and those that all sides share."""
_ROUNDS = 5
_CONVERGED = 0.2  # Maximum motion of an end at convergence, in standard deviations
# Windows, priors and model errors: checked by errors of corners in `make bench-vision` and their NEES in
# test_sides.py.
_FIRST_BLUR, _MIN_BLUR, _MAX_BLUR = 0.45, 0.08, 12.0  # Variance of the blur [px^2]
_BLUR_FREEDOM = 4.0  # Prior standard deviation of that variance [px^2]
_LIGHT_FREEDOM = 0.2  # Prior standard deviation of the relative difference of light over a marker
_REACH, _MORE_REACH_PX, _MIN_REACH_PX = 2.5, 0.6, 0.75
"""Half width of the window around a line: a multiple of the blur, plus pixels, and a lower bound [px]."""
_CLEAR = 1.6
"""Distance of the window from unknown areas: beyond the margin, behind the first row of cells [blurs]."""
_CLEAR_OF_CORNERS = 1.8
_MAX_SHIFT_PX = 1.5  # Maximum motion of a corner in the fit
_OUTLIER = 4.0  # Residual above which the weight of a pixel decreases, in standard deviations
_MIN_NOISE = 0.5  # Minimum standard deviation of a pixel [counts]
_MIN_STEP_PX = 0.004  # Error of an end without noise: blur is not exactly Gaussian
_NEIGHBOURS = 0.2  # Times the largest blur^3 / cell^2: shift of a side, as blur by motion is not Gaussian
_TABLE_END, _TABLE_STEPS = 5.0, 256.0
_NORMAL = ndtr(np.arange(-_TABLE_END, _TABLE_END, 1.0 / _TABLE_STEPS))
_BY_CHANCE, _CLEARLY_WHITE = 3.0, 0.7
"""Maximum displacement of white cells behind the border by errors [sigma]; minimum whiteness."""
_OF_CORNERS = 0.6  # Variance of corners over squares of these displacements; from photographs of a board
_BY_FIT, _OWN_PX = 1.4, 0.03  # Their error over that by noise, and without noise; from rendered images
_MAX_ERROR_PX, _RECENT_SIDES = 0.15, 300.0  # Maximum error and number of displacements in their mean square
NEW_CAMERA = 0.25 * np.array([0.2**2, 1.0])  # Before the first picture: 0.2 px, a quarter of a displacement
_ROOT_2PI = math.sqrt(2.0 * math.pi)


class _Work(NamedTuple):
    """Memory of a fit: parameters, normal equations, windows at the sides, and gaps behind them."""

    p: FloatArray
    normal: FloatArray
    gradient: FloatArray
    windows: FloatArray
    gaps: FloatArray


@cached_njit
def fit_sides(
    pixels: SidePixels,
    strips: Bits,
    border: int,
    ends: FloatArray,
    covariance: FloatArray,
    contrast: FloatArray,
    displaced: FloatArray,
) -> float:
    """Fit the four sides of each marker; returns the variance of corners by displaced edges [px^2].

    Args:
        pixels: Pixels near the sides of quadrangles within a pixel of the markers.
        strips: (N, 4, cells) the row of cells behind the border along each side; 1 is white.
        border: Width of the border [cells].
        ends: (N, 8) filled with the distance of each line outside of its side at both corners [px].
        covariance: (N, 8, 8) filled with their covariance [px^2].
        contrast: (N,) filled with light minus dark [counts]; 0: no fit.
        displaced: (2,) sum of squared displacements by this camera [px^2] and their number; updated.
    """
    row, normal = np.empty(_PARAMETERS), np.empty((_PARAMETERS, _PARAMETERS))
    work = _Work(row, normal, row.copy(), np.empty((4, 5)), np.empty((4, 2)))
    usual = max(displaced[0] - NEW_CAMERA[0], 0.0) / displaced[1]  # no cover in this picture counts
    for n in range(len(strips)):
        contrast[n] = _fit_sides(pixels, n, strips[n], border, usual, work)
        if contrast[n] > 0.0:
            ends[n] = work.p[:_ENDS]
            covariance[n] = work.normal[:_ENDS, :_ENDS]
            for gap, error in work.gaps:
                if 0.0 < error < _MAX_ERROR_PX:
                    most = _BY_CHANCE**2 * (error**2 + max(displaced[0], 0.0) / displaced[1])
                    displaced[0] += min(gap**2, most) - error**2
                    displaced[1] += 1.0
    displaced *= min(1.0, _RECENT_SIDES / displaced[1])
    return float(_OF_CORNERS * max(displaced[0], 0.0) / displaced[1])


@cached_njit
def _fit_sides(pixels: SidePixels, n: int, strips: Bits, border: int, usual: float, work: _Work) -> float:
    """Fit one marker; returns the contrast, 0: no fit. `work.normal` becomes the covariance."""
    p = work.p
    p[:] = 0.0
    p[_BLUR_XX] = p[_BLUR_YY] = _FIRST_BLUR
    noise = np.inf
    for turn in range(_ROUNDS):
        _set_windows(pixels.frames[n], border, work)
        weight, square = _set_equations(pixels, n, strips, border, noise, work)
        if weight < 2.0 * _PARAMETERS:
            return 0.0
        if turn == 0:
            if not _set_levels(work):
                return 0.0
            continue
        noise = max(math.sqrt(square / (weight - _PARAMETERS)), _MIN_NOISE)
        _add_knowledge(noise, work)
        if not _invert(work.normal):
            return 0.0
        moved = _advance(noise, work)
        if p[_CONTRAST] <= 0.0 or np.abs(p[:_ENDS]).max() > _MAX_SHIFT_PX:
            return 0.0
        if moved < _CONVERGED:
            break
    work.normal[:] *= noise * noise
    _set_gaps(pixels, n, strips, border, noise, work)
    _add_doubts(pixels.frames[n], border, usual, work)
    return float(p[_CONTRAST])


@cached_njit
def _add_doubts(frames: FloatArray, border: int, usual: float, work: _Work) -> None:
    """Add model errors to the covariance of the ends.

    Displaced cells behind the border indicate an occluded side, which may be displaced by the same amount.
    Those of the camera itself have the mean square `usual`.
    """
    for k in range(4):
        cell = min(frames[k, NEAR], frames[k, FAR]) / border
        blur = max(work.windows[k, 0], work.windows[k, 1])
        gap = max(abs(work.gaps[k, 0]) - _BY_CHANCE * math.sqrt(work.gaps[k, 1] ** 2 + usual), 0.0)
        together = (_NEIGHBOURS * blur**3 / cell**2) ** 2 + gap**2
        work.normal[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += together + _MIN_STEP_PX**2 * np.eye(2)


@cached_njit
def _set_gaps(pixels: SidePixels, n: int, strips: Bits, border: int, noise: float, work: _Work) -> None:
    """Set `work.gaps` to the displacement of white cells behind the border and its error [px]; 0: none there.

    Displacement and brightness of the white cells are fitted to the residuals of each side.
    """
    p, sums = work.p, np.zeros((4, 5))
    work.gaps[:] = 0.0
    for i in range(pixels.counts[n]):
        k, a = pixels.side[n, i] - INNER, pixels.along[n, i]
        if k < 0:
            continue
        across, along, _, _, clear = work.windows[k]
        frame = pixels.frames[n, k]
        s = a / frame[LENGTH]
        d = pixels.outside[n, i] - (1.0 - s) * p[2 * k] - s * p[2 * k + 1]
        gap = frame[NEAR] + s * (frame[FAR] - frame[NEAR])
        if a < clear or a > frame[LENGTH] - clear or abs(d + gap) > _inner_reach(frame, border, across):
            continue
        white = _white(a + frame[SHEAR] * (d + gap), along, strips[k], border, pixels.boundaries[n, k])
        if white > _CLEARLY_WHITE:
            level, slope, _ = _profile(d, gap, across, white)
            light = 1.0 + p[_LIGHT_X] * pixels.place[n, i, 0] + p[_LIGHT_Y] * pixels.place[n, i, 1]
            rest = (pixels.value[n, i] / light - p[_DARK]) / p[_CONTRAST] - level
            sums[k, 0] += slope * slope
            sums[k, 1] += slope * level
            sums[k, 2] += level * level
            sums[k, 3] += slope * rest
            sums[k, 4] += level * rest
    for k in range(4):
        determinant = sums[k, 0] * sums[k, 2] - sums[k, 1] ** 2
        if determinant > 1e-9:
            work.gaps[k, 0] = (sums[k, 1] * sums[k, 4] - sums[k, 2] * sums[k, 3]) / determinant
            by_noise = noise / p[_CONTRAST] * math.sqrt(sums[k, 2] / determinant)
            work.gaps[k, 1] = math.hypot(_BY_FIT * by_noise, _OWN_PX)


@cached_njit
def _inner_reach(frame: FloatArray, border: int, across: float) -> float:
    """Range of pixels that depend on the border's inner edge; 0 if other edges are too close [px]."""
    cell = min(frame[NEAR], frame[FAR]) / border
    reach = min(2.0 * across + 1.0, cell - _CLEAR * across, INNER_REACH_PX)
    return reach if reach > across else 0.0


@cached_njit
def _set_windows(frames: FloatArray, border: int, work: _Work) -> None:
    """Set for each side blur across and along, window inside, outside, and at its corners [px]."""
    p = work.p
    for k in range(4):
        du, dv = frames[k, DU], frames[k, DV]
        twice = 2.0 * p[_BLUR_XY] * du * dv
        across = math.sqrt(max(p[_BLUR_XX] * dv * dv + p[_BLUR_YY] * du * du - twice, _MIN_BLUR))
        along = math.sqrt(max(p[_BLUR_XX] * du * du + p[_BLUR_YY] * dv * dv + twice, _MIN_BLUR))
        wide = min(_REACH * across + _MORE_REACH_PX, REACH_PX)
        cell = min(frames[k, NEAR], frames[k, FAR]) / border
        work.windows[k, 0], work.windows[k, 1] = across, along
        work.windows[k, 2] = max(min(wide, (border + 1) * cell - _CLEAR * across), _MIN_REACH_PX)
        work.windows[k, 3] = max(min(wide, cell - _CLEAR * across), _MIN_REACH_PX)
        work.windows[k, 4] = min(_CLEAR_OF_CORNERS * along + 0.5, 0.25 * frames[k, LENGTH])


@cached_njit
def _set_equations(
    pixels: SidePixels, n: int, strips: Bits, border: int, noise: float, work: _Work
) -> tuple[float, float]:
    """Fill the normal equations from the pixels; returns the sum of weights and of weighted squares."""
    p, jacobian = work.p, np.empty(_OF_SIDE)
    of_side, towards = np.zeros((4, _OF_SIDE, _OF_SIDE)), np.zeros((4, _OF_SIDE))
    total, square = 0.0, 0.0
    for i in range(pixels.counts[n]):
        k, a = pixels.side[n, i], pixels.along[n, i]
        # only pixels in the window of the outer edge, clear of the corners
        if k >= INNER:
            continue
        across, along, inside, outside, clear = work.windows[k]
        frame = pixels.frames[n, k]
        s = a / frame[LENGTH]
        d = pixels.outside[n, i] - (1.0 - s) * p[2 * k] - s * p[2 * k + 1]
        if a < clear or a > frame[LENGTH] - clear or d < -inside or d > outside:
            continue
        # model: light (dark + contrast * profile), with the white cells behind the border
        gap = frame[NEAR] + s * (frame[FAR] - frame[NEAR])
        white = _white(a + frame[SHEAR] * (d + gap), along, strips[k], border, pixels.boundaries[n, k])
        level, slope, widening = _profile(d, gap, across, white)
        x, y = pixels.place[n, i]
        light = 1.0 + p[_LIGHT_X] * x + p[_LIGHT_Y] * y
        paint = p[_DARK] + p[_CONTRAST] * level
        # its derivatives by the ends, ink, contrast, light and blur
        by_place = light * p[_CONTRAST] * slope
        by_variance = light * p[_CONTRAST] * widening / (2.0 * across * across)
        jacobian[0], jacobian[1] = (s - 1.0) * by_place, -s * by_place
        jacobian[2], jacobian[3] = light, light * level
        jacobian[4], jacobian[5] = x * paint, y * paint
        jacobian[6], jacobian[7] = by_variance * frame[DV] ** 2, by_variance * frame[DU] ** 2
        jacobian[8] = -2.0 * by_variance * frame[DU] * frame[DV]
        # add the pixel with Huber's weight to the equations of its side
        rest = pixels.value[n, i] - light * paint
        weight = min(1.0, _OUTLIER * noise / max(abs(rest), 1e-9))
        total += weight
        square += weight * rest * rest
        for m in range(_OF_SIDE):
            weighed = weight * jacobian[m]
            towards[k, m] += weighed * rest
            for o in range(_OF_SIDE):
                of_side[k, m, o] += weighed * jacobian[o]
    # put the equations of the four sides together
    work.normal[:], work.gradient[:] = 0.0, 0.0
    for k in range(4):
        for m in range(_OF_SIDE):
            row = 2 * k + m if m < 2 else _ENDS + m - 2
            work.gradient[row] += towards[k, m]
            for o in range(_OF_SIDE):
                work.normal[row, 2 * k + o if o < 2 else _ENDS + o - 2] += of_side[k, m, o]
    return total, square


@cached_njit
def _white(a: float, along: float, strip: Bits, border: int, boundaries: FloatArray) -> float:
    """Whiteness, 0 to 1, of the blurred cells behind the border at a place along a side."""
    white, before, last = 0.0, 0, strip.size - border
    for cell in range(border, last + 1):
        here = int(strip[cell]) if cell < last else 0
        if here != before:
            white += (here - before) * _below((a - boundaries[cell]) / along)
            before = here
    return white


@cached_njit
def _profile(d: float, gap: float, across: float, white: float) -> tuple[float, float, float]:
    """Brightness, 0 (ink) to 1 (paper), outside of a line; its derivatives by place and by log of blur."""
    z, back = d / across, (d + gap) / across
    bell, inner = math.exp(-0.5 * z * z) / _ROOT_2PI, white * math.exp(-0.5 * back * back) / _ROOT_2PI
    return _below(z) + white * _below(-back), (bell - inner) / across, back * inner - z * bell


@cached_njit
def _below(z: float) -> float:
    """The cumulative normal distribution, to 1e-6."""
    place = (z + _TABLE_END) * _TABLE_STEPS
    if not 0.0 < place < _NORMAL.size - 1:
        return 0.0 if place <= 0.0 else 1.0
    i = int(place)
    return float(_NORMAL[i] + (place - i) * (_NORMAL[i + 1] - _NORMAL[i]))


@cached_njit
def _set_levels(work: _Work) -> bool:
    """Solve the first equations for dark and contrast, initially zero; False if they are singular."""
    p, normal, gradient = work.p, work.normal, work.gradient
    dark, both, light = normal[_DARK, _DARK], normal[_DARK, _CONTRAST], normal[_CONTRAST, _CONTRAST]
    determinant = dark * light - both * both
    if not determinant > 1e-9:
        return False
    p[_DARK] = (light * gradient[_DARK] - both * gradient[_CONTRAST]) / determinant
    p[_CONTRAST] = (dark * gradient[_CONTRAST] - both * gradient[_DARK]) / determinant
    return bool(p[_CONTRAST] > 0.0)


@cached_njit
def _add_knowledge(noise: float, work: _Work) -> None:
    """Add the priors on the blur and on the gradient of the light."""
    p, normal, gradient = work.p, work.normal, work.gradient
    for i in (_LIGHT_X, _LIGHT_Y):
        weight = (noise / _LIGHT_FREEDOM) ** 2
        normal[i, i] += weight
        gradient[i] -= weight * p[i]
    for i in (_BLUR_XX, _BLUR_YY, _BLUR_XY):
        weight = (noise / _BLUR_FREEDOM) ** 2
        normal[i, i] += weight
        gradient[i] += weight * ((0.0 if i == _BLUR_XY else _FIRST_BLUR) - p[i])


@cached_njit
def _advance(noise: float, work: _Work) -> float:
    """Take a bounded step; returns the largest motion of an end in standard deviations."""
    p, inverse = work.p, work.normal
    moved = 0.0
    for i in range(_PARAMETERS):
        change = 0.0
        for j in range(_PARAMETERS):
            change += inverse[i, j] * work.gradient[j]
        if i < _ENDS:
            change = min(max(change, -0.7), 0.7)
            moved = max(moved, abs(change) / (noise * math.sqrt(inverse[i, i]) + _MIN_STEP_PX))
        elif i >= _BLUR_XX:
            most = max(p[_BLUR_XX], p[_BLUR_YY])
            change = min(max(change, -0.6 * most), 1.5 * most)
        p[i] += change
    for i in (_BLUR_XX, _BLUR_YY):
        p[i] = min(max(p[i], _MIN_BLUR), _MAX_BLUR)
    most = 0.95 * math.sqrt(p[_BLUR_XX] * p[_BLUR_YY])
    p[_BLUR_XY] = min(max(p[_BLUR_XY], -most), most)
    return moved


@cached_njit
def _invert(matrix: FloatArray) -> bool:
    """Invert a positive definite matrix in place by Gauss-Jordan; False if it is not positive definite."""
    size = len(matrix)
    for k in range(size):
        pivot = matrix[k, k]
        if not pivot > 1e-9:
            return False
        matrix[k, k] = 1.0
        for j in range(size):
            matrix[k, j] /= pivot
        for i in range(size):
            if i != k:
                factor = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(size):
                    matrix[i, j] -= factor * matrix[k, j]
    return True


# Lines by crossings: checked by `make bench-vision` and test_detector.py.
_MIN_CROSSINGS = 3
_MIN_SINE = 0.1  # Minimum sine of the angle between neighbouring sides
_MIN_SIGMA_PX = 0.004  # Standard deviation of a line without noise, from print, lens and pixels
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
    # a cell of the shorter of the two means of opposite sides
    reaches = 0.5 * np.minimum(lengths[:, 0] + lengths[:, 2], lengths[:, 1] + lengths[:, 3]) / cells
    profile_crossings(image, lens, corners, reaches, spacing, crossings)
    ends, of_ends = np.empty((len(quads), 8)), np.empty((len(quads), 8, 8))
    _fit_lines(crossings, lengths, ends, of_ends, contrast)
    _intersect(corners, ends, of_ends, covariance, contrast)
    return Corners(corners, covariance, contrast)


def refine_read(
    image: Gray, lens: FloatArray, quads: FloatArray, strips: Bits, border: int, displaced: FloatArray
) -> Corners:
    """Move the corners of decoded markers to their edges by a fit to pixels.

    Args:
        image: (height, width).
        lens: See `camera.Camera`.
        quads: (N, 4, 2) clockwise from each marker's own upper left, within a pixel [ideal px].
        strips: (N, 4, cells) the row of cells behind the border along each side; 1 is white.
        border: Width of the border [cells].
        displaced: See `fit_sides`.
    """
    cells = strips.shape[2]
    corners, covariance = quads.copy(), np.zeros((len(quads), 8, 8))
    ends, of_ends, contrast = np.zeros((len(quads), 8)), np.zeros((len(quads), 8, 8)), np.empty(len(quads))
    pixels = side_pixels(image, lens, quads, cells, border)
    unsure = fit_sides(pixels, strips, border, ends, of_ends, contrast, displaced)
    _intersect(corners, ends, of_ends, covariance, contrast)
    lost = np.flatnonzero(contrast == 0.0)
    if len(lost):
        again = refine(image, lens, quads[lost], cells)
        corners[lost], covariance[lost], contrast[lost] = again
    covariance += unsure * np.eye(8)
    return Corners(corners, covariance, contrast)


@cached_njit
def _fit_lines(
    crossings: FloatArray, lengths: FloatArray, ends: FloatArray, covariance: FloatArray, contrast: FloatArray
) -> None:
    """Fit a line to the crossings of each side; fills the last three arguments as `sides.fit_sides`."""
    line = np.empty(5)
    for n in range(len(crossings)):
        contrast[n] = 1e9
        covariance[n] = 0.0
        for k in range(4):
            contrast[n] = min(contrast[n], _fit_line(crossings[n, k], line))
            length, i, j = lengths[n, k], 2 * k, 2 * k + 1
            ends[n, i], ends[n, j] = line[0], line[0] + length * line[1]
            covariance[n, i, i] = line[2]
            covariance[n, i, j] = covariance[n, j, i] = line[2] + length * line[3]
            covariance[n, j, j] = line[2] + length * (2.0 * line[3] + length * line[4])


@cached_njit
def _fit_line(crossings: FloatArray, line: FloatArray) -> float:
    """Fit a line by least squares, repeated without outliers.

    Args:
        crossings: (M, 3) along, outside, contrast.
        line: (5,) filled with the offset at `along` = 0, the slope, and var, cov, var of both.

    Returns:
        The mean contrast, 0 when there are too few crossings.
    """
    offset, slope, limit = 0.0, 0.0, 1e9
    variance, mean_contrast = 0.0, 0.0
    n, sx, sxx = 0.0, 0.0, 0.0
    for _ in range(3):
        # sums of the crossings within the limit of the last round
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
        # the line and the variance of the crossings around it
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
    # covariance of offset and slope
    of_one = (variance + _MIN_SIGMA_PX**2) / _SHARE_FRESH
    determinant = sxx - sx * sx / n
    line[0], line[1] = offset, slope
    line[2] = of_one * sxx / (n * determinant) + _MIN_SIGMA_PX**2
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
    # the lines along the sides
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
    # each corner is where the line before it and its own meet
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
