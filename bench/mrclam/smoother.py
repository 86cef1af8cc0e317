"""Batch solution of a recording by gtsam, with the models and noise of the estimator.

A smoother uses past and future measurements: its errors are a lower bound for online estimates. Each robot
has a pose at every stamp of a sighting or a comparison; and, if its model has one, a bias of its turn rate
that is constant for a tenth of its time constant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.filter.measurements import Measurements, select
from swarm_loc_estimator.filter.models import predict_one, write_innovation
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.offline.metrics import Errors, compare
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.inputs import InputConverter
from swarm_loc_estimator.swarm.calibration_states import TURN_BIAS
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.settings import Settings

_FLOOR = np.diag([1e-10, 1e-10, 1e-10])
"""Least covariance of a motion factor; that of a standing robot would be zero."""
_UNKNOWN = np.array([30.0, 30.0, 10.0])
_BEND = 3.0  # Width of the Cauchy loss of sightings [sigma], in place of the filter's gate
_NEES_POSES = 400  # Number of poses of each robot for the NEES; marginal covariances are slow
_MAX_ROUNDS = 25
_SETTLED = 1e-4  # The solution has converged if a step reduces the error by less than this share
_SHORTEST_STEP = 1e-3
_BIAS_STEP = 0.1  # A bias is constant for this share of its time constant


class SmootherError(Exception):
    """The batch solution has failed; the message is one sentence."""


@dataclass(frozen=True)
class _Nodes:
    """Poses to solve for; their index is the key."""

    stamps_ns: list[IntArray]  # Per robot, ascending
    compared: list[IntArray]  # Per robot, indices of those that are compared with ground truth
    first: IntArray  # (N,) key of each robot's first pose
    initial: FloatArray  # (V, 3) initial values

    def keys(self, robots: IntArray, stamps_ns: IntArray) -> IntArray:
        """Keys (m,) of poses; -1 for robot -1."""
        keys = np.full(robots.size, -1)
        for robot, stamps in enumerate(self.stamps_ns):
            rows = robots == robot
            keys[rows] = self.first[robot] + np.searchsorted(stamps, stamps_ns[rows])
        return keys


def smooth(recording: Recording, online: ReplayResult) -> Mapping[str, Errors]:
    """Solve a whole recording; returns the errors of robots with ground truth, by name.

    Args:
        recording: With ground truth.
        online: The estimate from it, which gives models, initial values and the stamps of the comparison.

    Raises:
        SmootherError: There is no solution, or it does not converge.
    """
    try:
        return _smooth(recording, online)
    except RuntimeError as error:  # gtsam's error for indeterminate systems
        raise SmootherError(f"gtsam: {' '.join(str(error).split('.')[0].split())}.") from error


def _smooth(recording: Recording, online: ReplayResult) -> Mapping[str, Errors]:
    """As `smooth`, with errors of gtsam."""
    swarm = online.swarm
    tracks, measured = _tracks_and_measurements(recording, swarm)
    estimates = [online.track(index) for index in range(len(swarm.robots))]
    measured = select(measured, _within(measured, estimates))
    nodes = _nodes(tracks, estimates, measured)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key, pose in enumerate(nodes.initial.tolist()):
        values.insert(key, gtsam.Pose2(*pose))
    _add_motion(graph, values, swarm, tracks, nodes)
    _add_sightings(graph, measured, nodes)
    return _errors(recording, swarm, nodes, _solved(graph, values), graph)


def _tracks_and_measurements(recording: Recording, swarm: Swarm) -> tuple[OdometryTracks, Measurements]:
    """All odometry, calibrated, and all sightings of known markers (m,)."""
    valid = InputConverter(swarm, Settings()).convert(recording.messages)
    tracks = OdometryTracks(swarm.robots)
    driven = valid.rows["odometry"]
    tracks.extend(driven.robot, driven.stamp_ns, driven.pose)
    return tracks, valid.rows["detections"]


def _solved(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """Optimize by Gauss-Newton with step halving.

    The optimizers of gtsam release the interpreter lock, which every factor in Python must take again: they
    take a hundred times as long.
    """
    error = graph.error(values)
    for _ in range(_MAX_ROUNDS):
        step, share = graph.linearize(values).optimize(), 1.0
        stepped = values.retract(step)
        found = graph.error(stepped)
        while found > error and share > _SHORTEST_STEP:
            share *= 0.3
            stepped = values.retract(_scaled(step, share))
            found = graph.error(stepped)
        if found > error:
            return values
        values, settled, error = stepped, error - found < _SETTLED * error, found
        if settled:
            return values
    raise SmootherError(f"the batch solution has not converged after {_MAX_ROUNDS} rounds.")


def _scaled(step: gtsam.VectorValues, share: float) -> gtsam.VectorValues:
    """A step times a factor."""
    scaled = gtsam.VectorValues()
    for key in range(step.size()):
        scaled.insert(key, share * step.at(key))
    return scaled


def _within(measured: Measurements, estimates: list[Trajectory]) -> NDArray[np.bool_]:
    """Whether measurements (m,) were taken while both robots were located online."""
    inside = np.ones(measured.size, dtype=bool)
    for side in (measured.observer, measured.target):
        for robot, track in enumerate(estimates):
            rows = side == robot
            stamps = measured.stamp_ns[rows]
            first_ns, last_ns = (track.stamp_ns[0], track.stamp_ns[-1]) if track.stamp_ns.size else (1, 0)
            inside[rows] &= (stamps >= first_ns) & (stamps <= last_ns)
    return inside


def _nodes(tracks: OdometryTracks, estimates: list[Trajectory], measured: Measurements) -> _Nodes:
    """Poses of each robot at all its stamps, initialized by odometry from the last online pose."""
    stamps_ns, compared, initial = [], [], [np.zeros((0, 3))]
    for robot, track in enumerate(estimates):
        seen = [measured.stamp_ns[side == robot] for side in (measured.observer, measured.target)]
        stamps = np.unique(np.concatenate([track.stamp_ns, *seen]))
        stamps_ns.append(stamps)
        compared.append(np.searchsorted(stamps, track.stamp_ns))
        if not stamps.size:
            continue
        before = np.searchsorted(track.stamp_ns, stamps, side="right") - 1
        who = np.full(stamps.size, robot)
        moved = se2.between(tracks.at(who, track.stamp_ns[before]).pose, tracks.at(who, stamps).pose)
        initial.append(se2.compose(track.pose[before], moved))
    sizes = np.array([stamps.size for stamps in stamps_ns])
    return _Nodes(stamps_ns, compared, np.cumsum(sizes) - sizes, np.concatenate(initial))


def _add_motion(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    swarm: Swarm,
    tracks: OdometryTracks,
    nodes: _Nodes,
) -> None:
    """Add priors of the starts, odometry, and biases of the turn rate."""
    for index, (robot, stamps) in enumerate(zip(swarm.robots, nodes.stamps_ns, strict=True)):
        if not stamps.size:
            continue
        first = int(nodes.first[index])
        graph.add(gtsam.PriorFactorPose2(first, gtsam.Pose2(*nodes.initial[first]), _start_noise(robot)))
        biases = _add_biases(graph, values, robot.odometry, stamps)
        sample = tracks.at(np.full(stamps.size, index), stamps)
        moved = se2.between(sample.pose[:-1], sample.pose[1:])
        to_body = se2.adjoint(se2.inverse(sample.pose[1:]))
        covariance = to_body @ np.diff(sample.covariance, axis=0) @ np.swapaxes(to_body, 1, 2) + _FLOOR
        drift = (to_body @ np.diff(sample.jacobian, axis=0))[:, :, TURN_BIAS]
        for step, motion in enumerate(moved.tolist()):
            model, key = gtsam.noiseModel.Gaussian.Covariance(covariance[step]), first + step
            if biases.size:
                drifting = _Drifting(gtsam.Pose2(*motion), drift[step])
                graph.add(gtsam.CustomFactor(model, [key, key + 1, int(biases[step])], drifting))
            else:
                graph.add(gtsam.BetweenFactorPose2(key, key + 1, gtsam.Pose2(*motion), model))


def _start_noise(robot: Robot) -> gtsam.noiseModel.Base:
    """Noise of the first pose: that of the start plus some motion, or very large if it is unknown."""
    if robot.start is None:
        return gtsam.noiseModel.Diagonal.Sigmas(_UNKNOWN)
    s = robot.start_sigma
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([s.x + 0.01, s.y + 0.01, s.theta]))


def _add_biases(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, model: OdometryModel, stamps_ns: IntArray
) -> IntArray:
    """Add a Gauss-Markov chain of biases, if the model has one; returns the key (m - 1,) of each step."""
    sigma, step_ns = model.turn_bias_sigma, _BIAS_STEP * model.turn_bias_time_s * 1e9
    if not sigma:
        return np.zeros(0, dtype=np.int64)
    kept = np.exp(-_BIAS_STEP)
    keys: IntArray = values.size() + ((stamps_ns[:-1] - stamps_ns[0]) // step_ns).astype(np.int64)
    innovation_noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma * np.sqrt(1.0 - kept**2))
    for key in range(int(keys[0]), int(keys[-1]) + 1):
        values.insert(key, np.zeros(1))
        if key == keys[0]:
            graph.add(gtsam.PriorFactorVector(key, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, sigma)))
        else:
            graph.add(gtsam.CustomFactor(innovation_noise, [key - 1, key], _Fading(kept)))
    return keys


def _add_sightings(graph: gtsam.NonlinearFactorGraph, measured: Measurements, nodes: _Nodes) -> None:
    """Add sightings at their stamps, with the measurement models of the estimator."""
    observers = nodes.keys(measured.observer, measured.stamp_ns).tolist()
    targets = nodes.keys(measured.target, measured.stamp_ns).tolist()
    bend = gtsam.noiseModel.mEstimator.Cauchy.Create(_BEND)
    size = 2 + measured.has_heading.astype(np.int64)
    for k in range(measured.size):
        gaussian = gtsam.noiseModel.Gaussian.Covariance(measured.covariance[k, : size[k], : size[k]])
        model = gtsam.noiseModel.Robust.Create(bend, gaussian)
        keys = [observers[k]] if targets[k] < 0 else [observers[k], targets[k]]
        graph.add(gtsam.CustomFactor(model, keys, _Sighting(measured, k, int(size[k]))))


class _Fading:
    """Residual of a bias: minus the decayed previous one."""

    def __init__(self, kept: float) -> None:
        self._kept = kept

    def __call__(
        self, factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        before, after = (values.atVector(key) for key in factor.keys())  # noqa: SIM118 # a method of gtsam
        if jacobians is not None:
            jacobians[0], jacobians[1] = np.array([[-self._kept]]), np.eye(1)
        return np.asarray(after - self._kept * before)


class _Drifting:
    """Residual of a step of odometry with a bias, as in gtsam's BetweenFactor."""

    def __init__(self, moved: gtsam.Pose2, drift: FloatArray) -> None:
        self._moved, self._drift = moved, drift

    def __call__(
        self, factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        begin, end, bias = factor.keys()
        moved = values.atPose2(begin).between(values.atPose2(end))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(-moved.inverse().AdjointMap())
            jacobians[1] = np.asfortranarray(np.eye(3))
            jacobians[2] = np.asfortranarray(-self._drift[:, None])
        apart = self._moved.localCoordinates(moved)
        return np.asarray(apart - self._drift * values.atVector(bias)[0])


class _Sighting:
    """Residual of a sighting, with Jacobians by the poses in their own frames."""

    def __init__(self, measured: Measurements, k: int, size: int) -> None:
        self._measured, self._k, self._size = measured, k, size

    def __call__(
        self, factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        found = [values.atPose2(key) for key in factor.keys()]  # noqa: SIM118 # a method of gtsam
        unmoved = (0.0, 0.0, 0.0)  # of a landmark as it was surveyed
        poses = np.array([*((pose.x(), pose.y(), pose.theta()) for pose in found), unmoved])
        value, jacobian, error = np.zeros(3), np.zeros((3, 6)), np.zeros(3)
        predict_one(self._measured, self._k, poses[0], poses[1], (0.0, 0.0, 0.0), value, jacobian)
        write_innovation(self._measured, self._k, self._measured.value[self._k], value, error)
        if jacobians is not None:
            signs = (-1.0, 1.0)
            for place, pose in enumerate(found):
                by_own_frame = signs[place] * jacobian[:, :3] @ pose.AdjointMap()
                jacobians[place] = np.asfortranarray(by_own_frame[: self._size])
        return -error[: self._size]


def _errors(
    recording: Recording,
    swarm: Swarm,
    nodes: _Nodes,
    solution: gtsam.Values,
    graph: gtsam.NonlinearFactorGraph,
) -> dict[str, Errors]:
    """Errors at the stamps of the online poses; the NEES at some of them."""
    marginals = gtsam.Marginals(graph, solution)
    errors = {}
    for index, robot in enumerate(swarm.robots):
        truth, rows = recording.truth.get(robot.name), nodes.compared[index]
        if truth is None or not rows.size:
            continue
        keys = (nodes.first[index] + rows).tolist()
        poses = np.array([[p.x(), p.y(), p.theta()] for p in (solution.atPose2(key) for key in keys)])
        covariance = np.full((rows.size, 3, 3), np.nan)
        for row in range(0, rows.size, max(1, rows.size // _NEES_POSES)):
            to_map = solution.atPose2(keys[row]).rotation().matrix()
            turned = np.eye(3)
            turned[:2, :2] = to_map
            covariance[row] = turned @ marginals.marginalCovariance(keys[row]) @ turned.T
        errors[robot.name] = compare(Trajectory(nodes.stamps_ns[index][rows], poses), covariance, truth)
    return errors
