"""Smoothed poses of a recording: one batch of all measurements, of the past and the future.

Models and noise are those of the description, as in the filter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.offline.batch.lasting import with_lasting_errors
from swarm_loc_estimator.offline.batch.parameters import Parameter
from swarm_loc_estimator.offline.batch.problem import problem_of
from swarm_loc_estimator.offline.batch.solver import ParameterPrior, Solution, Solver
from swarm_loc_estimator.offline.batch.start import Start, on_paths
from swarm_loc_estimator.offline.calibration.recording import Recording, read_recording
from swarm_loc_estimator.offline.recorded_bag import Progress, unwatched
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimate import Status


class SmoothError(UserError):
    """A recording that cannot be smoothed."""


def smooth(
    bag: Path | str,
    online: ReplayResult,
    *,
    remap: Mapping[str, str] = MappingProxyType({}),
    progress: Progress = unwatched,
) -> ReplayResult:
    """Smooth a replay of a bag."""
    recording = read_recording(Path(bag), online.swarm, progress, remap)
    return smooth_recording(recording, online, progress)


def smooth_recording(
    recording: Recording, online: ReplayResult, progress: Progress = unwatched
) -> ReplayResult:
    """Smooth a replay of a recording, see `smooth`."""
    swarm = online.swarm
    parameters, sigma = described_sigmas(swarm)
    problem = problem_of(recording, swarm, parameters, is_described=True)
    paths = {robot.name: online.track(index) for index, robot in enumerate(swarm.robots)}
    places = [
        (one.x, one.y, one.yaw or 0.0) if isinstance(one, Landmark) else (0.0, 0.0, 0.0)
        for one in swarm.surveyed
    ]
    nowhere = np.full((len(swarm.robots), 3), np.nan)
    start = Start(nowhere, np.array(places).reshape(-1, 3), on_paths(problem, paths, nowhere))
    problem = with_lasting_errors(problem, start)
    prior = ParameterPrior(np.zeros_like(sigma), sigma)
    solution = Solver(problem, start, prior).solve(progress)
    robots = len(swarm.robots)
    who, when = np.tile(np.arange(robots), online.stamp_ns.size), np.repeat(online.stamp_ns, robots)
    poses = solution.at(who, when)
    covariances = covariances_at(solution, who, when, poses).reshape(-1, robots, 3, 3)
    poses = poses.reshape(-1, robots, 3)
    known: BoolArray = np.isfinite(poses[:, :, 0])
    return replace(
        online,
        poses=poses,
        covariances=covariances,
        status=np.where(known, Status.TRACKED, Status.WAITING).astype(np.uint8),
        heading_known=known,
    )


_FIXED = 1e-6  # Standard deviation of a parameter that is exact


def described_sigmas(swarm: Swarm) -> tuple[tuple[Parameter, ...], FloatArray]:
    """Parameters of which a description states standard deviations, and these (N, p)."""
    found, sigmas = [], []
    for section, name, of in _UNSURE:
        sigma = np.array([of(robot) for robot in swarm.robots])
        if sigma.any():
            found.append(Parameter(section, name, float(sigma.max())))
            sigmas.append(np.maximum(sigma, _FIXED))
    return tuple(found), np.array(sigmas).reshape(-1, len(swarm.robots)).T


_UNSURE: tuple[tuple[str, str, Callable[[Robot], float]], ...] = (
    ("odometry", "distance_scale", lambda one: one.odometry.distance_scale * one.odometry.distance_scale_sigma),
    ("odometry", "turn_scale", lambda one: one.odometry.turn_scale_sigma if not one.imu.is_used else 0.0),
    ("imu", "turn_scale", lambda one: one.imu.turn_scale_sigma if one.imu.is_used else 0.0),
    ("sensor", "distance_scale", lambda one: one.sensor.distance_scale_sigma if one.camera else 0.0),
    ("sensor", "range_offset", lambda one: one.sensor.range_offset_sigma if one.camera else 0.0),
    ("camera", "yaw", lambda one: one.camera.yaw_sigma if one.camera and not one.camera.yaw_time_s else 0.0),
)


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
