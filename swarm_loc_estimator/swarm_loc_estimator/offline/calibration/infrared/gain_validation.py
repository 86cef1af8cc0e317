"""Cross-validation of gains over blocks of time.

Gains are estimated with one block held out at a time, and the likelihood of the held-out exchanges is
evaluated. Gains are accepted where it is higher than with unit gains and with unknown gains.
Errors of the curves are correlated over time, so the sum over all robots must exceed its scatter over blocks.
Single robots need only a positive sum, since some have few readings.

The relative pose of an exchange is unknown or uncertain, so the likelihood is marginalized over the pose by
importance sampling around the solutions with and without gains. All hypotheses on a pair's gains are compared
at the same poses. Any reading may be an outlier, blocked or too bright, at the rates of the board.
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
_EVIDENCE = math.log(100.0)  # Minimum increase of the log likelihood of all exchanges
GAINS, ALIKE, UNKNOWN = range(3)
"""Hypotheses on a robot's gains: the estimate; unit gains with the same uncertainty; unknown gains with the
board's `element_sigma`."""
HYPOTHESES = 3
_POINTS = 48  # Number of poses sampled around each solution
_SEED = 1


def helpful_gains(
    platform: IrPlatform,
    robots: int,
    exchanges: Exchanges,
    progress: Callable[[str], None] = lambda _: None,
) -> BoolArray:
    """True (robots,) where gains estimated by `estimate_gains` improve held-out exchanges.

    Args:
        platform: Of all robots.
        robots: Number of robots.
        exchanges: Their exchanges in order of time.
        progress: Called with the name of each step.
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
    """Remove the robot with the least improvement until each remaining one and their sum pass the test.

    Args:
        pairs: (2, k) receivers and transmitters.
        logs: (k, H, H) log likelihoods by the hypotheses on both.
        blocks: (k,) index of the block of time.
        robots: Number of robots.
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
    """Log-likelihood ratios by block of the estimated gains to each other hypothesis."""
    receiver, transmitter = np.where(helps, GAINS, UNKNOWN)[pairs]
    rows, gains = np.arange(len(blocks)), []
    for hypothesis in (ALIKE, UNKNOWN):
        one, other = np.where(judged[pairs], hypothesis, (receiver, transmitter))
        gain = logs[rows, receiver, transmitter] - logs[rows, one, other]
        gains.append(np.bincount(blocks, np.nan_to_num(gain), BLOCKS).astype(np.float64))
    return gains


def _beyond_chance(by_block: FloatArray) -> float:
    """The margin by which a sum over blocks exceeds its threshold."""
    return float(by_block.sum() - max(_EVIDENCE, np.linalg.norm(by_block)))


class _PairElements(NamedTuple):
    """Gains (H, n) of the receiver's sensors and the transmitter's emitters, and their sigmas (H,)."""

    sensor: FloatArray
    emitter: FloatArray
    of_receiver: FloatArray
    of_transmitter: FloatArray


def held_out_likelihoods(
    platform: IrPlatform, gains: tuple[IrGains, ...], exchanges: Exchanges
) -> FloatArray:
    """Log likelihoods (k, H, H) of exchanges by the hypotheses on receiver and transmitter.

    A constant per exchange is omitted; NaN where no pose is found.

    Args:
        platform: Of all robots.
        gains: Of every robot, estimated without these exchanges.
        exchanges: Held-out exchanges.
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
    """Gains (2, robots, H, n) of sensors and emitters, and their standard deviations (robots, H)."""
    factors = np.ones((2, len(gains), HYPOTHESES, platform.n))
    sigmas = np.full((len(gains), HYPOTHESES), platform.element_sigma)
    for robot, one in enumerate(gains):
        factors[:, robot, GAINS] = one.sensor, one.emitter
        sigmas[robot, [GAINS, ALIKE]] = math.hypot(one.sigma, one.common_sigma)
    return factors, sigmas


def _samples(
    platform: IrPlatform, gains: tuple[IrGains, ...], exchanges: Exchanges
) -> list[tuple[FloatArray, FloatArray]]:
    """Sampled poses (P, 3) of each exchange and log weights (P,); empty where the solver finds no pose."""
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
    """Samples around a known pose, with equal weights."""
    poses = pose + draws.reshape(-1, 3) * POSE_SIGMA
    return poses, np.zeros(len(poses))


def _about_found(
    solved: list[IrSolutions], k: int, draws: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray]:
    """Samples around the solutions of exchange k, with a uniform prior over the plane."""
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
        light: (P, modes, n, n) expected readings for unit gains [count].
        readings: (modes, n, n) [count]; NaN where not measured.
        saturation: (modes,) minimum of saturated readings [count].
        elements: Gains of both robots.
        noise: Additive standard deviation of a reading [count].
        curves: Additional relative standard deviation of a reading.
        shares: Shares of readings that are blocked, and that are too bright.
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
