"""Calibrate process and measurement noise: small position errors at a consistent NEES.

What is minimised is the position error, and how far the mean normalised error squared (NEES) is from what it
should be. White noise has to stand for errors that last, so the likelihood of the true poses is no criterion:
a few spells of lasting errors would have it enlarge the noise until all else is smoothed away. Nor is the
scatter of the sightings: it gives sigmas two or three times too small.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.optimize import minimize

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.number_spec import number_specs
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, interpolate
from swarm_loc_estimator.offline.calibration.recording import Recording, rerun
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.messages import chosen
from swarm_loc_estimator.swarm.swarm import OdometryModel, Robot, SensorModel, Swarm

TICK_S = 1.0
"""Errors are looked at this often."""
NEES_AIM = 2.5
"""A little less than 3: what was not fitted to errs more."""

_SPACING_NS = 50_000_000
_INCONSISTENCY = 0.2
"""A NEES off by half its aim is as bad as a tenth more error."""
_LOSS = 5.0
"""A hundredth of the poses missing is as bad as a twentieth more error."""
_FORGETTING = 0.005
"""Weight of the prior that a number stays near where it began, per squared factor of e."""
_FIRST_STEP, _LAST_STEP = 0.7, 0.07
_WORST = 1e3
_BAD = 0.3
"""How much worse than the beginning is all the same: where robots get lost the score says nothing more."""

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
        position_rmse: [m].
        heading_rmse: [rad].
        nees: Ideally 3.
        given: Share of the poses known in truth that were estimated.
    """

    position_rmse: float
    heading_rmse: float
    nees: float
    given: float

    @property
    def cost(self) -> float:
        """Logarithm of the position error, and penalties; small is good."""
        if not (self.given > 0.0 and 0.0 < self.nees < math.inf and self.position_rmse > 0.0):
            return _WORST
        inconsistency = math.log(self.nees / NEES_AIM) ** 2
        return math.log(self.position_rmse) + _INCONSISTENCY * inconsistency - _LOSS * math.log(self.given)


def score(results: Sequence[ReplayResult]) -> Score:
    """The score of all poses where the ground truth is dense, pooled."""
    errors, covariances, known_poses = [np.zeros((0, 3))], [np.zeros((0, 3, 3))], 0
    for result in results:
        for index, robot in enumerate(result.swarm.robots):
            truth = result.truth.get(robot.name)
            if truth is None:
                continue
            true, known = interpolate(truth, result.stamp_ns, DEFAULT_GAP_NS)
            known_poses += int(known.sum())
            known &= np.isfinite(result.poses[:, index]).all(axis=1)
            errors.append(result.poses[known, index] - true[known])
            covariances.append(result.covariances[known, index])
    error, covariance = np.concatenate(errors), np.concatenate(covariances)
    if not error.size:
        return Score(math.nan, math.nan, math.nan, 0.0)
    error[:, 2] = wrap_angle(error[:, 2])
    return Score(
        float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        float(np.sqrt(np.mean(error[:, 2] ** 2))),
        float(np.mean(nees(error, covariance))),
        len(error) / known_poses,
    )


def with_noise(swarm: Swarm, values: dict[str, float]) -> Swarm:
    """The swarm with noise numbers, given by name, the same for every robot."""
    return replace(swarm, robots=tuple(_robot_with(robot, values) for robot in swarm.robots))


def thinned(recording: Recording) -> Recording:
    """The recording with odometry no denser than the fit of noise needs."""
    rows = recording.odometry
    keep = np.ones(rows.robot.size, dtype=bool)
    for robot in np.unique(rows.robot).tolist():
        own = np.flatnonzero(rows.robot == robot)
        slot = rows.stamp_ns[own] // _SPACING_NS
        keep[own] = np.concatenate([[True], np.diff(slot) != 0])
    return replace(recording, odometry=chosen(rows, keep))


def fit_noise(
    folds: Sequence[Fold],
    begin: dict[str, float],
    fixed: dict[str, float],
    evaluations: int,
    report: Callable[[int, Score], None],
) -> dict[str, float]:
    """Numbers, by name, with the best score over all folds.

    Args:
        folds: What to run the estimator over.
        begin: Numbers to fit, and where to begin; positive.
        fixed: Other noise numbers.
        evaluations: How often the estimator may run over all folds.
        report: Called after each with its count and its score.
    """
    small = [replace(fold, recording=thinned(fold.recording)) for fold in folds]
    names, start = tuple(begin), np.log(np.array([*begin.values()]))
    costs: list[float] = []

    def cost(factors: FloatArray) -> float:
        values = {**fixed, **_clipped(names, start + factors)}
        runs = [rerun(fold.recording, with_noise(fold.swarm, values), TICK_S) for fold in small]
        found = score(runs)
        costs.append(found.cost)
        report(len(costs), found)
        return min(found.cost, costs[0] + _BAD) + _FORGETTING * float(np.sum(factors**2))

    options = {"maxfev": evaluations, "initial_tr_radius": _FIRST_STEP, "final_tr_radius": _LAST_STEP}
    found = minimize(cost, np.zeros(start.size), method="COBYQA", options=options)
    return _clipped(names, start + found.x)


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
