"""Start values: a table of readings expected at coarse poses, and the coarse posterior over these poses.

Blocked or too bright readings often cause several minima of the cost, some of them wide. The uncertainty of a
pose then follows from the posterior over all poses, not from one minimum.

A search from the closed form ends in a wrong minimum in up to a fifth of the poses where the far power
saturates and the near one is weak (12-15 cm). Instead, every bearing and heading of the table is tried. The
range follows from the total brightness, which decreases with range in every direction.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, norefcount_njit, reassociated_njit
from swarm_loc_estimator.common.se2_scalar import wrap
from swarm_loc_estimator.infrared.brightness import curve_at, distance_at, expected_brightness
from swarm_loc_estimator.swarm.ir_board import AngleCurve, IrModel, IrPlatform, TabulatedCurve

_NEGLIGIBLE = 16.0  # Maximum cost of a pose above the minimum; others are left out
_BESIDE = 1.5  # Maximum distance of poses that belong to one minimum, in steps of the table


@cached_njit
def add_spread(table: StartTable, work: StartWorkspace, pose: FloatArray, covariance: FloatArray) -> float:
    """Add the spread of other likely poses to a pose's covariance (3, 3).

    The prior is uniform over the plane. Ranges form a geometric series, so each is weighted by its square.

    Args:
        table: Start table of the platform.
        work: Workspace with the costs of the readings.
        pose: (3,) range [m], bearing, heading [rad].
        covariance: (3, 3) increased in place.

    Returns:
        The larger of the mean squared deviations of all poses in bearing and heading from this pose.
    """
    size, least = table.angles.size, work.costs.min()
    step = 2.0 * math.pi / size
    near = _BESIDE * math.log(table.ranges[1] / table.ranges[0])
    total, all_b, all_h = 0.0, 0.0, 0.0
    rr, rb, rh, bb, bh, hh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for d in range(work.costs.shape[0]):
        b, h = wrap(table.angles[d // size] - pose[1]), wrap(table.angles[d % size] - pose[2])
        beside = max(abs(b), abs(h)) < _BESIDE * step
        for k in range(table.ranges.size):
            above = work.costs[d, k] - least
            if above > _NEGLIGIBLE:
                continue
            weight = table.ranges[k] ** 2 * math.exp(-above)
            total += weight
            all_b, all_h = all_b + weight * b * b, all_h + weight * h * h
            if beside and abs(math.log(table.ranges[k] / pose[0])) < near:
                continue
            r = table.ranges[k] - pose[0]
            rr, rb, rh = rr + weight * r * r, rb + weight * r * b, rh + weight * r * h
            bb, bh, hh = bb + weight * b * b, bh + weight * b * h, hh + weight * h * h
    covariance[0, 0] += rr / total
    covariance[1, 1] += bb / total
    covariance[2, 2] += hh / total
    covariance[0, 1] += rb / total
    covariance[1, 0] += rb / total
    covariance[0, 2] += rh / total
    covariance[2, 0] += rh / total
    covariance[1, 2] += bh / total
    covariance[2, 1] += bh / total
    return max(all_b, all_h) / total


_DIRECTIONS = (16, 24)  # Minimum and maximum number of bearings, and of headings; in between, two per element
_LEVELS = 16  # Number of ranges; checked with the starts by `make bench-droplet`
_KNEE = 10.0  # Brightness above which compression is logarithmic instead of linear [sigma]
_SHOWN = 2.0  # Brightness of an aligned pair at the maximum range of the table [sigma]

_BLOCKED = np.float32(0.2)  # Maximum contribution of a blocked reading to the misfit
_PER_SIGMA = np.float32(_KNEE)  # Inverse standard deviation of noise on the table's compressed scale
_DARKEST = np.float32(3.0)  # Maximum cost of a possibly blocked reading where others may be too bright
_BLUR = 0.1  # Standard deviation of the Gaussian by which `blurred` smooths the curves [rad]
_BLUR_NOISE = 0.1  # Relative noise of the blurred model

Float32Array = NDArray[np.float32]


class StartTable(NamedTuple):
    """Expected readings at coarse poses, compressed so that bright readings do not dominate."""

    ranges: FloatArray  # (L,) ascending [m]
    angles: FloatArray  # (D,) bearings, and headings [rad]
    patterns: Float32Array  # (D * D, L, modes * n * n) by bearing and heading, range, reading
    totals: Float32Array  # (D * D, L) their sums, which fall with range


class StartWorkspace(NamedTuple):
    """Memory for the search for starts."""

    misfit: Float32Array  # (D * D,)
    level: NDArray[np.int64]  # (D * D,) the range of each direction
    totals: Float32Array  # (L,)
    costs: Float32Array  # (D * D, L) of every pose, where readings may be too bright


@cached_njit
def new_start_workspace(table: StartTable) -> StartWorkspace:
    """Memory for one table."""
    directions, levels = table.totals.shape
    return StartWorkspace(
        np.empty(directions, np.float32),
        np.empty(directions, np.int64),
        np.empty(levels, np.float32),
        np.empty((directions, levels), np.float32),
    )


def blurred(platform: IrPlatform) -> IrModel:
    """The platform's model with smoothed curves and a lower weight of bright readings.

    Kinks and steep flanks of the curves cause local minima around the true one. A search with the exact model
    from the minimum of this one seldom ends in them.
    """
    soft = replace(
        platform,
        sensor=_soft(platform.sensor),
        emitter=_soft(platform.emitter),
        relative_noise=max(platform.relative_noise, _BLUR_NOISE),
        bright_share=0.0,
    )
    return soft.model


def _soft(curve: AngleCurve) -> TabulatedCurve:
    """The curve's mean over a Gaussian."""
    angles, width = np.linspace(-math.pi, math.pi, 721, retstep=True)
    table = curve.table()
    values = scipy.ndimage.gaussian_filter1d(
        [curve_at(table, a)[0] for a in angles[:-1]], _BLUR / width, mode="wrap"
    )
    return TabulatedCurve(tuple(angles), (*values, values[0]))


def start_table(platform: IrPlatform) -> StartTable:
    """The table of a platform; about a megabyte."""
    model = platform.model
    farthest = distance_at(model.amplitudes[0], _SHOWN * model.noise)
    ranges = np.geomspace(2.0 * platform.radius, min(max(farthest, 4.0 * platform.radius), 1e3), _LEVELS)
    directions = min(max(_DIRECTIONS[0], 2 * platform.n), _DIRECTIONS[1])
    angles: FloatArray = np.linspace(-np.pi, np.pi, directions, endpoint=False)
    bearing, heading, distance = np.meshgrid(angles, angles, ranges, indexing="ij")
    poses = np.stack([distance, bearing, heading], axis=-1).reshape(-1, 3)
    readings = np.minimum(expected_brightness(platform, poses), model.saturation)
    patterns = np.arcsinh(readings / (_KNEE * model.noise)).astype(np.float32)
    patterns = patterns.reshape(directions**2, _LEVELS, -1)
    totals: Float32Array = np.sum(patterns, axis=-1)
    return StartTable(ranges.astype(np.float64), angles, patterns, totals)


@norefcount_njit
def find_starts(
    table: StartTable,
    pattern: Float32Array,
    present: Float32Array,
    dark: float,
    work: StartWorkspace,
    starts: FloatArray,
) -> int:
    """Write the best start poses, best first, each a local minimum of the table; returns their number.

    Args:
        table: Start table of the platform.
        pattern: (modes * n * n,) the readings by `compress`, any finite value where missing.
        present: (modes * n * n,) 1 where there is a reading, else 0.
        dark: Maximum of possibly blocked readings, by `compress`. If finite, all ranges are tried, since the
            total brightness is unreliable; inf: any may be blocked or too bright; -inf: none is blocked.
        work: Workspace.
        starts: (S, 4) written: range, bearing, heading, misfit.
    """
    total, count = np.float32(0.0), np.float32(0.0)
    for f in range(pattern.size):
        total += present[f] * pattern[f]
        count += present[f]
    for d in range(work.misfit.size):
        patterns = table.patterns[d]
        if dark == math.inf:
            level, costs = 0, work.costs[d]
            for k in range(costs.size):
                costs[k] = _cost_with_outliers(patterns[k], pattern, present)
                if costs[k] < costs[level]:
                    level = k
            work.level[d], work.misfit[d] = level, costs[level]
            continue
        if dark > -math.inf:
            work.level[d], work.misfit[d] = _best_level(patterns, pattern, present, np.float32(dark))
            continue
        if count == pattern.size:
            level = _level(table.totals[d], total)
        else:
            for k in range(work.totals.size):
                work.totals[k] = _sum_of_present(patterns[k], present)
            level = _level(work.totals, total)
        work.level[d] = level
        work.misfit[d] = _misfit(patterns[level], pattern, present, np.float32(dark))
    return _best_minima(table, work, starts)


@norefcount_njit
def compress(model: IrModel, reading: float) -> float:
    """A reading on the compressed scale of the table."""
    return math.asinh(min(reading, model.saturation) / (_KNEE * model.noise))


@cached_njit
def _level(totals: Float32Array, total: np.float32) -> int:
    """Index of the nearest of decreasing totals, by a binary search without branches."""
    low, size = 0, totals.size - 1
    while size > 1:
        half = size // 2
        low += half if totals[low + half] >= total else 0
        size -= half
    return low if totals[low] - total < total - totals[low + 1] else low + 1


@norefcount_njit
def _best_level(
    patterns: Float32Array, pattern: Float32Array, present: Float32Array, dark: np.float32
) -> tuple[int, float]:
    """Index of the range whose pattern (of L, modes * n * n) fits best, and its misfit."""
    best, least = 0, np.float32(math.inf)
    for level in range(patterns.shape[0]):
        misfit = _misfit(patterns[level], pattern, present, dark)
        if misfit < least:
            best, least = level, misfit
    return best, least


@reassociated_njit
def _sum_of_present(pattern: Float32Array, present: Float32Array) -> np.float32:
    """The sum of the readings that are present."""
    total: np.float32 = np.float32(0.0)
    for f in range(present.size):
        total += present[f] * pattern[f]
    return total


@reassociated_njit
def _misfit(
    expected_here: Float32Array, pattern: Float32Array, present: Float32Array, dark: np.float32
) -> np.float32:
    """The sum of squared differences, limited for readings that may be blocked."""
    total: np.float32 = np.float32(0.0)
    for f in range(pattern.size):
        difference = pattern[f] - expected_here[f]
        square = difference * difference
        if pattern[f] < dark and difference < 0.0:
            square = min(square, _BLOCKED)
        total += present[f] * square
    return total


@reassociated_njit
def _cost_with_outliers(
    expected_here: Float32Array, pattern: Float32Array, present: Float32Array
) -> np.float32:
    """The negative log likelihood of readings, each of which may be blocked or too bright.

    The excess of a reading that is too bright has an exponential distribution.
    """
    total: np.float32 = np.float32(0.0)
    for f in range(pattern.size):
        z = _PER_SIGMA * (pattern[f] - expected_here[f])
        square = np.float32(0.5) * z * z
        total += present[f] * min(square, z if z > np.float32(0.0) else _DARKEST)
    return total


@norefcount_njit
def _best_minima(table: StartTable, work: StartWorkspace, starts: FloatArray) -> int:
    """Write the best local minima over directions to `starts`; returns their number."""
    misfit, size, found = work.misfit, table.angles.size, 0
    for b in range(size):
        for h in range(size):
            here = misfit[b * size + h]
            if found == starts.shape[0] and here >= starts[found - 1, 3]:
                continue
            if not _is_minimum(misfit, size, b, h):
                continue
            found = min(found + 1, starts.shape[0])
            place = found - 1
            while place > 0 and starts[place - 1, 3] > here:
                for c in range(4):
                    starts[place, c] = starts[place - 1, c]
                place -= 1
            starts[place, 0] = table.ranges[work.level[b * size + h]]
            starts[place, 1], starts[place, 2], starts[place, 3] = table.angles[b], table.angles[h], here
    return found


@norefcount_njit
def _is_minimum(misfit: Float32Array, size: int, b: int, h: int) -> bool:
    """Whether no neighbour on the torus of bearing and heading has a lower misfit."""
    here = misfit[b * size + h]
    left, right = (h if h > 0 else size) - 1, h + 1 if h + 1 < size else 0
    for row in ((b if b > 0 else size) - 1, b, b + 1 if b + 1 < size else 0):
        first = row * size
        if min(misfit[first + left], misfit[first + h], misfit[first + right]) < here:
            return False
    return True
