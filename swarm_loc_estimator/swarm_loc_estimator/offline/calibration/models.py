"""Fit cameras, motion and a first noise to a recording, by batches of which ground truth may be a part."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.filter.models import RANGE
from swarm_loc_estimator.offline.batch.problem import (
    BatchProblem,
    all_changed,
    calibrated_parameters,
    problem_of,
    values_of,
)
from swarm_loc_estimator.offline.batch.solver import (
    ParameterPrior,
    Solution,
    Solver,
    placed,
    shared_by_places,
)
from swarm_loc_estimator.offline.batch.start import started_at
from swarm_loc_estimator.offline.calibration.motion import (
    WINDOW_S,
    Drive,
    Lateness,
    biased,
    drive_of,
    explained,
    fit_lateness,
    fit_response,
    windows,
)
from swarm_loc_estimator.offline.calibration.recording import (
    DENSE_GAP_NS,
    CalibrationError,
    Recording,
    rerun,
    started_at_truth,
)
from swarm_loc_estimator.offline.calibration.sightings import (
    MIN_SIGHTINGS,
    CameraFit,
    camera_fits,
    population,
    spread,
    with_scatter,
)
from swarm_loc_estimator.offline.recorded_bag import Progress, unwatched
from swarm_loc_estimator.swarm.error_models import MotionResponse, OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

EVALUATIONS = 80  # Runs of the estimator to fit the noise

_MIN_WINDOWS = 50
_ROUNDS, _ROUNDS_ALONE = 2, 5  # Of the batch, with and without ground truth
_SIGHTED = {
    True: ("range_sigma_per_m", "bearing_sigma"),
    False: ("forward_sigma", "left_sigma", "heading_sigma"),
}
"""Noise of ranges and bearings, and of poses, in which robots differ."""
_GOOD = 0.5  # Least weight of a sighting that counts
_MOVED_M = 0.02
_BIAS_ROUNDS = 3  # Of scale factors of motion, and turn biases
_SAMPLES = 60  # Windows of each robot, and sightings, whose variances by the batch are computed
_CORRELATION = 2.7  # Initial ratio of the white noise that represents correlated errors to their scatter
RUN_TICK_S = 0.5  # Of poses by the estimator that a fit uses
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

    drives: Mapping[int, Drive]  # Motion of the robots whose paths are known, by index
    late: Lateness  # Delay and lag
    response: MotionResponse | None  # Scale factors; None if only noise is fitted
    before: FloatArray  # (m, 2) errors of path [m] and turn [rad] of 5 s windows as reported
    after: FloatArray  # (m, 2) the same errors, calibrated
    doubt: FloatArray = field(default_factory=lambda: np.zeros(2))  # (2,) variances of the path itself there


@dataclass(frozen=True)
class FittedModels:
    """Calibrated models, and the noise to begin with."""

    swarm: Swarm  # Calibrated
    cameras: tuple[CameraFit, ...]  # Of all robots, ordered by type
    motion: tuple[DriveFit, ...]  # One per type
    remarks: tuple[str, ...]  # Parameters that could not be fitted, one sentence each
    noise: dict[str, float]  # First noise by name, from the scatter of sightings and of motion
    paths: Mapping[str, Trajectory]  # By which motion and noise were fitted


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
        for names in _SIGHTED.values()
        for name in sensor.keys() & set(names)
        if all(getattr(robot.sensor, name) > 0.0 for robot in swarm.robots)
    }
    robots = []
    for robot in swarm.robots:
        own = {name: sensor[name] * getattr(robot.sensor, name) / value for name, value in mean.items()}
        seen = replace(robot.sensor, **(sensor | {k: float(f"{v:.3g}") for k, v in own.items()}))
        robots.append(replace(robot, odometry=replace(robot.odometry, **odometry), sensor=seen))
    return replace(swarm, robots=tuple(robots))


def fixed_noise(swarm: Swarm) -> dict[str, float]:
    """Noise parameters that are not fitted, by name."""
    separation = max(robot.odometry.wheel_separation for robot in swarm.robots)
    return {**_FLOORS, "lateral_drift": float(f"{(_LATERAL_SLIP * separation) ** 2:.3g}")}


def fit_models(recording: Recording, swarm: Swarm, options: Options, progress: Progress) -> FittedModels:
    """Fit cameras, motion and first noise; with `plain` compute only the errors.

    Each round solves the recording as a batch, in which ground truth is one more measurement, and fits motion
    and noise to its paths. Without ground truth the noise follows from the batch's own residuals, so there
    are more rounds. Raises CalibrationError if too little is known about the poses of robots.
    """
    begin, truth = problem_of(recording, swarm, fixed=True), recording.truth
    if options.plain:
        return _fitted(recording, begin, begin, truth, options)
    if not truth and begin.sightings.size < MIN_SIGHTINGS:
        raise CalibrationError(
            f"recording '{recording.name}' holds {begin.sightings.size} sightings and ranges of robots that"
            f" drive; without ground truth {MIN_SIGHTINGS} are needed, of described landmarks or anchors, of"
            " other robots, or by described cameras."
        )
    current = started_at_truth(swarm, recording) if truth else swarm
    online = rerun(recording, current, RUN_TICK_S)
    known = {robot.name: online.track(index) for index, robot in enumerate(swarm.robots)} | dict(truth)
    seen, polar = begin.is_seen, begin.is_polar & begin.is_by_robot
    parameters = calibrated_parameters(
        polar=bool(polar.any()),
        poses=bool((seen & ~polar & begin.is_by_robot).any()),
        ranges=not seen.all(),
        truth=bool(truth),
    )
    mean, wide = values_of(swarm, parameters), np.array([one.sigma for one in parameters])
    sigma = np.tile(wide, (len(mean), 1))
    # motion but for its delay is fitted again in each round: a table of speeds takes its place
    is_delay = np.array([one.name == "delay_s" for one in parameters])
    is_fixed = np.array([not one.moves for one in parameters]) | is_delay
    rounds = _ROUNDS if truth else _ROUNDS_ALONE
    for number in range(rounds):
        progress(0.2 * number / rounds, f"models, round {number + 1} of {rounds}")
        # the batch, with parameters about those of the type
        about = np.where(is_fixed, np.nan_to_num(mean - values_of(current, parameters)), 0.0)
        prior = ParameterPrior(about, np.where(is_fixed, sigma, wide)) if number else None
        problem = problem_of(recording, current, parameters, truth, fixed=True)
        solution = Solver(problem, started_at(problem, known), prior).solve(unwatched)
        found = all_changed(current, parameters, np.round(solution.parameter, 5))
        typical, apart = _of_types(swarm, found, solution)
        # a robot that corrects its course by feedback seems to follow its wheels late: no recording is sure
        mean, sigma = np.where(is_delay, mean, typical), np.where(is_delay, sigma, apart)
        # motion and noise by its paths
        known = solution.paths()
        for name, one in truth.items():
            if one.stamp_ns.size > 1 and np.median(np.diff(one.stamp_ns)) <= DENSE_GAP_NS:
                known[name] = one
        paths = {name: one for name, one in known.items() if not truth or name in truth}
        known_by = problem_of(recording, found, fixed=True)
        models = _fitted(recording, begin, known_by, paths, options, solution)
        current = with_noise(models.swarm, {**fixed_noise(swarm), **models.noise})
    starts = [
        replace(one, start=old.start) for one, old in zip(models.swarm.robots, swarm.robots, strict=True)
    ]
    there = placed(solution, shared_by_places(solution))
    ids = {mark.id for mark in swarm.landmarks}
    found = replace(
        models.swarm,
        robots=tuple(starts),
        landmarks=tuple(mark for mark in there.landmarks if mark.id in ids),
        anchors=there.anchors,
        cameras=there.cameras,
        map_error=there.map_error,
    )
    return replace(models, swarm=found)


def _of_types(described: Swarm, found: Swarm, solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Mean (N, p) and standard deviation (N, p) of parameters by type, as priors of the next round."""
    parameters = solution.problem.parameters
    mean, old = values_of(found, parameters), values_of(described, parameters)
    sigma = np.tile(np.array([one.sigma for one in parameters]), (len(mean), 1))
    for name in dict.fromkeys(robot.type for robot in found.robots):
        rows = np.flatnonzero([robot.type == name and robot.camera is not None for robot in found.robots])
        if rows.size == 1:
            mean[rows] = old[rows]
        elif rows.size:
            typical, apart = population(mean[rows], solution.parameter_sigma[rows], sigma[0])
            mean[rows], sigma[rows] = typical, apart
    return mean, sigma


def _fitted(
    recording: Recording,
    begin: BatchProblem,
    found: BatchProblem,
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
            if solution is not None:
                robots[index] = _with_own_noise(robots[index], index, found, solution)
    if not motion and not any(fit.is_enough for fit in cameras):
        truth = "" if options.alone else "ground truth together with "
        raise CalibrationError(
            f"recording '{recording.name}' holds too little {truth}odometry or sightings; at least a minute"
            " of a moving robot that sees markers or is seen is needed."
        )
    swarm = replace(found.swarm, robots=tuple(robots))
    models = FittedModels(swarm, tuple(cameras), tuple(motion), tuple(remarks), {}, paths)
    noise = _first_noise(models, plain=options.plain)
    return replace(models, noise=noise if solution is None else _with_leverage(noise, solution))


def _with_leverage(noise: dict[str, float], solution: Solution) -> dict[str, float]:
    """Noise of sightings, whose errors by a path that follows them are too small by its own variance."""
    used, residual = np.flatnonzero(solution.used), solution.sightings[0]
    is_good = solution.weight[used] > _GOOD
    is_good &= (solution.problem.is_seen & solution.problem.is_by_robot)[used]
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
        drive = drive_of(track, swarm.robots[index].odometry, path)
        if windows(drive, WINDOW_S)[0].size >= _MIN_WINDOWS:
            drives[index] = drive
    if not drives:
        return None
    own, prompt = [*drives.values()], Lateness(0.0, 0.0)
    before = explained(own, prompt, None)
    if options.plain:
        return DriveFit(drives, prompt, None, before, before)
    # paths of the batch are as late as it has taken the wheels to be
    late = fit_lateness(own, 1.0) if options.alone else fit_lateness(own)
    for _ in range(_BIAS_ROUNDS):
        response = fit_response(own, late, table=options.response)
        own = [biased(drive, late, response) for drive in own]
    drives = dict(zip(drives, own, strict=True))
    return DriveFit(drives, late, response, before, explained(own, late, response))


def _doubt(solution: Solution, members: Sequence[int]) -> FloatArray:
    """Mean variances (2,) of path and turn over a window in which a robot moves, by the batch itself."""
    variances = solution.moved_variances(*np.concatenate([_moved(solution, one) for one in members], axis=1))
    return np.asarray(variances[:, [0, 2]].mean(axis=0)) if len(variances) else np.zeros(2)


def _moved(solution: Solution, robot: int) -> IntArray:
    """First and last knots (2, w) of some windows in which a robot moves."""
    knots = solution.problem.knots
    own = np.flatnonzero((knots.robot == robot) & (solution.column >= 0))
    end = np.searchsorted(knots.stamp_ns[own], knots.stamp_ns[own] + round(1e9 * WINDOW_S))
    begin = np.flatnonzero(end < own.size)
    late_ns = knots.stamp_ns[own[end[begin]]] - knots.stamp_ns[own[begin]] - round(1e9 * WINDOW_S)
    begin = begin[late_ns <= 2 * knots.step_ns]
    track = knots.sample.pose[own]
    moved = se2.between(track[begin], track[end[begin]])
    begin = begin[np.hypot(moved[:, 0], moved[:, 1]) > _MOVED_M]
    some = np.random.default_rng(robot).choice(begin, min(_SAMPLES, begin.size), replace=False)
    return np.stack([own[some], own[end[some]]])


def _with_own_noise(robot: Robot, index: int, found: BatchProblem, solution: Solution) -> Robot:
    """The robot with the noise of its gyroscope and its radio: residuals, and the variance of the batch."""
    first, last = _moved(solution, index)
    if robot.imu.is_used and first.size:
        knots = found.knots
        heading = solution.at(knots.robot, knots.stamp_ns)[:, 2] - knots.sample.pose[:, 2]
        missed = se2.wrap_angle(heading[last] - heading[first])
        variance = np.mean(missed**2 + solution.moved_variances(first, last)[:, 2])
        density = float(f"{math.sqrt(variance / WINDOW_S):.3g}")
        robot = replace(robot, imu=replace(robot.imu, turn_noise_density=density))
    used, some = np.flatnonzero(solution.used), solution.problem.sightings
    is_own = (some.observer[used] == index) & (some.model[used] == RANGE) & (solution.weight[used] > _GOOD)
    if is_own.sum() >= MIN_SIGHTINGS and robot.uwb is not None:
        rows = np.random.default_rng(0).choice(np.flatnonzero(is_own), _SAMPLES, replace=False)
        by_batch = float(np.median(solution.leverages(rows)[:, 0]))
        noise = np.median(some.covariance[used[is_own], 0, 0]) * (
            spread(solution.sightings[0][is_own, 0]) ** 2 + by_batch
        )
        sigma = float(f"{robot.uwb.range_scale * math.sqrt(noise):.3g}")
        robot = replace(robot, uwb=replace(robot.uwb, range_sigma=sigma))
    return robot


def _with_motion(robot: Robot, index: int, drive: DriveFit) -> Robot:
    late, response = drive.late, drive.response
    numbers = {
        "delay_s": round(late.delay_s, 4),
        "lag_s": round(late.lag_s, 4),
        "distance_scale": 1.0,
        "turn_scale": 1.0,
    }
    if index in drive.drives:
        bias = drive.drives[index].turn_bias
        numbers["turn_bias"] = round(float(bias[np.argmax(np.abs(bias))]), 5)
    if response is not None and len(response.speeds) == len(response.turn_rates) == 1:
        numbers["distance_scale"] = response.speed_share[0][0]
        numbers["turn_scale"] = response.turn_share[0][0]
        response = None
    return replace(robot, odometry=replace(robot.odometry, **numbers), response=response)


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
        begin |= {
            n: _CORRELATION * max(1e-4, spread(error[~polar, k])) for k, n in enumerate(_SIGHTED[False])
        }
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
            first, last = windows(drive, WINDOW_S)
            path += float(np.sum(np.abs(drive.path[last] - drive.path[first])))
            turn += float(np.sum(np.abs(drive.turn[last] - drive.turn[first])))
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
    names = ", ".join(swarm.robots[index].name for index in members)
    remarks = [
        f"{fit.robot.name} has too few sightings whose truth is known: it gets the mean of its type."
        for fit in fits
        if not fit.is_enough
    ]
    if fits and len(remarks) == len(fits):
        remarks.append(f"no camera of {names} could be calibrated: too few sightings whose truth is known.")
    if drive is None:
        remarks.append(f"the motion of {names} could not be calibrated: no path of theirs is known.")
    return remarks
