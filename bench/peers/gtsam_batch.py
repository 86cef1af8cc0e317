"""The optimum: gtsam's Levenberg-Marquardt over the poses at all stamps of all data that have arrived.

For every output stamp the whole past is solved anew, each robot with one pose per stamp at which it sees or
is seen. What the filter can know at that moment, this knows best; it is the yardstick of RMSE, not of speed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from bench.peers.gtsam_lag import KEYFRAME_NS, keyframe_poses
from bench.peers.problem import (
    Odometry,
    PeerResult,
    Sightings,
    no_moves,
    relative_poses,
    sightings_of,
    starts_of,
)
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from swarm_loc_drivers.sim.run import SimulatedRun

_FLOOR = np.diag([1e-11, 1e-11, 1e-11])
"""Odometry of a straight millisecond has no sideways noise; a factor needs some. Far below what matters."""


@dataclass(frozen=True)
class _Nodes:
    """The poses to solve for, sorted by robot and stamp; the position in these arrays is the key."""

    robot: IntArray  # (V,)
    stamp_ns: IntArray  # (V,)
    first: IntArray  # (N,) key of each robot's first pose

    def key(self, robot: IntArray, stamp_ns: IntArray) -> IntArray:
        """The keys (M,) of poses that exist."""
        found: IntArray = np.searchsorted(
            self._sort_key(self.robot, self.stamp_ns), self._sort_key(robot, stamp_ns)
        )
        return found

    def _sort_key(self, robot: IntArray, stamp_ns: IntArray) -> IntArray:
        base = self.stamp_ns.min()
        key: IntArray = robot * (self.stamp_ns.max() - base + 1) + (stamp_ns - base)
        return key


def solve(run: SimulatedRun, output_ns: IntArray) -> PeerResult:
    """Poses of all robots at each output stamp, from the data that have arrived by then."""
    begun = time.process_time()
    sightings = sightings_of(run)
    begin = keyframe_poses(run)
    poses = [_solve_until(run, sightings, begin, int(now_ns)) for now_ns in output_ns]
    return PeerResult(np.array(poses), time.process_time() - begun)


def _solve_until(run: SimulatedRun, sightings: Sightings, begin: FloatArray, now_ns: int) -> FloatArray:
    """Poses (N, 3) at `now_ns`, found from keyframe poses (K, N, 3) to begin at."""
    odometry = Odometry(run, run.odometry[run.odometry["arrival_ns"] <= now_ns])
    sightings = sightings[sightings.arrival_ns <= now_ns]
    nodes = _nodes(run, sightings, now_ns)
    graph = gtsam.NonlinearFactorGraph()
    _add_motion(graph, run, odometry, nodes)
    _add_sightings(graph, sightings, nodes)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-9)
    initial = _initial(run, odometry, nodes, begin)
    solution = gtsam.LevenbergMarquardtOptimizer(graph, initial, parameters).optimize()
    last = np.append(nodes.first[1:], len(nodes.robot)) - 1
    found = [solution.atPose2(int(key)) for key in last]
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in found])


def _nodes(run: SimulatedRun, sightings: Sightings, now_ns: int) -> _Nodes:
    """Every robot's start, the stamps at which it sees or is seen, and now."""
    robots = np.arange(len(run.swarm.robots))
    seen = sightings.target >= 0
    robot = np.concatenate([robots, sightings.observer, sightings.target[seen], robots])
    ends = np.full(len(robots), run.start_ns), np.full(len(robots), now_ns)
    stamp_ns = np.concatenate([ends[0], sightings.stamp_ns, sightings.stamp_ns[seen], ends[1]])
    unique = np.unique(np.column_stack([robot, stamp_ns]), axis=0)
    return _Nodes(unique[:, 0], unique[:, 1], np.flatnonzero(np.diff(unique[:, 0], prepend=-1)))


def _initial(run: SimulatedRun, odometry: Odometry, nodes: _Nodes, begin: FloatArray) -> gtsam.Values:
    """Where to begin: keyframe poses, and odometry since the last of them."""
    keyframe = np.minimum((nodes.stamp_ns - run.start_ns) // KEYFRAME_NS, len(begin) - 1)
    since, _ = odometry.step(nodes.robot, run.start_ns + keyframe * KEYFRAME_NS, nodes.stamp_ns)
    values = gtsam.Values()
    for key, (x, y, theta) in enumerate(se2.compose(begin[keyframe, nodes.robot], since).tolist()):
        values.insert(key, gtsam.Pose2(x, y, theta))
    return values


def _add_motion(
    graph: gtsam.NonlinearFactorGraph, run: SimulatedRun, odometry: Odometry, nodes: _Nodes
) -> None:
    """Starts and odometry as factors."""
    start, covariance = starts_of(run)
    for robot, key in enumerate(nodes.first.tolist()):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance[robot])
        graph.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(*start[robot]), noise))
    later = np.setdiff1d(np.arange(len(nodes.robot)), nodes.first)
    step, covariance = odometry.step(nodes.robot[later], nodes.stamp_ns[later - 1], nodes.stamp_ns[later])
    for key, motion, noise in zip(later.tolist(), step.tolist(), covariance + _FLOOR, strict=True):
        model = gtsam.noiseModel.Gaussian.Covariance(noise)
        graph.add(gtsam.BetweenFactorPose2(key - 1, key, gtsam.Pose2(*motion), model))


def _add_sightings(graph: gtsam.NonlinearFactorGraph, sightings: Sightings, nodes: _Nodes) -> None:
    """Sightings as factors at their own stamps."""
    count = len(sightings.stamp_ns)
    relative = relative_poses(sightings, no_moves(count), no_moves(count))
    observer = nodes.key(sightings.observer, sightings.stamp_ns).tolist()
    target = nodes.key(np.maximum(sightings.target, 0), sightings.stamp_ns).tolist()
    for row, pose in enumerate(relative.pose.tolist()):
        model = gtsam.noiseModel.Gaussian.Covariance(relative.covariance[row])
        if sightings.target[row] < 0:
            graph.add(gtsam.PriorFactorPose2(observer[row], gtsam.Pose2(*pose), model))
        else:
            graph.add(gtsam.BetweenFactorPose2(observer[row], target[row], gtsam.Pose2(*pose), model))
