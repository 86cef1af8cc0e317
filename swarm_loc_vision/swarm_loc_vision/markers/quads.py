"""Quadrangle candidates by adaptive thresholding and contour following.

The border of a marker is darker than the paper around it. So pixels are compared with the local mean, the
outlines of dark areas are followed, and outlines with four straight sides are kept: in full resolution with a
small neighbourhood for small markers and a large one for those that touch something dark, and in half
resolution for blurred ones.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.common.images import Gray

IntArray = NDArray[np.int32]

_MIN_SIDE_PX = 3  # Minimum size of an image with inner pixels
_DARK = 255
_FOLLOWED = 1  # Value of a dark pixel on a followed outline whose left neighbour is light
_SAME = 0.15  # Maximum distance of duplicate quadrangles, relative to their size
# Limits of outlines: checked by the recall of `make bench-vision` and by test_detector.py.
_NOISE_SIGMAS = 1.25  # Minimum ratio of contrast to noise; below it, specks would dominate the run time
_SMOOTHING_PX = 0.5  # Sigma of the blur that keeps outlines connected; more would close narrow cells
_NOISE_ROWS = 16  # The noise is measured in every 16th row
_DEVIATION = 0.75  # Standard deviation of noise, blurred as above, over the median of its second differences
_MIN_AREA = 0.6  # Minimum area of a quadrangle over the square of the minimum side
_MIN_COMPACTNESS = 0.008
"""Minimum area of a quadrangle over the square of its outline. A square seen at 75 degrees has 0.04, and a
fourth of that if the outline leads through a gap and around the inside."""
_SLACK_PX, _SLACK = 1.0, 0.05
"""Maximum distance of an outline from its side: pixels, and a share of its length. Points farther away, as at
a gap or an obstacle on the border, are ignored."""
_MIN_SEEN = 0.5  # Minimum share of a side that the outline covers
_ACROSS, _DOWN = np.array([1, 1, 0, -1, -1, -1, 0, 1]), np.array([0, -1, -1, -1, 0, 1, 1, 1])
"""The eight directions, counter-clockwise from the right [px]."""
_LEFT = 4  # Index of the direction to the left
_LONGEST_OUTLINE = 4  # Maximum number of points of an outline, relative to height plus width of the image
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
WINDOWS = ((7, 25), (35,))  # Sides of the neighbourhoods of local means [px], in full and in half resolution


def find_quads(gray: Gray, min_side: float, min_contrast: float, *, touching: bool = False) -> FloatArray:
    """(N, 4, 2) corners [px] of dark quadrangles, clockwise in the image, on the boundary of dark and light.

    Quadrangles have a minimum side [px] and contrast to the local mean [counts], which noise raises. Where
    they may touch others at their corners, dark areas are eroded by a pixel, and the sides lie up to a pixel
    too far inside.
    """
    scaled: NDArray[Any] = cv2.GaussianBlur(gray, (3, 3), _SMOOTHING_PX)
    found: list[FloatArray] = []
    for halvings, windows in enumerate(WINDOWS):
        scale = 1 << halvings
        if min(gray.shape) < _MIN_SIDE_PX * scale:
            break
        if halvings:
            height, width = (size // 2 for size in scaled.shape)
            even = scaled[: 2 * height, : 2 * width]
            scaled = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
        contrast = max(min_contrast, _NOISE_SIGMAS * _noise(scaled))
        for window in windows:
            # 255 where darker than the local mean; the frame is 0, so that outlines stay inside
            dark: NDArray[Any] = cv2.blur(scaled, (window, window))
            cv2.subtract(dark, scaled, dst=dark)  # in place: new arrays of this size cost as much as the rest
            cv2.threshold(dark, contrast - 0.5, _DARK, cv2.THRESH_BINARY, dst=dark)
            surplus = -dark.shape[1] % 8
            if surplus:
                dark = cv2.copyMakeBorder(dark, 0, 0, 0, surplus, cv2.BORDER_CONSTANT, value=0)
            dark[[0, -1]] = 0
            dark[:, [0, -1 - surplus]] = 0
            if touching:
                dark = np.asarray(cv2.erode(dark, _CROSS), np.uint8)
            rows, columns = dark.shape
            points = np.empty((_LONGEST_OUTLINE * (rows + columns), 2), np.int32)
            ahead = _ACROSS + columns * _DOWN
            quads = _follow(dark.reshape(-1), dark.view(np.uint64), ahead, min_side / scale, points)
            found.append((quads + 0.5) * scale - 0.5)
    # without those at the place and of the size of an earlier one
    quads = np.concatenate([np.zeros((0, 4, 2)), *found])
    middle = quads.mean(axis=1)
    size = np.abs(quads - middle[:, None]).mean(axis=(1, 2))
    return quads[apart(np.column_stack([middle, size]), _SAME * size, np.arange(len(quads)))]


@cached_njit
def apart(places: FloatArray, reaches: FloatArray, order: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(N,) which places (N, K) are chosen: in an order, those beyond their reach from all chosen before."""
    kept = np.zeros(len(places), np.bool_)
    for m in range(len(order)):
        i = order[m]
        kept[i] = True
        for n in range(m):
            j = order[n]
            if not kept[j] or abs(places[i, 0] - places[j, 0]) > reaches[i]:
                continue
            away = 0.0
            for c in range(places.shape[1]):
                away += (places[i, c] - places[j, c]) ** 2
            if away <= reaches[i] ** 2:
                kept[i] = False
                break
    return kept


@cached_njit
def _noise(gray: Gray) -> float:
    """Standard deviation of the noise [counts], from second differences, which suppress the image itself."""
    counts = np.zeros(4 * _DARK + 1, np.int64)
    for v in range(0, gray.shape[0], _NOISE_ROWS):
        row = gray[v]
        for u in range(1, len(row) - 1):
            counts[abs(int(row[u - 1]) - 2 * int(row[u]) + int(row[u + 1]))] += 1
    at_most = np.cumsum(counts)  # their median by counting
    half = at_most[-1] // 2
    low, high = (
        np.searchsorted(at_most, (at_most[-1] - 1) // 2, "right"),
        np.searchsorted(at_most, half, "right"),
    )
    return float(_DEVIATION * 0.5 * (low + high))


@cached_njit
def _follow(
    dark: NDArray[np.uint8],
    eights: NDArray[np.uint64],
    ahead: NDArray[np.int64],
    min_side: float,
    points: IntArray,
) -> FloatArray:
    """Follow each outline once and keep quadrangles with sides of `min_side` [px].

    `dark` (height * width) is 255 where dark, and modified, see `_FOLLOWED`; `eights` (height, width / 8) is
    the same memory. `ahead` (8,) are the offsets of a pixel's neighbours. Outlines longer than `points` are
    rejected.
    """
    height, words = eights.shape
    width = 8 * words
    quads = np.empty((64, 4, 2))
    count = 0
    quad = np.empty((4, 2))
    min_points = int(3.2 * min_side)
    for v in range(1, height - 1):
        for word in range(words):
            if eights[v, word] == 0:
                continue
            begin = v * width + 8 * word
            for start in range(begin, begin + 8):
                if dark[start] != _DARK or dark[start - 1] != 0:
                    continue
                length = _outline(dark, ahead, start, points)
                if length < min_points or length > len(points):
                    continue
                if not _quadrangle(points, length, start - v * width, v, min_side, quad):
                    continue
                if count == len(quads):
                    larger = np.empty((2 * count, 4, 2))
                    larger[:count] = quads
                    quads = larger
                quads[count] = quad
                count += 1
    return quads[:count]


@cached_njit
def _outline(dark: NDArray[np.uint8], ahead: NDArray[np.int64], start: int, points: IntArray) -> int:
    """Follow the outline through a dark pixel that is light to its left; returns the number of its points.

    Border following of Suzuki and Abe (1985), 8-connected. The directions to the next point are written to
    points[:, 1], where they fit.
    """
    dark[start] = _FOLLOWED
    back = -1
    for turn in range(1, 8):  # clockwise from the light pixel on the left
        direction = (_LEFT - turn) & 7
        if dark[start + ahead[direction]] != 0:
            back = direction
            break
    if back < 0:
        return 1
    end = start + ahead[back]
    here, length = start, 0
    while True:
        direction = (back + 1) & 7  # counter-clockwise from the previous pixel
        while dark[here + ahead[direction]] == 0:
            if direction == _LEFT:
                dark[here] = _FOLLOWED
            direction = (direction + 1) & 7
        if length < len(points):
            points[length, 1] = direction
        length += 1
        there = here + ahead[direction]
        if there == start and here == end:
            return length
        here, back = there, (direction + 4) & 7


@cached_njit
def _quadrangle(
    points: IntArray, length: int, start_u: int, start_v: int, min_side: float, quad: FloatArray
) -> bool:
    """Whether an outline of `_outline` is a dark quadrangle; fills its corners."""
    # its points, their box and sum, and twice its area
    u, v, twice_area, sum_u, sum_v = start_u, start_v, 0, 0, 0
    low_u, high_u, low_v, high_v = u, u, v, v
    for i in range(length):
        direction = points[i, 1]
        points[i, 0], points[i, 1] = u, v
        du, dv = _ACROSS[direction], _DOWN[direction]
        twice_area += u * dv - v * du
        sum_u, sum_v = sum_u + u, sum_v + v
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
        u, v = u + du, v + dv
    # counter-clockwise in the image: negative, as v points down; outlines of holes are positive
    least = max(_MIN_AREA * min_side**2, _MIN_COMPACTNESS * length**2, -0.375 * twice_area)
    if twice_area >= 0 or (high_u - low_u) * (high_v - low_v) < least:
        return False
    # the four points that span the largest quadrangle
    corners = np.empty(4, np.int64)
    mean_u, mean_v = sum_u / length, sum_v / length
    first, farthest = 0, -1.0
    for i in range(length):
        distance = (points[i, 0] - mean_u) ** 2 + (points[i, 1] - mean_v) ** 2
        if distance > farthest:
            first, farthest = i, distance
    third, farthest = first, -1.0
    for i in range(length):
        distance = float((points[i, 0] - points[first, 0]) ** 2 + (points[i, 1] - points[first, 1]) ** 2)
        if distance > farthest:
            third, farthest = i, distance
    corners[0], corners[2] = first, third
    corners[1] = _farthest(points, length, first, third)
    corners[3] = _farthest(points, length, third, first)
    for _ in range(2):
        has_moved = False
        for k in range(4):
            best = _farthest(points, length, corners[k - 1], corners[(k + 1) % 4])
            has_moved |= best != corners[k]
            corners[k] = best
        if not has_moved:
            break
    twice = 0
    for k in range(4):
        a, b = corners[k - 1], corners[k]
        if a == b:
            return False
        twice += points[a, 0] * points[b, 1] - points[b, 0] * points[a, 1]
    return -0.5 * twice >= least and _sides(points, length, corners, min_side, quad)


@cached_njit
def _farthest(points: IntArray, length: int, begin: int, end: int) -> int:
    """Index of the point between two points of an outline that is farthest from their chord."""
    du = points[end, 0] - points[begin, 0]
    dv = points[end, 1] - points[begin, 1]
    best, farthest = begin, -1
    i = begin
    while i != end:
        outside = abs(du * (points[i, 1] - points[begin, 1]) - dv * (points[i, 0] - points[begin, 0]))
        if outside > farthest:
            best, farthest = i, outside
        i = i + 1 if i + 1 < length else 0
    return best


@cached_njit
def _sides(
    points: IntArray, length: int, corners: NDArray[np.int64], min_side: float, quad: FloatArray
) -> bool:
    """Whether an outline is straight between its corners; fills the intersections of the sides."""
    lines = np.empty((4, 3))  # normal (outwards) and offset
    for k in range(4):
        # the chord between two corners
        begin, end = corners[k], corners[(k + 1) % 4]
        count = end - begin if end > begin else end - begin + length
        du = points[end, 0] - points[begin, 0]
        dv = points[end, 1] - points[begin, 1]
        chord = math.hypot(du, dv)
        if chord < 0.6 * min_side:
            return False
        # moments of the outline near it, clear of the corners
        steps = max(abs(du), abs(dv))
        skip = min(int(0.15 * steps), 12)
        slack = _SLACK_PX + _SLACK * chord
        n, su, sv, suu, suv, svv = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for step in range(skip, count - skip + 1):
            i = begin + step if begin + step < length else begin + step - length
            u, v = float(points[i, 0] - points[begin, 0]), float(points[i, 1] - points[begin, 1])
            if abs(du * v - dv * u) > slack * chord:  # the outline leads through a gap
                continue
            n += 1
            su += u
            sv += v
            suu += u * u
            suv += u * v
            svv += v * v
        # the line along the larger principal axis, which must be straight
        if n < max(_MIN_SEEN * (steps - 2 * skip), 2):
            return False
        su, sv = su / n, sv / n
        suu, suv, svv = suu / n - su * su, suv / n - su * sv, svv / n - sv * sv
        angle = 0.5 * math.atan2(2.0 * suv, suu - svv)
        normal_u, normal_v = -math.sin(angle), math.cos(angle)
        spread = 0.5 * (suu + svv) - math.hypot(0.5 * (suu - svv), suv)
        if spread > (0.4 + 0.02 * chord) ** 2:
            return False
        if normal_u * -dv + normal_v * du > 0.0:  # dark is on the left, outwards is right
            normal_u, normal_v = -normal_u, -normal_v
        # half a pixel outwards, from the outermost dark pixels to the boundary
        lines[k, 0], lines[k, 1] = normal_u, normal_v
        lines[k, 2] = normal_u * (points[begin, 0] + su) + normal_v * (points[begin, 1] + sv) + 0.5
    # neighbouring lines meet near the corners of the outline
    for k in range(4):
        a, b = lines[k - 1], lines[k]
        determinant = a[0] * b[1] - a[1] * b[0]
        if abs(determinant) < 0.1:
            return False
        # counter-clockwise in, clockwise out
        quad[3 - k, 0] = (a[2] * b[1] - b[2] * a[1]) / determinant
        quad[3 - k, 1] = (a[0] * b[2] - b[0] * a[2]) / determinant
        corner = corners[k]
        slack = 2.0 + 0.15 * min_side + 0.02 * length
        if math.hypot(quad[3 - k, 0] - points[corner, 0], quad[3 - k, 1] - points[corner, 1]) > slack:
            return False
    return True
