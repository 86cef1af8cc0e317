"""The Droplet paper's closed form for range, bearing and heading, eqs (5)-(18), corrected.

Errata of the paper: the sign in (10); "- arg(R)" in (12), which must be "- phi"; (18), which adds a scalar to
vectors instead of taking the length of a sum of vectors. Emitter directions are rotated by phi into the
receiver's frame, the arc tangent has two arguments, and angles are wrapped. The bound (16) is violated in a
fifth of all poses and serves only as a start. Iterating (11)-(18) does not help.

The bearing has a systematic error that is periodic in the elements: 3 to 6 degrees on average with six of
them. The covariance includes it: it is the mean squared error at the given range, tabulated by simulation.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.numerics import wrap
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.infrared.brightness import curve_at, distance_at, expected_brightness
from swarm_loc_estimator.infrared.search import DARKEST, IrOutcome, IrSolutions, checked, no_solutions
from swarm_loc_estimator.swarm.ir_board import IrModel, IrPlatform, PairGains

_FOUND, _TOO_WEAK, _UNDETERMINED = int(IrOutcome.FOUND), int(IrOutcome.TOO_WEAK), int(IrOutcome.UNDETERMINED)
_FAINTEST = 15.0  # Minimum of the brightest reading [sigma]; below it, noise makes far robots appear near
_CLEAR = 0.05  # Minimum length of the mean direction of light; below it, the direction is undetermined
_LEVELS, _SAMPLES = 32, 300  # Number of tabulated ranges, and of simulated poses at each
_FEWEST, _CORE = 30, 0.99
"""Minimum number of simulated poses per tabulated range, and share of them that enters the covariance."""
_SYSTEMATIC = 0.95  # Systematic share of the variance, from the approximation and from gains
_SIGMA_STEP = 0.02  # Resolution of the standard deviation of log-gains for which errors are tabulated


class IrEstimator(Protocol):
    """One of `ClosedForm` and `MaximumLikelihood`."""

    def solve(
        self, readings: ArrayLike, gains: PairGains | None = None, saturation: ArrayLike | None = None
    ) -> IrSolutions:
        """Relative poses of k pairs, see `MaximumLikelihood.solve`."""


class ClosedForm:
    """Poses by the closed form for one platform, from the strongest power neither saturated nor faint.

    Args:
        platform: The board of both robots.
    """

    def __init__(self, platform: IrPlatform) -> None:
        self._platform = platform
        model = platform.model
        farthest = 1.1 * distance_at(model.amplitudes[0], _FAINTEST * model.noise)
        self._ranges = np.geomspace(2.0 * platform.radius, max(farthest, 4.0 * platform.radius), _LEVELS)
        self._errors: dict[int, FloatArray] = {}

    def solve(
        self, readings: ArrayLike, gains: PairGains | None = None, saturation: ArrayLike | None = None
    ) -> IrSolutions:
        """Relative poses of k pairs, see `MaximumLikelihood.solve`; there are no alternatives."""
        values, known, limits = checked(self._platform, readings, gains, saturation)
        solutions = no_solutions(len(values))
        _solve_all(self._platform.model, values, known, limits, solutions.poses, solutions.outcomes)
        found = np.flatnonzero(solutions.outcomes == IrOutcome.FOUND)
        steps = np.ceil(np.sqrt(0.5 * np.sum(known.sigma[found] ** 2, axis=-1)) / _SIGMA_STEP).astype(int)
        for step in np.unique(steps):
            of_step = found[steps == step]
            solutions.covariances[of_step] = self._covariances(solutions.poses[of_step, 0], int(step))
        solutions.systematic_share[found] = _SYSTEMATIC
        return solutions

    def _covariances(self, ranges: FloatArray, step: int) -> FloatArray:
        """Mean squared errors (k, 3, 3) of ranges (k,), for log-gains with sigma step * `_SIGMA_STEP`."""
        if step not in self._errors:
            self._errors[step] = self._tabulate(step * _SIGMA_STEP)
        covariances: FloatArray = self._errors[step][self._level(ranges)]
        return covariances

    def _level(self, ranges: FloatArray) -> NDArray[np.int64]:
        """Index of the nearest tabulated range."""
        logs = np.log(self._ranges)
        levels = np.interp(np.log(np.maximum(ranges, 1e-6)), logs, np.arange(_LEVELS))
        return np.rint(levels).astype(np.int64)

    def _tabulate(self, sigma: float) -> FloatArray:
        """Mean squared errors (L, 3, 3) by estimated range, for log-gains with this standard deviation."""
        rng = np.random.default_rng(0)  # fixed seed: solutions must be reproducible
        platform, count = self._platform, _LEVELS * _SAMPLES
        poses = rng.uniform(-np.pi, np.pi, (count, 3))
        poses[:, 0] = np.repeat(self._ranges, _SAMPLES)
        factors = np.exp(sigma * rng.standard_normal((2, count, platform.n)))
        differing = PairGains(factors[0], factors[1], np.zeros((count, 4)))
        readings = expected_brightness(platform, poses, differing)
        spread = np.hypot(platform.noise, platform.relative * readings)
        readings = np.minimum(readings + spread * rng.standard_normal(readings.shape), platform.saturation)
        found, outcomes = np.zeros_like(poses), np.zeros(count, np.int64)
        _solve_all(platform.model, *checked(platform, readings, None, None), found, outcomes)
        errors, level = found - poses, self._level(found[:, 0])
        errors[:, 1:] = wrap_angle(errors[:, 1:])
        beside = [(outcomes == _FOUND) & (np.abs(level - k) <= 1) for k in range(_LEVELS)]
        known = np.array([k for k in range(_LEVELS) if beside[k].sum() >= _FEWEST])
        table = {k: _core_squares(errors[beside[k]]) for k in known.tolist()}
        return np.array([table[int(known[np.abs(known - k).argmin()])] for k in range(_LEVELS)])


def _core_squares(errors: FloatArray) -> FloatArray:
    """Mean squares (3, 3) of errors (s, 3), without the few far robots that appear near."""
    size = np.abs(errors[:, 0])
    core = errors[size <= np.quantile(size, _CORE)]
    squares: FloatArray = core.T @ core / len(core)
    return squares


@cached_njit
def _solve_all(
    model: IrModel,
    readings: FloatArray,
    gains: PairGains,
    saturation: FloatArray,
    poses: FloatArray,
    outcomes: NDArray[np.int64],
) -> None:
    """Solve all pairs; writes poses and outcomes."""
    n = readings.shape[2]
    matrix, sums = np.empty((n, n)), np.empty((2, n))
    for k in range(readings.shape[0]):
        mode = _best_power(model, readings[k], saturation[k])
        if mode < 0:
            outcomes[k] = _TOO_WEAK
            continue
        for i in range(n):
            for j in range(n):
                reading = readings[k, mode, i, j]
                light = reading / (gains.sensor[k, i] * gains.emitter[k, j])  # NaN where an element is dead
                light_there = math.isfinite(light) and reading > DARKEST * model.noise
                matrix[i, j] = light if light_there else 0.0
        outcomes[k] = _solve_one(model, model.amplitudes[mode], matrix, sums, poses[k])


@cached_njit
def _best_power(model: IrModel, readings: FloatArray, saturation: FloatArray) -> int:
    """The first power that neither saturates nor is faint, else the last that saturates; -1: all faint."""
    saturated = -1
    for m in range(readings.shape[0]):
        brightest = -math.inf
        for i in range(readings.shape[1]):
            for j in range(readings.shape[2]):
                if math.isfinite(readings[m, i, j]):
                    brightest = max(brightest, readings[m, i, j])
        if brightest >= saturation[m]:
            saturated = m
        elif brightest > _FAINTEST * model.noise:
            return m
    return saturated


@cached_njit
def _solve_one(
    model: IrModel, law: FloatArray, matrix: FloatArray, light: FloatArray, pose: FloatArray
) -> int:
    """Write the pose (3,) of one matrix Lambda (n, n); returns the outcome."""
    n, rho = matrix.shape[0], model.radius
    bi, bj = 0, 0
    light[:] = 0.0
    for i in range(n):
        for j in range(n):
            light[0, i] += matrix[i, j]  # (5), by sensor
            light[1, j] += matrix[i, j]  # (6), by emitter
            if matrix[i, j] > matrix[bi, bj]:
                bi, bj = i, j
    theta, clear = _direction(model.units, light[0])  # (7), (8)
    back, clear_back = _direction(model.units, light[1])  # (9)
    if min(clear, clear_back) < _CLEAR:
        return _UNDETERMINED
    phi = wrap(theta + math.pi - back)  # (10)
    ix, iy = model.units[bi, 0], model.units[bi, 1]
    jx = math.cos(model.angles[bj] + phi)
    jy = math.sin(model.angles[bj] + phi)
    # (13)-(16): from very far both angles are those of the centres
    r = _distance(model, law, matrix[bi, bj], bi, bj, theta, phi)
    distance = r + 2.0 * rho
    # (11), (12), (17), (18)
    along = math.atan2(
        distance * math.sin(theta) + rho * (jy - iy), distance * math.cos(theta) + rho * (jx - ix)
    )
    r = _distance(model, law, matrix[bi, bj], bi, bj, along, phi)
    if not math.isfinite(r):
        return _TOO_WEAK
    pose[0] = math.hypot(r * math.cos(along) + rho * (ix - jx), r * math.sin(along) + rho * (iy - jy))
    pose[1], pose[2] = wrap(theta), phi
    return _FOUND


@cached_njit
def _direction(units: FloatArray, light: FloatArray) -> tuple[float, float]:
    """Direction of the mean of unit vectors (n, 2) weighted by light (n,), and its length in [0, 1]."""
    x, y, total = 0.0, 0.0, 1e-300
    for i in range(light.size):
        x += light[i] * units[i, 0]
        y += light[i] * units[i, 1]
        total += abs(light[i])
    return math.atan2(y, x), math.hypot(x, y) / total


@cached_njit
def _distance(
    model: IrModel, law: FloatArray, brightness: float, i: int, j: int, along: float, phi: float
) -> float:
    """Eqs (15), (17): the distance from sensor i to emitter j, which lies in the direction `along`."""
    seen = curve_at(model.sensor, along - model.angles[i])[0]
    lit = curve_at(model.emitter, along + math.pi - model.angles[j] - phi)[0]
    return distance_at(law, brightness / max(seen * lit, 1e-12))
