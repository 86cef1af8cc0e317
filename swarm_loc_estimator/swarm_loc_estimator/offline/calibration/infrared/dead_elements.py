"""Find sensors and emitters that are dead or shaded, from the robots' readings of each other alone.

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
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.offline.calibration.infrared.element_likelihood import (
    SHARES,
    WHOLE,
    ElementLikelihoods,
    direction_step,
    element_likelihoods,
)
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
