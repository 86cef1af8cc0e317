"""Likelihood of exchanges as a function of the relative gain of one element, marginalized over poses.

The relative pose is unknown, so the likelihood is marginalized over a grid of relative poses. It is computed
for a few relative gains of each sensor of the receiver and emitter of the transmitter; all other elements
follow the board. Residuals are computed after a variance-stabilizing transform. Any reading may be blocked or
too bright, at the rates of the board.

Find sensors and emitters that are dead or shaded, from the robots' readings of each other alone.

A dead element stands out between bright ones wherever the other robot is, since no pose explains the readings
of its neighbours. Each element is tested by the likelihood ratio of two hypotheses: it gives about all of its
light, or a third of it or less. Under the first, the ratio exceeds 1 / p with a probability of at most p
(Markov's inequality). Each element is tested at p / elements, so the probability of any false alarm is p
(Wald's sequential test). In any one geometry of a pair an obstacle may block all light of an element, which
is modelled by the board's share of blocked readings; so a few geometries carry little evidence, however often
they were measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.infrared.search import DARKEST
from swarm_loc_estimator.infrared.start_table import start_table
from swarm_loc_estimator.swarm.ir_board import IrPlatform

FALSE_ALARM = 0.01  # Probability of a false alarm for any element
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
    n, bright = platform.n, _bright(platform, exchanges)
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


def _bright(platform: IrPlatform, exchanges: Exchanges) -> BoolArray:
    """(k,) True where an exchange is bright enough."""
    bright: BoolArray = np.nan_to_num(exchanges.readings[:, 0]).max(axis=(1, 2)) > _BRIGHT * platform.noise
    return bright


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
    for side, robot in zip(*np.nonzero(wanted), strict=True):
        rows = np.flatnonzero(robot_of[side] == robot)
        logs = likelihoods.log[rows, side]
        whole, lost = _by_hypothesis(logs, geometry[rows], max(platform.blocked_share, _MIN_BLOCKED))
        weight = _log_prior(platform)
        scores[side, robot] = _log_sum(lost, np.full(lost.shape[-1], -math.log(lost.shape[-1])))
        scores[side, robot] -= _log_sum(whole, weight)
        both = np.concatenate([lost, whole], axis=-1)
        shares[side, robot] = SHARES[np.argmax(both, axis=-1)]


def _log_prior(platform: IrPlatform) -> FloatArray:
    """Log probabilities of the shares of elements that work: gains differ by the board's `element_sigma`."""
    sigma = max(platform.element_sigma, _MIN_SIGMA)
    log = -0.5 * (np.log(SHARES[_WHOLE_SHARES]) / sigma) ** 2
    return np.asarray(log - np.logaddexp.reduce(log))


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
    light: Float32Array,
    stable: FloatArray,
    kinds: NDArray[np.int8],
    outlier: FloatArray,
    sides: FloatArray,
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
    light: Float32Array,
    stable: FloatArray,
    kinds: NDArray[np.int8],
    outlier: FloatArray,
    sides: FloatArray,
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
