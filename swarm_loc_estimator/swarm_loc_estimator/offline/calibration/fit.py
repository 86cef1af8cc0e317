"""Calibrate a swarm from a recording with ground truth: cameras, motion, and the noise that remains.

The noise is fitted to held-out data: each half of the recording is run with the calibration from the other
half. So the covariances contain the errors of a calibration in other recordings. The cost is the error of
position and heading, with a penalty for the distance of the NEES from its aim. The filter's white noise
represents correlated errors, too, so the likelihood of the true poses does not work as a cost: a few periods
of correlated errors would increase the noise until measurements hardly count. Nor does the scatter of the
sightings, which gives standard deviations two to three times too small.

The scatter of a calibrated camera's sightings is noise of each robot's own, and sway of its camera. Bearing
errors that all markers share at one time are errors of the camera's yaw: the mount sways, or the robot leans.
They last for seconds, so a filter that takes them for noise of single sightings is too sure. Their covariance
over the time between two sightings of different markers gives their standard deviation and time constant,
those of a first-order Gauss-Markov process. What remains is noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from scipy.optimize import least_squares, minimize

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.batch.parameters import all_changed, calibrated_parameters, values_of
from swarm_loc_estimator.offline.batch.problem import Problem, problem_of
from swarm_loc_estimator.offline.batch.solver import Solution, Solver
from swarm_loc_estimator.offline.batch.start import started_at
from swarm_loc_estimator.offline.calibration.camera import CameraFit, camera_fits
from swarm_loc_estimator.offline.calibration.motion import (
    DENSE_GAP_NS,
    WINDOW_S,
    Drive,
    Lateness,
    biased,
    explained,
    fit_lateness,
    fit_response,
    steps_of,
    true_motion,
    windows,
)
from swarm_loc_estimator.offline.calibration.recording import (
    CalibrationError,
    Recording,
    rerun,
    started_at_truth,
)
from swarm_loc_estimator.offline.calibration.robust import population, spread
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.offline.recorded_bag import Progress, unwatched
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.inputs import MAX_PAUSE_NS
from swarm_loc_estimator.swarm.error_models import MotionResponse, OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

# Checked by make bench-mrclam: parameters are fitted to set 1 and measured on set 2.
TICK_S = 1.0  # Interval at which errors are computed
NEES_AIM = 1.7  # Target of the NEES, below 3 since errors in other recordings are larger
_HEADING_WEIGHT = 0.2
"""A heading error larger by a factor costs as much as a position error larger by its power of this."""
_OF_SENSOR = frozenset({"range_sigma_per_m", "bearing_sigma", "forward_sigma", "left_sigma", "heading_sigma"})
"""Noise in which robots differ."""

_SPACING_NS = 50_000_000  # Odometry is thinned out to this spacing for speed
_INCONSISTENCY = 0.2  # A NEES of half or twice its aim costs as much as 10 % more error
_LOSS = 5.0  # A hundredth of the poses missing costs as much as 5 % more error
_FORGETTING = 0.005
"""Weight of the prior that parameters stay near their initial values, per squared factor of e."""
_FIRST_STEP, _LAST_STEP = 0.7, 0.07  # Trust radii of the search, in logarithms of the noise
_WORST = 1e3  # Cost where nothing was estimated
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


# Sway: checked by test_scatter.py.
_EDGES_S = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0])  # Bins of the time between two sightings
_MIN_PAIRS = 30  # Minimum number of pairs of sightings of a bin that counts
_MAX_STEPS = 60  # Sightings after each one that are compared with it
_CUT = 4.0  # Errors are cut at this many spreads, so that outliers have no weight
_MIN_SHARE = 0.05  # Smallest share of the variance of bearings that counts as sway
_TIMES_S = (1.0, 60.0)  # Smallest and largest time constant


def with_scatter(fits: Sequence[CameraFit]) -> list[Robot]:
    """Calibrated robots of one type with the noise of their own sightings and the sway of their own cameras.

    Robots with few sightings get the median of the others. The noise is that of single sightings; `fit_noise`
    scales it for all robots together.
    """
    found = {fit.robot.name: _numbers(fit) for fit in fits if fit.is_enough}
    if not found:
        return [fit.robot for fit in fits]
    names = {name for one in found.values() for name in one}
    typical = {
        name: float(np.median([one[name] for one in found.values() if name in one])) for name in sorted(names)
    }
    return [_with(fit.robot, found.get(fit.robot.name, typical)) for fit in fits]


def _with(robot: Robot, numbers: dict[str, float]) -> Robot:
    """The robot with noise of its sensor and the sway of its camera, rounded to three digits."""
    rounded = {name: float(f"{value:.3g}") for name, value in numbers.items()}
    sway = {name: rounded.pop(name) for name in ("yaw_sigma", "yaw_time_s")}
    camera = robot.camera and replace(robot.camera, **sway)
    return replace(robot, camera=camera, sensor=replace(robot.sensor, **rounded))


def _numbers(fit: CameraFit) -> dict[str, float]:
    """Standard deviations of a robot's sightings and its sway."""
    polar, value = fit.polar, fit.sightings.value
    far = np.maximum(value[:, 0], 0.1)
    bearing = np.where(polar, fit.after[:, 1], fit.after[:, 1] / far)
    seconds = np.multiply(fit.sightings.stamp_ns, 1e-9, dtype=float)
    sway, time_s = sway_of(seconds, fit.sightings.reading, bearing)
    own = np.sqrt(max(spread(bearing) ** 2 - sway**2, 0.1 * spread(bearing) ** 2))
    numbers = {"yaw_sigma": sway, "yaw_time_s": time_s}
    if polar.any():
        numbers["range_sigma_per_m"] = max(1e-4, spread(fit.after[polar, 0] / far[polar]))
        numbers["bearing_sigma"] = max(1e-4, float(own))
    if not polar.all():
        numbers["forward_sigma"] = max(1e-4, spread(fit.after[~polar, 0]))
        numbers["left_sigma"] = max(1e-4, spread(fit.after[~polar, 1]) * float(own) / spread(bearing))
        numbers["heading_sigma"] = max(1e-4, spread(fit.after[~polar, 2]))
    return numbers


def sway_of(time_s: FloatArray, marker: IntArray, bearing: FloatArray) -> tuple[float, float]:
    """Standard deviation [rad] and time constant [s] of bearing errors (m,) that different markers share.

    Zeros if the errors of different markers are independent.
    """
    order = np.argsort(time_s, kind="stable")
    time_s, marker, bearing = time_s[order], marker[order], bearing[order]
    bearing = np.clip(bearing, -_CUT * spread(bearing), _CUT * spread(bearing))
    total, count = np.zeros(_EDGES_S.size - 1), np.zeros(_EDGES_S.size - 1)
    for step in range(1, min(_MAX_STEPS, time_s.size)):
        other = marker[step:] != marker[:-step]
        later = np.searchsorted(_EDGES_S, (time_s[step:] - time_s[:-step])[other], side="right") - 1
        product = (bearing[step:] * bearing[:-step])[other]
        inside = later < total.size
        total += np.bincount(later[inside], product[inside], total.size)
        count += np.bincount(later[inside], minlength=total.size)
    known = count >= _MIN_PAIRS
    variance = float(np.mean(bearing**2))
    if known.sum() < 2 or not known[0] or not total[0] > _MIN_SHARE * variance * count[0]:
        return 0.0, 0.0
    between_s = 0.5 * (_EDGES_S[:-1] + _EDGES_S[1:])[known]
    covariance, weight = total[known] / count[known] / variance, np.sqrt(count[known] / count[known].sum())

    def misfit(guess: FloatArray) -> FloatArray:
        share, log_time = guess
        return np.asarray(weight * (share * np.exp(-between_s / np.exp(log_time)) - covariance))

    limits = [0.0, np.log(_TIMES_S[0])], [1.0, np.log(_TIMES_S[1])]
    share, log_time = least_squares(misfit, [min(covariance[0], 0.9), np.log(5.0)], bounds=limits).x
    return float(np.sqrt(share * variance)), float(np.exp(log_time))


EVALUATIONS = 80  # Runs of the estimator to fit the noise

_MIN_WINDOWS = 50
_ROUNDS, _ROUNDS_ALONE = 2, 5  # Of the batch, with and without ground truth
_SIGHTED = {
    True: ("range_sigma_per_m", "bearing_sigma"),
    False: ("forward_sigma", "left_sigma", "heading_sigma"),
}
"""Noise of ranges and bearings, and of poses."""
_GOOD = 0.5  # Least weight of a sighting that counts
_MOVED_M = 0.02
_BIAS_ROUNDS = 3  # Of scale factors of motion, and turn biases
_SAMPLES = 60  # Windows of each robot, and sightings, whose variances by the batch are computed
_CORRELATION = 2.7  # Initial ratio of the white noise that represents correlated errors to their scatter
_TICK_S = 0.5
_FLOORS = {"wheel_noise": 0.0, "distance_drift": 1e-5, "range_sigma": 1e-3}
"""Not fitted, since they duplicate fitted terms; they keep the covariance of a slow robot positive."""
_LATERAL_SLIP = 1.0 / 60.0
"""Standard deviation of the motion across the path after a second, in wheel separations.

Not fitted: robots slip sideways when they touch something, which few recordings show. Without it a robot that
turns on the spot and sees few markers is soon too sure of its place.
"""


@dataclass(frozen=True)
class Options:
    """Choices of a calibration."""

    plain: bool = False  # Whether only noise is fitted
    # Whether a table of scale factors may be fitted, else one of speed and one of turn rate
    response: bool = True
    evaluations: int = EVALUATIONS  # Limit of runs of the estimator to fit the noise
    alone: bool = False  # Whether the recording is fitted to itself, without ground truth


@dataclass(frozen=True)
class DriveFit:
    """Calibrated motion of a type of robot."""

    members: tuple[int, ...]  # Indices of its robots
    drives: Mapping[int, Drive]  # Motion of the robots whose paths are known, by index
    late: Lateness  # Delay and lag
    response: MotionResponse | None  # Scale factors; None if only noise is fitted
    before: FloatArray  # (m, 2) errors of path [m] and turn [rad] of 5 s windows as reported
    after: FloatArray  # (m, 2) the same errors, calibrated
    doubt: FloatArray = field(default_factory=lambda: np.zeros(2))  # (2,) variances of the path itself there


@dataclass(frozen=True)
class FittedModels:
    """Calibrated models, without noise."""

    swarm: Swarm  # Calibrated
    cameras: tuple[CameraFit, ...]  # Of all robots, ordered by type
    motion: tuple[DriveFit, ...]  # One per type
    remarks: tuple[str, ...]  # Parameters that could not be fitted, one sentence each
    noise: dict[str, float]  # First noise by name, from the scatter of sightings and of motion
    paths: Mapping[str, Trajectory]  # By which motion and noise were fitted


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration."""

    swarm: Swarm  # Calibrated, with unchanged starts
    models: FittedModels  # The fits that it is made of
    noise: dict[str, float] = field(default_factory=dict)  # Fitted noise parameters by name
    before: Score | None = None  # Score of the estimator on the recording, started at the true poses
    after: Score | None = None  # The same, calibrated
    # One sentence if the models do not help in a part that they were not fitted to; else ""
    warning: str = ""


def calibrate(recording: Recording, swarm: Swarm, options: Options, progress: Progress) -> Calibration:
    """Fit cameras, motion and noise to a recording with ground truth of at least one robot, or to itself.

    Without ground truth the paths of the batch take its place; where half of them is not better predicted
    with what the other half tells, the description stays as it is. `swarm` is the description to begin with.
    `progress` is called now and then with the share done and what is being done.

    Raises:
        CalibrationError: There is no or too little ground truth, or the clock of the recording jumps.
    """
    if options.alone:
        recording = replace(recording, truth={})
    elif not recording.truth:
        raise CalibrationError(
            f"recording '{recording.name}' holds no <robot>/ground_truth; a calibration needs it, or --self."
        )
    if recording.longest_pause_ns > MAX_PAUSE_NS:
        raise CalibrationError(
            f"recording '{recording.name}' has a jump of {recording.longest_pause_ns / 3.6e12:.0f} h"
            " in its times; calibrate from a part without it."
        )
    whole = fit_models(recording, swarm, options, progress)
    folds = _folds(recording, swarm, whole, options)
    begin = whole.noise

    def report(count: int, found: Score) -> None:
        rmse_mm = 1e3 * found.position_rmse
        share = 0.2 + 0.75 * min(1.0, count / options.evaluations)
        progress(share, f"noise, run {count}: {rmse_mm:.1f} mm, NEES {found.nees:.2f}")

    fixed = _fixed_noise(swarm)
    found = begin if options.alone else fit_noise(folds, begin, fixed, options.evaluations, report)
    noise = {**fixed, **{name: float(f"{value:.3g}") for name, value in found.items()}}
    progress(0.96, "before and after")
    calibrated = with_noise(whole.swarm, noise)
    recording = replace(recording, truth=whole.paths) if options.alone else recording
    scores = [score([rerun(recording, started_at_truth(s, recording), _TICK_S)]) for s in (swarm, calibrated)]
    warning = "" if options.plain else _warning(folds, swarm, noise)
    kept = swarm if options.alone and warning else calibrated
    return Calibration(kept, whole, noise, scores[0], scores[1], warning)


def _fixed_noise(swarm: Swarm) -> dict[str, float]:
    """Noise parameters that are not fitted, by name."""
    separation = max(robot.odometry.wheel_separation for robot in swarm.robots)
    return {**_FLOORS, "lateral_drift": float(f"{(_LATERAL_SLIP * separation) ** 2:.3g}")}


def _warning(folds: Sequence[Fold], swarm: Swarm, noise: dict[str, float]) -> str:
    """A sentence if a half is not better with the models of the other half than with the description."""
    if not all(fold.is_held_out for fold in folds):
        return "The recording is too short to check the fit: half of it is too little to fit anything."
    for fold in folds:
        described = started_at_truth(swarm, fold.recording)
        fitted_m, *described_m = (
            score([rerun(fold.recording, one, _TICK_S)]).position_rmse
            for one in (with_noise(fold.swarm, noise), described, with_noise(described, noise))
        )
        if fitted_m >= min(described_m):
            return (
                "The recording is too short to fit, or the description was as good before: fitted to one"
                f" half, the position RMSE of the other half is {1e3 * fitted_m:.1f} mm, as described"
                f" {1e3 * min(described_m):.1f} mm."
            )
    return ""


def fit_models(recording: Recording, swarm: Swarm, options: Options, progress: Progress) -> FittedModels:
    """Fit cameras, motion and first noise; with `plain` compute only the errors.

    Each round solves the recording as a batch, in which ground truth is one more measurement, and fits motion
    and noise to its paths. Without ground truth the noise follows from the batch's own residuals, so there
    are more rounds.

    Raises:
        CalibrationError: Too little is known about the poses of robots.
    """
    begin, truth = problem_of(recording, swarm), recording.truth
    if options.plain:
        return _fitted(recording, begin, begin, truth, options)
    current = started_at_truth(swarm, recording) if truth else swarm
    online = rerun(recording, current, _TICK_S)
    known = {robot.name: online.track(index) for index, robot in enumerate(swarm.robots)} | dict(truth)
    polar = bool(begin.is_polar.any())
    parameters = calibrated_parameters(polar=polar, poses=not begin.is_polar.all())
    mean, wide = values_of(swarm, parameters), np.array([one.sigma for one in parameters])
    sigma = np.tile(wide, (len(mean), 1))
    # motion begins anew in each round: a table of speeds takes its place
    is_fixed = np.array([not one.moves for one in parameters])
    rounds = _ROUNDS if truth else _ROUNDS_ALONE
    for number in range(rounds):
        progress(0.2 * number / rounds, f"models, round {number + 1} of {rounds}")
        # the batch, with parameters about those of the type
        about = np.where(is_fixed, np.nan_to_num(mean - values_of(current, parameters)), 0.0)
        prior = (about, np.where(is_fixed, sigma, wide)) if number else None
        problem = problem_of(recording, current, parameters, truth)
        solution = Solver(problem, started_at(problem, known), prior).solve(unwatched)
        found = all_changed(current, parameters, np.round(solution.parameter, 5))
        mean, sigma = _of_types(swarm, found, solution)
        # motion and noise by its paths
        known = solution.paths() | {name: one for name, one in truth.items() if _is_dense(one)}
        paths = {name: one for name, one in known.items() if not truth or name in truth}
        models = _fitted(recording, begin, problem_of(recording, found), paths, options, solution)
        current = with_noise(models.swarm, {**_fixed_noise(swarm), **models.noise})
    starts = [
        replace(one, start=old.start) for one, old in zip(models.swarm.robots, swarm.robots, strict=True)
    ]
    return replace(models, swarm=replace(models.swarm, robots=tuple(starts)))


def _of_types(described: Swarm, found: Swarm, solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Mean (N, p) and standard deviation (N, p) of parameters by type, as priors of the next round."""
    parameters = solution.problem.parameters
    mean, old = (
        np.array([[one.of(robot) for one in parameters] for robot in swarm.robots])
        for swarm in (found, described)
    )
    sigma = np.tile(np.array([one.sigma for one in parameters]), (len(mean), 1))
    for name in dict.fromkeys(robot.type for robot in found.robots):
        rows = np.flatnonzero([robot.type == name and robot.camera is not None for robot in found.robots])
        if rows.size == 1:
            mean[rows] = old[rows]
        elif rows.size:
            typical, apart = population(mean[rows], solution.parameter_sigma[rows], sigma[0])
            mean[rows] = typical
            sigma[rows] = apart
    return mean, sigma


def _is_dense(path: Trajectory) -> bool:
    """Whether most of a path is known without gaps."""
    return path.stamp_ns.size > 1 and float(np.median(np.diff(path.stamp_ns))) <= DENSE_GAP_NS


def _fitted(
    recording: Recording,
    begin: Problem,
    found: Problem,
    paths: Mapping[str, Trajectory],
    options: Options,
    solution: Solution | None = None,
) -> FittedModels:
    """Motion and noise by the paths of the robots, type by type, and the errors of their sightings."""
    robots, cameras = list(found.swarm.robots), camera_fits(begin, found, paths)
    motion: list[DriveFit] = []
    remarks: list[str] = []
    for name in dict.fromkeys(robot.type for robot in robots):
        members = [index for index, robot in enumerate(robots) if robot.type == name]
        fits = [fit for fit in cameras if fit.robot.type == name]
        drive = _fit_drive(recording, found.swarm, paths, members, options)
        remarks += _remarks(found.swarm, members, fits, drive)
        if drive is not None:
            motion.append(drive if solution is None else replace(drive, doubt=_doubt(solution, members)))
        if options.plain:
            continue
        sensed = {robot.name: robot for robot in with_scatter(fits)}
        for index in members:
            seen = sensed.get(robots[index].name, robots[index])
            robots[index] = seen if drive is None else _with_motion(seen, index, drive)
    if not motion and not any(fit.is_enough for fit in cameras):
        raise CalibrationError(
            f"recording '{recording.name}' holds too little ground truth together with odometry or sightings;"
            " at least a minute of a moving robot that sees markers is needed."
        )
    swarm = replace(found.swarm, robots=tuple(robots))
    models = FittedModels(swarm, tuple(cameras), tuple(motion), tuple(remarks), {}, paths)
    noise = _first_noise(models, plain=options.plain)
    return replace(models, noise=noise if solution is None else _with_leverage(noise, solution))


def _with_leverage(noise: dict[str, float], solution: Solution) -> dict[str, float]:
    """Noise of sightings, whose errors by a path that follows them are too small by its own variance."""
    used, residual = np.flatnonzero(solution.used), solution.sightings[0]
    is_good = solution.weight[used] > _GOOD
    is_polar, rng = solution.problem.is_polar[used], np.random.default_rng(0)
    larger = dict(noise)
    for polar, names in _SIGHTED.items():
        rows = np.flatnonzero(is_good & (is_polar == polar))
        if not rows.size or names[0] not in noise:
            continue
        some = rng.choice(rows, min(_SAMPLES * len(solution.problem.swarm.robots), rows.size), replace=False)
        own = np.median(solution.leverages(some), axis=0)
        for component, name in enumerate(names):
            scatter = (_CORRELATION * max(spread(residual[rows, component]), 1e-3)) ** 2
            larger[name] = noise[name] * math.sqrt(1.0 + float(own[component]) / scatter)
    return larger


def _fit_drive(
    recording: Recording,
    swarm: Swarm,
    paths: Mapping[str, Trajectory],
    members: Sequence[int],
    options: Options,
) -> DriveFit | None:
    """Fit the motion of a type; None without a robot whose path is known."""
    drives: dict[int, Drive] = {}
    for index in members:
        track, path = recording.track(index), paths.get(swarm.robots[index].name)
        if path is None or track.stamp_ns.size < 2:
            continue
        begin_ns, end_ns = int(track.stamp_ns[0]), int(track.stamp_ns[-1])
        drive = Drive(steps_of(track, swarm.robots[index].odometry), true_motion(path, begin_ns, end_ns))
        if windows(drive.motion, WINDOW_S)[0].size >= _MIN_WINDOWS:
            drives[index] = drive
    if not drives:
        return None
    own, prompt = [*drives.values()], Lateness(0.0, 0.0)
    before = explained(own, prompt, None)
    if options.plain:
        return DriveFit(tuple(members), drives, prompt, None, before, before)
    late = fit_lateness(own)
    for _ in range(_BIAS_ROUNDS):
        response = fit_response(own, late, table=options.response)
        own = [biased(drive, late, response) for drive in own]
    drives = dict(zip(drives, own, strict=True))
    return DriveFit(tuple(members), drives, late, response, before, explained(own, late, response))


def _doubt(solution: Solution, members: Sequence[int]) -> FloatArray:
    """Mean variances (2,) of path and turn over a window in which a robot moves, by the batch itself."""
    knots, rng = solution.problem.knots, np.random.default_rng(0)
    first, last = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for index in members:
        own = np.flatnonzero((knots.robot == index) & (solution.column >= 0))
        end = np.searchsorted(knots.stamp_ns[own], knots.stamp_ns[own] + round(1e9 * WINDOW_S))
        begin = np.flatnonzero(end < own.size)
        track = knots.sample.pose[own]
        moved = se2.between(track[begin], track[end[begin]])
        begin = begin[np.hypot(moved[:, 0], moved[:, 1]) > _MOVED_M]
        some = rng.choice(begin, min(_SAMPLES, begin.size), replace=False)
        first.append(own[some])
        last.append(own[end[some]])
    variances = solution.moved_variances(np.concatenate(first), np.concatenate(last))
    return np.asarray(variances[:, [0, 2]].mean(axis=0)) if len(variances) else np.zeros(2)


def _with_motion(robot: Robot, index: int, drive: DriveFit) -> Robot:
    """The robot with the delay, lag and scale factors of its type."""
    late, response = drive.late, drive.response
    numbers = {
        "delay_s": round(late.delay_s, 4),
        "lag_s": round(late.lag_s, 4),
        "distance_scale": 1.0,
        "turn_scale": 1.0,
    }
    if index in drive.drives:
        bias = drive.drives[index].steps.turn_bias
        numbers["turn_bias"] = round(float(bias[np.argmax(np.abs(bias))]), 5)
    if response is not None and len(response.speeds) == len(response.turn_rates) == 1:
        numbers["distance_scale"] = response.speed_share[0][0]
        numbers["turn_scale"] = response.turn_share[0][0]
        response = None
    return replace(robot, odometry=replace(robot.odometry, **numbers), response=response)


def _folds(recording: Recording, swarm: Swarm, whole: FittedModels, options: Options) -> list[Fold]:
    """Each half of the recording with the models of the other half; if that has too little, of the whole."""
    if options.plain:
        return [Fold(recording, started_at_truth(whole.swarm, recording))]
    first_ns, last_ns = recording.range_ns
    middle_ns = (first_ns + last_ns) // 2
    halves = [recording.between(first_ns, middle_ns), recording.between(middle_ns, last_ns + 1)]
    folds = []
    for half, fitted in ((halves[0], halves[1]), (halves[1], halves[0])):
        run = replace(half, truth=whole.paths) if options.alone else half
        try:
            models = fit_models(fitted, swarm, options, unwatched)
        except CalibrationError:
            models = whole
        folds.append(Fold(run, started_at_truth(models.swarm, run), models is not whole))
    return folds


def _first_noise(models: FittedModels, *, plain: bool) -> dict[str, float]:
    """Initial noise parameters, from the scatter of sightings and the errors of motion windows."""
    polar = np.concatenate([fit.polar for fit in models.cameras] or [np.zeros(0, dtype=bool)])
    errors = [fit.before if plain else fit.after for fit in models.cameras]
    error = np.concatenate(errors or [np.zeros((0, 3))])
    begin: dict[str, float] = {}
    if polar.any():
        metres = np.concatenate([fit.sightings.value[:, 0] for fit in models.cameras])[polar]
        begin["range_sigma_per_m"] = _CORRELATION * spread(error[polar, 0] / np.maximum(metres, 0.1))
        begin["bearing_sigma"] = _CORRELATION * spread(error[polar, 1])
    if (~polar).any():
        names = ("forward_sigma", "left_sigma", "heading_sigma")
        begin |= {n: _CORRELATION * max(1e-4, spread(error[~polar, k])) for k, n in enumerate(names)}
    if models.motion:
        begin |= _first_motion_noise(models.motion, plain=plain)
    else:
        model = OdometryModel()
        begin |= {"distance_noise": model.wheel_noise, "turn_noise": 0.01, "turn_drift": 1e-4}
    return begin


def _first_motion_noise(motion: Sequence[DriveFit], *, plain: bool) -> dict[str, float]:
    """Initial noise of motion: each parameter explains a part of the mean squared errors of windows."""
    path = turn = seconds = path2 = turn2 = 0.0
    for fit in motion:
        for drive in fit.drives.values():
            first, last = windows(drive.motion, WINDOW_S)
            path += float(np.sum(np.abs(drive.motion.path[last] - drive.motion.path[first])))
            turn += float(np.sum(np.abs(drive.motion.turn[last] - drive.motion.turn[first])))
            seconds += WINDOW_S * first.size
        # errors by a path that follows the odometry are too small by its own variance
        path2 += float(np.sum(fit.after[:, 0] ** 2 + fit.doubt[0]))
        turn2 += float(np.sum(fit.after[:, 1] ** 2 + fit.doubt[1]))
    path, turn, path2, turn2 = max(path, 1e-3), max(turn, 1e-3), max(path2, 1e-7), max(turn2, 1e-7)
    begin = {} if plain else {"turn_bias_sigma": np.sqrt(0.1 * turn2 / (seconds * WINDOW_S))}
    return begin | {
        "distance_noise": 0.5 * path2 / path,
        "distance_turn_noise": 0.5 * path2 / turn,
        "lateral_noise": 0.05 * path2 / path,
        "turn_drift": 0.3 * turn2 / seconds,
        "turn_noise": 0.3 * turn2 / turn,
        "turn_change_noise": 0.2 * turn2 / turn,
    }


def _remarks(
    swarm: Swarm, members: Sequence[int], fits: Sequence[CameraFit], drive: DriveFit | None
) -> list[str]:
    """One sentence for everything that could not be fitted."""
    poor = [fit.robot.name for fit in fits if not fit.is_enough]
    remarks = [
        f"{name} has too few sightings with ground truth: it gets the mean of its type." for name in poor
    ]
    if not any(fit.is_enough for fit in fits) and any(
        swarm.robots[index].camera is not None for index in members
    ):
        names = ", ".join(swarm.robots[index].name for index in members)
        remarks.append(f"no camera of {names} could be calibrated: too few sightings with ground truth.")
    if drive is None:
        names = ", ".join(swarm.robots[index].name for index in members)
        remarks.append(f"the motion of {names} could not be calibrated: none has dense ground truth.")
    return remarks
