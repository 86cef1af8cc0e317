"""Calibrate a swarm from a recording with ground truth: cameras, motion, and the noise that remains.

The noise is fitted to held-out data: each half of the recording is run with the calibration from the other
half. So the covariances contain the errors of a calibration in other recordings. The cost is the error of
position and heading, with a penalty for the distance of the NEES from its aim. The filter's white noise
represents correlated errors, too, so the likelihood of the true poses does not work as a cost: a few periods
of correlated errors would increase the noise until measurements hardly count. Nor does the scatter of the
sightings, which gives standard deviations two to three times too small.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import UserError, number_specs
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, interpolate
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.batch.problem import calibrated_parameters, corrections, moved, problem_of
from swarm_loc_estimator.offline.batch.solver import Solver
from swarm_loc_estimator.offline.batch.start import started_at
from swarm_loc_estimator.offline.calibration.models import (
    RUN_TICK_S,
    FittedModels,
    Options,
    fit_models,
    fixed_noise,
    with_noise,
)
from swarm_loc_estimator.offline.calibration.recording import (
    CalibrationError,
    Recording,
    recording_of,
    rerun,
    started_at_truth,
)
from swarm_loc_estimator.offline.calibration.sightings import errors_of, spread
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.offline.recorded_bag import Progress, unwatched
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.inputs import MAX_PAUSE_NS, Batch
from swarm_loc_estimator.swarm.error_models import OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm

# Checked by make bench-mrclam: parameters are fitted to set 1 and measured on set 2.
TICK_S = 1.0  # Interval at which errors are computed
NEES_AIM = 1.7  # Target of the NEES, below 3 since errors in other recordings are larger
_HEADING_WEIGHT = 0.2
"""A heading error larger by a factor costs as much as a position error larger by its power of this."""


_SPACING_NS = 50_000_000  # Odometry is thinned out to this spacing for speed
_INCONSISTENCY = 0.2  # A NEES of half or twice its aim costs as much as 10 % more error
_LOSS = 5.0  # A hundredth of the poses missing costs as much as 5 % more error
_FORGETTING = 0.005  # Weight of the prior that parameters stay near where they began, per squared factor of e
_FIRST_STEP, _LAST_STEP = 0.7, 0.07  # Trust radii of the search, in logarithms of the noise
_BETTER = 0.97  # Scatter of held-out sightings that is asked of a fit without ground truth, per described one
_MISSED = 0.1  # Share of the poses that a description without ground truth may cost
_UNCHECKED = "The recording is too short to check the fit: half of it is too little to fit anything."
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
    gain: str = ""  # One sentence by how much they help there, without ground truth; else ""


def calibrate(recording: Recording, swarm: Swarm, options: Options, progress: Progress) -> Calibration:
    """Fit cameras, motion and noise to a recording with ground truth of at least one robot, or to itself.

    Without ground truth the paths of the batch take its place; where sightings of one half do not scatter
    less with what the other half tells, the description stays as it is. `swarm` is the description to begin
    with. `progress` is called now and then with the share done and what is being done.

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

    fixed = fixed_noise(swarm)
    found = begin if options.alone else fit_noise(folds, begin, fixed, options.evaluations, report)
    noise = {**fixed, **{name: float(f"{value:.3g}") for name, value in found.items()}}
    progress(0.96, "before and after")
    calibrated = with_noise(whole.swarm, noise)
    recording = replace(recording, truth=whole.paths) if options.alone else recording
    scores = [
        score([rerun(recording, started_at_truth(s, recording), RUN_TICK_S)]) for s in (swarm, calibrated)
    ]
    warning = gain = ""
    if not options.plain and not all(one.is_held_out for one in folds):
        warning = _UNCHECKED
    elif options.alone and not options.plain:
        warning, gain = _judged_alone(folds, swarm, noise, *(one.given for one in scores))
    elif not options.plain:
        warning = _warning(folds, swarm, noise)
    kept = swarm if options.alone and warning else calibrated
    return Calibration(kept, whole, noise, scores[0], scores[1], warning, gain)


def _warning(folds: Sequence[Fold], swarm: Swarm, noise: dict[str, float]) -> str:
    """A sentence if a half is not better with the models of the other half than with the description."""
    for fold in folds:
        described = started_at_truth(swarm, fold.recording)
        fitted_m, *described_m = (
            score([rerun(fold.recording, one, RUN_TICK_S)]).position_rmse
            for one in (with_noise(fold.swarm, noise), described, with_noise(described, noise))
        )
        if fitted_m >= min(described_m):
            return (
                "The recording is too short to fit, or the description was as good before: fitted to one"
                f" half, the position RMSE of the other half is {1e3 * fitted_m:.1f} mm, as described"
                f" {1e3 * min(described_m):.1f} mm."
            )
    return ""


def _judged_alone(
    folds: Sequence[Fold], swarm: Swarm, noise: dict[str, float], before: float, after: float
) -> tuple[str, str]:
    """A warning, and by how much sightings of a half scatter less with the models of the other half.

    Paths do not tell: those of the new description are as far off as it is. It must not cost poses, of which
    the estimator gave a share before and after.
    """
    worst = 0.0
    for fold in folds:
        fitted, described = (_scatter(fold, with_noise(one, noise)) for one in (fold.swarm, swarm))
        worst = max(worst, float(np.exp(np.mean(np.log(fitted / described)))))
    said = f"fitted to one half, sightings of the other half scatter {worst:.2f} times as much as with"
    if worst > _BETTER:
        kept = "The description is kept, since it was as good:"
        return f"{kept} {said} it, and {_BETTER} is asked.", ""
    if after < before - _MISSED:
        kept = f"The description is kept, since the estimator gives {before:.0%} of the poses with it,"
        return f"{kept} and {after:.0%} with the new one.", ""
    return "", f"Held-out check: {said} the old description."


def _scatter(fold: Fold, swarm: Swarm) -> FloatArray:
    """Scatter of sightings (two components) and of ranges about a batch of a part, by kind of sightings."""
    problem = problem_of(fold.recording, swarm, fixed=True)
    solution = Solver(problem, started_at(problem, fold.recording.truth)).solve(unwatched)
    error = errors_of(problem, solution.paths())
    known, seen, polar = np.isfinite(error[:, 0]), problem.is_seen, problem.is_polar
    kinds = [(known & polar, 2), (known & seen & ~polar, 2), (known & ~seen, 1)]
    return np.array([spread(error[rows, k]) for rows, count in kinds if rows.any() for k in range(count)])


def _folds(recording: Recording, swarm: Swarm, whole: FittedModels, options: Options) -> list[Fold]:
    """Halves of all bags with the models of the other halves; if these have too little, of the whole.

    Without ground truth each bag is judged by itself: none may lose by what the others tell.
    """
    if options.plain:
        return [Fold(recording, started_at_truth(whole.swarm, recording))]
    early, late = recording.halves_ns
    # robots begin the second half where nobody has described
    later = replace(swarm, robots=tuple(replace(one, start=None) for one in swarm.robots))
    folds = []
    for held, used, begin in ((early, late, later), (late, early, swarm)):
        try:
            models = fit_models(recording.between(*used), begin, options, unwatched)
        except CalibrationError:
            models = whole
        for spans in [[span] for span in held] if options.alone else [held]:
            run = recording.between(*spans)
            run = replace(run, truth=whole.paths) if options.alone else run
            folds.append(Fold(run, started_at_truth(models.swarm, run), models is not whole))
    return folds


def refined(parts: Sequence[Batch], swarm: Swarm, path: Path) -> tuple[bool, str]:
    """Fit a description to inputs of a run, and write it beside that of a path; whether so, and a text."""
    beside = path.with_suffix(f".refined{path.suffix}")
    try:
        done = calibrate(recording_of(path.name, parts, swarm), swarm, Options(alone=True), unwatched)
        if done.warning:
            return False, done.warning
        save_swarm(done.swarm, beside, f"Proposed in place of {path.name} by the first minutes of a run.")
    except UserError as error:
        return False, f"Nothing is refined: {error}"
    parameters = calibrated_parameters(polar=True, poses=True, ranges=True, truth=False)
    changes = corrections(swarm, done.swarm, parameters)
    robots = zip(swarm.robots, done.swarm.robots, strict=True)
    tables = [new.name for old, new in robots if old.response != new.response]
    changes += [f"Other scale factors by speed: {', '.join(tables)}."] if tables else []
    first = f"{beside} is proposed in place of {path.name}, which stays in use."
    return True, "\n".join([first, done.gain, *changes, *moved(swarm, done.swarm)])
