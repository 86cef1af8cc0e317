"""Single sensors and emitters, from readings of each other alone: dead ones, saturation and noise.

Dead or shaded elements: a dead element stands out between bright ones wherever the other robot is, since no
pose explains the readings of its neighbours. Each element is tested by the likelihood ratio of two
hypotheses: it gives about all of its light, or a third of it or less. Under the first, the ratio exceeds 1 /
p with a probability of at most p (Markov's inequality). Each element is tested at p / elements, so the
probability of any false alarm is p (Wald's sequential test). In any one geometry of a pair an obstacle may
block all light of an element, which is modelled by the board's share of blocked readings; so a few geometries
carry little evidence, however often they were measured.

Since the relative pose is unknown, the likelihood is marginalized over a grid of relative poses. It is
computed for a few relative gains of each sensor of the receiver and emitter of the transmitter; all other
elements follow the board. Residuals are computed after a variance-stabilizing transform. Any reading may be
blocked or too bright, at the rates of the board.

For saturation and noise, neither poses nor curves are used, since a board's curves may be wrong.

Saturation: without saturation, the density of a sensor's readings over different geometries decreases with
brightness near its maximum. Of the readings within a span below the maximum, at most the share window / span
then lies within a narrow window at the top. A binomial test detects the accumulation that saturation causes.

Noise: consecutive readings of a pair differ by the noise of both readings while the robots are stationary.
Motion scales all readings (range) or shifts light to neighbouring sensors (bearing) and emitters (heading).
An F test compares the change along these three directions with that along all others, independently of the
scale of the noise. Changes along the other directions are noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, fdtrc

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.infrared.brightness import expected_brightness, start_table
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.infrared.search import DARKEST
from swarm_loc_estimator.swarm.ir_board import IrPlatform

FALSE_ALARM = 0.01  # Probability of a false alarm for any element: that it is dead, or that it saturates
# Dead elements: checked by test_dead_elements.py and, on recordings of 2016, by make bench-droplet_real.
_LOST, _WHOLE_SHARES = slice(0, 3), slice(3, None)
"""Relative gains (of `SHARES`) under the hypotheses dead or shaded, and working."""
_SAME_GEOMETRY = 1.5  # Maximum difference of directions within one geometry, in steps of the grid
_BRIGHT = 10.0
"""Minimum of the brightest reading of a usable exchange [sigma]; below, robots are out of range or sight."""
_MIN_BLOCKED = 0.05  # Minimum assumed share of geometries with an obstacle on the line of sight

_MIN_SIGMA = 0.05  # Minimum relative standard deviation of the gains of working elements


@dataclass(frozen=True)
class ElementVerdicts:
    """The verdict on each element."""

    dead: BoolArray  # (2, robots, n) sensors and emitters that are dead or shaded
    works: BoolArray  # (2, robots, n) sensors and emitters that certainly work
    share: FloatArray  # (2, robots, n) most likely relative gain

    @property
    def undecided(self) -> BoolArray:
        """(2, robots, n) elements with too few exchanges for a verdict."""
        return ~self.dead & ~self.works

    def numbers(self, robot: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Numbers of a robot's dead sensors and emitters."""
        sensors, emitters = (tuple(np.flatnonzero(side[robot]).tolist()) for side in self.dead)
        return sensors, emitters

    def without(self, exchanges: Exchanges) -> Exchanges:
        """The exchanges with readings of dead elements left out."""
        left_out = self.dead[0, exchanges.receiver][:, None, :, None]
        left_out = left_out | self.dead[1, exchanges.transmitter][:, None, None, :]
        return exchanges._replace(readings=np.where(left_out, np.nan, exchanges.readings))


def find_dead_elements(platform: IrPlatform, robots: int, exchanges: Exchanges) -> ElementVerdicts:
    """Test all sensors and emitters of robots with one kind of board; known poses are not used.

    Detected elements are excluded and the others are tested again, since in some geometries two faults are
    ambiguous. If exchanges do not discriminate between two elements of a robot (at the same probability),
    both are reported.
    """
    n = platform.n
    bright = np.nan_to_num(exchanges.readings[:, 0]).max(axis=(1, 2)) > _BRIGHT * platform.noise
    readings: FloatArray = exchanges.readings[bright, 0]
    saturation = exchanges.saturation[bright, 0]
    robot_of = np.stack([exchanges.receiver[bright], exchanges.transmitter[bright]])
    dead = np.zeros((2, robots, n), dtype=np.bool_)
    shares, scores = np.ones((2, robots, n)), np.zeros((2, robots, n))
    enough = math.log(dead.size / FALSE_ALARM)
    likelihoods = element_likelihoods(platform, readings, saturation)
    judged = np.ones((2, robots), dtype=np.bool_)
    while judged.any():
        _score(platform, robot_of, likelihoods, judged, scores, shares)
        scores[dead] = -math.inf
        best = scores.max(axis=2, keepdims=True)
        named = (best > enough) & (best - scores < -math.log(FALSE_ALARM))
        dead |= named
        changed = named[0, robot_of[0]].any(axis=1) | named[1, robot_of[1]].any(axis=1)
        readings[dead[0, robot_of[0]]] = np.nan
        np.swapaxes(readings, 1, 2)[dead[1, robot_of[1]]] = np.nan
        likelihoods.log[changed], likelihoods.directions[changed] = element_likelihoods(
            platform, readings[changed], saturation[changed]
        )
        judged = np.zeros((2, robots), dtype=np.bool_)
        for side in range(2):
            judged[side, robot_of[side, changed]] = True
    return ElementVerdicts(dead, ~dead & (scores < math.log(FALSE_ALARM)), shares)


def _score(
    platform: IrPlatform,
    robot_of: NDArray[np.int64],
    likelihoods: ElementLikelihoods,
    wanted: BoolArray,
    scores: FloatArray,
    shares: FloatArray,
) -> None:
    """Write log likelihood ratios and likeliest shares (2, robots, n), of robots `wanted` (2, robots)."""
    geometry = _geometries(robot_of, likelihoods.directions, _SAME_GEOMETRY * direction_step(platform))
    # gains of elements that work differ by the board's `element_sigma`
    sigma = max(platform.element_sigma, _MIN_SIGMA)
    weight = -0.5 * (np.log(SHARES[_WHOLE_SHARES]) / sigma) ** 2
    weight -= np.logaddexp.reduce(weight)
    for side, robot in zip(*np.nonzero(wanted), strict=True):
        rows = np.flatnonzero(robot_of[side] == robot)
        logs = likelihoods.log[rows, side]
        whole, lost = _by_hypothesis(logs, geometry[rows], max(platform.blocked_share, _MIN_BLOCKED))
        scores[side, robot] = _log_sum(lost, np.full(lost.shape[-1], -math.log(lost.shape[-1])))
        scores[side, robot] -= _log_sum(whole, weight)
        both = np.concatenate([lost, whole], axis=-1)
        shares[side, robot] = SHARES[np.argmax(both, axis=-1)]


def _by_hypothesis(
    logs: FloatArray, geometry: NDArray[np.int64], blocked: float
) -> tuple[FloatArray, FloatArray]:
    """Log likelihoods (n, S') of all exchanges by share, of elements that work and of those that do not.

    Of an element that works the light may be lost altogether, and of one that does not it may be there: in
    single exchanges, and in all of a geometry.

    Args:
        logs: (k, n, S) of the exchanges.
        geometry: (k,) numbers.
        blocked: How often.
    """
    none, all_of_it = logs[..., :1], logs[..., WHOLE : WHOLE + 1]
    rare, usual = math.log(blocked), math.log1p(-blocked)
    darkened, lit = (np.logaddexp(usual + logs, rare + other) for other in (none, all_of_it))
    places, number = np.unique(geometry, return_inverse=True)
    sums = np.zeros((2, places.size, *logs.shape[1:]))
    np.add.at(sums[0], number, darkened)
    np.add.at(sums[1], number, lit)
    darkened, lit = sums
    whole = np.logaddexp(usual + darkened, rare + lit[..., :1])
    lost = np.logaddexp(usual + lit, rare + darkened[..., WHOLE : WHOLE + 1])
    return whole.sum(axis=0)[:, _WHOLE_SHARES], lost.sum(axis=0)[:, _LOST]


def _log_sum(logs: FloatArray, weight: FloatArray) -> FloatArray:
    """Logarithm of the weighted sum over the last axis."""
    return np.asarray(np.logaddexp.reduce(logs + weight, axis=-1))


def _geometries(robot_of: NDArray[np.int64], directions: FloatArray, width: float) -> NDArray[np.int64]:
    """Number (k,) of each exchange's geometry: bearing and heading of a pair are about the same."""
    number = np.empty(len(directions), dtype=np.int64)
    seen = dict[tuple[int, int], list[int]]()
    for k, pair in enumerate(zip(*robot_of.tolist(), strict=True)):
        firsts = seen.setdefault(pair, [])
        apart = np.abs(wrap_angle(directions[firsts] - directions[k])).max(axis=1, initial=0.0)
        near = np.flatnonzero(apart < width)
        if not near.size:
            firsts.append(k)
        number[k] = firsts[near[0]] if near.size else k
    return number


SHARES: FloatArray = np.array([0.0, 0.15, 0.35, 0.7, 1.0, 1.4])
"""Relative gains of an element that are compared; the first is zero."""
WHOLE = 4  # Index of the relative gain one
_PER_ELEMENT, _MAX_DIRECTIONS = 4, 24  # Number of bearings, and of headings, of the grid
_SHOWN = 10.0  # Minimum of readings that determine the discretization error of the grid [sigma]
_NOISE_RATIO = 1.2  # Maximum relative difference in noise of exchanges that share a table
_NEGLIGIBLE = 8.0  # Maximum log-likelihood ratio to the best pose; less likely poses are skipped
BRIGHT_SPAN = 20.0  # Width of the uniform distribution of readings that are too bright [sigma]
MIN_SHARE = 1e-3  # Minimum assumed share of outliers
PEAK = 1.0 / math.sqrt(2.0 * math.pi)
LOWEST = 1e-300
_FAR_OFF = 8.0  # Maximum residual with a non-negligible likelihood [sigma]

Float32Array = NDArray[np.float32]


class ElementLikelihoods(NamedTuple):
    """Likelihoods of the elements of exchanges."""

    # (k, 2, n, S) log likelihood for each relative gain of `SHARES`, of the receiver's sensors and the
    # transmitter's emitters
    log: FloatArray
    directions: FloatArray  # (k, 2) bearing and heading [rad] of the most likely pose


def element_likelihoods(
    platform: IrPlatform, readings: FloatArray, saturation: FloatArray
) -> ElementLikelihoods:
    """Log likelihoods of k exchanges as functions of the relative gain of each element.

    Args:
        platform: The board of both robots.
        readings: (k, n, n) [count] at full power, [sensor, emitter]; NaN where not measured or left out.
        saturation: (k,) of each exchange [count].
    """
    count, n = len(readings), platform.n
    poses, light, log_prior = _grid(platform)
    found = np.empty((count, 2, n, SHARES.size))
    best = np.zeros(count, dtype=np.int64)
    relative = math.sqrt(
        platform.relative**2 + 2.0 * platform.element_sigma**2 + _grid_variance(platform, light)
    )
    bright = np.nan_to_num(readings, nan=0.0).max(axis=(1, 2))
    noise = np.hypot(platform.noise, platform.stray_noise * np.minimum(bright, saturation))
    level = np.rint(np.log(noise / platform.noise) / math.log(_NOISE_RATIO)).astype(np.int64)
    blocked, stray = max(platform.blocked_share, MIN_SHARE), max(platform.bright_share, MIN_SHARE)
    for one in np.unique(level).tolist():
        rows = np.flatnonzero(level == one)
        sigma = platform.noise * _NOISE_RATIO**one
        table = np.stack([_stabilized(share * light, sigma, relative) for share in SHARES])
        present = np.isfinite(readings[rows]) & (readings[rows] >= DARKEST * sigma)
        limit = saturation[rows, None, None]
        saturated = present & (readings[rows] >= limit)
        stable = _stabilized(np.where(present, np.minimum(readings[rows], limit), 0.0), sigma, relative)
        kinds = present.astype(np.int8) + saturated
        dark = np.where(saturated, 0.0, blocked * PEAK * np.exp(-0.5 * np.square(stable, dtype=np.float64)))
        outlier = dark + stray / BRIGHT_SPAN
        part, places = np.empty((rows.size, 2, n, SHARES.size)), np.zeros(rows.size, dtype=np.int64)
        _marginalize(table, log_prior, stable.astype(np.float64), kinds, outlier, part, places)
        found[rows], best[rows] = part, places
    return ElementLikelihoods(found, poses[best, 1:])


def direction_step(platform: IrPlatform) -> float:
    """Step of the grid in bearing and heading [rad]."""
    return 2.0 * math.pi / min(_PER_ELEMENT * platform.n, _MAX_DIRECTIONS)


def _grid(platform: IrPlatform) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses (g, 3), expected readings (g, n, n), and log prior (g,), uniform over the plane."""
    full = replace(platform, amplitudes=platform.amplitudes[:1])
    ranges = start_table(full).ranges
    angles = np.arange(-math.pi, math.pi - 1e-9, direction_step(platform))
    poses = np.stack(np.meshgrid(ranges, angles, angles, indexing="ij"), axis=-1).reshape(-1, 3)
    return poses, expected_brightness(full, poses)[:, 0], 2.0 * np.log(poses[:, 0] / ranges[-1])


def _grid_variance(platform: IrPlatform, light: FloatArray) -> float:
    """Mean squared relative error of readings due to the discretization of poses."""
    n, size = platform.n, round(2.0 * math.pi / direction_step(platform))
    logs = np.log(np.clip(light, platform.noise, platform.saturation)).reshape(-1, size, size, n * n)
    shown = logs > math.log(_SHOWN * platform.noise)
    total = 0.0
    for axis in range(3):
        steps = np.diff(logs, axis=axis)
        one, other = (np.delete(shown, end, axis=axis) for end in (-1, 0))
        total += float(np.mean(np.square(steps[one | other])))
    return total / 12.0  # uniform within a step


def _stabilized(values: FloatArray, noise: float, relative: float) -> Float32Array:
    """Variance-stabilizing transform of readings with additive and relative noise [sigma]."""
    stable: Float32Array = (np.arcsinh(relative / noise * values) / relative).astype(np.float32)
    return stable


@cached_njit
def _marginalize(
    table: Float32Array,
    log_prior: FloatArray,
    stable: FloatArray,
    kinds: NDArray[np.int8],
    outlier: FloatArray,
    found: FloatArray,
    best: NDArray[np.int64],
) -> None:
    """Write `found` (k, 2, n, S) and the most likely pose of each exchange.

    Args:
        table: (S, g, n, n) expected readings by relative gain.
        log_prior: (g,).
        stable: (k, n, n) readings.
        kinds: (k, n, n) 0 missing, 1 measured, 2 saturated.
        outlier: (k, n, n) densities under the outlier hypotheses.
        found: Written.
        best: (k,) written.
    """
    shares, poses, n = table.shape[0], table.shape[1], stable.shape[1]
    sides, logs, tops = np.empty((poses, 2, n)), np.empty(poses), np.empty((2, n))
    dark, changed = np.empty((2, n)), np.empty((shares, 2, n))
    for k in range(stable.shape[0]):
        # log likelihood of each pose with all elements working, and with each single one dead
        _likelihoods(table[0, 0], stable[k], kinds[k], outlier[k], changed[0])  # the same at all poses
        dark[:] = np.log(changed[0])
        tops[:] = -math.inf
        best[k] = 0
        for g in range(poses):
            logs[g] = log_prior[g] + _by_side(table[WHOLE, g], stable[k], kinds[k], outlier[k], sides[g])
            if logs[g] > logs[best[k]]:
                best[k] = g
            for side in range(2):
                for e in range(n):
                    tops[side, e] = max(tops[side, e], logs[g] - sides[g, side, e] + dark[side, e])
        # sum over the poses that count, with each relative gain of each element
        found[k] = 0.0
        base = logs[best[k]]
        for g in range(poses):
            if not _counts(logs[g], base, sides[g], dark, tops):
                continue
            changed[WHOLE] = np.exp(sides[g])
            for s in range(1, shares):
                if s != WHOLE:
                    _likelihoods(table[s, g], stable[k], kinds[k], outlier[k], changed[s])
            for side in range(2):
                for e in range(n):
                    others = math.exp(logs[g] - sides[g, side, e] - base)
                    for s in range(shares):
                        found[k, side, e, s] += others * changed[s, side, e]
        # back to logarithms
        for side in range(2):
            for e in range(n):
                for s in range(shares):
                    found[k, side, e, s] = base + math.log(max(found[k, side, e, s], LOWEST))


@cached_njit
def _counts(log: float, base: float, sides: FloatArray, dark: FloatArray, tops: FloatArray) -> bool:
    """Whether a pose is not negligible, with all elements working or any one of them dead."""
    if log > base - _NEGLIGIBLE:
        return True
    for side in range(2):
        for e in range(sides.shape[1]):
            if log - sides[side, e] + dark[side, e] > tops[side, e] - _NEGLIGIBLE:
                return True
    return False


@cached_njit
def _by_side(
    light: Float32Array, stable: FloatArray, kinds: NDArray[np.int8], outlier: FloatArray, sides: FloatArray
) -> float:
    """Write the log likelihood of each sensor's and each emitter's readings (2, n); returns the total."""
    _likelihoods(light, stable, kinds, outlier, sides)
    total = 0.0
    for e in range(stable.shape[0]):
        sides[0, e], sides[1, e] = math.log(sides[0, e]), math.log(sides[1, e])
        total += sides[0, e]
    return total


@cached_njit
def _likelihoods(
    light: Float32Array, stable: FloatArray, kinds: NDArray[np.int8], outlier: FloatArray, sides: FloatArray
) -> None:
    """Write the likelihood of each sensor's and each emitter's readings (2, n), at least `LOWEST`."""
    n = stable.shape[0]
    for e in range(n):
        sides[1, e] = 1.0
    for i in range(n):
        row = 1.0
        for j in range(n):
            if kinds[i, j] == 0:
                continue
            off, density = stable[i, j] - light[i, j], outlier[i, j]
            if kinds[i, j] == 2:
                density += 0.5 * math.erfc(off / math.sqrt(2.0))
            elif abs(off) < _FAR_OFF:
                density += PEAK * math.exp(-0.5 * off * off)
            row *= density
            sides[1, j] *= density
        sides[0, i] = max(row, LOWEST)
    for e in range(n):
        sides[1, e] = max(sides[1, e], LOWEST)


# Saturation and noise: checked by test_reading_limits.py.
_SPAN, _WIDTHS = 0.3, (0.0, 0.005, 0.01, 0.02, 0.04)
"""Span below the highest reading, and widths of the windows at the top, relative to it."""
_MIN_EMITTERS = 3
"""Minimum number of emitters at the top: a single one may face the sensor at a constant distance."""
_SAME = 0.2  # Maximum change of a reading within one geometry, relative to the brightest
_CLEAR_OF_TOP = 0.9  # Maximum reading used for noise, relative to saturation
_SHOWS_MOTION = 10.0  # Minimum of the brightest reading of pairs tested for motion [sigma of a change]
_MAX_CHANGE = 0.3  # Maximum change of a stationary pair beyond noise: relative root sum of squares
_MOTIONS, _MOVED = 3, 0.05
"""Number of motion directions (range, bearing, heading); false alarm probability of the F test for motion."""
_MIN_STANDING = 0.2
"""Minimum share of stationary pairs; fewer may pass the test by chance while all robots move."""
_MIN_READINGS = 60  # Minimum number of differences for the noise of a sensor
_MIN_FREE = 0.2  # Minimum share of a change that motion cannot explain, for its use in the noise estimate
_TRIM, _TRIMMED = 3.0, 0.9733
"""Outlier threshold of differences [sigma], and the relative variance of a normal truncated there."""
_MAX_UNSURE = 0.03
"""Relative noise is reported if this value were detectable, or if it exceeds twice its standard deviation."""
_ROUNDS, _FIT_ROUNDS = 4, 30
_TINY = 1e-300
_FIRST_RELATIVE, _LEAST_NOISE = 0.03, 0.3  # Initial noise: relative, and minimum [count]
_LOWER, _FACTOR = 0.97, 1.5
"""Thresholds of a contradiction: saturation relative to the described one, and factor between noises."""
_LEAST_RELATIVE = 0.05
"""Minimum relative noise of a contradiction: small motions cause apparent noise of some percent."""


@dataclass(frozen=True)
class ReadingLimits:
    """Saturation and noise of sensors; NaN where exchanges do not determine them."""

    saturation: FloatArray  # (robots, n) saturation above the dark level [count]
    noise: FloatArray  # (robots, n) standard deviation of a dark reading [count]
    relative_noise: FloatArray  # (robots, n) additional noise relative to the reading

    @property
    def typical_noise(self) -> tuple[float, float]:
        """Medians of noise [count] and relative noise over sensors; NaN where none is known."""
        return _median_of_known(self.noise), _median_of_known(self.relative_noise)


class _Repeats(NamedTuple):
    """Pairs of consecutive exchanges of one receiver with one transmitter."""

    receiver: NDArray[np.int64]  # (p,) index of the receiver
    change: FloatArray  # (p, n, n) change of readings [count]; 0 where one of the two is unusable
    level: FloatArray  # (p, n, n) mean of both readings
    known: BoolArray  # (p, n, n) True where both are usable


def find_reading_limits(platform: IrPlatform, robots: int, exchanges: Exchanges) -> ReadingLimits:
    """Saturation and noise of all sensors of robots with one kind of board, by readings at full power.

    The saturation of the platform and the directions of its elements are used, known poses are not. Exchanges
    are in order of time.
    """
    saturation = np.full((robots, platform.n), np.nan)
    firsts = _first_of_geometries(exchanges)
    alarm = FALSE_ALARM / (max(np.unique(exchanges.receiver).size, 1) * platform.n)
    for robot in range(robots):
        own = firsts & (exchanges.receiver == robot)
        if own.any():
            tops, emitters = _tops(exchanges.select(own))
            saturation[robot] = [_pile(tops[:, i], emitters[:, i], alarm) for i in range(platform.n)]
    noise = _noise(platform, robots, _repeats(exchanges, saturation))
    return ReadingLimits(saturation, noise[0], noise[1])


def contradictions(
    platform: IrPlatform, exchanges: Exchanges, limits: ReadingLimits, names: Sequence[str]
) -> list[str]:
    """Contradictions between exchanges, which state a saturation, and the board, one sentence each."""
    low = []
    for robot, name in enumerate(names):
        own = exchanges.receiver == robot
        said = float(np.median(exchanges.saturation[own, 0])) if own.any() else math.inf
        sensors = np.flatnonzero(limits.saturation[robot] < _LOWER * said)
        if sensors.size:
            at = limits.saturation[robot, sensors].min() + platform.dark_level
            low.append(f"{name} {sensors.tolist()} at {at:.0f} of {said + platform.dark_level:.0f} counts")
    found = []
    if low:
        found.append(f"Sensors saturate lower than board and matrices say: {', '.join(low)}.")
    noise, relative = limits.typical_noise  # NaN contradicts nothing
    if max(noise / platform.noise, platform.noise / noise) > _FACTOR:
        found.append(
            f"Where robots stand, dark readings scatter by {noise:.3g} counts, but noise of the board is"
            f" {platform.noise:g}."
        )
    if relative > _FACTOR * max(platform.relative, _LEAST_RELATIVE):
        found.append(
            f"Where robots stand, bright readings scatter by {100.0 * relative:.0f} % besides, but"
            f" relative_noise and curve_sigma of the board are {100.0 * platform.relative:.0f} % together."
        )
    return found


def _median_of_known(values: FloatArray) -> float:
    """The median of the values that are not NaN; NaN where all are."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


def _first_of_geometries(exchanges: Exchanges) -> BoolArray:
    """(k,) True for the first exchange of a pair in each geometry."""
    first = np.zeros(len(exchanges.receiver), dtype=np.bool_)
    readings = np.nan_to_num(exchanges.readings[:, 0])
    for rows in _rows_of_pairs(exchanges):
        own, brightest = readings[rows], readings[rows].max(axis=(1, 2))
        seen: list[int] = []
        for k in range(rows.size):
            apart = np.abs(own[seen] - own[k]).max(axis=(1, 2), initial=0.0)
            if not np.any(apart <= _SAME * np.maximum(brightest[seen], brightest[k])):
                seen.append(k)
        first[rows[seen]] = True
    return first


def _rows_of_pairs(exchanges: Exchanges) -> list[NDArray[np.int64]]:
    """Row indices of each ordered pair of robots, in order of time."""
    pairs = np.stack([exchanges.receiver, exchanges.transmitter])
    _, number = np.unique(pairs, axis=1, return_inverse=True)
    in_order = np.argsort(number.ravel(), kind="stable")
    return np.split(in_order, np.flatnonzero(np.diff(number.ravel()[in_order])) + 1)


def _tops(exchanges: Exchanges) -> tuple[FloatArray, NDArray[np.int64]]:
    """Brightest reading (k, n) of each sensor in each exchange, and the index of its emitter."""
    readings = np.nan_to_num(exchanges.readings[:, 0], nan=-np.inf)
    emitter = readings.argmax(axis=2)
    top: FloatArray = np.take_along_axis(readings, emitter[..., None], axis=2)[..., 0]
    return top, exchanges.transmitter[:, None] * readings.shape[2] + emitter


def _pile(tops: FloatArray, emitters: NDArray[np.int64], alarm: float) -> float:
    """Saturation of a sensor from its readings (k,) [count]; NaN where not significant at level `alarm`."""
    highest = float(tops.max())
    if not highest > 0.0:
        return math.nan
    others = np.count_nonzero(tops >= (1.0 - _SPAN) * highest) - 1
    best, level = alarm / len(_WIDTHS), math.nan
    for width in _WIDTHS:
        piled = tops >= (1.0 - width) * highest
        # readings are integers: a window contains one more of them than its width
        share = (width * highest + 1.0) / (_SPAN * highest + 1.0)
        chance = float(bdtrc(np.count_nonzero(piled) - 2, others, share)) if piled.sum() > 1 else 1.0
        if chance < best and np.unique(emitters[piled]).size >= _MIN_EMITTERS:
            best, level = chance, float(np.median(tops[piled]))
    return level


def _repeats(exchanges: Exchanges, saturation: FloatArray) -> _Repeats:
    """All pairs of consecutive exchanges, without readings near described or estimated saturation."""
    rows = _rows_of_pairs(exchanges)
    one, other = (np.concatenate([part[s] for part in rows]) for s in (slice(None, -1), slice(1, None)))
    first, second = exchanges.readings[one, 0], exchanges.readings[other, 0]
    receiver, level = exchanges.receiver[one], 0.5 * (first + second)
    limit = np.fmin(exchanges.saturation[one, 0, None], saturation[receiver])[..., None]
    known = level < _CLEAR_OF_TOP * limit  # False where one is NaN
    return _Repeats(receiver, np.where(known, second - first, 0.0), np.where(known, level, 0.0), known)


def _noise(platform: IrPlatform, robots: int, repeats: _Repeats) -> FloatArray:
    """Noise and relative noise (2, robots, n) of all sensors."""
    found = np.full((2, robots, platform.n), np.nan)
    if not repeats.known.any():
        return found
    # most readings are dark and unaffected by motion
    dark = float(np.median(np.abs(repeats.change[repeats.known]))) / (0.6745 * math.sqrt(2.0))
    dark = max(dark, _LEAST_NOISE)
    order = np.argsort(np.mod(platform.angles, 2.0 * np.pi))
    for _ in range(_ROUNDS):
        own, relative = (
            np.nan_to_num(part, nan=start)[repeats.receiver][..., None]
            for part, start in zip(found, (dark, _FIRST_RELATIVE), strict=True)
        )
        sigma = math.sqrt(2.0) * np.hypot(own, relative * np.maximum(repeats.level, 0.0))
        noise, determined = _unexplained(repeats, sigma, order)
        for robot, i in np.ndindex(robots, platform.n):
            rows = repeats.receiver == robot
            there = determined[rows, i]
            found[:, robot, i] = _fitted(repeats.level[rows, i][there], noise[rows, i][there], dark)
    return found


def _unexplained(
    repeats: _Repeats, sigma: FloatArray, order: NDArray[np.int64]
) -> tuple[FloatArray, BoolArray]:
    """Changes not explained by motion, scaled to one reading (p, n, n), and where they are determined.

    Args:
        repeats: Pairs of consecutive exchanges.
        sigma: (p, n, n) standard deviation of a change [count].
        order: (n,) elements around the ring.
    """
    weight = np.where(repeats.known, 1.0 / sigma, 0.0)
    flat = (len(sigma), -1)
    motions = [(way * weight).reshape(flat) for way in _motions(repeats.level, order)]
    basis = np.linalg.qr(np.stack(motions, axis=-1))[0]
    change = (repeats.change * weight).reshape(flat)
    along = np.einsum("pcw,pc->pw", basis, change)
    rest = change - np.einsum("pcw,pw->pc", basis, along)
    stands = _stands(repeats, sigma, np.sum(along**2, axis=1), np.sum(rest**2, axis=1))
    free = 1.0 - np.sum(basis**2, axis=-1)
    determined = repeats.known.reshape(flat) & (free > _MIN_FREE) & stands[:, None]
    noise = rest / np.sqrt(2.0 * np.maximum(free, _MIN_FREE)) * sigma.reshape(flat)
    return noise.reshape(sigma.shape), determined.reshape(sigma.shape)


def _motions(level: FloatArray, order: NDArray[np.int64]) -> list[FloatArray]:
    """Directions of change of readings (p, n, n) with range, bearing and heading, unnormalized."""
    back = np.argsort(order)
    following, before = order[(back + 1) % len(order)], order[back - 1]
    return [level, level[:, following] - level[:, before], level[:, :, following] - level[:, :, before]]


def _stands(repeats: _Repeats, sigma: FloatArray, moving: FloatArray, rest: FloatArray) -> BoolArray:
    """(p,) True for stationary pairs; `moving`, `rest`: squared changes along motions and across [sigma]."""
    free = np.maximum(repeats.known.sum(axis=(1, 2)) - _MOTIONS, 1.0)
    chance = fdtrc(_MOTIONS, free, moving / _MOTIONS / np.maximum(rest / free, 1e-12))
    excess = np.sum(repeats.change**2 - np.where(repeats.known, sigma**2, 0.0), axis=(1, 2))
    alike = excess < _MAX_CHANGE**2 * np.sum(repeats.level**2, axis=(1, 2))
    bright = repeats.level.max(axis=(1, 2)) > _SHOWS_MOTION * np.median(sigma)
    stands: BoolArray = bright & alike & (chance > _MOVED)
    if stands.sum() < _MIN_STANDING * bright.sum():
        stands[:] = False
    return stands


def _fitted(level: FloatArray, error: FloatArray, start: float) -> tuple[float, float]:
    """Noise [count] and relative noise, fitted to errors (m,) at brightness levels [count]."""
    if level.size < _MIN_READINGS:
        return math.nan, math.nan
    terms = np.stack([np.ones_like(level), np.maximum(level, 0.0) ** 2])
    parts = np.array([start**2, _FIRST_RELATIVE**2])
    for _ in range(_FIT_ROUNDS):
        variance = parts @ terms
        kept = error**2 < _TRIM**2 * variance
        weighted = terms[:, kept] / variance[kept] ** 2
        normal, right = weighted @ terms[:, kept].T, weighted @ (error[kept] ** 2 / _TRIMMED)
        parts = np.linalg.lstsq(normal, right, rcond=None)[0]  # singular for a sensor that is never lit
        if parts.min() < 0.0:
            single = np.maximum(right / np.maximum(np.diag(normal), _TINY), 1e-9)
            parts = np.where(parts < 0.0, 0.0, single)
        parts[0] = max(parts[0], 0.01 * start**2)
    # twice the inverse of the normal matrix is the variance of both parts
    unsure = math.sqrt(2.0 / max(normal[1, 1], _TINY))
    relative = np.sqrt(parts[1]) if unsure < max(_MAX_UNSURE**2, 0.5 * parts[1]) else np.nan
    return float(np.sqrt(parts[0])), float(relative)
