"""The pixels around the sides of quadrangles, each given in the frame of its side.

Sides are straight in an image without distortion ("ideal" pixels). Raw pixels next to a side are mapped there
by the shift of the lens, interpolated from six points at the side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.common.camera import raw_pixels
from swarm_loc_vision.common.images import Gray
from swarm_loc_vision.common.sampling import homographies

REACH_PX, INNER_REACH_PX = 7.0, 3.5
"""Maximum distance of pixels from a side, and from the inner edge of its border."""
_MAX_ROWS = 32  # Maximum number of rows or columns of pixels across a side; spread evenly over longer sides
_ROOM = 4 * (_MAX_ROWS + 1) * (2 * math.ceil(math.sqrt(2.0) * (REACH_PX + INNER_REACH_PX)) + 4)
_NODES = 6
"""Points at a side whose shift is computed: start, middle and end on it, and one pixel outside of these."""
U, V, DU, DV, LENGTH, NEAR, FAR, SHEAR = range(8)
INNER = 4


class SidePixels(NamedTuple):
    """Pixels near the four sides of N quadrangles."""

    # (N, 4, 8) of each side: start, direction, length, width of the border at both ends [px], and shear, the
    # shift of cells along the side per distance inwards
    frames: FloatArray
    # (N, 4, cells + 1) distance along a side of the boundaries of cells behind the border [px]
    boundaries: FloatArray
    counts: NDArray[np.int64]  # (N,) number of pixels of each quadrangle; M is the bound on it
    # (N, M) index of the side; INNER is added for pixels at the inner edge of its border
    side: NDArray[np.int64]
    along: FloatArray  # (N, M) distance along the side [px]
    outside: FloatArray  # (N, M) distance outside of the side [px]
    place: FloatArray  # (N, M, 2) position from the first corner, over the size of the quadrangle
    value: FloatArray  # (N, M) brightness


def side_pixels(image: Gray, lens: FloatArray, quads: FloatArray, cells: int, border: int) -> SidePixels:
    """Collect the pixels near the sides of quadrangles.

    Args:
        image: (height, width).
        lens: See `camera.Camera`.
        quads: (N, 4, 2) clockwise from the marker's own upper left [ideal px].
        cells: Cells along a side.
        border: Width of the border [cells].
    """
    count = len(quads)
    found = SidePixels(
        np.empty((count, 4, 8)),
        np.empty((count, 4, cells + 1)),
        np.zeros(count, np.int64),
        np.empty((count, _ROOM), np.int64),
        np.empty((count, _ROOM)),
        np.empty((count, _ROOM)),
        np.empty((count, _ROOM, 2)),
        np.empty((count, _ROOM)),
    )
    points = _nodes(quads)
    shifts = raw_pixels(lens, points.reshape(-1, 2)).reshape(points.shape) - points
    _collect(image, quads, homographies(quads), shifts, border, found)
    return found


def _nodes(quads: FloatArray) -> FloatArray:
    """(N, 4, _NODES, 2) start, middle and end of each side of quadrangles (N, 4, 2), and a pixel outside."""
    along = np.roll(quads, -1, axis=1) - quads
    outwards = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    outwards /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    shares, steps = np.array([0.0, 0.5, 1.0] * 2), np.array([0.0] * 3 + [1.0] * 3)
    points: FloatArray = quads[:, :, None] + shares[:, None] * along[:, :, None]
    return points + steps[:, None] * outwards[:, :, None]


@cached_njit
def _collect(
    image: Gray, quads: FloatArray, planes: FloatArray, shifts: FloatArray, border: int, found: SidePixels
) -> None:
    """Fill `found`; `shifts` (N, 4, _NODES, 2) map ideal to raw pixels, `planes` markers to ideal pixels."""
    warp, back = np.empty((6, 2)), np.empty((2, 2))
    for n in range(len(quads)):
        size = 0.5 * math.hypot(quads[n, 2, 0] - quads[n, 0, 0], quads[n, 2, 1] - quads[n, 0, 1])
        for k in range(4):
            frame = found.frames[n, k]
            _set_frame(quads[n], planes[n], k, border, frame, found.boundaries[n, k])
            _set_warp(shifts[n, k], warp)
            if _set_way_back(warp, frame, back):
                _collect_side(image, n, k, warp, back, size, found)


@cached_njit
def _set_frame(
    quad: FloatArray, plane: FloatArray, k: int, border: int, frame: FloatArray, boundaries: FloatArray
) -> None:
    """Fill the frame (8,) of side k and the boundaries of cells behind its border."""
    cells = boundaries.size - 1
    u, v = quad[k, 0], quad[k, 1]
    du, dv = quad[(k + 1) % 4, 0] - u, quad[(k + 1) % 4, 1] - v
    length = max(math.hypot(du, dv), 1e-9)
    du, dv = du / length, dv / length
    depth = border / cells
    for i in range(cells + 1):
        x, y = _place(plane, k, i / cells, depth)
        boundaries[i] = (x - u) * du + (y - v) * dv
    x, y = _place(plane, k, depth, depth)
    first, at_first = (y - v) * du - (x - u) * dv, (x - u) * du + (y - v) * dv
    x, y = _place(plane, k, 1.0 - depth, depth)
    last, at_last = (y - v) * du - (x - u) * dv, (x - u) * du + (y - v) * dv
    slope = (last - first) / (at_last - at_first)
    frame[U], frame[V], frame[DU], frame[DV], frame[LENGTH] = u, v, du, dv, length
    frame[NEAR] = first - slope * at_first
    frame[FAR] = frame[NEAR] + slope * length
    x, y = _place(plane, k, 0.5, depth)
    shallow, at_shallow = (y - v) * du - (x - u) * dv, (x - u) * du + (y - v) * dv
    x, y = _place(plane, k, 0.5, 2.0 * depth)
    deep, at_deep = (y - v) * du - (x - u) * dv, (x - u) * du + (y - v) * dv
    frame[SHEAR] = (at_deep - at_shallow) / (deep - shallow)


@cached_njit
def _place(h: FloatArray, k: int, along: float, depth: float) -> tuple[float, float]:
    """Ideal pixel of a point of a marker, given by its place along side k and its depth."""
    x, y = along, depth
    if k == 1:
        x, y = 1.0 - depth, along
    elif k == 2:
        x, y = 1.0 - along, 1.0 - depth
    elif k == 3:
        x, y = depth, 1.0 - along
    w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    return (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w


@cached_njit
def _set_warp(shifts: FloatArray, warp: FloatArray) -> None:
    """Coefficients (6, 2) of 1 s s2 d ds ds2 in the shift; s 0 to 1 along the side, d outside [px]."""
    for axis in range(2):
        for layer in range(2):
            a, b, c = shifts[3 * layer, axis], shifts[3 * layer + 1, axis], shifts[3 * layer + 2, axis]
            warp[3 * layer, axis] = a
            warp[3 * layer + 1, axis] = 4.0 * b - 3.0 * a - c
            warp[3 * layer + 2, axis] = 2.0 * (a + c) - 4.0 * b
        for i in range(3):
            warp[3 + i, axis] -= warp[i, axis]


@cached_njit
def _shift(warp: FloatArray, axis: int, s: float, d: float) -> float:
    """The shift by the polynomial of `_set_warp`."""
    on_line = warp[0, axis] + s * (warp[1, axis] + s * warp[2, axis])
    across = warp[3, axis] + s * (warp[4, axis] + s * warp[5, axis])
    return float(on_line + d * across)


@cached_njit
def _set_way_back(warp: FloatArray, frame: FloatArray, back: FloatArray) -> bool:
    """Fill the inverse Jacobian (2, 2) of raw pixels at the middle of a side; False if it is singular."""
    du, dv, length = frame[DU], frame[DV], frame[LENGTH]
    by_along_u, by_along_v = du + (warp[1, 0] + warp[2, 0]) / length, dv + (warp[1, 1] + warp[2, 1]) / length
    by_outside_u = dv + warp[3, 0] + 0.5 * (warp[4, 0] + 0.5 * warp[5, 0])
    by_outside_v = -du + warp[3, 1] + 0.5 * (warp[4, 1] + 0.5 * warp[5, 1])
    determinant = by_along_u * by_outside_v - by_outside_u * by_along_v
    if not abs(determinant) > 0.1:  # also when not a number
        return False
    back[0, 0], back[0, 1] = by_outside_v / determinant, -by_outside_u / determinant
    back[1, 0], back[1, 1] = -by_along_v / determinant, by_along_u / determinant
    return True


@cached_njit
def _collect_side(
    image: Gray, n: int, k: int, warp: FloatArray, back: FloatArray, size: float, found: SidePixels
) -> None:
    """Collect the pixels near one side by rows or columns across it."""
    frame = found.frames[n, k]
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
    # walk along the rows or columns that cross it
    width, height = (image.shape[1], image.shape[0]) if is_flat else (image.shape[0], image.shape[1])
    low, high = max(math.ceil(min(begin, end)), 0), min(math.floor(max(begin, end)), width - 1)
    stride = max(1, math.ceil((high - low + 1) / _MAX_ROWS))
    for i in range(low, high + 1, stride):
        share = (i - begin) / (end - begin)
        # pixels around the outer edge, and in every other row around the inner one
        centre = across + slope * (i - begin) + share * (1.0 - share) * bow
        gap = frame[NEAR] + share * (frame[FAR] - frame[NEAR])
        for inner in range(2 if (i - low) % (2 * stride) == 0 else 1):  # every other row is enough inside
            middle = centre + inner * inwards * gap
            room = lean * (INNER_REACH_PX if inner else REACH_PX)
            top, bottom = max(math.ceil(middle - room), 0), min(math.floor(middle + room), height - 1)
            for j in range(top, bottom + 1):
                m = found.counts[n]
                if m == _ROOM:
                    return
                x, y = (float(i), float(j)) if is_flat else (float(j), float(i))
                # place along and outside of the side, by two Newton steps
                a, d = share * length, -inner * gap
                for _ in range(2):
                    s = a / length
                    rest_u = x - (u + a * du + d * dv + _shift(warp, 0, s, d))
                    rest_v = y - (v + a * dv - d * du + _shift(warp, 1, s, d))
                    a += back[0, 0] * rest_u + back[0, 1] * rest_v
                    d += back[1, 0] * rest_u + back[1, 1] * rest_v
                found.side[n, m], found.along[n, m], found.outside[n, m] = k + INNER * inner, a, d
                found.place[n, m, 0] = (x - found.frames[n, 0, U]) / size
                found.place[n, m, 1] = (y - found.frames[n, 0, V]) / size
                found.value[n, m] = float(image[j, i] if is_flat else image[i, j])
                found.counts[n] = m + 1
