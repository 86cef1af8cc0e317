"""Lines along the sides of quadrangles, by edges on profiles across each side; brightness of cells.

The lines are intersected. The spread of the edges around their line gives the covariance of lines and
corners. Places are "ideal" pixels: those of an image without distortion, where straight lines are straight.
The lens (`Camera.lens`) maps them to the raw image.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.common.camera import raw_pixel
from swarm_loc_vision.common.images import Gray

MAX_PROFILES = 40
# Profiles: checked by the corners of small and blurred markers in `make bench-vision` and test_detector.py.
_MIN_REACH_PX, _MAX_REACH_PX = 1.5, 6.0
_STEP_PX = 0.5
_MIN_SHARED_CELL_PX = 2.0
_SPREAD = 0.4
_MIN_CLEAR_CELL_PX = 4.5  # Narrower cells do not all reach the brightness of ink and paper


@cached_njit
def _brightness(image: Gray, u: float, v: float) -> float:
    """Brightness at a raw pixel inside the image, bilinear."""
    i, j = int(u), int(v)
    a, b = u - i, v - j
    upper = image[j, i] + a * (float(image[j, i + 1]) - image[j, i])
    lower = image[j + 1, i] + a * (float(image[j + 1, i + 1]) - image[j + 1, i])
    return float(upper + b * (lower - upper))


@cached_njit
def profile_crossings(
    image: Gray,
    lens: FloatArray,
    quads: FloatArray,
    reaches: FloatArray,
    spacing: float,
    crossings: FloatArray,
) -> None:
    """Find where brightness crosses the middle level between dark and light on profiles across the sides.

    Crossings (N, 4, MAX_PROFILES, 3) are filled with the place along side k, from corner k to k + 1, the
    distance outside of it [px], and the contrast, 0: no crossing. Profiles have a length (N,) to each side,
    and a spacing if MAX_PROFILES are enough [px]; for the other arguments see `refine`.
    """
    most = 2 * math.ceil(_MAX_REACH_PX / _STEP_PX) + 1
    profiles = np.empty((4, MAX_PROFILES, most))
    dark, light = np.empty((4, MAX_PROFILES)), np.empty((4, MAX_PROFILES))
    for n in range(len(quads)):
        reach = min(max(reaches[n], _MIN_REACH_PX), _MAX_REACH_PX)
        half = math.ceil(reach / _STEP_PX)
        taken = 0
        # take the profiles of each side, clear of its corners
        for k in range(4):
            crossings[n, k, :, 2] = 0.0
            u, v = quads[n, k, 0], quads[n, k, 1]
            du, dv = quads[n, (k + 1) % 4, 0] - u, quads[n, (k + 1) % 4, 1] - v
            length = math.hypot(du, dv)
            if not length > 1.0:  # also when not a number
                continue
            du, dv = du / length, dv / length
            skip = min(0.2 * length, 1.0 + 0.5 * reach)
            usable = length - 2.0 * skip
            count = min(max(int(usable / spacing) + 1, 4), MAX_PROFILES)
            for m in range(count):
                along = skip + usable * m / (count - 1)
                middle_u, middle_v = u + along * du, v + along * dv
                raw_u, raw_v = raw_pixel(lens, middle_u, middle_v)
                out_u, out_v = raw_pixel(lens, middle_u + dv, middle_v - du)  # straight enough over a profile
                profile = profiles[k, m]
                if _profile(image, raw_u, raw_v, out_u - raw_u, out_v - raw_v, half, profile):
                    # the darkest inner and the lightest outer value
                    dark[k, m] = light[k, m] = profile[half]
                    for j in range(half):
                        dark[k, m] = min(dark[k, m], profile[j])
                        light[k, m] = max(light[k, m], profile[half + 1 + j])
                    crossings[n, k, m, 0] = along
                    crossings[n, k, m, 2] = light[k, m] - dark[k, m]
                    taken += 1
        # of a small marker all profiles share one level
        is_small = reach < _MIN_CLEAR_CELL_PX and taken > 0
        common = _common_level(crossings[n, :, :, 2], dark, light) if is_small else 0.0
        # where each profile crosses its level
        for k in range(4):
            for m in range(MAX_PROFILES):
                if crossings[n, k, m, 2] > 0.0:
                    own = 0.5 * (dark[k, m] + light[k, m])
                    place, found = _crossing(profiles[k, m], half, common if is_small else own)
                    if not found and is_small:
                        place, found = _crossing(profiles[k, m], half, own)
                    crossings[n, k, m, 1] = place * _STEP_PX
                    if not found:
                        crossings[n, k, m, 2] = 0.0


@cached_njit
def _common_level(contrasts: FloatArray, dark: FloatArray, light: FloatArray) -> float:
    """The middle level of the clearest quarter of a small marker's profiles.

    Where cells are hardly wider than the blur, white cells behind the border and dark surroundings bias the
    middle levels of many profiles.
    """
    all_dark, all_light = np.empty(contrasts.size), np.empty(contrasts.size)
    count = 0
    for k in range(contrasts.shape[0]):
        for m in range(contrasts.shape[1]):
            if contrasts[k, m] > 0.0:
                all_dark[count], all_light[count] = dark[k, m], light[k, m]
                count += 1
    quarter = (count + 3) // 4
    darkest = np.sort(all_dark[:count])[:quarter].mean()
    return float(0.5 * (darkest + np.sort(all_light[:count])[count - quarter :].mean()))


@cached_njit
def _profile(image: Gray, u: float, v: float, du: float, dv: float, half: int, profile: FloatArray) -> bool:
    """Sample 2 half + 1 points around a raw pixel; False when they leave the image."""
    du, dv = _STEP_PX * du, _STEP_PX * dv
    for end in (-half, half):
        x, y = u + end * du, v + end * dv
        if not (0.0 <= x < image.shape[1] - 1 and 0.0 <= y < image.shape[0] - 1):  # also if NaN
            return False
    for j in range(2 * half + 1):
        profile[j] = _brightness(image, u + (j - half) * du, v + (j - half) * dv)
    return True


@cached_njit
def _crossing(profile: FloatArray, half: int, level: float) -> tuple[float, bool]:
    """Where a profile (2 half + 1,) rises through a level next to its centre [steps]; whether it does."""
    best, found = 0.0, False
    for j in range(2 * half):
        low, high = profile[j], profile[j + 1]
        if low < level <= high:
            place = j - half + (level - low) / (high - low)
            if not found or abs(place) < abs(best):
                best, found = place, True
    return best, found


@cached_njit
def read_cells(image: Gray, lens: FloatArray, homographies: FloatArray, side: int, cells: FloatArray) -> None:
    """Fill cells (N, grid, grid) with the mean brightness in their middle, upper left first.

    The marker, with `side` cells along a side, is in the middle. Homographies (N, 3, 3) are those of
    `homographies`; for the lens see `camera.Camera`.
    """
    grid = cells.shape[1]
    first = 0.5 * (side - grid)
    for n in range(len(homographies)):
        h = homographies[n]
        # points along a cell's side and their distance [cells]: one where the middle cell is small
        w = 0.5 * (h[2, 0] + h[2, 1]) + h[2, 2]
        u, v = (0.5 * (h[0, 0] + h[0, 1]) + h[0, 2]) / w, (0.5 * (h[1, 0] + h[1, 1]) + h[1, 2]) / w
        a, b = (h[0, 0] - u * h[2, 0]) / w, (h[0, 1] - u * h[2, 1]) / w
        c, d = (h[1, 0] - v * h[2, 0]) / w, (h[1, 1] - v * h[2, 1]) / w
        cell = math.sqrt(abs(a * d - b * c)) / side
        points, spread = (1, 0.0) if cell < _MIN_SHARED_CELL_PX else (2, _SPREAD)
        for row in range(grid):
            for column in range(grid):
                total = 0.0
                for i in range(points):
                    y = (first + row + 0.5 + spread * (i - 0.5 * (points - 1))) / side
                    for j in range(points):
                        x = (first + column + 0.5 + spread * (j - 0.5 * (points - 1))) / side
                        w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
                        u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w
                        v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
                        u, v = raw_pixel(lens, u, v)
                        u = min(max(u, 0.0), image.shape[1] - 1.001)
                        v = min(max(v, 0.0), image.shape[0] - 1.001)
                        total += _brightness(image, u, v)
                cells[n, row, column] = total / (points * points)


def homographies(quads: FloatArray) -> FloatArray:
    """(N, 3, 3) from the unit square, clockwise from its upper left (0, 0), to quadrangles (N, 4, 2)."""
    first, second, third, fourth = np.moveaxis(quads, 1, 0)
    uneven = first - second + third - fourth
    a, b = second - third, fourth - third

    def cross(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1])

    g, h = cross(uneven, b) / cross(a, b), cross(a, uneven) / cross(a, b)
    result = np.empty((len(quads), 3, 3))
    result[:, :2, 0] = second - first + g[:, None] * second
    result[:, :2, 1] = fourth - first + h[:, None] * fourth
    result[:, :2, 2] = first
    result[:, 2, 0], result[:, 2, 1], result[:, 2, 2] = g, h, 1.0
    return result


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
    """Refine quadrangles (N, 4, 2), clockwise, dark inside [ideal px], by lines fitted to their edges.

    Profiles reach one of the `cells` of a side to both of its sides, at a spacing along it [px]; for the lens
    see `camera.Camera`.
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
    intersect(corners, ends, of_ends, covariance, contrast)
    return Corners(corners, covariance, contrast)


@cached_njit
def _fit_lines(
    crossings: FloatArray, lengths: FloatArray, ends: FloatArray, covariance: FloatArray, contrast: FloatArray
) -> None:
    """Fit a line to the crossings of each side; see `intersect` for the last three arguments."""
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
    """Fit a line to crossings (M, 3), repeated without outliers; the mean contrast, 0: too few crossings.

    The line (5,) is the offset at the first corner, the slope, and var, cov, var of both.
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
def intersect(
    corners: FloatArray, ends: FloatArray, of_ends: FloatArray, covariance: FloatArray, contrast: FloatArray
) -> None:
    """Move the corners (N, 4, 2) of quadrangles to where the lines along their sides meet.

    Ends (N, 8) are the distances of each line outside of its side at the first and the last corner [px], with
    a covariance (N, 8, 8). That of the corners is filled. Where lines do not meet, the contrast (N,) is 0.
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

    Fills the `moved` corners, and their derivatives by `ends`, see `intersect`.
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
