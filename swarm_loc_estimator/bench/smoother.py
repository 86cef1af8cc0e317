"""The offline limit: gtsam's batch solution of a recording with the estimator's own models and noise.

A filter knows the past, a smoother also the future: no online estimate can be as good. Each robot has a pose
at every stamp at which it sees or is seen, and at every whole half second, where the result is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.calibration.recording import Recording
from swarm_loc_estimator.core import se2
from swarm_loc_estimator.core.measurements import (
    MeasurementArray,
    MeasurementColumns,
    innovation,
    predict_one,
)
from swarm_loc_estimator.core.metrics import DEFAULT_GAP_NS, Track, interpolate
from swarm_loc_estimator.core.odometry import OdometryTracks
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.sightings import SightingConverter
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.replay_result import ReplayResult

PERIOD_NS = 500_000_000

_FLOOR = np.diag([1e-10, 1e-10, 1e-10])
"""A robot that stands gathers no noise; a factor needs some."""
_BEND = 3.0
"""From this many sigmas on a sighting counts less and less (Cauchy), where the filter has its gate."""
_NEES_POSES = 150
"""Marginal covariances are slow; the NEES is taken over about so many poses of each robot."""

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class SmootherErrors:
    """Errors of the batch solution where ground truth is known.

    Attributes:
        position: (m,) [m].
        heading: (m,) [rad].
        nees: (k,) of some of the poses.
    """

    position: FloatArray
    heading: FloatArray
    nees: FloatArray


@dataclass(frozen=True)
class _Nodes:
    """The poses to solve for; the position in these arrays is the key.

    Attributes:
        stamps_ns: Per robot, ascending.
        first: (N,) key of each robot's first pose.
        initial: (V, 3) where to begin.
    """

    stamps_ns: list[IntArray]
    first: IntArray
    initial: FloatArray

    def keys(self, robots: IntArray, stamps_ns: IntArray) -> IntArray:
        """The keys (m,) of poses that exist; -1 for nobody."""
        keys = np.full(robots.size, -1)
        for robot, stamps in enumerate(self.stamps_ns):
            rows = robots == robot
            keys[rows] = self.first[robot] + np.searchsorted(stamps, stamps_ns[rows])
        return keys


def smooth(recording: Recording, online: ReplayResult) -> SmootherErrors:
    """Solve a whole recording.

    Args:
        recording: What was reported and seen, and the truth to compare with.
        online: What the estimator made of it; its swarm has the models, its poses are where to begin.
    """
    swarm = online.swarm
    tracks, measured = _tracks(recording, swarm), _measurements(recording, swarm)
    estimates = [online.track(index) for index in range(len(swarm.robots))]
    measured = measured[_within(measured, estimates)]
    nodes = _nodes(tracks, estimates, measured)
    graph = gtsam.NonlinearFactorGraph()
    _add_motion(graph, swarm, tracks, nodes)
    _add_sightings(graph, measured, nodes)
    values = gtsam.Values()
    for key, pose in enumerate(nodes.initial.tolist()):
        values.insert(key, gtsam.Pose2(*pose))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-3)
    parameters.setMaxIterations(25)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return _errors(recording, swarm, nodes, solution, gtsam.Marginals(graph, solution))


def _tracks(recording: Recording, swarm: Swarm) -> OdometryTracks:
    """All odometry as the estimator reads it."""
    tracks = OdometryTracks(swarm.robots)
    rows = recording.odometry
    tracks.extend(rows.robot, rows.stamp_ns, np.array(rows.data, dtype=float))
    return tracks


def _measurements(recording: Recording, swarm: Swarm) -> MeasurementArray:
    """All sightings as the estimator reads them."""
    rows = recording.detections
    found: list[Any] = [*rows.data]
    counts = [len(one) for one in found]
    conversion = SightingConverter(swarm).convert(
        np.repeat(rows.robot, counts), np.repeat(rows.stamp_ns, counts), np.concatenate(found)
    )
    return conversion.measurements


def _within(measured: MeasurementArray, estimates: list[Track]) -> NDArray[np.bool_]:
    """Which measurements (m,) were taken while the online estimate knew both robots."""
    inside = np.ones(measured.size, dtype=bool)
    for name in ("observer", "target"):
        for robot, track in enumerate(estimates):
            rows = measured[name] == robot
            stamps = measured["stamp_ns"][rows]
            first_ns, last_ns = (track.stamp_ns[0], track.stamp_ns[-1]) if track.stamp_ns.size else (1, 0)
            inside[rows] &= (stamps >= first_ns) & (stamps <= last_ns)
    return inside


def _nodes(tracks: OdometryTracks, estimates: list[Track], measured: MeasurementArray) -> _Nodes:
    """A pose of each robot at every stamp that matters, at first by odometry from the last online one."""
    stamps_ns, initial = [], []
    for robot, track in enumerate(estimates):
        if not track.stamp_ns.size:
            stamps_ns.append(np.zeros(0, dtype=np.int64))
            continue
        first_ns, last_ns = int(track.stamp_ns[0]), int(track.stamp_ns[-1])
        grid = np.arange(-(-first_ns // PERIOD_NS) * PERIOD_NS, last_ns + 1, PERIOD_NS)
        seen = [measured["stamp_ns"][measured[name] == robot] for name in ("observer", "target")]
        stamps = np.unique(np.concatenate([[first_ns], grid, *seen]))
        before = np.searchsorted(track.stamp_ns, stamps, side="right") - 1
        who = np.full(stamps.size, robot)
        moved = se2.between(tracks.at(who, track.stamp_ns[before]).pose, tracks.at(who, stamps).pose)
        stamps_ns.append(stamps)
        initial.append(se2.compose(track.pose[before], moved))
    sizes = np.array([stamps.size for stamps in stamps_ns])
    return _Nodes(stamps_ns, np.cumsum(sizes) - sizes, np.concatenate(initial))


def _add_motion(
    graph: gtsam.NonlinearFactorGraph, swarm: Swarm, tracks: OdometryTracks, nodes: _Nodes
) -> None:
    """Starts and odometry as factors."""
    for index, (robot, stamps) in enumerate(zip(swarm.robots, nodes.stamps_ns, strict=True)):
        if not stamps.size:
            continue
        first = int(nodes.first[index])
        if robot.start is not None:  # the first online pose is a moment after the start
            s = robot.start_sigma
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([s.x + 0.01, s.y + 0.01, s.theta]))
            graph.add(gtsam.PriorFactorPose2(first, gtsam.Pose2(*nodes.initial[first]), noise))
        sample = tracks.at(np.full(stamps.size, index), stamps)
        moved = se2.between(sample.pose[:-1], sample.pose[1:])
        to_body = se2.adjoint(se2.inverse(sample.pose[1:]))
        gathered = to_body @ np.diff(sample.noise, axis=0) @ np.swapaxes(to_body, 1, 2) + _FLOOR
        for step, (motion, covariance) in enumerate(zip(moved.tolist(), gathered, strict=True)):
            model = gtsam.noiseModel.Gaussian.Covariance(covariance)
            key = first + step
            graph.add(gtsam.BetweenFactorPose2(key, key + 1, gtsam.Pose2(*motion), model))


def _add_sightings(graph: gtsam.NonlinearFactorGraph, measured: MeasurementArray, nodes: _Nodes) -> None:
    """Sightings as factors at their own stamps, with the estimator's prediction."""
    columns = MeasurementColumns.of(measured)
    observers = nodes.keys(measured["observer"], measured["stamp_ns"]).tolist()
    targets = nodes.keys(measured["target"], measured["stamp_ns"]).tolist()
    size = 2 + measured["has_heading"]
    for k in range(measured.size):
        model = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Cauchy.Create(_BEND),
            gtsam.noiseModel.Gaussian.Covariance(measured["covariance"][k, : size[k], : size[k]]),
        )
        keys = [observers[k]] if targets[k] < 0 else [observers[k], targets[k]]
        graph.add(gtsam.CustomFactor(model, keys, _Sighting(columns, k, int(size[k]))))


class _Sighting:
    """Predicted minus measured of one sighting, and its Jacobians by the poses in their own frames."""

    def __init__(self, columns: MeasurementColumns, k: int, size: int) -> None:
        self._columns, self._k, self._size = columns, k, size

    def __call__(
        self, factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        found = [values.atPose2(key) for key in factor.keys()]  # noqa: SIM118 # a method of gtsam
        poses = np.array([[pose.x(), pose.y(), pose.theta()] for pose in found])
        value, jacobian, error = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
        predict_one(self._columns, self._k, poses[0], poses[-1], value, jacobian)
        innovation(self._columns, self._k, self._columns.value[self._k], value, error)
        if jacobians is not None:
            signs = (-1.0, 1.0)
            for place, pose in enumerate(found):
                by_own_frame = signs[place] * jacobian @ pose.AdjointMap()
                jacobians[place] = np.asfortranarray(by_own_frame[: self._size])
        return -error[: self._size]


def _errors(
    recording: Recording, swarm: Swarm, nodes: _Nodes, solution: gtsam.Values, marginals: gtsam.Marginals
) -> SmootherErrors:
    """Errors at the whole half seconds, pooled over the robots."""
    positions, headings, nees = [], [], []
    for index, robot in enumerate(swarm.robots):
        truth = recording.truth.get(robot.name)
        stamps = nodes.stamps_ns[index]
        rows = np.flatnonzero(stamps % PERIOD_NS == 0)
        if truth is None or not rows.size:
            continue
        true, known = interpolate(truth, stamps[rows], DEFAULT_GAP_NS)
        rows, true = rows[known], true[known]
        if not rows.size:
            continue
        keys = (nodes.first[index] + rows).tolist()
        poses = np.array([[p.x(), p.y(), p.theta()] for p in (solution.atPose2(key) for key in keys)])
        apart = se2.between(poses, true)
        positions.append(np.hypot(apart[:, 0], apart[:, 1]))
        headings.append(apart[:, 2])
        for row in range(0, len(keys), max(1, len(keys) // _NEES_POSES)):
            covariance = marginals.marginalCovariance(keys[row])
            nees.append(float(apart[row] @ np.linalg.solve(covariance, apart[row])))
    return SmootherErrors(np.concatenate(positions), np.concatenate(headings), np.array(nees))
