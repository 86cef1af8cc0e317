"""Listen to a live graph of simulated robots: what they send, and where they truly are."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.time import Time
from sensor_msgs.msg import Image

from swarm_loc_estimator.common.messages.cdr import decode_pose_stamped
from swarm_loc_estimator.common.messages.typestore import DETECTIONS, ODOMETRY, POSE_STAMPED
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.live.graph import START_PATIENCE_S, LiveError, LiveGraph
from swarm_loc_estimator.offline.recorded_bag import read_truth
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_msgs.msg import MarkerDetectionArray

TYPE_OF = {"odom": ODOMETRY, "detections": DETECTIONS, "ground_truth": POSE_STAMPED}
"""What is kept of each robot, with its message type."""
_CLASS_OF: dict[str, type] = {
    "odom": Odometry,
    "detections": MarkerDetectionArray,
    "ground_truth": PoseStamped,
}
_MOVED_M = 0.002
_DEPTH = 1000

Say = Callable[[str], None]


@dataclass
class Listener:
    """Keeps what is sent in the graph.

    Attributes:
        graph: Whose recorder listens.
        names: Of the robots.
        looked_at: The robot whose pictures are kept.
        kept: Robot and topic -> times of arrival in the graph's time [ns], and messages.
        pictures: Robot and stamp -> picture.
    """

    graph: LiveGraph
    names: Sequence[str]
    looked_at: str = ""
    kept: dict[tuple[str, str], tuple[list[int], list[bytes]]] = field(default_factory=dict)
    pictures: dict[tuple[str, int], Image] = field(default_factory=dict)

    def __post_init__(self) -> None:
        recorder = self.graph.recorder
        for name in self.names:
            for topic, kind in _CLASS_OF.items():
                arrivals, data = self.kept.setdefault((name, topic), ([], []))
                keep = partial(self._keep, arrivals, data)
                recorder.create_subscription(kind, f"{name}/{topic}", keep, _DEPTH, raw=True)

    def _keep(self, arrivals: list[int], messages: list[bytes], data: bytes) -> None:
        arrivals.append(self.graph.recorder.get_clock().now().nanoseconds)
        messages.append(data)

    def listen_to_camera(self, name: str) -> None:
        """Keep a robot's pictures, too, from here on: they are large."""

        def keep(message: Image) -> None:
            self.pictures[name, Time.from_msg(message.header.stamp).nanoseconds] = message

        self.graph.recorder.create_subscription(Image, f"{name}/image_raw", keep, 1)
        self.looked_at = name

    @property
    def now_ns(self) -> int:
        """How far the world is, by its newest truth; 0 before the first."""
        newest = self.newest_truth(self.names[0])
        return newest[0] if newest else 0

    def newest_truth(self, name: str) -> tuple[int, NDArray[np.float64]] | None:
        """Stamp and place (2,) of a robot, and None before the first."""
        messages = self.kept[name, "ground_truth"][1]
        if not messages:
            return None
        truth = decode_pose_stamped(messages[-1])
        return truth.stamp_ns, np.array(truth.pose[:2])

    def truth(self, swarm: Swarm) -> dict[str, Trajectory]:
        """Where the robots were."""
        return read_truth(swarm, {name: self.kept[name, "ground_truth"][1] for name in self.names})

    def wait_until_they_drive(self, say: Say) -> int:
        """When the robots began to drive [ns].

        Raises:
            LiveError: They do not.
        """
        starts: list[NDArray[np.float64]] = []
        deadline_s = time.monotonic() + START_PATIENCE_S

        def has_begun() -> bool:
            say("starting")
            newest = self.newest_truth(self.names[0])
            if newest is None:
                return False
            starts.append(newest[1])
            if time.monotonic() > deadline_s:
                raise LiveError(f"The robots have not begun to drive within {START_PATIENCE_S:.0f} s.")
            return float(np.linalg.norm(newest[1] - starts[0])) > _MOVED_M

        self.graph.wait_for(has_begun, "begin to drive", START_PATIENCE_S)
        return self.now_ns
