"""The forward model: brightness that each sensor reads of each emitter, eqs (1)-(4) of the Droplet paper.

The paper mixes the frames of both robots. Here all vectors are in the receiver's frame: emitter directions
are rotated by the heading phi before eq. (1), r = R - rho i + rho Rot(phi) j, a step that the paper omits.
Angles are signed and wrapped.

A relative pose is range [m] from centre to centre, bearing [rad] of the transmitter in the receiver's
base_link, and heading [rad] of the transmitter's base_link relative to the receiver's.

Evaluation of the curves S, E and A of a board in compiled code: values and slopes.

Start values: a table of readings expected at coarse poses, and the coarse posterior over these poses.

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
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, norefcount_njit, reassociated_njit
from swarm_loc_estimator.common.numerics import direction_of, wrap
from swarm_loc_estimator.swarm.ir_board import (
    AngleCurve,
    CurveTable,
    IrModel,
    IrPlatform,
    PairGains,
    TabulatedCurve,
)


@cached_njit
def curve_at(table: CurveTable, angle: float) -> tuple[float, float]:
    """The value and slope [1/rad] of a curve at an angle [rad] of any size."""
    a = angle - 2.0 * math.pi * math.floor(angle * (0.5 / math.pi) + 0.5)
    edges = table.edges
    piece = 0
    while piece < edges.size - 2 and a >= edges[piece + 1]:
        piece += 1
    per_radian = table.per_radian[piece]
    place = (a - edges[piece]) * per_radian
    cell = min(max(int(place), 0), table.cubics.shape[1] - 1)
    return _cubic_at(table.cubics[piece, cell], place - cell, per_radian)


@cached_njit
def curves_at(
    table: CurveTable, angles: FloatArray, piece: FloatArray, values: FloatArray, slopes: FloatArray
) -> None:
    """Write the values and slopes [1/rad] of `curve_at` at many angles (k,), without a branch.

    Angles are wrapped in place; `piece` (k,) is workspace for the piece that contains each of them.
    """
    edges, cells = table.edges, table.cubics.shape[1]
    for k in range(angles.size):
        angles[k] -= 2.0 * math.pi * math.floor(angles[k] * (0.5 / math.pi) + 0.5)
        piece[k] = 0.0
    for edge in edges[1:-1]:
        for k in range(angles.size):
            piece[k] += 1.0 if angles[k] >= edge else 0.0
    for k in range(angles.size):
        here = int(piece[k])
        per_radian = table.per_radian[here]
        place = (angles[k] - edges[here]) * per_radian
        cell = min(max(int(place), 0), cells - 1)
        values[k], slopes[k] = _cubic_at(table.cubics[here, cell], place - cell, per_radian)


@cached_njit
def _cubic_at(c: FloatArray, t: float, per_radian: float) -> tuple[float, float]:
    """The value and slope [1/rad] of one cell's cubic at t in [0, 1]."""
    return c[0] + t * (c[1] + t * (c[2] + t * c[3])), (c[1] + t * (2.0 * c[2] + 3.0 * t * c[3])) * per_radian


@cached_njit
def amplitude_at(law: FloatArray, r: float) -> tuple[float, float]:
    """The brightness [count] of an aligned pair at a distance [m], and its slope [count/m].

    `law` (5,) are the fields of `Amplitude` in their order.
    """
    closeness = _closeness(law, r)
    return _amplitude(law, r, closeness, closeness * closeness if law[2] == 2.0 else closeness ** law[2])


@cached_njit
def amplitudes_at(law: FloatArray, r: FloatArray, values: FloatArray, slopes: FloatArray) -> None:
    """Write the values and slopes of `amplitude_at` at many distances (k,)."""
    if law[2] == 2.0:  # a separate loop, since one with a power is not vectorized
        for k in range(r.size):
            closeness = _closeness(law, r[k])
            values[k], slopes[k] = _amplitude(law, r[k], closeness, closeness * closeness)
    else:
        for k in range(r.size):
            values[k], slopes[k] = amplitude_at(law, r[k])


@cached_njit
def _closeness(law: FloatArray, r: float) -> float:
    """One over the distance from the law's pole [1/m]."""
    return 1.0 / float(max(r, law[4]) + law[1])


@cached_njit
def _amplitude(law: FloatArray, r: float, closeness: float, power: float) -> tuple[float, float]:
    """The law's value and slope; `power` is the closeness raised to the law's exponent."""
    value = law[0] * power
    slope = -law[2] * value * closeness
    return value + law[3] + slope * min(r - law[4], 0.0), slope


@cached_njit
def distance_at(law: FloatArray, brightness: float) -> float:
    """The distance [m] at which an aligned pair has this brightness [count], eq. (22); infinite if none.

    The printed 118 is the root of 14000, rounded.
    """
    above = brightness - law[3]
    if above <= 0.0:
        return math.inf
    top, slope = amplitude_at(law, law[4])
    if brightness > top:
        return float(max(law[4] + (brightness - top) / slope, 0.0))
    ratio = law[0] / above
    return float((math.sqrt(ratio) if law[2] == 2.0 else ratio ** (1.0 / law[2])) - law[1])


def expected_brightness(platform: IrPlatform, poses: ArrayLike, gains: PairGains | None = None) -> FloatArray:
    """Readings (k, modes, n, n) [count] without noise, not cut at saturation; [mode, sensor, emitter].

    Args:
        platform: The board of both robots.
        poses: (k, 3) range [m], bearing [rad], heading [rad].
        gains: Of the k pairs; None: unit gains.
    """
    return _at(platform, poses, gains)[0]


def expected_with_slopes(
    platform: IrPlatform, poses: ArrayLike, gains: PairGains | None = None
) -> tuple[FloatArray, FloatArray]:
    """Readings and their derivatives (k, modes, n, n, 3) by range [count/m], bearing, heading [count/rad]."""
    readings, slopes = _at(platform, poses, gains)
    return readings, np.moveaxis(slopes, 1, -1)


def _at(platform: IrPlatform, poses: ArrayLike, gains: PairGains | None) -> tuple[FloatArray, FloatArray]:
    """Readings (k, modes, n, n) and slopes (k, 3, modes, n, n)."""
    at = np.atleast_2d(np.asarray(poses, dtype=float))
    modes, n = len(platform.amplitudes), platform.n
    readings = np.empty((len(at), modes, n, n))
    slopes = np.empty((len(at), 3, modes, n, n))
    _predict_all(platform.model, at, readings.reshape(len(at), -1), slopes.reshape(len(at), 3, -1))
    if gains is None:
        return readings, slopes
    factor = (gains.sensor[:, :, None] * gains.emitter[:, None, :])[:, None]
    return readings * factor, slopes * factor[:, None]


WAY_ROWS = 22  # Number of rows of the workspace of `predict_brightness`


@cached_njit
def _predict_all(model: IrModel, poses: FloatArray, readings: FloatArray, slopes: FloatArray) -> None:
    work = np.empty((WAY_ROWS, model.angles.size**2))
    for k in range(poses.shape[0]):
        predict_brightness(model, poses[k, 0], poses[k, 1], poses[k, 2], work, readings[k], slopes[k])


@norefcount_njit
def predict_brightness(
    model: IrModel,
    distance: float,
    bearing: float,
    heading: float,
    work: FloatArray,
    readings: FloatArray,
    slopes: FloatArray,
) -> None:
    """Write readings (modes * n * n,) and their slopes (3, modes * n * n) of one pose.

    The workspace is (WAY_ROWS, n * n), for the paths from each sensor to each emitter, ordered by sensor.
    Every step is a loop over all paths, without branches where it can be vectorized.
    """
    n, units, rho, count = model.angles.size, model.units, model.radius, work.shape[1]
    x, y, length, direction, piece = work[0], work[1], work[2], work[3], work[8]
    emitter_x, emitter_y, at_sensor, at_emitter = work[4], work[5], work[6], work[7]
    seen, seen_slope, lit, lit_slope, share = work[9], work[10], work[11], work[12], work[13]
    bright, bright_slope, by_length, by_turn = work[14], work[15], work[16:19], work[19:22]
    # the directions of the emitters, and the vectors r from sensors to them, in the receiver's frame, eq. (1)
    cos, sin = math.cos(heading), math.sin(heading)
    ux, uy = math.cos(bearing), math.sin(bearing)
    for j in range(n):
        jx, jy = cos * units[j, 0] - sin * units[j, 1], sin * units[j, 0] + cos * units[j, 1]
        for i in range(n):
            emitter_x[i * n + j], emitter_y[i * n + j] = jx, jy
            x[i * n + j] = distance * ux + rho * (jx - units[i, 0])
            y[i * n + j] = distance * uy + rho * (jy - units[i, 1])
    # their lengths and directions, and the angles at both ends, eqs (2)-(4)
    _measure(x, y, length, direction)
    for i in range(n):
        for j in range(n):
            at_sensor[i * n + j] = direction[i * n + j] - model.angles[i]
            at_emitter[i * n + j] = direction[i * n + j] + math.pi - model.angles[j] - heading
    # the curves S and E there, and what does not depend on the power: factors in the derivatives by range,
    # bearing and heading, of the amplitude's slope and of the amplitude
    curves_at(model.sensor, at_sensor, piece, seen, seen_slope)
    curves_at(model.emitter, at_emitter, piece, lit, lit_slope)
    for w in range(count):
        per_r = 1.0 / length[w]
        vx, vy, of_emitter = x[w] * per_r, y[w] * per_r, seen[w] * lit_slope[w]
        turned = (seen_slope[w] * lit[w] + of_emitter) * per_r  # by the direction of the path
        share[w] = seen[w] * lit[w]
        # motion of the emitter along the path and across it
        forward, aside = vx * ux + vy * uy, vx * uy - vy * ux
        by_length[0, w], by_turn[0, w] = share[w] * forward, turned * aside
        by_length[1, w], by_turn[1, w] = -share[w] * distance * aside, turned * distance * forward
        jx, jy = emitter_x[w], emitter_y[w]
        forward, aside = vx * jx + vy * jy, vx * jy - vy * jx
        by_length[2, w], by_turn[2, w] = -share[w] * rho * aside, turned * rho * forward - of_emitter
    # for each power the readings A S E, and their derivatives
    for m in range(model.amplitudes.shape[0]):
        begin, end = m * count, (m + 1) * count
        amplitudes_at(model.amplitudes[m], length, bright, bright_slope)
        out = readings[begin:end]
        for w in range(count):
            out[w] = share[w] * bright[w]
        for p in range(3):
            _combine(by_length[p], bright_slope, by_turn[p], bright, slopes[p, begin:end])


@cached_njit
def _measure(x: FloatArray, y: FloatArray, length: FloatArray, direction: FloatArray) -> None:
    """Write nonzero lengths and directions [rad] of vectors."""
    for k in range(x.size):
        length[k] = math.sqrt(max(x[k] * x[k] + y[k] * y[k], 1e-12))
        direction[k] = direction_of(y[k], x[k])


@cached_njit
def _combine(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, out: FloatArray) -> None:
    """Write a b + c d, entry by entry."""
    for w in range(out.size):
        out[w] = a[w] * b[w] + c[w] * d[w]


_NEGLIGIBLE = 16.0  # Maximum cost of a pose above the minimum; others are left out
_BESIDE = 1.5  # Maximum distance of poses that belong to one minimum, in steps of the table


@cached_njit
def add_spread(table: StartTable, work: StartWorkspace, pose: FloatArray, covariance: FloatArray) -> float:
    """Add the spread of other likely poses to the covariance (3, 3) of a pose (3,): range, bearing, heading.

    `work` has the costs of the readings. The prior is uniform over the plane. Ranges form a geometric series,
    so each is weighted by its square.

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
    spread = ((rr, rb, rh), (rb, bb, bh), (rh, bh, hh))
    for i in range(3):
        for j in range(3):
            covariance[i, j] += spread[i][j] / total
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
    level: IntArray  # (D * D,) the range of each direction
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

    `pattern` (modes * n * n,) are the readings by `compress`, any finite value where missing, `present` is 1
    where there is one, else 0. `dark` is the maximum of possibly blocked readings, by `compress`: if finite,
    all ranges are tried, since the total brightness is unreliable; inf: any may be blocked or too bright;
    -inf: none is blocked. Starts (S, 4) are range, bearing, heading, misfit.
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
        if dark > -math.inf:  # the range whose pattern fits best
            work.level[d], work.misfit[d] = 0, np.float32(math.inf)
            for k in range(patterns.shape[0]):
                misfit = _misfit(patterns[k], pattern, present, np.float32(dark))
                if misfit < work.misfit[d]:
                    work.level[d], work.misfit[d] = k, misfit
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
    """The negative log likelihood of readings that may be blocked, or too bright by an exponential excess."""
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
