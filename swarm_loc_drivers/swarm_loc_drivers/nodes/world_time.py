"""What every simulated world does as a node: tells time and true poses, answers its robots' drivers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from swarm_loc_drivers.nodes.odometry_output import stamp_message
from swarm_loc_drivers.sim.firmware.host import FirmwareHost
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.io.messages import encode_pose_stamped
from swarm_loc_estimator.nodes.running import Stop

_CLOCK_QOS = QoSProfile(depth=10)
_TRUTH_QOS = QoSProfile(depth=10)
_HELD_WAKE_S = 0.002
_LONGEST_LAG_S = 0.1
"""A world that cannot keep up goes on from now instead of hurrying after."""


class WorldTime:
    """Lets a world's time pass.

    Args:
        node: Whose publishers.
        names: Of the robots.
        step_ns: Simulated time of a step.
        rate: Simulated seconds per second, as far as the machine keeps up.
        truth_rate: Published true poses of each robot [1/s].
        clock_steps: The time is told every so many steps.
    """

    def __init__(
        self,
        node: Node,
        names: Sequence[str],
        step_ns: int,
        rate: float,
        truth_rate: float,
        clock_steps: int = 1,
    ) -> None:
        self._node = node
        self._step_s = step_ns * 1e-9
        self._rate = rate
        self._clock = node.create_publisher(Clock, "/clock", _CLOCK_QOS)
        self._truths = [
            node.create_publisher(PoseStamped, f"{name}/ground_truth", _TRUTH_QOS) for name in names
        ]
        self._clock_steps = clock_steps
        self._truth_steps = max(1, round(1.0 / (truth_rate * self._step_s)))
        self._steps = 0

    def tell(self, now_ns: int, poses: FloatArray) -> None:
        """A step was done: publish the time, and at times the true poses (N, 3)."""
        if self._steps % self._clock_steps == 0:
            self._clock.publish(Clock(clock=stamp_message(now_ns)))
        if self._steps % self._truth_steps == 0:
            stamp_ns = np.array([now_ns], np.int64)
            for publisher, pose in zip(self._truths, poses, strict=True):
                publisher.publish(encode_pose_stamped("map", stamp_ns, pose[None])[0])
        self._steps += 1

    def run(
        self,
        step: Callable[[], None],
        host: FirmwareHost,
        stop: Stop,
        is_held: Callable[[], bool] = lambda: False,
    ) -> None:
        """Step again and again, and answer drivers in between, until asked to stop.

        Args:
            step: Lets the world do its next step.
            host: Of the robots' firmware.
            stop: Says when to end.
            is_held: While it says so time stands still.
        """
        executor = EventsExecutor()
        executor.add_node(self._node)
        due_s = time.monotonic()
        while not stop.requested:
            step()
            due_s = max(due_s + self._step_s / self._rate, time.monotonic() - _LONGEST_LAG_S)
            host.poll(0.0)
            while (left_s := due_s - time.monotonic()) > 0.0:
                host.poll(left_s)
            executor.spin_once(timeout_sec=0.0)
            while is_held() and not stop.requested:
                host.poll(0.0)
                executor.spin_once(timeout_sec=_HELD_WAKE_S)
        executor.shutdown()
