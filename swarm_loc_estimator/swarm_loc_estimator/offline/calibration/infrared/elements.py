"""Single sensors and emitters, from readings of each other alone: dead ones, saturation and noise.

Dead or shaded elements: a dead element stands out between bright ones wherever the other robot is, since no
pose explains the readings of its neighbours. Each element is tested by the likelihood ratio of two
hypotheses: it gives about all of its light, or a third of it or less. Under the first, the ratio exceeds 1 /
p with a probability of at most p (Markov's inequality). Each element is tested at p / elements, so the
probability of any false alarm is p (Wald's sequential test). In any one geometry of a pair an obstacle may
block all light of an element, so a geometry counts with a limited ratio, however often it was measured.

Since the relative pose is unknown, likelihoods are sums over a grid of relative poses. Any reading may be
blocked or too bright, at the rates of the board: its residual, after a variance-stabilizing transform, is
limited.

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import bdtrc, fdtrc, logsumexp

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.infrared.brightness import expected_brightness, start_table
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.infrared.search import DARKEST
from swarm_loc_estimator.swarm.ir_board import IrPlatform

FALSE_ALARM = 0.01  # Probability of a false alarm for any element: that it is dead, or that it saturates
# Dead elements: checked by test_ir_boards.py; on recordings of 2016: `a084869b:bench/droplet/real`.
_DEAD_SHARES = (0.0, 0.15, 0.35)  # Shares of its light that a dead or shaded element gives
_BRIGHT = 10.0
"""Minimum of the brightest reading of a usable exchange [sigma]; below, robots are out of range or sight."""
_MIN_BLOCKED = 0.15  # Minimum assumed share of geometries with an obstacle on the line of sight
_DIRECTIONS = 24  # Number of bearings, and of headings, of the grid
_SAME_GEOMETRY = 3.0 * math.pi / _DIRECTIONS  # Maximum difference of directions within one geometry [rad]
_SHOWN = 10.0  # Minimum of readings that determine the discretization error of the grid [sigma]
_NOISE_RATIO = 1.2  # Maximum relative difference in noise of exchanges that share a table
_MIN_SHARE = 1e-3  # Minimum assumed share of outliers
_BRIGHT_SPAN = 8.0  # Range of readings that are too bright, in widths of the density of one that is not
_NEGLIGIBLE = 10.0  # Maximum log-likelihood ratio to the best pose; less likely poses are skipped


@dataclass(frozen=True)
class ElementVerdicts:
    """The verdict on each element."""

    dead: BoolArray  # (2, robots, n) sensors and emitters that are dead or shaded
    works: BoolArray  # (2, robots, n) sensors and emitters that certainly work

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
    bright = np.nan_to_num(exchanges.readings[:, 0]).max(axis=(1, 2)) > _BRIGHT * platform.noise
    readings: FloatArray = exchanges.readings[bright, 0]
    saturation = exchanges.saturation[bright, 0]
    robot_of = np.stack([exchanges.receiver[bright], exchanges.transmitter[bright]])
    dead = np.zeros((2, robots, platform.n), dtype=np.bool_)
    most, enough = -math.log(max(platform.blocked_share, _MIN_BLOCKED)), math.log(dead.size / FALSE_ALARM)
    ratios, directions = _log_ratios(platform, readings, saturation)
    while True:
        # sum of the evidence of all geometries
        alike = _geometries(robot_of, lambda k, others: _same_directions(directions, k, others))
        places, number = np.unique(alike, return_inverse=True)
        of_geometry = np.zeros((places.size, 2, platform.n))
        np.add.at(of_geometry, number, ratios)
        scores = np.zeros(dead.shape)
        for side in range(2):
            np.add.at(scores[side], robot_of[side, places], np.clip(of_geometry[:, side], -most, most))
        # the worst elements of each robot
        scores[dead] = -math.inf
        best = scores.max(axis=2, keepdims=True)
        named = (best > enough) & (best - scores < -math.log(FALSE_ALARM))
        if not named.any():
            return ElementVerdicts(dead, ~dead & (scores < math.log(FALSE_ALARM)))
        # once more without them
        dead |= named
        changed = named[0, robot_of[0]].any(axis=1) | named[1, robot_of[1]].any(axis=1)
        readings[dead[0, robot_of[0]]] = np.nan
        np.swapaxes(readings, 1, 2)[dead[1, robot_of[1]]] = np.nan
        ratios[changed], directions[changed] = _log_ratios(platform, readings[changed], saturation[changed])


def _geometries(robot_of: IntArray, same: Callable[[int, list[int]], BoolArray]) -> IntArray:
    """Index (k,) of the first exchange in the geometry of each exchange of receivers and transmitters (2, k).

    `same` tells in which of some earlier exchanges of its pair (m,) the geometry is that of an exchange.
    """
    number, seen = np.arange(robot_of.shape[1]), dict[tuple[int, ...], list[int]]()
    for k, pair in enumerate(zip(*robot_of.tolist(), strict=True)):
        firsts = seen.setdefault(pair, [])
        near = np.flatnonzero(same(k, firsts)).tolist() if firsts else []
        if near:
            number[k] = firsts[near[0]]
        else:
            firsts.append(k)
    return number


def _same_directions(directions: FloatArray, k: int, others: list[int]) -> BoolArray:
    apart: FloatArray = np.abs(wrap_angle(directions[others] - directions[k])).max(axis=1)
    return apart < _SAME_GEOMETRY


def _log_ratios(
    platform: IrPlatform, readings: FloatArray, saturation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Log-likelihood ratios (k, 2, n) of each sensor and emitter being dead to its working.

    Args:
        platform: The board of both robots.
        readings: (k, n, n) at full power [count], [sensor, emitter]; NaN where not measured or left out.
        saturation: (k,) of each exchange [count].

    Returns:
        The ratios, and (k, 2) bearing and heading [rad] of the most likely pose if all elements work.
    """
    poses, light, grid_variance = _grid(platform)
    given: FloatArray = np.multiply.outer([1.0, *_DEAD_SHARES], light).astype(np.float32)
    log_prior = 2.0 * np.log(poses[:, 0])  # uniform over the plane
    log_blocked = np.float32(math.log(max(platform.blocked_share, _MIN_SHARE)))
    log_bright = np.float32(math.log(max(platform.bright_share, _MIN_SHARE) / _BRIGHT_SPAN))
    ratios, directions = np.empty((len(readings), 2, platform.n)), np.empty((len(readings), 2))
    relative = math.sqrt(platform.relative**2 + 2.0 * platform.element_sigma**2 + grid_variance)
    bright = np.nan_to_num(readings).max(axis=(1, 2))
    noise = np.hypot(platform.noise, platform.stray_noise * np.minimum(bright, saturation))
    level = np.rint(np.log(noise / platform.noise) / math.log(_NOISE_RATIO))
    for one in np.unique(level).tolist():
        sigma = platform.noise * _NOISE_RATIO**one
        working, *shaded = stabilized(given, sigma, relative)
        for k in np.flatnonzero(level == one).tolist():
            # log likelihoods of the readings at all poses, if all elements work
            measured = np.isfinite(readings[k]) & (readings[k] >= DARKEST * sigma)
            cut = np.where(measured, np.minimum(readings[k], saturation[k]), 0.0)
            stable, top = (
                stabilized(value.astype(np.float32), sigma, relative) for value in (cut, saturation[k])
            )
            outlier = np.where(measured, np.maximum(log_blocked - 0.5 * stable**2, log_bright), 0.0)
            each = _fits(stable, outlier, np.minimum(working, top))
            whole = log_prior + each.sum(axis=(0, 1))
            directions[k] = poses[whole.argmax(), 1:]
            # the same if one element is dead, at all poses that the other elements allow
            without = whole - np.stack([each.sum(axis=1), each.sum(axis=0)])
            likely = np.any(without > without.max(axis=2, keepdims=True) - _NEGLIGIBLE, axis=(0, 1))
            dead = [_fits(stable, outlier, np.minimum(table[..., likely], top)) for table in shaded]
            logs = [without[..., likely] + np.stack([one.sum(axis=1), one.sum(axis=0)]) for one in dead]
            ratios[k] = logsumexp(np.concatenate(logs, axis=2), axis=2) - math.log(len(logs))
            ratios[k] -= logsumexp(whole)
    return ratios, directions


def _fits(stable: FloatArray, outlier: FloatArray, expected: FloatArray) -> FloatArray:
    """Log likelihoods (n, n, g) of stabilized readings at expectations, at least those of outliers (n, n)."""
    fits: FloatArray = np.maximum(-0.5 * np.square(stable[..., None] - expected), outlier[..., None])
    return fits


def _grid(platform: IrPlatform) -> tuple[FloatArray, FloatArray, float]:
    """Poses (g, 3), expected readings (n, n, g), and their squared relative error between the poses."""
    full = replace(platform, amplitudes=platform.amplitudes[:1])
    angles = 2.0 * math.pi / _DIRECTIONS * np.arange(_DIRECTIONS) - math.pi
    poses = np.stack(np.meshgrid(start_table(full).ranges, angles, angles, indexing="ij"), axis=-1)
    flat = poses.reshape(-1, 3)
    light = np.moveaxis(expected_brightness(full, flat)[:, 0], 0, 2)
    logs = np.log(np.clip(light, platform.noise, platform.saturation)).reshape(-1, *poses.shape[:3])
    shown, variance = logs > math.log(_SHOWN * platform.noise), 0.0
    for axis in range(1, 4):
        one, other = (np.delete(shown, end, axis=axis) for end in (-1, 0))
        steps = np.diff(logs, axis=axis)[one | other]
        variance += float(np.mean(np.square(steps))) / 12.0  # uniform within a step
    return flat, light, variance


def stabilized(values: FloatArray, noise: FloatArray | float, relative: FloatArray | float) -> FloatArray:
    """Variance-stabilizing transform of readings with additive and relative noise [sigma]."""
    return np.asarray(np.arcsinh(relative / noise * values) / relative)


# Saturation and noise: checked by test_ir_boards.py.
_SPAN, _WIDTHS = 0.3, (0.0, 0.005, 0.01, 0.02, 0.04)
"""Span below the highest reading, and widths of the windows at the top, relative to it."""
_MIN_EMITTERS = 3  # Least number at the top: a single emitter may face the sensor at a constant distance
_SAME = 0.2  # Maximum change of a reading within one geometry, relative to the brightest
_CLEAR_OF_TOP = 0.9  # Maximum reading used for noise, relative to saturation
_SHOWS_MOTION = 10.0  # Minimum of the brightest reading of pairs tested for motion [sigma of a change]
_MAX_CHANGE = 0.3  # Maximum change of a stationary pair beyond noise: relative root sum of squares
_MOTIONS, _MOVED = 3, 0.05
"""Number of motion directions (range, bearing, heading); false alarm probability of the F test for motion."""
_MIN_STANDING = 0.2  # Minimum share of stationary pairs; fewer may pass by chance while all robots move
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
_LEAST_RELATIVE = 0.05  # Least relative noise of a contradiction: small motions look like some percent


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

    receiver: IntArray  # (p,) index of the receiver
    change: FloatArray  # (p, n, n) change of readings [count]; 0 where one of the two is unusable
    level: FloatArray  # (p, n, n) mean of both readings
    known: BoolArray  # (p, n, n) True where both are usable


def find_reading_limits(platform: IrPlatform, robots: int, exchanges: Exchanges) -> ReadingLimits:
    """Saturation and noise of all sensors of robots with one kind of board, by readings at full power.

    The saturation of the platform and the directions of its elements are used, known poses are not. Exchanges
    are in order of time.
    """
    saturation = np.full((robots, platform.n), np.nan)
    pairs, read = (
        np.stack([exchanges.receiver, exchanges.transmitter]),
        np.nan_to_num(exchanges.readings[:, 0]),
    )
    firsts = _geometries(pairs, lambda k, others: _same_readings(read, k, others)) == np.arange(len(read))
    alarm = FALSE_ALARM / (max(np.unique(exchanges.receiver).size, 1) * platform.n)
    for robot in range(robots):
        own = firsts & (exchanges.receiver == robot)
        if own.any():
            tops, emitters = _tops(select(exchanges, own))
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
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


def _same_readings(readings: FloatArray, k: int, others: list[int]) -> BoolArray:
    apart = np.abs(readings[others] - readings[k]).max(axis=(1, 2))
    same: BoolArray = apart <= _SAME * np.maximum(readings[others].max(axis=(1, 2)), readings[k].max())
    return same


def _tops(exchanges: Exchanges) -> tuple[FloatArray, IntArray]:
    """Brightest reading (k, n) of each sensor in each exchange, and the index of its emitter."""
    readings = np.nan_to_num(exchanges.readings[:, 0], nan=-np.inf)
    emitter = readings.argmax(axis=2)
    top: FloatArray = np.take_along_axis(readings, emitter[..., None], axis=2)[..., 0]
    return top, exchanges.transmitter[:, None] * readings.shape[2] + emitter


def _pile(tops: FloatArray, emitters: IntArray, alarm: float) -> float:
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
    pairs = np.stack([exchanges.receiver, exchanges.transmitter])
    _, number = np.unique(pairs, axis=1, return_inverse=True)
    in_order = np.argsort(number.ravel(), kind="stable")
    rows = np.split(in_order, np.flatnonzero(np.diff(number.ravel()[in_order])) + 1)
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


def _unexplained(repeats: _Repeats, sigma: FloatArray, order: IntArray) -> tuple[FloatArray, BoolArray]:
    """Changes not explained by motion, scaled to one reading (p, n, n), and where they are determined.

    Args:
        repeats: Pairs of consecutive exchanges.
        sigma: (p, n, n) standard deviation of a change [count].
        order: (n,) elements around the ring.
    """
    weight = np.where(repeats.known, 1.0 / sigma, 0.0)
    flat = (len(sigma), -1)
    # directions of change with range, bearing and heading, unnormalized
    level, back = repeats.level, np.argsort(order)
    following, before = order[(back + 1) % len(order)], order[back - 1]
    ways = level, level[:, following] - level[:, before], level[:, :, following] - level[:, :, before]
    motions = [(way * weight).reshape(flat) for way in ways]
    basis = np.linalg.qr(np.stack(motions, axis=-1))[0]
    change = (repeats.change * weight).reshape(flat)
    along = np.einsum("pcw,pc->pw", basis, change)
    rest = change - np.einsum("pcw,pw->pc", basis, along)
    stands = _stands(repeats, sigma, np.sum(along**2, axis=1), np.sum(rest**2, axis=1))
    free = 1.0 - np.sum(basis**2, axis=-1)
    determined = repeats.known.reshape(flat) & (free > _MIN_FREE) & stands[:, None]
    noise = rest / np.sqrt(2.0 * np.maximum(free, _MIN_FREE)) * sigma.reshape(flat)
    return noise.reshape(sigma.shape), determined.reshape(sigma.shape)


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
