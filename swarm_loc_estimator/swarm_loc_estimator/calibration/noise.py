"""The fit of noise: what makes the estimator's own covariances fit its errors, through the estimator itself.

The criterion is the logarithmic score: the likelihood of the true poses under the estimated ones with their
covariances. It rewards accuracy and punishes covariances too small and too large alike; where all noise is
scaled rightly, the mean normalised error squared (NEES) is 3. White noise has to stand for errors that last,
which only running the filter can tell: scatter alone gives sigmas two or three times too small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.optimize import minimize

from swarm_loc_estimator.calibration.recording import Recording, Rows
from swarm_loc_estimator.calibration.rerun import rerun
from swarm_loc_estimator.core.metrics import DEFAULT_GAP_NS, interpolate, nees
from swarm_loc_estimator.core.se2 import FloatArray, wrap_angle
from swarm_loc_estimator.core.swarm import OdometryModel, Robot, SensorModel, Swarm, number_specs
from swarm_loc_estimator.replay_result import ReplayResult

TICK_S = 1.0
"""Errors are looked at this often."""

_SPACING_NS = 50_000_000
_STEP = 0.7
_FORGETTING = 0.02
"""Weight of the prior that a number stays near where it began, per squared factor of e."""
_WORST = 1e6

_OF_SENSOR = frozenset(number_specs(SensorModel))

NumberNames = tuple[str, ...]


@dataclass(frozen=True)
class Fold:
    """A part of a recording, and the swarm as calibrated without it.

    Attributes:
        recording: To run the estimator over.
        swarm: Started where the ground truth says.
    """

    recording: Recording
    swarm: Swarm


@dataclass(frozen=True)
class Score:
    """How an estimate does.

    Attributes:
        log_score: Mean of half the normalised error squared plus half the logarithm of det P; small is good.
        position_rmse: [m].
        heading_rmse: [rad].
        nees: Ideally 3.
    """

    log_score: float
    position_rmse: float
    heading_rmse: float
    nees: float


def score(results: Sequence[ReplayResult]) -> Score:
    """The score of all poses where the ground truth is dense, pooled."""
    errors, covariances = [], []
    for result in results:
        for index, robot in enumerate(result.swarm.robots):
            truth = result.truth.get(robot.name)
            if truth is None:
                continue
            true, known = interpolate(truth, result.stamp_ns, DEFAULT_GAP_NS)
            known &= np.isfinite(result.pose[:, index]).all(axis=1)
            errors.append(result.pose[known, index] - true[known])
            covariances.append(result.covariance[known, index])
    error, covariance = np.concatenate(errors), np.concatenate(covariances)
    if not error.size:
        return Score(_WORST, float("nan"), float("nan"), float("nan"))
    error[:, 2] = wrap_angle(error[:, 2])
    normalised = nees(error, covariance)
    sign, log_det = np.linalg.slogdet(covariance)
    sound = np.isfinite(normalised).all() and (sign > 0.0).all()
    return Score(
        0.5 * float(np.mean(normalised + log_det)) if sound else _WORST,
        float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        float(np.sqrt(np.mean(error[:, 2] ** 2))),
        float(np.mean(normalised)),
    )


def with_noise(swarm: Swarm, values: dict[str, float]) -> Swarm:
    """The swarm with noise numbers, given by name, the same for every robot."""
    return replace(swarm, robots=tuple(_robot_with(robot, values) for robot in swarm.robots))


def thinned(recording: Recording) -> Recording:
    """The recording with odometry no denser than the fit of noise needs."""
    rows: Rows = recording.odometry
    keep = np.ones(rows.robot.size, dtype=bool)
    for robot in np.unique(rows.robot).tolist():
        own = np.flatnonzero(rows.robot == robot)
        slot = rows.stamp_ns[own] // _SPACING_NS
        keep[own] = np.concatenate([[True], np.diff(slot) != 0])
    return replace(recording, odometry=rows.chosen(keep))


def fit_noise(
    folds: Sequence[Fold],
    begin: dict[str, float],
    fixed: dict[str, float],
    evaluations: int,
    report: Callable[[int, Score, dict[str, float]], None],
) -> dict[str, float]:
    """Numbers, by name, with the best logarithmic score over all folds.

    Args:
        folds: What to run the estimator over.
        begin: Numbers to fit, and where to begin; positive.
        fixed: Other noise numbers.
        evaluations: How often the estimator may run over all folds.
        report: Called after each with its count, its score and its numbers.
    """
    small = [replace(fold, recording=thinned(fold.recording)) for fold in folds]
    names, start = tuple(begin), np.log(np.array([*begin.values()]))
    groups = np.array([[name in _OF_SENSOR, name not in _OF_SENSOR] for name in names], dtype=float)
    count = 0

    def cost(logarithms: FloatArray) -> float:
        nonlocal count
        values = _clipped(names, logarithms)
        results = [
            rerun(fold.recording, with_noise(fold.swarm, {**fixed, **values}), TICK_S) for fold in small
        ]
        found = score(results)
        count += 1
        report(count, found, values)
        return found.log_score + _FORGETTING * float(np.mean((logarithms - start) ** 2))

    # how much noise sensors and motion have as a whole comes first, then each number of its own
    coarse = _search(lambda factors: cost(start + groups @ factors), np.zeros(2), evaluations // 3)
    fine = _search(cost, start + groups @ coarse, evaluations - evaluations // 3)
    return _clipped(names, fine)


def _search(cost: Callable[[FloatArray], float], start: FloatArray, evaluations: int) -> FloatArray:
    """The best point that a number of evaluations finds from a start (p,)."""
    steps = np.diag(_STEP * (-1.0) ** np.arange(start.size))  # not all in one direction
    options = {
        "initial_simplex": np.concatenate([start[None], start + steps]),
        "maxfev": max(1, evaluations),
        "xatol": 0.05,
        "fatol": 0.002,
        "adaptive": start.size > 2,
    }
    found: FloatArray = minimize(cost, start, method="Nelder-Mead", options=options).x
    return found


def _clipped(names: NumberNames, logarithms: FloatArray) -> dict[str, float]:
    """Numbers within what a swarm description may hold, to three digits."""
    specs = {**number_specs(OdometryModel), **number_specs(SensorModel)}
    return {
        name: float(f"{min(specs[name].high, np.exp(min(value, 50.0))):.3g}")
        for name, value in zip(names, logarithms.tolist(), strict=True)
    }


def _robot_with(robot: Robot, values: dict[str, float]) -> Robot:
    odometry = {f.name: values[f.name] for f in fields(OdometryModel) if f.name in values}
    sensor = {f.name: values[f.name] for f in fields(SensorModel) if f.name in values}
    return replace(
        robot, odometry=replace(robot.odometry, **odometry), sensor=replace(robot.sensor, **sensor)
    )
