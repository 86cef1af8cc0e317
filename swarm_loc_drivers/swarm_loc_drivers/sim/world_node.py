"""A simulated world as a ROS node: publishes time and true poses, answers its robots' drivers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from swarm_loc_drivers.common.odometry_output import stamp_message
from swarm_loc_drivers.sim.link_host import FirmwareHost
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.encoders import encode_pose_stamped
from swarm_loc_estimator.common.node import ConfiguredNode, Parameters, Stop
from swarm_loc_estimator.common.parameters import ParameterError

_CLOCK_QOS = QoSProfile(depth=10)
_TRUTH_QOS = QoSProfile(depth=10)
_HELD_WAKE_S = 0.002
_MAX_LAG_S = 0.1
"""A world that cannot keep up goes on from now instead of hurrying after."""


class Pace(NamedTuple):
    """How a world's time passes and is told.

    Attributes:
        step_ns: Simulated time of a step.
        rate: Simulated seconds per second, as far as the machine keeps up.
        truth_rate: Published true poses of each robot [1/s].
        clock_steps: The time is told every so many steps.
    """

    step_ns: int
    rate: float
    truth_rate: float
    clock_steps: int = 1


class WorldNode(ConfiguredNode[Parameters]):
    """Lets the time of a world pass; a kind of world says what a step does. See `ConfiguredNode`."""

    def __init__(self, name: str, parameters: type[Parameters], **node_arguments: Any) -> None:
        super().__init__(name, parameters, **node_arguments)
        self.host = FirmwareHost()
        self._steps = 0

    def begin(self, names: Sequence[str], pace: Pace, serve: Callable[[int], str], place: str) -> None:
        """Put all robots on their links, and publish from now on.

        Args:
            names: Of the robots.
            pace: How time passes.
            serve: Puts a robot on its link; returns the address for its driver.
            place: The parameter that says where links are, and its value, for errors.

        Raises:
            ParameterError: A link cannot be there.
        """
        for robot, name in enumerate(names):
            try:
                self.get_logger().info(f"{name} answers at {serve(robot)}")
            except OSError as error:
                raise ParameterError(
                    f"parameter {place} cannot be used for {name}: {error.strerror}."
                ) from error
        self._step_s, self._rate, self._clock_steps = pace.step_ns * 1e-9, pace.rate, pace.clock_steps
        self._truth_steps = max(1, round(1.0 / (pace.truth_rate * self._step_s)))
        self._clock_publisher = self.create_publisher(Clock, "/clock", _CLOCK_QOS)
        self._truths = [
            self.create_publisher(PoseStamped, f"{name}/ground_truth", _TRUTH_QOS) for name in names
        ]

    def step(self) -> None:
        """Let the world do its next step, and `tell` it."""
        raise NotImplementedError

    def is_held(self) -> bool:
        """Whether time stands still for now."""
        return False

    def tell(self, now_ns: int, poses: FloatArray) -> None:
        """A step was done: publish the time, and at times the true poses (N, 3)."""
        if self._steps % self._clock_steps == 0:
            self._clock_publisher.publish(Clock(clock=stamp_message(now_ns)))
        if self._steps % self._truth_steps == 0:
            stamp_ns = np.array([now_ns], np.int64)
            for publisher, pose in zip(self._truths, poses, strict=True):
                publisher.publish(encode_pose_stamped("map", stamp_ns, pose[None])[0])
        self._steps += 1

    def run(self, stop: Stop) -> int:
        """Step again and again, and answer drivers in between, until asked to stop; the exit status."""
        executor = EventsExecutor()
        executor.add_node(self)
        due_s = time.monotonic()
        while not stop.requested:
            self.step()
            due_s = max(due_s + self._step_s / self._rate, time.monotonic() - _MAX_LAG_S)
            self.host.poll(0.0)
            while (left_s := due_s - time.monotonic()) > 0.0:
                self.host.poll(left_s)
            executor.spin_once(timeout_sec=0.0)
            while self.is_held() and not stop.requested:
                self.host.poll(0.0)
                executor.spin_once(timeout_sec=_HELD_WAKE_S)
        executor.shutdown()
        return 0

    def destroy_node(self) -> None:
        """Switch the robots off, too."""
        self.host.close()
        super().destroy_node()
