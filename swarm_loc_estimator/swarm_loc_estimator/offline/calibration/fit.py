"""Calibrate a swarm from a recording with ground truth: cameras, motion, and the noise that remains.

The noise is fitted to held-out data: each half of the recording is run with the calibration from the other
half. So the covariances contain the errors of a calibration in other recordings.

Scatter of a calibrated camera's sightings: noise of each robot's own, and sway of its camera.

Bearing errors that all markers share at one time are errors of the camera's yaw: the mount sways, or the
robot leans. They last for seconds, so a filter that takes them for noise of single sightings is too sure.
Their covariance over the time between two sightings of different markers gives their standard deviation and
time constant, those of a first-order Gauss-Markov process. What remains is noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import least_squares

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.offline.calibration.camera import CameraFit, fit_cameras
from swarm_loc_estimator.offline.calibration.motion import (
    WINDOW_S,
    Drive,
    Lateness,
    explained,
    fit_lateness,
    fit_offsets,
    fit_response,
    steps_of,
    true_motion,
    windows,
)
from swarm_loc_estimator.offline.calibration.noise import (
    Fold,
    Score,
    fit_noise,
    score,
    with_noise,
)
from swarm_loc_estimator.offline.calibration.recording import (
    CalibrationError,
    Recording,
    rerun,
    started_at_truth,
)
from swarm_loc_estimator.offline.calibration.robust import spread
from swarm_loc_estimator.offline.recorded_bag import Progress, unwatched
from swarm_loc_estimator.sensors.ingest import MAX_PAUSE_NS
from swarm_loc_estimator.swarm.error_models import MotionResponse, OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

_EDGES_S = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0])  # Bins of the time between two sightings
_MIN_PAIRS = 30
_MAX_STEPS = 60  # Sightings after each one that are compared with it
_CUT = 4.0  # Errors are cut at this many spreads, so that outliers have no weight
_MIN_SHARE = 0.05  # Smallest share of the variance of bearings that counts as sway
_TIMES_S = (1.0, 60.0)  # Smallest and largest time constant
_MIN_SIGHTINGS = 100


def with_scatter(fits: Sequence[CameraFit]) -> list[Robot]:
    """Calibrated robots of one type with the noise of their own sightings and the sway of their own cameras.

    Robots with few sightings get the median of the others. The noise is that of single sightings; `fit_noise`
    scales it for all robots together.
    """
    found = {fit.robot.name: _numbers(fit) for fit in fits if fit.after.shape[0] >= _MIN_SIGHTINGS}
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
    polar, value = fit.sightings.polar, fit.sightings.value
    far = np.maximum(value[:, 0], 0.1)
    bearing = np.where(polar, fit.after[:, 1], fit.after[:, 1] / far)
    seconds = np.multiply(fit.sightings.stamp_ns, 1e-9, dtype=float)
    sway, time_s = sway_of(seconds, fit.sightings.marker_id, bearing)
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
    """Standard deviation [rad] and time constant [s] of bearing errors that different markers share.

    Args:
        time_s: (m,) of the sightings.
        marker: (m,) their marker ids.
        bearing: (m,) their bearing errors.

    Returns:
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
    """What is fitted."""

    plain: bool = False  # Whether only noise is fitted
    # Whether a table of scale factors may be fitted, else one of speed and one of turn rate
    response: bool = True
    evaluations: int = EVALUATIONS  # Limit of runs of the estimator to fit the noise


@dataclass(frozen=True)
class DriveFit:
    """Calibrated motion of a type of robot."""

    members: tuple[int, ...]  # Indices of its robots
    drives: tuple[Drive, ...]  # Motion of the robots with dense ground truth
    late: Lateness  # Delay and lag
    response: MotionResponse | None  # Scale factors; None if only noise is fitted
    before: FloatArray  # (m, 2) errors of path [m] and turn [rad] of 5 s windows as reported
    after: FloatArray  # (m, 2) the same errors, calibrated


@dataclass(frozen=True)
class FittedModels:
    """Calibrated models, without noise."""

    swarm: Swarm  # Calibrated
    cameras: tuple[CameraFit, ...]  # Of all robots, ordered by type
    motion: tuple[DriveFit, ...]  # One per type
    remarks: tuple[str, ...]  # Parameters that could not be fitted, one sentence each


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration."""

    swarm: Swarm  # Calibrated, with unchanged starts
    models: FittedModels  # The fits behind it
    noise: dict[str, float] = field(default_factory=dict)  # Fitted noise parameters by name
    before: Score | None = None  # Score of the estimator on the recording, started at the true poses
    after: Score | None = None  # The same, calibrated
    # One sentence if the models do not help in a part that they were not fitted to; else ""
    warning: str = ""


def calibrate(recording: Recording, swarm: Swarm, options: Options, progress: Progress) -> Calibration:
    """Fit cameras, motion and noise.

    Args:
        recording: With ground truth of at least one robot.
        swarm: The description to begin with.
        options: What is fitted.
        progress: Called now and then with the share done and what is being done.

    Raises:
        CalibrationError: There is no or too little ground truth, or the clock of the recording jumps.
    """
    if not recording.truth:
        raise CalibrationError(
            f"recording '{recording.name}' holds no <robot>/ground_truth; a calibration needs it."
        )
    if recording.longest_pause_ns > MAX_PAUSE_NS:
        raise CalibrationError(
            f"recording '{recording.name}' has a jump of {recording.longest_pause_ns / 3.6e12:.0f} h"
            " in its times; calibrate from a part without it."
        )
    whole = fit_models(recording, swarm, options, progress)
    folds = _folds(recording, swarm, whole, options)
    begin = _first_noise(whole, plain=options.plain)

    def report(count: int, found: Score) -> None:
        rmse_mm = 1e3 * found.position_rmse
        share = 0.2 + 0.75 * min(1.0, count / options.evaluations)
        progress(share, f"noise, run {count}: {rmse_mm:.1f} mm, NEES {found.nees:.2f}")

    separation = max(robot.odometry.wheel_separation for robot in swarm.robots)
    fixed = {**_FLOORS, "lateral_drift": float(f"{(_LATERAL_SLIP * separation) ** 2:.3g}")}
    noise = {**fixed, **fit_noise(folds, begin, fixed, options.evaluations, report)}
    progress(0.96, "before and after")
    calibrated = with_noise(whole.swarm, noise)
    scores = [score([rerun(recording, started_at_truth(s, recording), _TICK_S)]) for s in (swarm, calibrated)]
    warning = "" if options.plain else _warning(folds, swarm, noise)
    return Calibration(calibrated, whole, noise, scores[0], scores[1], warning)


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
    """Fit cameras and motion type by type; with `plain` only compute the errors.

    Raises:
        CalibrationError: There is too little ground truth.
    """
    robots = list(swarm.robots)
    cameras: list[CameraFit] = []
    motion: list[DriveFit] = []
    remarks: list[str] = []
    types = list(dict.fromkeys(robot.type for robot in robots))
    for number, name in enumerate(types):
        members = [index for index, robot in enumerate(swarm.robots) if robot.type == name]
        progress(0.1 * number / len(types), f"cameras of type '{name}'")
        fits = fit_cameras(recording, swarm, members)
        cameras += fits
        progress(0.1 * (number + 0.5) / len(types), f"motion of type '{name}'")
        drive = _fit_drive(recording, swarm, members, options)
        motion += [] if drive is None else [drive]
        remarks += _remarks(swarm, members, fits, drive)
        if options.plain:
            continue
        sensed = {robot.name: robot for robot in with_scatter(fits)}
        for index in members:
            seen = sensed.get(robots[index].name, robots[index])
            robots[index] = seen if drive is None else _with_motion(seen, drive)
        moved = fit_offsets(recording, replace(swarm, robots=tuple(robots)), members) if drive else {}
        for index, robot in moved.items():
            robots[index] = robot
    if not motion and not any(fit.count for fit in cameras):
        raise CalibrationError(
            f"recording '{recording.name}' holds too little ground truth together with odometry or sightings;"
            " at least a minute of a moving robot that sees markers is needed."
        )
    return FittedModels(replace(swarm, robots=tuple(robots)), tuple(cameras), tuple(motion), tuple(remarks))


def _fit_drive(
    recording: Recording, swarm: Swarm, members: Sequence[int], options: Options
) -> DriveFit | None:
    """Fit the motion of a type; None without a robot with dense ground truth."""
    drives = []
    for index in members:
        track, truth = recording.track(index), recording.truth.get(swarm.robots[index].name)
        if truth is None or track.stamp_ns.size < 2:
            continue
        begin_ns, end_ns = int(track.stamp_ns[0]), int(track.stamp_ns[-1])
        drive = Drive(steps_of(track, swarm.robots[index].odometry), true_motion(truth, begin_ns, end_ns))
        if windows(drive.motion, WINDOW_S)[0].size >= _MIN_WINDOWS:
            drives.append(drive)
    if not drives:
        return None
    prompt = Lateness(0.0, 0.0)
    before = explained(drives, prompt, None)
    if options.plain:
        return DriveFit(tuple(members), tuple(drives), prompt, None, before, before)
    late = fit_lateness(drives)
    response = fit_response(drives, late, table=options.response)
    return DriveFit(tuple(members), tuple(drives), late, response, before, explained(drives, late, response))


def _with_motion(robot: Robot, drive: DriveFit) -> Robot:
    """The robot with the delay, lag and scale factors of its type."""
    late, response = drive.late, drive.response
    numbers = {
        "delay_s": round(late.delay_s, 4),
        "lag_s": round(late.lag_s, 4),
        "distance_scale": 1.0,
        "turn_scale": 1.0,
    }
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
    for run, fitted in ((halves[0], halves[1]), (halves[1], halves[0])):
        try:
            models = fit_models(fitted, swarm, options, unwatched)
        except CalibrationError:
            models = whole
        folds.append(Fold(run, started_at_truth(models.swarm, run), models is not whole))
    return folds


def _first_noise(models: FittedModels, *, plain: bool) -> dict[str, float]:
    """Initial noise parameters, from the scatter of sightings and the errors of motion windows."""
    polar = np.concatenate([fit.sightings.polar for fit in models.cameras] or [np.zeros(0, dtype=bool)])
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
        for drive in fit.drives:
            first, last = windows(drive.motion, WINDOW_S)
            path += float(np.sum(np.abs(drive.motion.path[last] - drive.motion.path[first])))
            turn += float(np.sum(np.abs(drive.motion.turn[last] - drive.motion.turn[first])))
            seconds += WINDOW_S * first.size
        path2 += float(np.sum(fit.after[:, 0] ** 2))
        turn2 += float(np.sum(fit.after[:, 1] ** 2))
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
    poor = [fit.robot.name for fit in fits if not fit.count]
    remarks = [
        f"{name} has too few sightings with ground truth: it gets the mean of its type." for name in poor
    ]
    if not fits and any(swarm.robots[index].camera is not None for index in members):
        names = ", ".join(swarm.robots[index].name for index in members)
        remarks.append(f"no camera of {names} could be calibrated: too few sightings with ground truth.")
    if drive is None:
        names = ", ".join(swarm.robots[index].name for index in members)
        remarks.append(f"the motion of {names} could not be calibrated: none has dense ground truth.")
    return remarks
