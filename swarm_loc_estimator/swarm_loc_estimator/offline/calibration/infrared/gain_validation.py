"""Which robots' gains improve exchanges that they were not estimated from: cross-validation over time.

Gains are estimated without one block at a time, and the exchanges of each block are compared by their
likelihood under those gains. Gains help where exchanges are likelier with them than with all elements alike,
and than with unknown gains. Errors of the curves are correlated within a stretch of time, so the sum over all
robots must exceed its scatter over blocks; single robots need only a positive sum, for some read little.

The relative pose of an exchange is unknown or known only roughly, so its likelihood is marginalized over the
pose, by importance sampling about the poses that the solver finds with gains and without. All hypotheses on a
pair's gains are compared at the same poses. Any reading may be blocked, or lit from elsewhere, at the rates
of the board.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.gains import POSE_SIGMA, Exchanges, GainsError, estimate_gains
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.solution import DARKEST, IrSolutions
from swarm_loc_estimator.offline.calibration.infrared.element_likelihood import (
    BRIGHT_SPAN,
    LOWEST,
    MIN_SHARE,
    PEAK,
)
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform, PairGains

BLOCKS = 4
_EVIDENCE = math.log(100.0)
"""By so much the log likelihood of all exchanges must be larger."""
GAINS, ALIKE, UNKNOWN = range(3)
"""Hypotheses on a robot's elements: they differ as was found; they do not, which is as sure; they differ by
what the board says, nobody knows how."""
HYPOTHESES = 3
_POINTS = 48
"""Poses drawn about each that the solver finds."""
_SEED = 1


def helpful_gains(
    platform: IrPlatform,
    robots: int,
    exchanges: Exchanges,
    progress: Callable[[str], None] = lambda _: None,
) -> BoolArray:
    """Whether the gains (robots,) that `estimate_gains` finds of these exchanges help in others.

    Args:
        platform: Of all robots.
        robots: How many there are.
        exchanges: What they read, in the order of time.
        progress: Called with a word on what is being done.
    """
    count = len(exchanges.receiver)
    logs, blocks = np.full((count, HYPOTHESES, HYPOTHESES), np.nan), np.arange(count) * BLOCKS // count
    for block in range(BLOCKS):
        progress(f"held-out block {block + 1}")
        held = blocks == block
        try:
            fit = estimate_gains(platform, robots, exchanges.select(~held))
        except GainsError:
            continue
        logs[held] = held_out_likelihoods(platform, fit.gains, exchanges.select(held))
    return _chosen_robots(np.stack([exchanges.receiver, exchanges.transmitter]), logs, blocks, robots)


def _chosen_robots(
    pairs: NDArray[np.int64], logs: FloatArray, blocks: NDArray[np.int64], robots: int
) -> BoolArray:
    """Leave out the robot whose gains help least, until each of the others' help, and all of them for sure.

    Args:
        pairs: (2, k) receivers and transmitters.
        logs: (k, H, H) log likelihoods by the hypotheses on both.
        blocks: (k,) of time.
        robots: How many there are.
    """
    helps = np.ones(robots, dtype=np.bool_)
    while helps.any():
        own = np.full(robots, np.inf)
        for robot in np.flatnonzero(helps).tolist():
            alone = np.arange(robots) == robot
            own[robot] = min(by_block.sum() for by_block in _by_block(pairs, logs, blocks, helps, alone))
        sure = min(_beyond_chance(by_block) for by_block in _by_block(pairs, logs, blocks, helps, helps))
        if own.min() > 0.0 and sure > 0.0:
            break
        helps[own.argmin()] = False
    return helps


def _by_block(
    pairs: NDArray[np.int64],
    logs: FloatArray,
    blocks: NDArray[np.int64],
    helps: BoolArray,
    judged: BoolArray,
) -> list[FloatArray]:
    """By how much (blocks,) gains of robots that are judged are likelier than each other hypothesis."""
    receiver, transmitter = np.where(helps, GAINS, UNKNOWN)[pairs]
    rows, gains = np.arange(len(blocks)), []
    for hypothesis in (ALIKE, UNKNOWN):
        one, other = np.where(judged[pairs], hypothesis, (receiver, transmitter))
        gain = logs[rows, receiver, transmitter] - logs[rows, one, other]
        gains.append(np.bincount(blocks, np.nan_to_num(gain), BLOCKS).astype(np.float64))
    return gains


def _beyond_chance(by_block: FloatArray) -> float:
    """By how much a sum over blocks is larger than it must be."""
    return float(by_block.sum() - max(_EVIDENCE, np.linalg.norm(by_block)))


class _PairElements(NamedTuple):
    """Factors (H, n) of the receiver's sensors and the transmitter's emitters, and their sigmas (H,)."""

    sensor: FloatArray
    emitter: FloatArray
    of_receiver: FloatArray
    of_transmitter: FloatArray


def held_out_likelihoods(
    platform: IrPlatform, gains: tuple[IrGains, ...], exchanges: Exchanges
) -> FloatArray:
    """Log likelihoods (k, H, H) of exchanges by the hypotheses on receiver and transmitter.

    They are up to a constant of each exchange; NaN where no pose is found.

    Args:
        platform: Of all robots.
        gains: Of every robot, estimated from other exchanges than these.
        exchanges: What they read.
    """
    found = np.full((len(exchanges.receiver), HYPOTHESES, HYPOTHESES), np.nan)
    factors, sigmas = _by_hypothesis(platform, gains)
    brightest = np.nan_to_num(exchanges.readings).max(axis=(1, 2, 3))
    noise = np.hypot(platform.noise, platform.stray_noise * np.minimum(brightest, platform.saturation))
    shares = (max(platform.blocked_share, MIN_SHARE), max(platform.bright_share, MIN_SHARE))
    for k, (poses, log_weights) in enumerate(_samples(platform, gains, exchanges)):
        if not len(poses):
            continue
        one, other = exchanges.receiver[k], exchanges.transmitter[k]
        logs = np.empty((HYPOTHESES, HYPOTHESES, len(poses)))
        _write_likelihoods(
            expected_brightness(platform, poses),
            exchanges.readings[k],
            exchanges.saturation[k],
            _PairElements(factors[0, one], factors[1, other], sigmas[one], sigmas[other]),
            float(noise[k]),
            platform.relative,
            shares,
            logs,
        )
        found[k] = np.logaddexp.reduce(logs + log_weights, axis=-1)
    return found


def _by_hypothesis(platform: IrPlatform, gains: tuple[IrGains, ...]) -> tuple[FloatArray, FloatArray]:
    """Factors (2, robots, H, n) of sensors and emitters, and how unsure they are (robots, H)."""
    factors = np.ones((2, len(gains), HYPOTHESES, platform.n))
    sigmas = np.full((len(gains), HYPOTHESES), platform.element_sigma)
    for robot, one in enumerate(gains):
        factors[:, robot, GAINS] = one.sensor, one.emitter
        sigmas[robot, [GAINS, ALIKE]] = math.hypot(one.sigma, one.common_sigma)
    return factors, sigmas


def _samples(
    platform: IrPlatform, gains: tuple[IrGains, ...], exchanges: Exchanges
) -> list[tuple[FloatArray, FloatArray]]:
    """Poses (P, 3) of each exchange and their log weights (P,), none where the solver finds none."""
    of_pair = [
        [gains[robot] for robot in side.tolist()] for side in (exchanges.receiver, exchanges.transmitter)
    ]
    estimator, count = MaximumLikelihood(platform), len(exchanges.receiver)
    solved = [
        estimator.solve(exchanges.readings, one, exchanges.saturation)
        for one in (platform.unknown_gains(count), PairGains.of(*of_pair))
    ]
    draws = np.random.default_rng(_SEED).standard_normal((2 * len(solved), _POINTS, 3))
    known: BoolArray = np.isfinite(exchanges.poses[:, 0])
    return [
        _about_known(exchanges.poses[k], draws)
        if known[k]
        else _about_found(solved, k, draws, platform.radius)
        for k in range(count)
    ]


def _about_known(pose: FloatArray, draws: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses about one that is known, all of the same weight."""
    poses = pose + draws.reshape(-1, 3) * POSE_SIGMA
    return poses, np.zeros(len(poses))


def _about_found(
    solved: list[IrSolutions], k: int, draws: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray]:
    """Poses about those that were found of exchange k, which is as likely to be all over the plane."""
    centres = np.array([pose[k] for one in solved for pose in (one.poses, one.alternatives)])
    spreads = np.array([one.covariances[k] for one in solved for _ in range(2)])
    there = np.isfinite(centres).all(axis=1)
    centres, roots = centres[there], np.linalg.cholesky(spreads[there])
    poses = (centres[:, None] + draws[there] @ np.swapaxes(roots, 1, 2)).reshape(-1, 3)
    poses = poses[poses[:, 0] > 2.0 * radius]
    apart = poses[:, None] - centres
    apart[..., 1:] = wrap_angle(apart[..., 1:])
    half = np.linalg.solve(roots, apart[..., None])[..., 0]
    drawn = -0.5 * np.sum(half**2, axis=-1) - np.log(np.einsum("maa->ma", roots)).sum(axis=-1)
    return poses, np.log(poses[:, 0]) - np.logaddexp.reduce(drawn, axis=1, initial=-np.inf)


@cached_njit
def _write_likelihoods(
    light: FloatArray,
    readings: FloatArray,
    saturation: FloatArray,
    elements: _PairElements,
    noise: float,
    curves: float,
    shares: tuple[float, float],
    logs: FloatArray,
) -> None:
    """Write the log likelihoods (H, H, P) of one exchange at P poses.

    Args:
        light: (P, modes, n, n) expectations without gains [count].
        readings: (modes, n, n) [count]; NaN where not measured.
        saturation: (modes,) from where on they tell no more [count].
        elements: Of both robots.
        noise: Standard deviation of every reading [count].
        curves: Standard deviation besides, relative to the reading.
        shares: Of readings that are blocked, and that are lit from elsewhere.
        logs: Written.
    """
    sensor, emitter, of_receiver, of_transmitter = elements
    blocked, bright = shares
    sure = 1.0 - blocked - bright
    for a in range(logs.shape[0]):
        for b in range(logs.shape[1]):
            relative = math.sqrt(curves**2 + of_receiver[a] ** 2 + of_transmitter[b] ** 2)
            logs[a, b] = 0.0
            for m, i, j in np.ndindex(readings.shape):
                reading = min(readings[m, i, j], saturation[m])
                if not reading >= DARKEST * noise:
                    continue
                scale = relative / noise
                stable = math.asinh(scale * reading) / relative
                # densities are per count, since the scale depends on the hypothesis
                slope = 1.0 / math.hypot(noise, relative * reading)
                outlier = blocked * PEAK * math.exp(-0.5 * (reading / noise) ** 2) / noise
                outlier += bright / BRIGHT_SPAN / math.hypot(noise, curves * reading)
                for p in range(light.shape[0]):
                    light_here = light[p, m, i, j] * sensor[a, i] * emitter[b, j]
                    off = stable - math.asinh(scale * light_here) / relative
                    if reading >= saturation[m]:
                        density = sure * 0.5 * math.erfc(off / math.sqrt(2.0)) + bright
                    else:
                        density = sure * PEAK * math.exp(-0.5 * off * off) * slope + outlier
                    logs[a, b, p] += math.log(max(density, LOWEST))
