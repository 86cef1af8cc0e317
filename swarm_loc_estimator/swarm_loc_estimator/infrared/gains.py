"""Calibration of the gains of sensors and emitters from brightness matrices.

Gauss-Newton estimates all gains and the relative pose of every exchange together; the pose of an
exchange and the residual ambient light of each sensor are eliminated by the Schur complement. Without known
poses, only near robots separate the common gain of a robot from range; far robots with brighter elements just
appear nearer. `IrGains.common_sigma` includes this uncertainty. Known poses determine the common gain except
for a factor between sensors and emitters, which cancels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.infrared.brightness import expected_with_slopes
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.search import DARKEST, IrOutcome
from swarm_loc_estimator.swarm.ir_board import GAIN_RANGE, IrGains, IrPlatform, PairGains

Progress = Callable[[str], None]

# The constants of gains are checked by `make bench-droplet`: elements that differ by 10 %.
_ROUNDS = 8  # Maximum number of Gauss-Newton steps
_STILL = 1e-3  # Maximum change of a log-gain at convergence
POSE_SIGMA = (0.0005, 0.005, 0.005)  # Standard deviations of known poses: range [m], bearing, heading [rad]
_BACKGROUND = 0.5  # Standard deviation of the residual ambient light of a sensor [sigma of a reading]
_SEARCH_SIGMA = 0.02  # Standard deviation of log-gains in the search for poses
_MAX_ODDS = 0.05
_MAX_MISFIT = 3.0
"""Maximum odds of the second-best pose and maximum misfit of exchanges that are used; where most exchanges
fit worse with free gains, the curves are wrong."""
_CLEAR_OF_SATURATION = 3.0  # Minimum distance of the expected reading from saturation [sigma]
_WORST = 5.0  # Maximum mean squared residual of an exchange, relative to the median
_LONGEST_STEP = 0.3  # Maximum change of a log-gain per step
_MIN_SIGMA = 0.003  # Minimum reported standard deviation of gains


class Exchanges(NamedTuple):
    """Readings of robots of each other."""

    receiver: IntArray  # (k,) index of the robot that measured
    transmitter: IntArray  # (k,) index of the robot that lit its emitters
    readings: FloatArray  # (k, modes, n, n) [count], [mode, sensor, emitter], NaN where not measured
    saturation: FloatArray  # (k, modes) minimum of saturated readings [count]
    # (k, 3) of the transmitter seen from the receiver, range [m], bearing, heading [rad]; NaN where not known
    poses: FloatArray


@dataclass(frozen=True)
class GainsFit:
    """Gains of all robots, and the residuals without and with them."""

    # One per robot; the uncalibrated default where contradictory exchanges would make the estimate less
    # certain than that
    gains: tuple[IrGains, ...]
    used: BoolArray  # (k,) which exchanges were used
    # (k, modes, n, n) residuals with all gains 1, in sigmas; NaN where a reading was not used
    before: FloatArray
    after: FloatArray  # (k, modes, n, n) those residuals with the gains


class GainsError(ValueError):
    """Exchanges that do not determine gains."""


def estimate_gains(
    platform: IrPlatform, robots: int, exchanges: Exchanges, progress: Progress = lambda _: None
) -> GainsFit:
    """Estimate the gains of all robots; `element_sigma` of the platform is their prior standard deviation.

    `progress` is called with the name of each step. Raises GainsError if `element_sigma` is 0, the platform's
    curves do not hold, or no exchange can be used.
    """
    if platform.element_sigma == 0.0:
        raise GainsError("element_sigma of the platform is 0, so that all gains are 1.")
    estimator = MaximumLikelihood(platform)
    logs = np.zeros((2, robots, platform.n))
    unknown = _pairs(exchanges, logs, platform.element_sigma)
    misfits = estimator.solve(exchanges.readings, unknown, exchanges.saturation).misfits
    found = misfits[np.isfinite(misfits)]
    if found.size and np.median(found) > _MAX_MISFIT:  # most exchanges fit no pose with free gains
        raise GainsError(
            f"its curves do not hold, for readings are off by {np.sqrt(np.median(found)):.1f} sigma whatever"
            " poses and gains are taken; find the board itself first, with `calibrate_ir --board`."
        )
    poses, used = _poses(estimator, exchanges, unknown)
    before = _residuals(platform, exchanges, logs, poses, used)
    for number in range(_ROUNDS):
        progress(f"gains, round {number + 1}")
        logs, covariances, moved = _improved(platform, exchanges, logs, poses, used)
        poses, used = _poses(estimator, exchanges, _pairs(exchanges, logs, _SEARCH_SIGMA))
        # leave out the few exchanges that fit far worse than most
        squares = np.nanmean(_residuals(platform, exchanges, logs, poses, used)[used] ** 2, axis=(1, 2, 3))
        used[np.flatnonzero(used)] = squares <= _WORST * max(float(np.median(squares)), 1.0)
        if moved < _STILL:
            break
    after = _residuals(platform, exchanges, logs, poses, used)
    return GainsFit(_as_gains(platform, exchanges, logs, covariances, used), used, before, after)


def _pairs(exchanges: Exchanges, logs: FloatArray, sigma: float) -> PairGains:
    """The gains of every exchange's pair, from log-gains (2, robots, n) of sensors and emitters."""
    factors = np.exp(logs)
    sigmas = np.tile([sigma, 0.0, sigma, 0.0], (len(exchanges.receiver), 1))
    return PairGains(factors[0, exchanges.receiver], factors[1, exchanges.transmitter], sigmas)


def _poses(
    estimator: MaximumLikelihood, exchanges: Exchanges, pairs: PairGains
) -> tuple[FloatArray, BoolArray]:
    """The pose (k, 3) of every exchange, and which are reliable; raises GainsError if none is.

    Known poses are combined with the readings, since robots may have moved during the exchange.
    """
    solutions = estimator.solve(exchanges.readings, pairs, exchanges.saturation)
    known = np.isfinite(exchanges.poses[:, 0])
    sure = (solutions.odds < _MAX_ODDS) & (solutions.misfits < _MAX_MISFIT)
    found = solutions.outcomes == IrOutcome.FOUND
    used = np.asarray(found & (known | sure))
    if not used.any():
        raise GainsError(f"None of {len(used)} exchanges determines a pose.")
    poses, both = np.where(known[:, None], exchanges.poses, solutions.poses), found & known
    prior = np.diag(np.square(POSE_SIGMA))
    share = prior @ np.linalg.inv(prior + solutions.covariances[both])
    poses[both] += np.einsum("kab,kb->ka", share, _apart(solutions.poses[both], poses[both]))
    return poses, used


def _apart(poses: FloatArray, others: FloatArray) -> FloatArray:
    """Differences of poses (k, 3), angles wrapped."""
    apart = poses - others
    apart[:, 1:] = wrap_angle(apart[:, 1:])
    return apart


def _residuals(
    platform: IrPlatform, exchanges: Exchanges, logs: FloatArray, poses: FloatArray, used: BoolArray
) -> FloatArray:
    """Residuals (k, modes, n, n) [sigma]; NaN where not used."""
    linear = _linearized(platform, exchanges, logs, poses, used)
    residuals = np.full(exchanges.readings.shape, np.nan)
    residuals[used] = np.where(linear.weight > 0.0, linear.residual * np.sqrt(linear.weight), np.nan)
    return residuals


class _Linear(NamedTuple):
    """Readings of the u exchanges used, linearized at the current estimate."""

    weight: FloatArray  # (u, modes, n, n) inverse variance, 0 where a reading is not used
    residual: FloatArray  # (u, modes, n, n) reading minus expectation
    expected: FloatArray  # (u, modes, n, n) expectation, equal to its derivative by a log-gain
    slopes: FloatArray  # (u, modes, n, n, 3) derivatives by the pose


def _linearized(
    platform: IrPlatform, exchanges: Exchanges, logs: FloatArray, poses: FloatArray, used: BoolArray
) -> _Linear:
    pairs = PairGains(*(values[used] for values in _pairs(exchanges, logs, 0.0)))
    expected, slopes = expected_with_slopes(platform, poses[used], pairs)
    readings, limit = exchanges.readings[used], exchanges.saturation[used][..., None, None]
    with np.errstate(invalid="ignore"):
        spread = np.hypot(platform.noise, platform.relative * readings)
        clear = expected < limit - _CLEAR_OF_SATURATION * platform.noise
        light = (readings > DARKEST * platform.noise) & (readings < limit)
    usable = np.isfinite(readings) & clear & light
    weight = np.where(usable, 1.0 / np.where(usable, spread, 1.0) ** 2, 0.0)
    return _Linear(weight, np.where(usable, readings - expected, 0.0), expected, slopes)


def _improved(
    platform: IrPlatform, exchanges: Exchanges, logs: FloatArray, poses: FloatArray, used: BoolArray
) -> tuple[FloatArray, FloatArray, float]:
    """One Gauss-Newton step: log-gains, two covariances (2, P, P), and the largest change.

    The first covariance follows from the noise. The second, White's sandwich estimator, is larger where
    exchanges disagree more than noise explains, as when robots move during an exchange.
    """
    linear = _linearized(platform, exchanges, logs, poses, used)
    to_known = _apart(exchanges.poses[used], poses[used])
    information, pull = _without_pose(linear, to_known, _BACKGROUND * platform.noise)
    _, robots, n = logs.shape
    own = np.arange(n)
    sensors = exchanges.receiver[used, None] * n + own
    emitters = robots * n + exchanges.transmitter[used, None] * n + own
    place = np.concatenate([sensors, emitters], axis=1)
    prior = 1.0 / platform.element_sigma**2
    matrix, vector = prior * np.eye(logs.size), -prior * logs.ravel()
    scatter, block = matrix.copy(), (place[:, :, None], place[:, None, :])
    np.add.at(matrix, block, information)
    np.add.at(scatter, block, pull[:, :, None] * pull[:, None, :])
    np.add.at(vector, place, pull)
    covariance = np.asarray(np.linalg.inv(matrix))
    step = np.clip(covariance @ vector, -_LONGEST_STEP, _LONGEST_STEP)
    both = np.stack([covariance, covariance @ scatter @ covariance])
    return logs + step.reshape(logs.shape), both, float(np.abs(step).max())


def _without_pose(linear: _Linear, to_known: FloatArray, background: float) -> tuple[FloatArray, FloatArray]:
    """Information matrices (u, 2n, 2n) and vectors (u, 2n) of each exchange on log-gains of its elements.

    The pose, whose prior is the known minus the estimated one (u, 3), or NaN, and the background of each
    sensor, of this standard deviation [count], are eliminated.
    """
    weight, expected, slopes = linear.weight, linear.expected, linear.slopes
    bright = weight * expected
    square, mixed = bright * expected, bright[..., None] * slopes
    count, _, n, _ = weight.shape
    gains = np.zeros((count, 2 * n, 2 * n))
    both, own = square.sum(axis=1), np.arange(n)
    gains[:, own, own], gains[:, n + own, n + own] = both.sum(axis=2), both.sum(axis=1)
    gains[:, :n, n:], gains[:, n:, :n] = both, np.swapaxes(both, 1, 2)
    to_pose = np.concatenate([mixed.sum(axis=(1, 3)), mixed.sum(axis=(1, 2))], axis=1)
    pose = np.einsum("kmij,kmija,kmijb->kab", weight, slopes, slopes)
    known = np.isfinite(to_known[:, 0])
    pose[known] += np.diag(1.0 / np.square(POSE_SIGMA))
    of_gains = bright * linear.residual
    pull = np.concatenate([of_gains.sum(axis=(1, 3)), of_gains.sum(axis=(1, 2))], axis=1)
    of_pose = np.einsum("kmij,kmija->ka", weight * linear.residual, slopes)
    of_pose[known] += to_known[known] / np.square(POSE_SIGMA)
    dark = _of_background(linear, background)
    gains, to_pose = gains - dark[:, :-4, :-4], to_pose - dark[:, :-4, -4:-1]
    pose, pull, of_pose = pose - dark[:, -4:-1, -4:-1], pull - dark[:, :-4, -1], of_pose - dark[:, -4:-1, -1]
    back = np.linalg.solve(pose, np.swapaxes(to_pose, 1, 2))
    return gains - to_pose @ back, pull - np.einsum("kap,ka->kp", back, of_pose)


def _of_background(linear: _Linear, sigma: float) -> FloatArray:
    """What is lost to the unknown background of each sensor, of the normal equations (u, 2n + 4, 2n + 4).

    Their columns are those of sensors, emitters, pose and residual.
    """
    weight, own = linear.weight, np.arange(linear.weight.shape[2])
    bright = (weight * linear.expected).sum(axis=1)
    pose = np.einsum("kmij,kmija->kia", weight, linear.slopes)
    residual = (weight * linear.residual).sum(axis=(1, 3))
    columns = np.concatenate([np.zeros_like(bright), bright, pose, residual[..., None]], axis=2)
    columns[:, own, own] = bright.sum(axis=2)
    columns /= np.sqrt(1.0 / sigma**2 + weight.sum(axis=(1, 3)))[..., None]
    return np.asarray(np.swapaxes(columns, 1, 2) @ columns)


def _as_gains(
    platform: IrPlatform,
    exchanges: Exchanges,
    logs: FloatArray,
    covariances: FloatArray,
    used: BoolArray,
) -> tuple[IrGains, ...]:
    """Gains with standard deviations from the larger of the covariances (2, P, P); see `GainsFit`."""
    unseen = platform.element_sigma**2 / platform.n
    pairs = np.stack([exchanges.receiver[used], len(logs[0]) + exchanges.transmitter[used]], axis=1)
    sigmas = [_sigmas(pairs, covariance, logs.shape, unseen) for covariance in covariances]
    own, shared = np.max(sigmas, axis=0)
    factors = np.clip(np.exp(logs), *GAIN_RANGE)
    gains = []
    for k, (sensor, emitter) in enumerate(zip(*factors.tolist(), strict=True)):
        is_surer = max(own[k], shared[k]) < platform.element_sigma
        found = (tuple(sensor), tuple(emitter), max(float(own[k]), _MIN_SIGMA), float(shared[k]))
        gains.append(IrGains(*found) if is_surer else IrGains.unknown(platform))
    return tuple(gains)


def _sigmas(pairs: IntArray, covariance: FloatArray, shape: tuple[int, ...], unseen: float) -> FloatArray:
    """Standard deviations (2, robots) of log-gains: individual, and common to all elements of a robot.

    The common variance of a receiver's sensors and a transmitter's emitters is divided equally between them,
    since only the product of their gains is observable.
    """
    _, robots, n = shape
    blocks = covariance.reshape(2 * robots, n, 2 * robots, n)
    means = blocks.mean(axis=(1, 3))
    own = np.array([np.trace(blocks[k, :, k]) / n - means[k, k] for k in range(2 * robots)])
    common: list[list[float]] = [[] for _ in range(2 * robots)]
    for sensors, emitters in np.unique(pairs, axis=0).tolist():
        both = means[sensors, sensors] + means[emitters, emitters] + 2.0 * means[sensors, emitters]
        common[sensors].append(0.5 * float(both))
        common[emitters].append(0.5 * float(both))
    shared = np.array([np.mean(values) if values else unseen for values in common])
    return np.sqrt([np.mean(v.reshape(2, robots), axis=0) for v in (own, shared)])
