"""Smoothed poses of a recording: one batch of all measurements, of the past and the future.

Models and noise are those of the description, as in the filter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.filter.correlated_noise import LENGTH_M, RADIO_LENGTH_M, REPEATED
from swarm_loc_estimator.filter.measurements import Measurements
from swarm_loc_estimator.filter.models import POLAR, is_compiled, predict_any
from swarm_loc_estimator.filter.prediction import GROWTH
from swarm_loc_estimator.filter.sources import CORRELATION_NS, LEAST_SHARE
from swarm_loc_estimator.offline.batch.problem import BatchProblem, Knots, Parameter, opened, problem_of
from swarm_loc_estimator.offline.batch.solver import ParameterPrior, Solution, Solver
from swarm_loc_estimator.offline.batch.start import Start, on_paths
from swarm_loc_estimator.offline.calibration.recording import Recording, read_recording
from swarm_loc_estimator.offline.recorded_bag import Progress, unwatched
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.inputs import kinds
from swarm_loc_estimator.swarm.calibration_states import (
    CAMERA_OFFSET,
    CAMERA_SCALE,
    CAMERA_YAW,
    DISTANCE_SCALE,
    TURN_SCALE,
    ParameterTable,
)
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimate import Status

MAX_STEP_S, MAX_SIZE = 3.0, 1_000_000  # Longest time between two knots, and most knots times robots
_FIXED = 1e-6  # Standard deviation of a parameter that is exact
_CONTRADICTED = 0.5  # Weight below which the batch contradicts a measurement
_CONTRADICTING = 0.15  # Share of the measurements of a robot or camera from which they contradict the others
_USED = {"odometry", "imu", "detections", "fixes", "ranges"}  # Sensors
_WITHOUT_FRAME = "it has no start, landmark or fix, so its poses are relative to a robot"


class SmoothError(UserError):
    """A recording that cannot be smoothed."""

    def __init__(self, recording: str, why: str) -> None:
        super().__init__(f"'{recording}' cannot be smoothed: {why}.")


def smooth(
    bag: Path | str,
    online: ReplayResult,
    *,
    remap: Mapping[str, str] = MappingProxyType({}),
    progress: Progress = unwatched,
) -> ReplayResult:
    """Estimate all poses of a replay again, each from the whole bag, past and future.

    Args:
        bag: The bag of the replay: rosbag2 folder, .mcap or .db3 file.
        online: Its result, where the batch begins; the smoothed poses are at its instants.
        remap: As for `replay`.
        progress: Called now and then with the share done and what is being done.

    Returns:
        The result with smoothed poses and their covariances. Robots are TRACKED while they have odometry and
        were measured, also before they were located online.

    Raises:
        BagError: Nothing in the bag can be read, or a topic cannot be mapped.
        SmoothError: Nothing ties the poses to `map`, the bag is too large, robots have infrared boards or
            lidars or are seen from above, or measurements contradict each other.
    """
    received = (kind for kind in kinds().values() if online.counters.get(f"messages on {kind.pattern}"))
    if lacked := {kind.rows for kind in received} - _USED:
        raise SmoothError(online.title, f"the batch does not use its {listed(sorted(lacked))}")
    recording = read_recording(Path(bag), online.swarm, progress, remap)
    return smooth_recording(recording, online, progress)


def smooth_recording(
    recording: Recording, online: ReplayResult, progress: Progress = unwatched
) -> ReplayResult:
    """Estimate all poses of a run over a recording again, see `smooth`."""
    # the problem, as described and with landmarks opened by contradictions, begun at the online poses
    if not recording.odometry.robot.size:
        raise SmoothError(recording.name, "it has no odometry")
    if online.is_local.any():
        raise SmoothError(recording.name, _WITHOUT_FRAME)
    swarm = _opened(online)
    parameters, sigma = _unsure(swarm, online.self_calibrated or swarm)
    problem = problem_of(recording, swarm, parameters, is_described=True)
    knots = problem.knots
    if knots.step_ns > MAX_STEP_S * 1e9 or knots.robot.size * len(swarm.robots) > MAX_SIZE:
        raise SmoothError(recording.name, "it is too large; cut it, or leave robots out")
    paths = {robot.name: online.track(index) for index, robot in enumerate(swarm.robots)}
    places = [(one.x, one.y, one.yaw or 0.0) for one in swarm.landmarks]
    places += [(0.0, 0.0, 0.0)] * (len(swarm.surveyed) - len(places))
    nowhere = np.full((len(swarm.robots), 3), np.nan)
    knot = on_paths(problem, paths, nowhere)
    if not np.isfinite(knot).any():
        raise SmoothError(recording.name, "no robot was located online")
    start = Start(nowhere, np.array(places).reshape(-1, 3), knot)
    problem = counted_once(problem)
    # the solution
    prior = ParameterPrior(np.zeros_like(sigma), sigma)
    solver = Solver(problem, start, prior)
    solution = solver.solve(progress)
    # unless it contradicts much of a source
    sources = problem.sightings.received_from
    for index, source in enumerate(swarm.sources):
        own = solution.weight[(sources == index) & solution.used]
        wrong = float(np.mean(own < _CONTRADICTED)) if own.size else 0.0
        if wrong > _CONTRADICTING:
            raise SmoothError(
                recording.name, f"{wrong:.0%} of the measurements of {source.name} contradict the others"
            )
    lasting = with_lasting_errors(problem, solution.knot, solution.landmark)
    return _result(online, solver.with_noise_of(lasting))


def _result(online: ReplayResult, solution: Solution) -> ReplayResult:
    """The online result with the smoothed poses at its instants."""
    robots = len(online.swarm.robots)
    who, when = np.tile(np.arange(robots), online.stamp_ns.size), np.repeat(online.stamp_ns, robots)
    poses = solution.at(who, when)
    covariances = covariances_at(solution, who, when, poses) + _of_fixes(solution, who, when)
    poses, covariances = poses.reshape(-1, robots, 3), covariances.reshape(-1, robots, 3, 3)
    known: BoolArray = np.isfinite(poses[:, :, 0])
    return replace(
        online,
        poses=poses,
        covariances=covariances,
        status=np.where(known, Status.TRACKED, Status.WAITING).astype(np.uint8),
        heading_known=known,
        self_calibrated=None,
        sightings=(),
        losses=(),
    )


def _opened(online: ReplayResult) -> Swarm:
    """The description, with standard deviations of landmarks that a contradiction has opened.

    The batch does not estimate biases of robots' radios: they are those found online.
    """
    learned = online.self_calibrated or online.swarm
    marks = tuple(
        opened(mark) if now.is_estimated else mark
        for mark, now in zip(online.swarm.landmarks, learned.landmarks, strict=True)
    )
    robots = zip(online.swarm.robots, learned.robots, strict=True)
    return replace(
        online.swarm, robots=tuple(replace(one, uwb=now.uwb) for one, now in robots), landmarks=marks
    )


def _unsure(swarm: Swarm, learned: Swarm) -> tuple[tuple[Parameter, ...], FloatArray]:
    """Constant parameters that were estimated online, and their standard deviations before (N, p)."""
    table, found, sigmas = ParameterTable.of(swarm.robots), [], []
    for section, name, which in _CONSTANT:
        sigma = np.full(len(swarm.robots), _FIXED)
        for index, (robot, now) in enumerate(zip(swarm.robots, learned.robots, strict=True)):
            holder = getattr(now, section)
            is_own = holder is not None and (name != "turn_scale" or holder is now.turn_sensor)
            drifts = table.column[index, which] >= 0 and np.isfinite(table.time_s[index, which])
            if is_own and not drifts and getattr(holder, f"{name}_sigma") > 0.0:
                scale = (
                    1.0 if which in {CAMERA_YAW, CAMERA_OFFSET} else getattr(getattr(robot, section), name)
                )
                sigma[index] = abs(scale) * table.sigma[index, which]
        if np.any(sigma > _FIXED):
            found.append(Parameter(section, name, float(sigma.max())))
            sigmas.append(sigma)
    return tuple(found), np.array(sigmas).reshape(-1, len(swarm.robots)).T


_CONSTANT = (
    ("odometry", "distance_scale", DISTANCE_SCALE),
    ("odometry", "turn_scale", TURN_SCALE),
    ("imu", "turn_scale", TURN_SCALE),
    ("sensor", "distance_scale", CAMERA_SCALE),
    ("sensor", "range_offset", CAMERA_OFFSET),
    ("camera", "yaw", CAMERA_YAW),
)
"""Section and name of a parameter, and which self-calibration state it is."""


def _of_fixes(solution: Solution, robots: IntArray, stamps_ns: IntArray) -> FloatArray:
    """Covariances (k, 3, 3) of errors that fixes of a robot share, of the next fix of robots at instants."""
    some, found = solution.problem.sightings, np.zeros((robots.size, 3, 3))
    lasting = (some.observer < 0) & (some.mount < 0) & (some.systematic_share[:, 0] > 0.0)
    for robot in np.unique(some.target[lasting]).tolist():
        own = np.flatnonzero(lasting & (some.target == robot) & solution.used)
        own, rows = own[np.argsort(some.stamp_ns[own])], np.flatnonzero(robots == robot)
        following = own[np.searchsorted(some.stamp_ns[own], stamps_ns[rows]).clip(max=own.size - 1)]
        share = np.where(some.has_heading[following], some.systematic_share[following, 0], 0.0)
        found[rows] = share[:, None, None] * some.covariance[following]
    return found


def covariances_at(
    solution: Solution, robots: IntArray, stamps_ns: IntArray, poses: FloatArray
) -> FloatArray:
    """Covariances (k, 3, 3) of x, y, theta of poses (k, 3) by `Solution.at`; NaN where these are.

    Errors are those of the knots before and after, between which the robot has slipped, too.
    """
    problem, found = solution.problem, np.full((robots.size, 3, 3), np.nan)
    inverse, knots = solution.factor.inverse_band(), problem.knots
    for robot in np.unique(robots).tolist():
        own = np.flatnonzero((knots.robot == robot) & (solution.column >= 0))
        rows = np.flatnonzero((robots == robot) & np.isfinite(poses[:, 0]))
        if not rows.size:
            continue
        stamps = knots.stamp_ns[own]
        before = np.clip(np.searchsorted(stamps, stamps_ns[rows], side="right") - 1, 0, own.size - 2)
        share = (stamps_ns[rows] - stamps[before]) / (stamps[before + 1] - stamps[before])
        a, b = own[before], own[before + 1]
        weight = np.stack([1.0 - share, share])
        total = np.zeros((rows.size, 3, 3))
        for i, first in enumerate((a, b)):
            for j, last in enumerate((a, b)):
                row = solution.column[first][:, None, None] + np.arange(3)[:, None]
                column = solution.column[last][:, None, None] + np.arange(3)
                block = inverse[np.abs(row - column), np.minimum(row, column)]
                total += (weight[i] * weight[j])[:, None, None] * block
        slip = knots.sample.covariance[b] - knots.sample.covariance[a]
        turn = se2.adjoint(solution.knot[a])
        total += (share * (1.0 - share))[:, None, None] * (turn @ slip @ turn.transpose(0, 2, 1))
        found[rows] = se2.pose_covariance(poses[rows], total)
    return found


def counted_once(problem: BatchProblem) -> BatchProblem:
    """The problem in which measurements of a link within their correlation time count as one.

    Wheels are the less sure the longer nothing has measured their robot, lest the batch contradicts what does
    so at last.
    """
    sightings = problem.sightings
    order, same = _links(sightings)
    share = np.empty(sightings.size)
    share[order] = _shares(sightings, order, same)
    covariance = sightings.covariance / share[:, None, None]
    return replace(problem, sightings=sightings._replace(covariance=covariance), knots=_unmeasured(problem))


def with_lasting_errors(problem: BatchProblem, knot: FloatArray, place: FloatArray) -> BatchProblem:
    """The problem with the noise of errors that last, about knots (k, 3) and places (S, 3)."""
    some, rows = problem.sightings, np.arange(problem.sightings.size)
    # how far each end of a link has moved, as the other sees it
    poses = problem.poses(rows, knot, place, problem.tracks)
    predicted, *_ = predict_any(some, poses[0], poses[1], np.zeros((some.size, 3)))
    seen, polar = predicted[:, :2].copy(), some.model == POLAR
    cos, sin = np.cos(predicted[polar, 1]), np.sin(predicted[polar, 1])
    seen[polar] = predicted[polar, :1] * np.column_stack([cos, sin])
    order, same = _links(some)
    a, b = order[:-1], order[1:]
    moved = np.hypot(*(seen[b] - seen[a]).T) / np.where(is_compiled(some.model[b]), LENGTH_M, RADIO_LENGTH_M)
    same &= ((some.observer[b] >= 0) | (some.mount[b] >= 0)) & np.isfinite(moved)  # no fixes
    kept = np.where(same, np.exp(-np.where(same, moved, 0.0)), 0.0).tolist()
    # sums of all that have the same error, before and after
    own = _shares(some, order, same)
    before, after = own.copy(), own.copy()
    for k, left in enumerate(kept):
        before[k + 1] += left * before[k]
    for k in range(len(kept) - 1, -1, -1):
        after[k] += kept[k] * after[k + 1]
    factor = np.empty(some.size)
    factor[order] = 1.0 + REPEATED * (before + after - own - 1.0).clip(min=0.0)
    covariance = some.covariance * factor[:, None, None]
    return replace(problem, sightings=some._replace(covariance=covariance))


def _links(some: Measurements) -> tuple[IntArray, BoolArray]:
    """Order (m,) of measurements, link by link, and whether each (m - 1,) but the first continues a link."""
    columns = (some.received_from, some.observer, some.target, some.landmark, some.mount, some.model)
    _, link = np.unique(np.stack([*columns, some.reading]), axis=1, return_inverse=True)
    order = np.lexsort((some.stamp_ns, link.ravel()))
    return order, np.asarray(np.diff(link.ravel()[order]) == 0)


def _shares(some: Measurements, order: IntArray, same: BoolArray) -> FloatArray:
    """By how much measurements (m,) in their order count, see `share_of` of `filter/sources.py`."""
    a, b = order[:-1], order[1:]
    since_ns = some.stamp_ns[b] - some.stamp_ns[a]
    is_fix = (some.observer[b] < 0) & (some.mount[b] < 0)
    share = np.clip(since_ns / CORRELATION_NS, LEAST_SHARE, 1.0)
    share[(since_ns == 0) & ~is_fix] = 1.0
    share[~is_compiled(some.model[b]) & (some.value[a, 0] == some.value[b, 0])] = LEAST_SHARE
    return np.concatenate([np.ones(min(1, order.size)), np.where(same, share, 1.0)])


def _unmeasured(problem: BatchProblem) -> Knots:
    """Knots with noise of wheels that grows with the time to the nearest measurement of the robot."""
    knots = problem.knots
    covariance = knots.sample.covariance.copy()
    for robot in np.unique(knots.robot).tolist():
        own = np.flatnonzero(knots.robot == robot)
        some, at_ns = problem.sightings, knots.stamp_ns[own]
        if own.size < 2 or problem.swarm.robots[robot].stands:
            continue
        seen = np.sort(some.stamp_ns[(some.observer == robot) | (some.target == robot)])
        middle_ns = at_ns[:-1] + np.diff(at_ns) // 2
        place = np.searchsorted(seen, middle_ns)
        far = np.append(np.append(-np.inf, seen.astype(float)), np.inf)
        apart_s = 1e-9 * np.minimum(middle_ns - far[place], far[place + 1] - middle_ns)
        growth = 1.0 + GROWTH * np.where(np.isfinite(apart_s), apart_s, 0.0)
        steps = np.diff(covariance[own], axis=0) * growth[:, None, None]
        covariance[own[1:]] = covariance[own[0]] + np.cumsum(steps, axis=0)
    return replace(knots, sample=knots.sample._replace(covariance=covariance))
