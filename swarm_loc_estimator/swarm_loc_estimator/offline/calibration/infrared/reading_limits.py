"""Estimate the saturation and noise of sensors from exchanges alone.

Neither poses nor curves are used, since a board's curves may be wrong.

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
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, fdtrc

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.swarm.ir_board import IrPlatform

FALSE_ALARM = 0.01  # Probability of any false detection of saturation
_SPAN, _WIDTHS = 0.3, (0.0, 0.005, 0.01, 0.02, 0.04)
"""Span below the highest reading, and widths of the windows at the top, relative to it."""
_MIN_EMITTERS = 3
"""Minimum number of emitters at the top: a single one may face the sensor at a constant distance."""
_SAME = 0.2  # Maximum change of a reading within one geometry, relative to the brightest
_CLEAR_OF_TOP = 0.9  # Maximum reading used for noise, relative to saturation
_BRIGHT = 10.0  # Minimum of the brightest reading of pairs tested for motion [sigma of a change]
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

    Args:
        platform: Its saturation and the directions of its elements are used.
        robots: Number of robots.
        exchanges: Exchanges in order of time; known poses are not used.
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
    """Contradictions between exchanges and the description of the board, one sentence each.

    Args:
        platform: Description of the board.
        exchanges: Exchanges, whose matrices also state a saturation.
        limits: Limits estimated from them.
        names: Names of the robots.
    """
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
    ahead, behind = order[(back + 1) % len(order)], order[back - 1]
    return [level, level[:, ahead] - level[:, behind], level[:, :, ahead] - level[:, :, behind]]


def _stands(repeats: _Repeats, sigma: FloatArray, moving: FloatArray, rest: FloatArray) -> BoolArray:
    """(p,) True for stationary pairs; `moving`, `rest`: squared changes along motions and across [sigma]."""
    free = np.maximum(repeats.known.sum(axis=(1, 2)) - _MOTIONS, 1.0)
    chance = fdtrc(_MOTIONS, free, moving / _MOTIONS / np.maximum(rest / free, 1e-12))
    excess = np.sum(repeats.change**2 - np.where(repeats.known, sigma**2, 0.0), axis=(1, 2))
    alike = excess < _MAX_CHANGE**2 * np.sum(repeats.level**2, axis=(1, 2))
    bright = repeats.level.max(axis=(1, 2)) > _BRIGHT * np.median(sigma)
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
