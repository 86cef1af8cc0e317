"""Start values: a table of coarse poses, and the coarse posterior over it.

A minimum of the cost tells nothing of other minima. Readings of which some are blocked and others too bright
often have several, some of them wide: how uncertain a pose is then follows from the probability of all poses.

One start from the closed form ends in a wrong minimum in up to a fifth of the poses where the far power
saturates and the near one is weak (12-15 cm). Here every direction of the table is tried, and the range
follows from how bright it is in all: brightness falls with range whatever the direction.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit, norefcount_njit, reassociated_njit
from swarm_loc_estimator.common.se2_scalar import wrap
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.curves import curve_at, distance_at
from swarm_loc_estimator.swarm.ir_board import IrModel, IrPlatform
from swarm_loc_estimator.swarm.ir_curves import AngleCurve, TabulatedCurve

_NEGLIGIBLE = 16.0
"""Poses whose costs are higher by this are left out."""
_BESIDE = 1.5
"""What is nearer than so many steps of the table, in range, bearing and heading, is the same minimum."""


@cached_njit
def add_spread(table: StartTable, work: StartWorkspace, pose: FloatArray, covariance: FloatArray) -> float:
    """Add to a pose's covariance (3, 3) what other poses that are likely make it uncertain by.

    Where robots stand is as likely everywhere in the plane. Ranges are spaced as a geometric series, so each
    counts by its square.

    Args:
        table: Of the platform.
        work: Whose costs are those of the readings.
        pose: (3,) range [m], bearing, heading [rad].
        covariance: Added to.

    Returns:
        The larger of the mean squares by which bearing and heading of all poses differ from this one's.
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


_DIRECTIONS = (16, 24)
"""Bearings, and headings, at least and at most; between them two per element."""
_LEVELS = 16
_KNEE = 10.0
"""Readings count linearly up to here, then by their logarithm [sigma]."""
_SHOWN = 2.0
"""The table ends where an aligned pair is so bright [sigma]."""

_BLOCKED = np.float32(0.2)
"""What a blocked reading adds to the misfit at most."""
_PER_SIGMA = np.float32(_KNEE)
"""What one standard deviation of noise is on the table's scale, to the power of -1."""
_DARKEST = np.float32(3.0)
"""The cost of a reading that may be blocked, at most, where others may be too bright."""
_BLUR = 0.1
"""By how much `blurred` softens the curves [rad]."""
_BLUR_NOISE = 0.1
"""Its noise, relative to readings."""

Float32Array = NDArray[np.float32]


class StartTable(NamedTuple):
    """What is read at poses all around, compressed so that bright readings do not outweigh all others.

    Attributes:
        ranges: (L,) ascending [m].
        angles: (D,) bearings, and headings [rad].
        patterns: (D * D, L, modes * n * n) by bearing and heading, range, reading.
        totals: (D * D, L) their sums, which fall with range.
    """

    ranges: FloatArray
    angles: FloatArray
    patterns: Float32Array
    totals: Float32Array


class StartWorkspace(NamedTuple):
    """Memory for the search for starts.

    Attributes:
        misfit: (D * D,).
        level: (D * D,) the range of each direction.
        totals: (L,).
        costs: (D * D, L) of every pose, where readings may be too bright.
    """

    misfit: Float32Array
    level: NDArray[np.int64]
    totals: Float32Array
    costs: Float32Array


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
    """The platform with soft curves, and bright readings weighed less.

    Kinks and steep flanks of the curves make minima of their own around the true one. Where this model's
    search ends, the exact one's seldom goes astray.
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
    values = gaussian_filter1d([curve_at(table, a)[0] for a in angles[:-1]], _BLUR / width, mode="wrap")
    return TabulatedCurve(tuple(angles), (*values, values[0]))


def start_table(platform: IrPlatform) -> StartTable:
    """The table of a platform, of a megabyte or so."""
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
    """Write the best poses to begin at, best first, each the best of its neighbours; returns how many.

    Args:
        table: Of the platform.
        pattern: (modes * n * n,) the readings by `compress`, something finite where missing.
        present: (modes * n * n,) 1 where there is a reading, else 0.
        dark: Readings darker than this, by `compress`, may be blocked ones; how bright they are in all then
            does not tell the range, and all ranges are tried; infinite: any may be blocked or too bright.
        work: To work in.
        starts: (S, 4) range, bearing, heading, and how badly they fit.
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
    """A reading as the table has it."""
    return math.asinh(min(reading, model.saturation) / (_KNEE * model.noise))


@cached_njit
def _level(totals: Float32Array, total: np.float32) -> int:
    """Where among falling totals one is nearest, halving without a branch, which could not be predicted."""
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
    """The range of patterns (L, modes * n * n) that fits best, and how badly it does."""
    best, least = 0, np.float32(math.inf)
    for level in range(patterns.shape[0]):
        misfit = _misfit(patterns[level], pattern, present, dark)
        if misfit < least:
            best, least = level, misfit
    return best, least


@reassociated_njit
def _sum_of_present(pattern: Float32Array, present: Float32Array) -> np.float32:
    """The total of those readings that there are."""
    total: np.float32 = np.float32(0.0)
    for f in range(present.size):
        total += present[f] * pattern[f]
    return total


@reassociated_njit
def _misfit(
    expected_here: Float32Array, pattern: Float32Array, present: Float32Array, dark: np.float32
) -> np.float32:
    """The sum of squares of the differences, for readings that may be blocked up to a limit."""
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
    """The negative log likelihood of readings each of which may be blocked or too bright.

    How bright one is that is too bright has an exponential distribution.
    """
    total: np.float32 = np.float32(0.0)
    for f in range(pattern.size):
        z = _PER_SIGMA * (pattern[f] - expected_here[f])
        square = np.float32(0.5) * z * z
        total += present[f] * min(square, z if z > np.float32(0.0) else _DARKEST)
    return total


@norefcount_njit
def _best_minima(table: StartTable, work: StartWorkspace, starts: FloatArray) -> int:
    """The directions that no neighbour betters, the best `starts` of them."""
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
    """Whether no neighbour on the torus of directions is better."""
    here = misfit[b * size + h]
    left, right = (h if h > 0 else size) - 1, h + 1 if h + 1 < size else 0
    for row in ((b if b > 0 else size) - 1, b, b + 1 if b + 1 < size else 0):
        first = row * size
        if min(misfit[first + left], misfit[first + h], misfit[first + right]) < here:
            return False
    return True
