"""Calibrate process and measurement noise: small errors of position and heading at a consistent NEES.

The cost is the error, with a penalty for the distance of the NEES from its aim. The filter's white
noise represents correlated errors, too, so the likelihood of the true poses does not work as a cost: a few
periods of correlated errors would increase the noise until measurements hardly count. Nor does the scatter of
the sightings, which gives standard deviations two to three times too small.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.optimize import minimize

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, interpolate
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.calibration.recording import Recording, rerun
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.error_models import OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import Swarm

TICK_S = 1.0  # Interval at which errors are computed
NEES_AIM = 1.7  # Target of the NEES, below 3 since errors in other recordings are larger
_HEADING_WEIGHT = 0.2
"""A heading error larger by a factor costs as much as a position error larger by its power of this."""
_OF_SENSOR = frozenset({"range_sigma_per_m", "bearing_sigma", "forward_sigma", "left_sigma", "heading_sigma"})
"""Noise in which robots differ."""

_SPACING_NS = 50_000_000
_INCONSISTENCY = 0.2  # A NEES of half or twice its aim costs as much as 10 % more error
_LOSS = 5.0  # A hundredth of the poses missing costs as much as 5 % more error
_FORGETTING = 0.005
"""Weight of the prior that parameters stay near their initial values, per squared factor of e."""
_FIRST_STEP, _LAST_STEP = 0.7, 0.07
_WORST = 1e3
_BAD = 0.3  # Costs are capped this far above the initial one: when robots get lost, a score means nothing


@dataclass(frozen=True)
class Fold:
    """A part of a recording, and the swarm as calibrated without it."""

    recording: Recording  # Input of the estimator
    swarm: Swarm  # With the true starts
    is_held_out: bool = True  # Whether the swarm was calibrated without this part


@dataclass(frozen=True)
class Score:
    """Quality of an estimate."""

    position_rmse: float  # [m]
    heading_rmse: float  # [rad]
    nees: float  # Ideally 3
    given: float  # Share of the poses with ground truth that were estimated

    @property
    def cost(self) -> float:
        """Logarithm of the errors plus penalties; smaller is better."""
        if not (self.given > 0.0 and 0.0 < self.nees < math.inf and self.position_rmse > 0.0):
            return _WORST
        inconsistency = math.log(self.nees / NEES_AIM) ** 2
        error = math.log(self.position_rmse) + _HEADING_WEIGHT * math.log(max(self.heading_rmse, 1e-9))
        return error + _INCONSISTENCY * inconsistency - _LOSS * math.log(self.given)


def score(results: Sequence[ReplayResult]) -> Score:
    """The score of all poses with dense ground truth, pooled."""
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
    """The swarm with noise parameters by name.

    Noise of sightings keeps its ratios between the robots, and their geometric mean becomes the value.
    """
    odometry, sensor = (
        {field.name: values[field.name] for field in fields(model) if field.name in values}
        for model in (OdometryModel, SensorModel)
    )
    mean = {
        name: math.exp(np.mean([math.log(getattr(robot.sensor, name)) for robot in swarm.robots]))
        for name in _OF_SENSOR & sensor.keys()
        if all(getattr(robot.sensor, name) > 0.0 for robot in swarm.robots)
    }
    robots = []
    for robot in swarm.robots:
        own = {name: sensor[name] * getattr(robot.sensor, name) / value for name, value in mean.items()}
        seen = replace(robot.sensor, **(sensor | {k: float(f"{v:.3g}") for k, v in own.items()}))
        robots.append(replace(robot, odometry=replace(robot.odometry, **odometry), sensor=seen))
    return replace(swarm, robots=tuple(robots))


def thinned(recording: Recording) -> Recording:
    """The recording with at most one odometry message per robot and 50 ms, for speed."""
    rows = recording.odometry
    keep = np.ones(rows.robot.size, dtype=bool)
    for robot in np.unique(rows.robot).tolist():
        own = np.flatnonzero(rows.robot == robot)
        slot = rows.stamp_ns[own] // _SPACING_NS
        keep[own] = np.concatenate([[True], np.diff(slot) != 0])
    return replace(recording, odometry=select(rows, keep))


def fit_noise(
    folds: Sequence[Fold],
    begin: dict[str, float],
    fixed: dict[str, float],
    evaluations: int,
    report: Callable[[int, Score], None],
) -> dict[str, float]:
    """Noise parameters by name with the best score over all folds.

    Args:
        folds: Recordings with swarms.
        begin: Initial values of the fitted parameters; positive.
        fixed: Other noise parameters.
        evaluations: Limit of runs of the estimator over all folds.
        report: Called after each run with its number and score.
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


def _clipped(names: Sequence[str], logarithms: FloatArray) -> dict[str, float]:
    """Parameters within their ranges, rounded to three digits."""
    specs = {**number_specs(OdometryModel), **number_specs(SensorModel)}
    return {
        name: float(f"{min(specs[name].high, np.exp(min(value, 50.0))):.3g}")
        for name, value in zip(names, logarithms.tolist(), strict=True)
    }
