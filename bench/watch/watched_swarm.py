"""A swarm that a test moves by hand, served to a page."""

from __future__ import annotations

import queue
import time
from typing import Any

import numpy as np

from swarm_loc_estimator.core.description.swarm import Landmark, Robot, Swarm
from swarm_loc_estimator.core.estimation.sightings import Sightings
from swarm_loc_estimator.io.messages.estimates import EstimateMessage
from swarm_loc_estimator.io.watch.about import about
from swarm_loc_estimator.io.watch.access import Access
from swarm_loc_estimator.io.watch.frames import poses_frame, sightings_frame
from swarm_loc_estimator.io.watch.server import Answer, Command, WatchServer
from swarm_loc_estimator.numerics.arrays import FloatArray

SWARM = Swarm(
    robots=(Robot("alpha"), Robot("beta"), Robot("gamma")),
    landmarks=(Landmark(1, -1.0, -1.0, yaw=0.5), Landmark(2, 1.0, 1.0)),
)
PLACES = np.array([[0.5, 0.25, 1.0], [-0.5, 0.5, -2.0], [0.0, -0.5, 0.0]])


class WatchedSwarm:
    """Serves it; what pages order lies in `commands`.

    Args:
        port: 0 for any.
    """

    def __init__(self, port: int = 0) -> None:
        self.commands: queue.Queue[dict[str, Any]] = queue.Queue()
        told = about(SWARM, "three robots", teleop=True)
        self.server = WatchServer(told, Access("127.0.0.1"), port, 20.0, self._take)
        self.now_ns = time.time_ns()

    def _take(self, command: Command, answer: Answer) -> None:
        self.commands.put(dict(command))
        answer(f"done: {command['do']}")

    def publish(self, poses: FloatArray = PLACES, later_ns: int = 100_000_000) -> None:
        """All robots at poses (3, 3) a while later, tracked but the last, which waits."""
        self.now_ns += later_ns
        shown = poses.copy()
        shown[2] = np.nan
        covariance = np.tile(np.diag([1e-4, 4e-4, 1e-3]), (3, 1, 1))
        status = np.array([1, 1, 0], dtype=np.uint8)
        age = np.array([0.1, -1.0, -1.0])
        names = tuple(robot.name for robot in SWARM.robots)
        estimate = EstimateMessage(self.now_ns, "map", names, shown, covariance, age, status)
        self.server.publish(poses_frame(estimate))
        sees = Sightings(
            np.array([0, 0], np.int32),
            np.array([1, -1], np.int32),
            np.array([1, 2], np.uint8),
            np.array([1.0, 30.0], np.float32),
            np.array([0.1, 0.2], np.float32),
        )
        self.server.publish(sightings_frame(self.now_ns, sees))
