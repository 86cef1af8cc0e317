"""Record a live graph of simulated robots on the eight: their messages and true poses."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray

from bench.scenarios.eight_run import EightSettings, describe
from bench.shared.bags import read_truth
from swarm_loc_drivers.sim.scenarios.eight import HALF_WIDTH, Lemniscate
from swarm_loc_drivers.sim.worlds import ErrorModel
from swarm_loc_estimator.common.messages.poses import decode_pose_stamped
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.live_run import START_PATIENCE_S, LiveError, LiveGraph
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_msgs.msg import MarkerDetectionArray

_CLASS_OF: dict[str, type] = {
    "odom": Odometry,
    "detections": MarkerDetectionArray,
    "ground_truth": PoseStamped,
}
ROBOTS = 5
_MOVED_M = 0.002
_DEPTH = 1000

Say = Callable[[str], None]


def starting_swarm(errors: ErrorModel) -> Swarm:
    """Five robots at their starts on the eight, as a world with some errors describes them."""
    path = Lemniscate(HALF_WIDTH)
    start, _ = path.at(np.arange(ROBOTS) * path.length / ROBOTS)
    return describe(EightSettings(robots=ROBOTS, errors=errors), start)


@dataclass
class Listener:
    """Records messages of a graph."""

    graph: LiveGraph  # The graph; its recorder subscribes
    names: Sequence[str]  # Of the robots
    # Robot and topic -> times of arrival by the graph's clock [ns], and messages
    kept: dict[tuple[str, str], tuple[list[int], list[bytes]]] = field(default_factory=dict)

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

    @property
    def now_ns(self) -> int:
        """Time of the world by its newest ground truth; 0 before the first."""
        newest = self.newest_truth(self.names[0])
        return newest[0] if newest else 0

    def newest_truth(self, name: str) -> tuple[int, NDArray[np.float64]] | None:
        """Stamp and true position (2,) of a robot; None before the first."""
        messages = self.kept[name, "ground_truth"][1]
        if not messages:
            return None
        truth = decode_pose_stamped(messages[-1])
        return truth.stamp_ns, np.array(truth.pose[:2])

    def truth(self, swarm: Swarm) -> dict[str, Trajectory]:
        """Robot name -> ground truth."""
        return read_truth(swarm, {name: self.kept[name, "ground_truth"][1] for name in self.names})

    def wait_until_they_drive(self, say: Say) -> int:
        """Wait until the robots drive; returns the time [ns].

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
