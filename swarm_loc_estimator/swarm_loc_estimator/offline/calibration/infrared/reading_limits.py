"""Find the saturation and noise of sensors from the robots' readings of each other alone.

Neither poses nor curves are used, for a board's curves may be what is wrong.

Saturation: below a sensor's highest reading the readings of different geometries get rarer the brighter they
are, however they are distributed otherwise. So of those within a span below the highest one at most the share
of a window's width lies within a narrow window at the top, and the binomial distribution tells how probable
it is that so many lie there by chance. A sensor that saturates piles them up.

Noise: what one pair reads twice in a row differs by the noise of both readings, while the two stand. Robots
that moved in between change readings in proportion (their range), and towards neighbouring sensors (bearing)
and emitters (heading). An F test separates these three directions from all others, whatever the scale of the
noise; changes in the other directions are noise.
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

FALSE_ALARM = 0.01
"""Probability that any sensor is said to saturate that does not."""
_SPAN, _WIDTHS = 0.3, (0.0, 0.005, 0.01, 0.02, 0.04)
"""How far below the highest reading they are compared, and the windows at the top, relative to it."""
_MIN_EMITTERS = 3
"""So many emitters must be at the top: one that faces a sensor at a lasting distance is no saturation."""
_SAME = 0.2
"""Exchanges in which no reading differs by more are of one geometry, relative to the brightest."""
_CLEAR_OF_TOP = 0.9
"""Readings above this share of saturation are not asked for noise."""
_BRIGHT = 10.0
"""Pairs whose brightest reading is below are not tested for standing [sigma of a change]."""
_MAX_CHANGE = 0.3
"""Pairs whose readings changed by more, besides noise, have moved: relative, root of the sum of squares."""
_MOTIONS, _MOVED = 3, 0.05
"""Range, bearing and heading; the F test's probability to take a pair for moved that stands."""
_MIN_STANDING = 0.2
"""Where a smaller share of exchanges passes for standing, robots moved all the time, and it is by chance."""
_MIN_READINGS = 60
"""Differences of a sensor, for its noise."""
_MIN_FREE = 0.2
"""Changes of which motion may explain all but this share are not used for noise."""
_TRIM, _TRIMMED = 3.0, 0.9733
"""Differences beyond so many sigmas are outliers; the variance of the others, relative."""
_MAX_UNSURE = 0.03
"""Relative noise is reported where it would be detected at this size, or is twice its own sigma."""
_ROUNDS, _FIT_ROUNDS = 4, 30
_TINY = 1e-300
_FIRST_RELATIVE, _LEAST_NOISE = 0.03, 0.3
"""What the search begins with, relative, and at least [count]."""
_LOWER, _FACTOR = 0.97, 1.5
"""A saturation below this share of what is said contradicts it, and noise that differs by this factor."""
_LEAST_RELATIVE = 0.05
"""Robots that shuffle where they stand look like relative noise of some percent."""


@dataclass(frozen=True)
class ReadingLimits:
    """Saturation and noise of sensors; NaN where exchanges do not determine them.

    Attributes:
        saturation: (robots, n) where readings pile up [count], what is read in the dark taken off.
        noise: (robots, n) standard deviation of a dark reading [count].
        relative_noise: (robots, n) noise besides, relative to the reading.
    """

    saturation: FloatArray
    noise: FloatArray
    relative_noise: FloatArray

    @property
    def typical_noise(self) -> tuple[float, float]:
        """Medians of noise [count] and relative noise over sensors; NaN where none is known."""
        return _median_of_known(self.noise), _median_of_known(self.relative_noise)


class _Repeats(NamedTuple):
    """Two exchanges in a row of one receiver with one transmitter.

    Attributes:
        receiver: (p,).
        change: (p, n, n) by how much readings changed [count]; 0 where one of the two is unusable.
        level: (p, n, n) their mean.
        known: (p, n, n) whether both are usable.
    """

    receiver: NDArray[np.int64]
    change: FloatArray
    level: FloatArray
    known: BoolArray


def find_reading_limits(platform: IrPlatform, robots: int, exchanges: Exchanges) -> ReadingLimits:
    """Saturation and noise of all sensors of robots with one kind of board, by readings at full power.

    Args:
        platform: Only the directions of its elements count.
        robots: How many there are.
        exchanges: What they read, in the order of time; known poses are not used.
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
    """Where exchanges contradict what is said of the board, one sentence each.

    Args:
        platform: What is said.
        exchanges: Whose matrices say a saturation, too.
        limits: What was found of them.
        names: Of the robots.
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
    """(k,) which exchanges are the first of their pair in a geometry."""
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
    """The rows of each receiver with each transmitter, in the order of time."""
    pairs = np.stack([exchanges.receiver, exchanges.transmitter])
    _, number = np.unique(pairs, axis=1, return_inverse=True)
    in_order = np.argsort(number.ravel(), kind="stable")
    return np.split(in_order, np.flatnonzero(np.diff(number.ravel()[in_order])) + 1)


def _tops(exchanges: Exchanges) -> tuple[FloatArray, NDArray[np.int64]]:
    """Each sensor's brightest reading (k, n) of each exchange, and the number of the emitter it was of."""
    readings = np.nan_to_num(exchanges.readings[:, 0], nan=-np.inf)
    emitter = readings.argmax(axis=2)
    top: FloatArray = np.take_along_axis(readings, emitter[..., None], axis=2)[..., 0]
    return top, exchanges.transmitter[:, None] * readings.shape[2] + emitter


def _pile(tops: FloatArray, emitters: NDArray[np.int64], alarm: float) -> float:
    """Where a sensor's readings (k,) pile up [count]; NaN where chance may do it more often than `alarm`."""
    highest = float(tops.max())
    if not highest > 0.0:
        return math.nan
    others = np.count_nonzero(tops >= (1.0 - _SPAN) * highest) - 1
    best, level = alarm / len(_WIDTHS), math.nan
    for width in _WIDTHS:
        piled = tops >= (1.0 - width) * highest
        # readings are whole counts, of which a window has one more than its width
        share = (width * highest + 1.0) / (_SPAN * highest + 1.0)
        chance = float(bdtrc(np.count_nonzero(piled) - 2, others, share)) if piled.sum() > 1 else 1.0
        if chance < best and np.unique(emitters[piled]).size >= _MIN_EMITTERS:
            best, level = chance, float(np.median(tops[piled]))
    return level


def _repeats(exchanges: Exchanges, saturation: FloatArray) -> _Repeats:
    """All exchanges in a row, without readings near saturation, as described or found."""
    rows = _rows_of_pairs(exchanges)
    one, other = (np.concatenate([part[s] for part in rows]) for s in (slice(None, -1), slice(1, None)))
    first, second = exchanges.readings[one, 0], exchanges.readings[other, 0]
    receiver, level = exchanges.receiver[one], 0.5 * (first + second)
    limit = np.fmin(exchanges.saturation[one, 0, None], saturation[receiver])[..., None]
    known = level < _CLEAR_OF_TOP * limit  # never where one is NaN
    return _Repeats(receiver, np.where(known, second - first, 0.0), np.where(known, level, 0.0), known)


def _noise(platform: IrPlatform, robots: int, repeats: _Repeats) -> FloatArray:
    """Noise and relative noise (2, robots, n) of all sensors."""
    found = np.full((2, robots, platform.n), np.nan)
    if not repeats.known.any():
        return found
    # most readings are dark, where pairs that move change nothing, too
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
    """What no motion explains of the changes, as noise of one reading (p, n, n), and where it is determined.

    Args:
        repeats: What was read twice.
        sigma: (p, n, n) of a change [count].
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
    """How readings (p, n, n) change, up to a factor, as range, bearing and heading do."""
    back = np.argsort(order)
    ahead, behind = order[(back + 1) % len(order)], order[back - 1]
    return [level, level[:, ahead] - level[:, behind], level[:, :, ahead] - level[:, :, behind]]


def _stands(repeats: _Repeats, sigma: FloatArray, moving: FloatArray, rest: FloatArray) -> BoolArray:
    """Whether both robots stand (p,), by the squares of the change along motions and across [sigma]."""
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
    """Noise [count] and relative noise by errors (m,) at some levels [count]: a fit of their variance."""
    if level.size < _MIN_READINGS:
        return math.nan, math.nan
    terms = np.stack([np.ones_like(level), np.maximum(level, 0.0) ** 2])
    parts = np.array([start**2, _FIRST_RELATIVE**2])
    for _ in range(_FIT_ROUNDS):
        variance = parts @ terms
        kept = error**2 < _TRIM**2 * variance
        weighted = terms[:, kept] / variance[kept] ** 2
        normal, right = weighted @ terms[:, kept].T, weighted @ (error[kept] ** 2 / _TRIMMED)
        parts = np.linalg.lstsq(normal, right)[0]  # a sensor that is never lit leaves one open
        if parts.min() < 0.0:
            single = np.maximum(right / np.maximum(np.diag(normal), _TINY), 1e-9)
            parts = np.where(parts < 0.0, 0.0, single)
        parts[0] = max(parts[0], 0.01 * start**2)
    # twice the inverse of the normal matrix is the variance of both parts
    unsure = math.sqrt(2.0 / max(normal[1, 1], _TINY))
    relative = np.sqrt(parts[1]) if unsure < max(_MAX_UNSURE**2, 0.5 * parts[1]) else np.nan
    return float(np.sqrt(parts[0])), float(relative)
