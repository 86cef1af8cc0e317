"""Sub-pixel corners of decoded markers: their four sides, blur and light, fitted to the raw pixels.

The image of a decoded marker depends on few unknowns: the sides, the brightness of ink and paper, the
gradient of the light, and the blur of optics, pixels and motion, an ellipse. Their least-squares fit to raw
pixels needs no interpolation, which would shift edges along rows or columns by up to a tenth of a pixel. The
white cells behind the border, known from the word of the marker, are part of the model, because their light
blurs into the border. The fit gives the covariance, which is larger for blurred markers.

Tone curves and sharpening of cameras displace edges, which the edge itself does not show. How far the inner
edge of the border is off the place that the outer one predicts, in recent pictures, measures the trust.

Sides are straight in an image without distortion ("ideal" pixels). Raw pixels next to a side are mapped there
by the shift of the lens, interpolated from six points at the side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.common.camera import raw_pixels
from swarm_loc_vision.common.images import Gray
from swarm_loc_vision.markers.lines import Corners, homographies, intersect, refine

Bits = NDArray[np.uint8]

REACH_PX, INNER_REACH_PX, _SHARP_REACH_PX = 7.0, 3.5, 4.0
"""Maximum distance of pixels from a side, from the inner edge of its border, and from a side where the image
turns out to be sharp enough for fewer pixels."""
_MAX_ROWS = 32  # Maximum number of rows or columns of pixels across a side; spread evenly over longer sides
_ROOM = 4 * (_MAX_ROWS + 1) * (2 * math.ceil(math.sqrt(2.0) * (REACH_PX + INNER_REACH_PX)) + 4)
_NODES = 6  # Points whose shift is computed: start, middle and end of a side, and a pixel outside each
U, V, DU, DV, LENGTH, NEAR, FAR, SHEAR = range(8)


class SidePixels(NamedTuple):
    """Pixels near the four sides of a quadrangle."""

    # (4, 8) of each side: start, direction, length, width of the border at both ends [px], and shear, the
    # shift of cells along the side per distance inwards
    frames: FloatArray
    boundaries: (
        FloatArray  # (4, cells + 1) place along a side of the boundaries of cells behind the border [px]
    )
    first: NDArray[np.int64]  # (5,) the first pixel of each side, and their number; M is the bound on it
    is_inner: NDArray[np.bool_]  # (M,) whether the pixel is at the inner edge of the border
    along: FloatArray  # (M,) distance along the side [px]
    outside: FloatArray  # (M,) distance outside of the side [px]
    place: FloatArray  # (M, 2) position from the first corner, over the size of the quadrangle
    value: FloatArray  # (M,) brightness


@cached_njit
def empty_pixels(cells: int) -> SidePixels:
    """Memory for the pixels of one quadrangle with cells along a side."""
    frames, boundaries, first = np.empty((4, 8)), np.empty((4, cells + 1)), np.zeros(5, np.int64)
    along, outside, place = np.empty(_ROOM), np.empty(_ROOM), np.empty((_ROOM, 2))
    is_inner, value = np.empty(_ROOM, np.bool_), np.empty(_ROOM)
    return SidePixels(frames, boundaries, first, is_inner, along, outside, place, value)


def lens_shifts(lens: FloatArray, quads: FloatArray) -> FloatArray:
    """(N, 4, _NODES, 2) from ideal to raw pixels at the nodes of the sides of quadrangles (N, 4, 2)."""
    along = np.roll(quads, -1, axis=1) - quads
    outwards = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    outwards /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    shares, steps = np.array([0.0, 0.5, 1.0] * 2)[:, None], np.array([0.0] * 3 + [1.0] * 3)[:, None]
    nodes = quads[:, :, None] + shares * along[:, :, None] + steps * outwards[:, :, None]
    return np.asarray(raw_pixels(lens, nodes.reshape(-1, 2)).reshape(nodes.shape) - nodes)


@cached_njit
def collect(
    image: Gray, quad: FloatArray, plane: FloatArray, shifts: FloatArray, border: int, reach: float,
    found: SidePixels,
) -> None:  # fmt: skip
    """Collect the pixels near the sides of a quadrangle (4, 2), clockwise from the marker's own upper left.

    `plane` (3, 3) maps the marker to ideal pixels, `shifts` are those of `lens_shifts`, and `reach` is the
    largest distance of pixels from a side [px].
    """
    warp, back = np.empty((6, 2)), np.empty((2, 2))
    size = 0.5 * math.hypot(quad[2, 0] - quad[0, 0], quad[2, 1] - quad[0, 1])
    found.first[0] = 0
    for k in range(4):
        found.first[k + 1] = found.first[k]
        frame = found.frames[k]
        _set_frame(quad, plane, k, border, frame, found.boundaries[k])
        # coefficients of 1 s s2 d ds ds2 in the shift; s 0 to 1 along the side, d outside [px]
        for axis in range(2):
            for layer in range(2):
                a, b, c = (
                    shifts[k, 3 * layer, axis],
                    shifts[k, 3 * layer + 1, axis],
                    shifts[k, 3 * layer + 2, axis],
                )
                warp[3 * layer, axis] = a
                warp[3 * layer + 1, axis] = 4.0 * b - 3.0 * a - c
                warp[3 * layer + 2, axis] = 2.0 * (a + c) - 4.0 * b
            for i in range(3):
                warp[3 + i, axis] -= warp[i, axis]
        # the inverse Jacobian of raw pixels at the middle of the side
        du, dv, length = frame[DU], frame[DV], frame[LENGTH]
        by_along_u = du + (warp[1, 0] + warp[2, 0]) / length
        by_along_v = dv + (warp[1, 1] + warp[2, 1]) / length
        by_outside_u = dv + warp[3, 0] + 0.5 * (warp[4, 0] + 0.5 * warp[5, 0])
        by_outside_v = -du + warp[3, 1] + 0.5 * (warp[4, 1] + 0.5 * warp[5, 1])
        determinant = by_along_u * by_outside_v - by_outside_u * by_along_v
        if abs(determinant) > 0.1:  # not when not a number
            back[0, 0], back[0, 1] = by_outside_v / determinant, -by_outside_u / determinant
            back[1, 0], back[1, 1] = -by_along_v / determinant, by_along_u / determinant
            _collect_side(image, k, warp, back, size, reach, found)


@cached_njit
def _set_frame(
    quad: FloatArray, plane: FloatArray, k: int, border: int, frame: FloatArray, boundaries: FloatArray
) -> None:
    """Fill the frame (8,) of side k and the boundaries of cells behind its border."""
    cells = boundaries.size - 1
    u, v = quad[k, 0], quad[k, 1]
    du, dv = quad[(k + 1) % 4, 0] - u, quad[(k + 1) % 4, 1] - v
    length, depth = max(math.hypot(du, dv), 1e-9), border / cells
    frame[U], frame[V], frame[DU], frame[DV], frame[LENGTH] = u, v, du / length, dv / length, length
    for i in range(cells + 1):
        boundaries[i] = _from_side(plane, k, frame, i / cells, depth)[0]
    # width of the border at both ends, and shear
    at_first, first = _from_side(plane, k, frame, depth, depth)
    at_last, last = _from_side(plane, k, frame, 1.0 - depth, depth)
    slope = (last - first) / (at_last - at_first)
    frame[NEAR] = first - slope * at_first
    frame[FAR] = frame[NEAR] + slope * length
    at_shallow, shallow = _from_side(plane, k, frame, 0.5, depth)
    at_deep, deep = _from_side(plane, k, frame, 0.5, 2.0 * depth)
    frame[SHEAR] = (at_deep - at_shallow) / (deep - shallow)


@cached_njit
def _from_side(h: FloatArray, k: int, frame: FloatArray, along: float, depth: float) -> tuple[float, float]:
    """Distance along side k and inwards [px] of a point given by its place along that side and its depth."""
    x, y = along, depth
    if k == 1:
        x, y = 1.0 - depth, along
    elif k == 2:
        x, y = 1.0 - along, 1.0 - depth
    elif k == 3:
        x, y = depth, 1.0 - along
    w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w - frame[U]
    v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w - frame[V]
    return u * frame[DU] + v * frame[DV], v * frame[DU] - u * frame[DV]


@cached_njit
def _shift(warp: FloatArray, axis: int, s: float, d: float) -> float:
    """The shift by the polynomial of `collect`."""
    on_line = warp[0, axis] + s * (warp[1, axis] + s * warp[2, axis])
    across = warp[3, axis] + s * (warp[4, axis] + s * warp[5, axis])
    return float(on_line + d * across)


@cached_njit
def _collect_side(
    image: Gray, k: int, warp: FloatArray, back: FloatArray, size: float, reach: float, found: SidePixels
) -> None:
    """Collect the pixels near one side by rows or columns across it."""
    frame = found.frames[k]
    u, v, du, dv, length = frame[U], frame[V], frame[DU], frame[DV], frame[LENGTH]
    # the side in raw pixels: its ends, its slope and its bow by the lens
    begin_u, begin_v = u + warp[0, 0], v + warp[0, 1]
    end_u, end_v = u + length * du + _shift(warp, 0, 1.0, 0.0), v + length * dv + _shift(warp, 1, 1.0, 0.0)
    is_flat = abs(end_u - begin_u) >= abs(end_v - begin_v)
    begin, end = (begin_u, end_u) if is_flat else (begin_v, end_v)
    across, across_end = (begin_v, end_v) if is_flat else (begin_u, end_u)
    bow = -warp[2, 1 if is_flat else 0]
    slope = (across_end - across) / (end - begin)
    lean = math.hypot(1.0, slope)
    inwards = lean if (du > 0.0 if is_flat else dv < 0.0) else -lean
    steps = 2 if np.abs(warp).max() > 0.0 else 1  # without distortion one is exact
    # walk along the rows or columns that cross it
    width, height = (image.shape[1], image.shape[0]) if is_flat else (image.shape[0], image.shape[1])
    low, high = max(math.ceil(min(begin, end)), 0), min(math.floor(max(begin, end)), width - 1)
    stride, m = max(1, math.ceil((high - low + 1) / _MAX_ROWS)), found.first[k + 1]
    for i in range(low, high + 1, stride):
        share = (i - begin) / (end - begin)
        # pixels around the outer edge, and in every other row around the inner one
        centre = across + slope * (i - begin) + share * (1.0 - share) * bow
        gap = frame[NEAR] + share * (frame[FAR] - frame[NEAR])
        for inner in range(2 if (i - low) % (2 * stride) == 0 else 1):  # every other row is enough inside
            middle = centre + inner * inwards * gap
            room = lean * (INNER_REACH_PX if inner else reach)
            top, bottom = max(math.ceil(middle - room), 0), min(math.floor(middle + room), height - 1)
            for j in range(top, min(bottom, top + _ROOM - m - 1) + 1):
                x, y = (float(i), float(j)) if is_flat else (float(j), float(i))
                # place along and outside of the side, by Newton steps
                a, d = share * length, -inner * gap
                for _ in range(steps):
                    s = a / length
                    rest_u = x - (u + a * du + d * dv + _shift(warp, 0, s, d))
                    rest_v = y - (v + a * dv - d * du + _shift(warp, 1, s, d))
                    a += back[0, 0] * rest_u + back[0, 1] * rest_v
                    d += back[1, 0] * rest_u + back[1, 1] * rest_v
                found.is_inner[m], found.along[m], found.outside[m] = inner > 0, a, d
                found.place[m, 0] = (x - found.frames[0, U]) / size
                found.place[m, 1] = (y - found.frames[0, V]) / size
                found.value[m] = float(image[j, i] if is_flat else image[i, j])
                m += 1
    found.first[k + 1] = m


_ENDS = 8  # The first parameters: distance of each line outside of its side at both corners [px]
_DARK, _CONTRAST, _LIGHT_X, _LIGHT_Y, _BLUR_XX, _BLUR_YY, _BLUR_XY = range(_ENDS, _ENDS + 7)
_PARAMETERS = _ENDS + 7
_SLOPES = 7  # Derivatives of a pixel: by the two ends of its side, by what all sides share, by blur across it
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
def _fit_markers(
    image: Gray,
    quads: FloatArray,
    planes: FloatArray,
    shifts: FloatArray,
    strips: Bits,
    border: int,
    ends: FloatArray,
    covariance: FloatArray,
    contrast: FloatArray,
    displaced: FloatArray,
) -> float:
    """Fill ends, covariance, and contrast, 0: no fit; the variance of corners by displaced edges [px^2]."""
    row, normal = np.empty(_PARAMETERS), np.empty((_PARAMETERS, _PARAMETERS))
    work = _Work(row, normal, row.copy(), np.empty((4, 5)), np.empty((4, 2)))
    pixels = empty_pixels(strips.shape[2])
    usual = max(displaced[0] - NEW_CAMERA[0], 0.0) / displaced[1]  # no cover in this picture counts
    for n in range(len(strips)):
        for reach in (_SHARP_REACH_PX, REACH_PX):
            collect(image, quads[n], planes[n], shifts[n], border, reach, pixels)
            contrast[n] = _fit_sides(pixels, strips[n], border, reach, usual, work)
            if contrast[n] > 0.0:
                break
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
def _fit_sides(
    pixels: SidePixels, strips: Bits, border: int, reach: float, usual: float, work: _Work
) -> float:
    """Fit one marker; returns the contrast, 0: no fit within reach. `work.normal` becomes the covariance."""
    p, normal, gradient = work.p, work.normal, work.gradient
    p[:] = 0.0
    p[_BLUR_XX] = p[_BLUR_YY] = _FIRST_BLUR
    noise = np.inf
    for turn in range(_ROUNDS):
        _set_windows(pixels.frames, border, work)
        if reach < REACH_PX and work.windows[:, 2:4].max() + np.abs(p[:_ENDS]).max() > reach:
            return 0.0
        weight, square = _set_equations(pixels, strips, border, noise, work)
        if weight < 2.0 * _PARAMETERS:
            return 0.0
        # first solve for dark and contrast, initially zero
        if turn == 0:
            dark, both, light = normal[_DARK, _DARK], normal[_DARK, _CONTRAST], normal[_CONTRAST, _CONTRAST]
            determinant = dark * light - both * both
            if not determinant > 1e-9:
                return 0.0
            p[_DARK] = (light * gradient[_DARK] - both * gradient[_CONTRAST]) / determinant
            p[_CONTRAST] = (dark * gradient[_CONTRAST] - both * gradient[_DARK]) / determinant
            if not p[_CONTRAST] > 0.0:
                return 0.0
            continue
        # priors on the gradient of the light and on the blur
        noise = max(math.sqrt(square / (weight - _PARAMETERS)), _MIN_NOISE)
        for i in range(_LIGHT_X, _BLUR_XY + 1):
            is_light = i <= _LIGHT_Y
            weight = (noise / (_LIGHT_FREEDOM if is_light else _BLUR_FREEDOM)) ** 2
            usually = 0.0 if is_light or i == _BLUR_XY else _FIRST_BLUR
            normal[i, i] += weight
            gradient[i] += weight * (usually - p[i])
        # then all
        if not _invert(normal):
            return 0.0
        moved = _advance(noise, work)
        if p[_CONTRAST] <= 0.0 or np.abs(p[:_ENDS]).max() > _MAX_SHIFT_PX:
            return 0.0
        if moved < _CONVERGED:
            break
    normal[:] *= noise * noise
    _set_gaps(pixels, strips, border, noise, work)
    # displaced cells behind the border indicate an occluded side, which may be displaced by the same amount;
    # those of the camera itself have the mean square `usual`
    for k in range(4):
        cell = min(pixels.frames[k, NEAR], pixels.frames[k, FAR]) / border
        blur = max(work.windows[k, 0], work.windows[k, 1])
        gap = max(abs(work.gaps[k, 0]) - _BY_CHANCE * math.sqrt(work.gaps[k, 1] ** 2 + usual), 0.0)
        together = (_NEIGHBOURS * blur**3 / cell**2) ** 2 + gap**2
        normal[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += together + _MIN_STEP_PX**2 * np.eye(2)
    return float(p[_CONTRAST])


@cached_njit
def _set_gaps(pixels: SidePixels, strips: Bits, border: int, noise: float, work: _Work) -> None:
    """Set `work.gaps` to the displacement of white cells behind the border and its error [px]; 0: none."""
    # displacement and brightness of the white cells are fitted to the residuals of each side
    p, sums = work.p, np.zeros((4, 5))
    work.gaps[:] = 0.0
    for k in range(4):
        frame, (across, along, _, _, clear) = pixels.frames[k], work.windows[k]
        # the range of pixels that depend on the border's inner edge; none if other edges are too close
        cell = min(frame[NEAR], frame[FAR]) / border
        reach = min(2.0 * across + 1.0, cell - _CLEAR * across, INNER_REACH_PX)
        reach = reach if reach > across else 0.0
        for i in range(pixels.first[k], pixels.first[k + 1]):
            a = pixels.along[i]
            s = a / frame[LENGTH]
            d = pixels.outside[i] - (1.0 - s) * p[2 * k] - s * p[2 * k + 1]
            gap = frame[NEAR] + s * (frame[FAR] - frame[NEAR])
            if not pixels.is_inner[i] or a < clear or a > frame[LENGTH] - clear or abs(d + gap) > reach:
                continue
            white = _white(a + frame[SHEAR] * (d + gap), along, strips[k], border, pixels.boundaries[k])
            if white > _CLEARLY_WHITE:
                level, slope, _ = _profile(d, gap, across, white)
                light = 1.0 + p[_LIGHT_X] * pixels.place[i, 0] + p[_LIGHT_Y] * pixels.place[i, 1]
                rest = (pixels.value[i] / light - p[_DARK]) / p[_CONTRAST] - level
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
    pixels: SidePixels, strips: Bits, border: int, noise: float, work: _Work
) -> tuple[float, float]:
    """Fill the normal equations from the pixels; returns the sum of weights and of weighted squares."""
    p, slopes = work.p, np.empty(_SLOPES)
    work.normal[:], work.gradient[:] = 0.0, 0.0
    total, square = 0.0, 0.0
    for k in range(4):
        frame, boundaries, strip = pixels.frames[k], pixels.boundaries[k], strips[k]
        length, near, shear = frame[LENGTH], frame[NEAR], frame[SHEAR]
        widens = (frame[FAR] - near) / length
        across, along, inside, outside, clear = work.windows[k]
        products, towards = np.zeros((_SLOPES, _SLOPES)), np.zeros(_SLOPES)
        for i in range(pixels.first[k], pixels.first[k + 1]):
            # only pixels in the window of the outer edge, clear of the corners
            a = pixels.along[i]
            s = a / length
            d = pixels.outside[i] - (1.0 - s) * p[2 * k] - s * p[2 * k + 1]
            if pixels.is_inner[i] or a < clear or a > length - clear or d < -inside or d > outside:
                continue
            # model: light (dark + contrast * profile), with the white cells behind the border
            gap, white = near + a * widens, 0.0
            if d + gap < _TABLE_END * across:
                white = _white(a + shear * (d + gap), along, strip, border, boundaries)
            level, slope, widening = _profile(d, gap, across, white)
            x, y = pixels.place[i, 0], pixels.place[i, 1]
            light = 1.0 + p[_LIGHT_X] * x + p[_LIGHT_Y] * y
            paint = p[_DARK] + p[_CONTRAST] * level
            # its derivatives by the ends, ink, contrast, light, and blur across the side
            by_place = light * p[_CONTRAST] * slope
            slopes[0], slopes[1] = (s - 1.0) * by_place, -s * by_place
            slopes[2], slopes[3] = light, light * level
            slopes[4], slopes[5] = x * paint, y * paint
            slopes[6] = light * p[_CONTRAST] * widening / (2.0 * across * across)
            # add the pixel with Huber's weight to the equations of its side
            rest = pixels.value[i] - light * paint
            weight = min(1.0, _OUTLIER * noise / max(abs(rest), 1e-9))
            total += weight
            square += weight * rest * rest
            for m in range(_SLOPES):
                weighed = weight * slopes[m]
                towards[m] += weighed * rest
                for o in range(m, _SLOPES):
                    products[m, o] += weighed * slopes[o]
        # put the equations of the four sides together; blur across a side is that in three directions
        du, dv = frame[DU], frame[DV]
        for m in range(_SLOPES + 2):
            row = 2 * k + m if m < 2 else _ENDS + m - 2
            share = _share(m, du, dv)
            work.gradient[row] += share * towards[min(m, _SLOPES - 1)]
            for o in range(_SLOPES + 2):
                low, high = min(m, o, _SLOPES - 1), min(max(m, o), _SLOPES - 1)
                column = 2 * k + o if o < 2 else _ENDS + o - 2
                work.normal[row, column] += share * _share(o, du, dv) * products[low, high]
    return total, square


@cached_njit
def _share(m: int, du: float, dv: float) -> float:
    """Derivative of the m-th slope at a side in a direction by the parameter that it is the slope of."""
    if m == _SLOPES - 1:
        return dv * dv
    if m == _SLOPES:
        return du * du
    return -2.0 * du * dv if m == _SLOPES + 1 else 1.0


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
    bell = math.exp(-0.5 * z * z) / _ROOT_2PI
    if white == 0.0:
        return _below(z), bell / across, -z * bell
    inner = white * math.exp(-0.5 * back * back) / _ROOT_2PI
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
        displaced: (2,) sum of squared displacements by this camera [px^2] and their number; updated.
    """
    cells = strips.shape[2]
    corners, covariance = quads.copy(), np.zeros((len(quads), 8, 8))
    ends, of_ends, contrast = np.zeros((len(quads), 8)), np.zeros((len(quads), 8, 8)), np.empty(len(quads))
    planes, shifts = homographies(quads), lens_shifts(lens, quads)
    unsure = _fit_markers(image, quads, planes, shifts, strips, border, ends, of_ends, contrast, displaced)
    intersect(corners, ends, of_ends, covariance, contrast)
    lost = np.flatnonzero(contrast == 0.0)
    if len(lost):
        again = refine(image, lens, quads[lost], cells)
        corners[lost], covariance[lost], contrast[lost] = again
    covariance += unsure * np.eye(8)
    return Corners(corners, covariance, contrast)
