"""gtsam's IncrementalFixedLagSmoother with a keyframe of all robots five times a second.

The configuration that serves it best on these data: between keyframes odometry is summed up into one factor,
sightings are moved to the nearest keyframe by odometry (its noise added), the lag is as short as the latest
data allow, and no marginal covariances are asked for.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from bench.peers.problem import (
    Moves,
    Odometry,
    PeerResult,
    Sightings,
    relative_poses,
    sightings_of,
    starts_of,
)
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import SupportsFloat, SupportsIndex, SupportsInt

    from swarm_loc_drivers.sim.run import SimulatedRun

KEYFRAME_NS = 200_000_000
SETTLED_NS = 80_000_000
"""After this much the odometry around an instant has arrived, and a keyframe can be made of it."""
LAG_S = 0.45
"""Age of the oldest keyframe kept. Between two updates 200 ms apart nothing arrives that is more than
200 + 300 - SETTLED_NS = 420 ms older than the newest keyframe, and that belongs to the one 400 ms back."""

_FLOOR = np.diag([1e-10, 1e-10, 1e-10])


class _Smoother:
    """The smoother with its keys: keyframe * N + robot."""

    def __init__(self, run: SimulatedRun) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.findUnusedFactorSlots = True
        self._isam = gtsam.IncrementalFixedLagSmoother(LAG_S, parameters)
        self._run = run
        self._odometry = Odometry(run, run.odometry)
        self._robots = np.arange(len(run.swarm.robots))
        self.keyframe = -1
        self.poses, self._start_covariance = starts_of(run)

    def stamp_ns(self, keyframe: IntArray | int) -> IntArray:
        """When keyframes are."""
        return np.asarray(self._run.start_ns + KEYFRAME_NS * np.asarray(keyframe))

    def advance(self, sightings: Sightings) -> None:
        """Make the next keyframe and use sightings (S,) at the keyframes nearest to them."""
        self.keyframe += 1
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = {}
        self._add_motion(graph)
        self._add_sightings(graph, sightings)
        for robot, (x, y, theta) in enumerate(self.poses.tolist()):
            key = self.keyframe * len(self._robots) + robot
            values.insert(key, gtsam.Pose2(x, y, theta))
            stamps[key] = self.keyframe * KEYFRAME_NS * 1e-9
        self._isam.update(graph, values, stamps)
        first = self.keyframe * len(self._robots)
        found = [self._isam.calculateEstimatePose2(first + robot) for robot in self._robots.tolist()]
        self.poses = np.array([[pose.x(), pose.y(), pose.theta()] for pose in found])

    def poses_at(self, stamp_ns: int) -> FloatArray:
        """Poses (N, 3) by odometry since the newest keyframe."""
        since = np.full(len(self._robots), self.stamp_ns(self.keyframe))
        step, _ = self._odometry.step(self._robots, since, np.full(len(self._robots), stamp_ns))
        return se2.compose(self.poses, step)

    def _add_motion(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """The factors between the last keyframe and the new one; moves the poses on to it."""
        count = len(self._robots)
        first = self.keyframe * count
        if self.keyframe == 0:
            for robot, pose in enumerate(self.poses):
                model = gtsam.noiseModel.Gaussian.Covariance(self._start_covariance[robot])
                graph.add(gtsam.PriorFactorPose2(robot, gtsam.Pose2(*pose), model))
            return
        before, now = (np.full(count, self.stamp_ns(self.keyframe - back)) for back in (1, 0))
        step, covariance = self._odometry.step(self._robots, before, now)
        for robot, noise in enumerate(covariance + _FLOOR):
            model = gtsam.noiseModel.Gaussian.Covariance(noise)
            key = first + robot
            graph.add(gtsam.BetweenFactorPose2(key - count, key, gtsam.Pose2(*step[robot]), model))
        self.poses = se2.compose(self.poses, step)

    def _add_sightings(self, graph: gtsam.NonlinearFactorGraph, sightings: Sightings) -> None:
        nearest = (sightings.stamp_ns - self._run.start_ns + KEYFRAME_NS // 2) // KEYFRAME_NS
        nearest = np.minimum(nearest, self.keyframe)
        at_ns = self.stamp_ns(nearest)
        target = np.maximum(sightings.target, 0)
        moves = [
            Moves(*self._odometry.step(who, at_ns, sightings.stamp_ns))
            for who in (sightings.observer, target)
        ]
        relative = relative_poses(sightings, moves[0], moves[1])
        observers = (nearest * len(self._robots) + sightings.observer).tolist()
        targets = (nearest * len(self._robots) + target).tolist()
        for row, pose in enumerate(relative.pose.tolist()):
            model = gtsam.noiseModel.Gaussian.Covariance(relative.covariance[row])
            if sightings.target[row] < 0:
                graph.add(gtsam.PriorFactorPose2(observers[row], gtsam.Pose2(*pose), model))
            else:
                graph.add(gtsam.BetweenFactorPose2(observers[row], targets[row], gtsam.Pose2(*pose), model))


class _Feed:
    """Hands a run to the smoother keyframe by keyframe, with the sightings that have arrived by then."""

    def __init__(self, run: SimulatedRun) -> None:
        self.smoother = _Smoother(run)
        self._sightings = sightings_of(run)
        self._used = 0

    def advance_until(self, now_ns: int) -> Iterator[None]:
        """Make all keyframes that are settled at `now_ns`, one a turn."""
        while (at_ns := int(self.smoother.stamp_ns(self.smoother.keyframe + 1)) + SETTLED_NS) <= now_ns:
            until = int(np.searchsorted(self._sightings.arrival_ns, at_ns, side="right"))
            self.smoother.advance(self._sightings[self._used : until])
            self._used = until
            yield


def solve(run: SimulatedRun, output_ns: IntArray) -> PeerResult:
    """Poses of all robots at each output stamp, ascending, from the sightings that have arrived by then."""
    begun = time.process_time()
    feed = _Feed(run)
    poses = []
    for stamp_ns in output_ns.tolist():
        for _ in feed.advance_until(stamp_ns):
            pass
        poses.append(feed.smoother.poses_at(stamp_ns))
    return PeerResult(np.array(poses), time.process_time() - begun)


def keyframe_poses(run: SimulatedRun) -> FloatArray:
    """Poses (K, N, 3) of the keyframes of a whole run, each as it was found at first."""
    feed = _Feed(run)
    return np.array([feed.smoother.poses for _ in feed.advance_until(run.end_ns)])
