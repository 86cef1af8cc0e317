"""Scans: readings of a laser, the beams of a turn, and the lines of walls.

A wall at distance D with normal n is met by a beam of direction u at the inverse distance (n.u)/D, which is
A cos(a) + B sin(a) with (A, B) = n/D: linear least squares with noise that is the same everywhere.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit

UNSEEN = 0.0  #: Inverse distance of a beam without reflection


class Readings(NamedTuple):
    """Readings (n,) of one robot in order of time.

    The inverse of a distance is what a camera beside a laser measures: it is linear in the pixel at which the
    reflection is seen, d = f b / (p - p_inf), so its noise does not depend on the distance.
    """

    stamp_ns: IntArray  #: (n,)
    odometry: FloatArray  #: (n, 3) pose by odometry at each stamp, in the robot's own odom frame
    #: (n,) inverse distance along x of the robot, from its centre [1/m]; `UNSEEN`: nothing
    inverse: FloatArray
    #: Standard deviation of an inverse distance, sigma_px / (f b) [1/m]; NaN before the first reflection
    sigma: float


class LightSightings(NamedTuple):
    """Sightings (m,) of lights of other robots by one robot."""

    stamp_ns: IntArray  #: (m,)
    target: IntArray  #: (m,) number of the robot whose light it is
    bearing: FloatArray  #: (m,) in the frame of the robot that saw it [rad]
    sigma: FloatArray  #: (m,) its standard deviation [rad]


MAX_BEAMS = 768  # Maximum number of beams per stop; if exceeded, every second one is dropped


class Beams(NamedTuple):
    """Beams of stops (k,)."""

    turn: FloatArray  # (k, MAX_BEAMS) turn by odometry since arrival at the stop [rad]
    inverse: FloatArray  # (k, MAX_BEAMS) inverse distance [1/m], 0: no reflection
    bearing: FloatArray  # (k, MAX_BEAMS) direction in the frame of the robot [rad]; 0 of a laser pointer
    weight: FloatArray  # (k, MAX_BEAMS) variance sigma^2 over that of this beam; 1 of a laser pointer
    counts: IntArray  # (k,) number of beams
    sigma: FloatArray  # (k,) standard deviation of an inverse distance [1/m]; of a lidar at its range
    reach: FloatArray  # (k,) range of the laser [m]
    free: FloatArray  # (k,) distance that is free in a direction without reflection [m]


def no_beams(capacity: int) -> Beams:
    """Memory for the beams of `capacity` stops."""
    shape = (capacity, MAX_BEAMS)
    turn, inverse, bearing = np.zeros((3, *shape))
    sigma, reach, free = np.ones((3, capacity))
    return Beams(
        turn, inverse, bearing, np.ones(shape), np.zeros(capacity, dtype=np.int64), sigma, reach, free
    )


class Scan(NamedTuple):
    """What was measured at one place, beams (n,); the fields are the first ones of `Beams`."""

    turn: FloatArray
    inverse: FloatArray
    bearing: FloatArray | float = 0.0
    weight: FloatArray | float = 1.0


def set_beams(beams: Beams, stop: int, scan: Scan) -> None:
    """Set the beams of a stop."""
    every = -(-len(scan.turn) // MAX_BEAMS) or 1
    count = len(scan.turn[::every])
    for memory, values in zip(beams, scan, strict=False):
        memory[stop, :count] = values[::every] if isinstance(values, np.ndarray) else values
    beams.counts[stop] = count


BINS = 360
UNKNOWN, FREE, POINT, LINE = 0, 1, 2, 3
"""Kinds of a direction: unknown; no reflection; reflection without a line; line."""

_SEEN, _CC, _CS, _SS, _YC, _YS, _YY, _C, _S, _Y, _ALL, _W = range(12)
"""Sums over the beams of a direction, all but the two counts weighted; y is the inverse distance."""
_WINDOWS = (40, 28, 20, 14, 9, 6)
_MIN_BEAMS, _MIN_SEEN_SHARE = 5, 0.85
_MAX_THIRD_SIGMAS = 2.2
"""Maximum distance of the mean of a third of a window from the line; beyond it the wall has a step."""
_MIN_INCIDENCE = 0.15  # Minimum cosine between beam and normal
_MAX_NORMAL_SIGMA = 0.08
_RANGE_SIGMAS = 2.5


class Lines(NamedTuple):
    """Lines of stops (k,), per degree of direction relative to the heading on arrival."""

    kind: NDArray[np.int8]  # (k, BINS) `UNKNOWN`, `FREE`, `POINT` or `LINE`
    a: FloatArray  # (k, BINS) normal over distance, along x [1/m]
    b: FloatArray  # (k, BINS) normal over distance, along y [1/m]
    distance: FloatArray  # (k, BINS) along the direction [m]
    variance: FloatArray  # (k, BINS) of the line's inverse distance along the direction [1/m^2]
    turn: FloatArray  # (k, BINS) turn by odometry at which the direction was scanned [rad]
    normal_variance: FloatArray  # (k, BINS) of the direction of the normal [rad^2]
    usable: NDArray[np.bool_]  # (k, BINS) whether the normal is accurate enough for scan matching


def no_lines(capacity: int) -> Lines:
    """Memory for the lines of `capacity` stops."""
    shape = (capacity, BINS)
    a, b, distance, variance, turn, normal = np.zeros((6, *shape))
    kind, usable = np.zeros(shape, dtype=np.int8), np.zeros(shape, dtype=bool)
    return Lines(kind, a, b, distance, variance, turn, normal, usable)


@cached_njit
def fit_lines(stop: int, ratio: float, max_range: float, beams: Beams, lines: Lines) -> None:
    """Fit the lines of one stop.

    Args:
        stop: Its number.
        ratio: True turn over turn by odometry.
        max_range: Maximum range of the laser [m].
        beams: Of all stops.
        lines: Of all stops; those of this one are written.
    """
    sums, turns = _sums_per_bin(stop, ratio, beams)
    total = np.zeros((3 * BINS + 1, 12))  # three periods, since windows cross the seam
    for m in range(3 * BINS):
        total[m + 1] = total[m] + sums[m % BINS]
    sigma = beams.sigma[stop]
    least = 1.0 / max_range + _RANGE_SIGMAS * sigma
    for m in range(BINS):
        seen, looked = sums[m, _SEEN], sums[m, _ALL]
        lines.turn[stop, m] = turns[m] / looked if looked > 0 else (m + 0.5) * 2.0 * math.pi / BINS / ratio
        lines.usable[stop, m] = False
        if _fit_bin(stop, m, total, sigma, least, lines):
            continue
        lines.kind[stop, m] = UNKNOWN
        if _is_free(total, m):
            lines.kind[stop, m] = FREE
        elif seen > 0:
            lines.kind[stop, m] = POINT
            lines.distance[stop, m] = 1.0 / math.sqrt(sums[m, _YY] / sums[m, _W])


@cached_njit
def _sums_per_bin(stop: int, ratio: float, beams: Beams) -> tuple[FloatArray, FloatArray]:
    """Sums (BINS, 12), and sums of turns by odometry (BINS,)."""
    sums, turns = np.zeros((BINS, 12)), np.zeros(BINS)
    for i in range(beams.counts[stop]):
        angle = beams.bearing[stop, i] + ratio * beams.turn[stop, i]
        m = math.floor(angle * BINS / (2.0 * math.pi)) % BINS
        y = beams.inverse[stop, i]
        sums[m, _ALL] += 1.0
        turns[m] += beams.turn[stop, i]
        if y > 0.0:
            c, s, w = math.cos(angle), math.sin(angle), beams.weight[stop, i]
            row = sums[m]
            row[_SEEN] += 1.0
            row[_W] += w
            row[_CC] += w * c * c
            row[_CS] += w * c * s
            row[_SS] += w * s * s
            row[_YC] += w * y * c
            row[_YS] += w * y * s
            row[_YY] += w * y * y
            row[_C] += w * c
            row[_S] += w * s
            row[_Y] += w * y
    return sums, turns


@cached_njit
def _fit_bin(stop: int, m: int, total: FloatArray, sigma: float, least: float, lines: Lines) -> bool:
    """Fit the longest window around a bin that is consistent with a line; returns whether there is one."""
    here = BINS + m
    if total[here + 3, _SEEN] - total[here - 2, _SEEN] == 0.0:
        return False
    angle = (m + 0.5) * 2.0 * math.pi / BINS
    c, s = math.cos(angle), math.sin(angle)
    for width in _WINDOWS:
        best = math.inf
        for position in range(3):
            low = here - (width // 2 if position == 0 else (width - 2 if position == 1 else 1))
            misfit, a, b, vaa, vab, vbb = _fit_window(total, low, low + width, sigma)
            if misfit >= best:
                continue
            y, square = a * c + b * s, a * a + b * b
            if y < least or y < _MIN_INCIDENCE * math.sqrt(square):
                continue
            best = misfit
            lines.a[stop, m], lines.b[stop, m] = a, b
            lines.distance[stop, m] = 1.0 / y
            lines.variance[stop, m] = c * c * vaa + 2.0 * c * s * vab + s * s * vbb
            normal_variance = (b * b * vaa - 2.0 * a * b * vab + a * a * vbb) / (square * square)
            lines.normal_variance[stop, m] = normal_variance
            lines.usable[stop, m] = normal_variance < _MAX_NORMAL_SIGMA**2
        if best < math.inf:
            lines.kind[stop, m] = LINE
            return True
    return False


@cached_njit
def _fit_window(
    total: FloatArray, low: int, high: int, sigma: float
) -> tuple[float, float, float, float, float, float]:
    """Misfit (infinite: no line), a, b, and their covariance aa, ab, bb."""
    none = (math.inf, 0.0, 0.0, 0.0, 0.0, 0.0)
    d = total[high] - total[low]
    n = d[_SEEN]
    if n < _MIN_BEAMS or n < _MIN_SEEN_SHARE * d[_ALL]:
        return none
    det = d[_CC] * d[_SS] - d[_CS] * d[_CS]
    if det < 1e-9 * (d[_W] / n) ** 2:
        return none
    a = (d[_SS] * d[_YC] - d[_CS] * d[_YS]) / det
    b = (d[_CC] * d[_YS] - d[_CS] * d[_YC]) / det
    misfit = (d[_YY] - a * d[_YC] - b * d[_YS]) / (sigma * sigma * max(1.0, n - 2.0))
    if misfit >= 1.0 + 2.0 * math.sqrt(2.0 / n):
        return none
    width = high - low
    for part in range(3):
        first, last = low + part * width // 3, low + (part + 1) * width // 3
        count = total[last, _W] - total[first, _W]
        if count > 0.0:
            off = total[last, _Y] - total[first, _Y]
            off -= a * (total[last, _C] - total[first, _C]) + b * (total[last, _S] - total[first, _S])
            if abs(off) > _MAX_THIRD_SIGMAS * sigma * math.sqrt(count):
                return none
    v = sigma * sigma / det
    return misfit, a, b, v * d[_SS], -v * d[_CS], v * d[_CC]


@cached_njit
def _is_free(total: FloatArray, m: int) -> bool:
    """Whether the beams around a bin show no obstacle within range."""
    here = BINS + m
    looked = total[here + 2, _ALL] - total[here - 1, _ALL]
    seen = total[here + 2, _SEEN] - total[here - 1, _SEEN]
    if looked == 0.0 or seen > 0.2 * looked:
        return False
    around = total[here + 3, _ALL] - total[here - 2, _ALL]
    return bool(total[here + 3, _SEEN] - total[here - 2, _SEEN] <= 0.34 * around)


MIN_OVERLAP = 50  # Minimum number of beams of the first turn with a neighbour in the second
_LOW, _HIGH, _STEP = 0.90, 1.02, 0.0005
_OUTLIER = 9.0


@cached_njit
def turn_ratio(turn: FloatArray, inverse: FloatArray, sigma: float) -> float:
    """The turn ratio at which beams (n,) agree best with those one turn later; NaN if too few see a wall.

    Args:
        turn: (n,) by odometry, increasing or decreasing throughout [rad].
        inverse: (n,) inverse distances, 0: no reflection [1/m].
        sigma: Standard deviation of an inverse distance [1/m].
    """
    forward = np.abs(turn - turn[0])
    best, found = math.inf, math.nan
    if np.sum(inverse > 0.0) < 2 * MIN_OVERLAP:
        return found
    for m in range(round((_HIGH - _LOW) / _STEP) + 1):
        ratio = _HIGH - m * _STEP
        cost, count = _disagreement(forward, inverse, sigma, 2.0 * math.pi / ratio)
        if count >= MIN_OVERLAP and cost / count < best:
            best, found = cost / count, ratio
    return found


@cached_njit
def _disagreement(turn: FloatArray, inverse: FloatArray, sigma: float, later: float) -> tuple[float, int]:
    """Sum of capped squared differences of beams and those a turn `later` [rad], and their number."""
    cost, count, j = 0.0, 0, 0
    for i in range(len(turn)):
        wanted = turn[i] + later
        while j + 1 < len(turn) and turn[j + 1] < wanted:
            j += 1
        if j + 1 >= len(turn):
            break
        count += 1
        if (inverse[i] > 0.0) != (inverse[j] > 0.0):
            cost += _OUTLIER
        elif inverse[i] > 0.0 and inverse[j + 1] > 0.0:
            gap = turn[j + 1] - turn[j]
            share = (wanted - turn[j]) / gap if gap > 0.0 else 0.0
            off = (inverse[i] - (1.0 - share) * inverse[j] - share * inverse[j + 1]) / (1.3 * sigma)
            cost += min(off * off, _OUTLIER)
    return cost, count
