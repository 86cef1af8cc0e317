"""A swarm that a test moves by hand, served to a page."""

import queue
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.poses import EstimateMessage
from swarm_loc_estimator.mapping.messages import GridMessage
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.sightings import Sightings
from swarm_loc_estimator.watch.page import (
    Frame,
    about,
    aerial_frame,
    map_frame,
    places_frame,
    poses_frame,
    sightings_frame,
)
from swarm_loc_estimator.watch.server import Access, Answer, Command, WatchServer

SWARM = Swarm(
    robots=(Robot("alpha"), Robot("beta"), Robot("gamma")),
    landmarks=(Landmark(1, -1.0, -1.0, yaw=0.5), Landmark(2, 1.0, 1.0)),
)
PLACES = np.array([[0.5, 0.25, 1.0], [-0.5, 0.5, -2.0], [0.0, -0.5, 0.0]])
STATUS = (1, 1, 0)
MAP_CORNER = (-1.5, -1.5, 0.3)
_PATIENCE_S = 15.0


class WatchedSwarm:
    """Serves it; what pages order lies in `commands`, see `next_order`.

    Args:
        port: 0 for any.
        access: Who may look.
        infrared: Whether beta sees by infrared.
        teleop: Whether robots may be driven.
    """

    def __init__(
        self, port: int = 0, access: Access | None = None, *, infrared: bool = False, teleop: bool = True
    ) -> None:
        self.commands: queue.Queue[dict[str, Any]] = queue.Queue()
        told = about(SWARM, "three robots", teleop=teleop)
        told["infrared"] = [0, int(infrared), 0]
        self.server = WatchServer(told, access or Access("127.0.0.1"), port, 20.0, self._take)
        self.now_ns = time.time_ns()

    def _take(self, command: Command, answer: Answer) -> None:
        self.commands.put(dict(command))
        answer(f"done: {command['do']}")

    def next_order(self) -> dict[str, Any]:
        """What the page orders next."""
        try:
            return self.commands.get(timeout=_PATIENCE_S)
        except queue.Empty:
            raise AssertionError("the page has ordered nothing") from None

    def publish(
        self, poses: FloatArray = PLACES, later_ns: int = 100_000_000, status: Sequence[int] = STATUS
    ) -> None:
        """All robots at poses (3, 3) a while later, tracked but the last, which waits."""
        self.now_ns += later_ns
        for frame in swarm_frames(self.now_ns, poses, status):
            self.server.publish(frame)

    def publish_surroundings(self) -> None:
        """All else that a page shows, at the instant of the newest poses."""
        for frame in surroundings(self.now_ns):
            self.server.publish(frame)


def swarm_frames(stamp_ns: int, poses: FloatArray = PLACES, status: Sequence[int] = STATUS) -> list[Frame]:
    """All robots at poses (3, 3), tracked but the last, which waits; and what they see."""
    shown = poses.copy()
    shown[np.array(status) == 0] = np.nan
    covariance = np.tile(np.diag([1e-4, 4e-4, 1e-3]), (3, 1, 1))
    age = np.array([0.1, -1.0, -1.0])
    names = tuple(robot.name for robot in SWARM.robots)
    state = np.array(status, np.uint8)
    estimate = EstimateMessage(stamp_ns, "map", names, shown, covariance, age, state, state > 0)
    sees = Sightings(
        np.array([0, 0, 1], np.int32),
        np.array([1, -1, -2], np.int32),
        np.array([1, 2, 1], np.uint8),
        np.array([1.0, 30.0, 1.0], np.float32),
        np.array([0.1, 0.2, 0.2], np.float32),
    )
    return [poses_frame(estimate), sightings_frame(stamp_ns, sees)]


def surroundings(stamp_ns: int) -> list[Frame]:
    """Ground truth, a goal, an image from above in which one robot is known, and a map."""
    cells = np.full((40, 60), -1, dtype=np.int8)
    cells[10:30, 10:50] = 0
    cells[10:30, (10, 49)] = cells[(10, 29), 10:50] = 100
    seen = np.array([[0.55, 0.25], [-0.5, 0.4], [0.9, -0.7]])
    return [
        places_frame("truth", stamp_ns, [0, 1], PLACES[:2] + np.array([0.03, 0.0, 0.1])),
        places_frame("goals", stamp_ns, [1], np.array([[-1.0, 0.0, 0.0]])),
        aerial_frame(stamp_ns, seen, np.array([0, -1, -1]), np.array([0.97, 0.0, 0.0])),
        map_frame(stamp_ns, GridMessage(stamp_ns, "map", 0.05, MAP_CORNER, cells)),
    ]
