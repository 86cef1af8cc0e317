"""A simulated world as a ROS node: publishes time and true poses, answers its robots' drivers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from swarm_loc_drivers.common.robot_driver import MAX_STOP_S
from swarm_loc_drivers.common.robot_driver_node import stamp_message
from swarm_loc_drivers.sim.link_host import FirmwareHost
from swarm_loc_drivers.sim.worlds import WorldParameters
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.poses import encode_pose_stamped
from swarm_loc_estimator.common.node import ConfiguredNode, Stop
from swarm_loc_estimator.common.parameters import ParameterError

_CLOCK_QOS = QoSProfile(depth=10)
_TRUTH_QOS = QoSProfile(depth=10)
_HELD_WAKE_S, _PATIENCE_S = 0.002, 10.0
_MAX_LAG_S = 0.1  # A world that cannot keep up continues from now and does not catch up
_QUIET_S, _FAREWELL_S = 0.5, MAX_STOP_S + 1.0
"""A world that is to stop goes on until no driver has been connected for so long, and at most so long [s].

The first is longer than a driver's pause before it connects again.
"""

Parameters = TypeVar("Parameters", bound=WorldParameters)


class WorldNode(ConfiguredNode[Parameters]):
    """Steps a world in paced simulated time; a derived class implements `step`. See `ConfiguredNode`."""

    def __init__(self, name: str, parameters: type[Parameters], **node_arguments: Any) -> None:
        super().__init__(name, parameters, **node_arguments)
        self.host = FirmwareHost()
        self._steps = 0
        self._asked_s, self._used_s = math.inf, 0.0
        self._held_since_s: float | None = None

    def serve(
        self,
        names: Sequence[str],
        firmware_of: Callable[[int], Any],
        link_folder: str,
        *,
        first_port: int = 0,
        waits: bool = False,
    ) -> None:
        """Put all robots on their links.

        `firmware_of` makes the firmware of a robot by its index: a `ConsoleFirmware` with a folder of links,
        else a `StreamFirmware`. Serial ports have flow control if these wait. TCP ports follow the first one;
        0: any. Raises ParameterError if a link cannot be made.
        """
        for robot, name in enumerate(names):
            firmware = firmware_of(robot)
            try:
                if link_folder:
                    address = str(self.host.serve_pty(firmware, Path(link_folder) / name, waits=waits))
                else:
                    port = self.host.serve_tcp(firmware, port=first_port and first_port + robot)
                    address = f"tcp://localhost:{port}"
            except OSError as error:
                place = f"link_folder = {link_folder}" if link_folder else f"first_port = {first_port}"
                raise ParameterError(
                    f"parameter {place} cannot be used for {name}: {error.strerror}."
                ) from error
            self.get_logger().info(f"{name} answers at {address}")

    def begin(self, names: Sequence[str], step_ns: int, *, clock_steps: int = 1) -> None:
        """Start publishing the true poses of robots and, every `clock_steps` steps, the time."""
        self._step_s, self._clock_steps = step_ns * 1e-9, clock_steps
        self._truth_steps = max(1, round(1.0 / (self.params.truth_rate * self._step_s)))
        self._clock_publisher = self.create_publisher(Clock, "/clock", _CLOCK_QOS)
        self._truths = [
            self.create_publisher(PoseStamped, f"{name}/ground_truth", _TRUTH_QOS) for name in names
        ]

    def step(self) -> None:
        """Advance the world by a step, and `publish_step`."""
        raise NotImplementedError

    def waits(self) -> bool:
        """Whether simulated time waits for what another node has still to send; see `give_up`."""
        return False

    def give_up(self) -> None:
        """Wait no longer: nothing has come for `_PATIENCE_S` of real time."""

    def _is_held(self) -> bool:
        """Whether simulated time is paused."""
        if not self.waits():
            self._held_since_s = None
            return False
        now_s = time.monotonic()
        self._held_since_s = self._held_since_s or now_s
        if now_s > self._held_since_s + _PATIENCE_S:
            self._held_since_s = None
            self.give_up()
        return True

    def publish_step(self, now_ns: int, poses: FloatArray) -> None:
        """Publish the time after a step, and at `truth_rate` the true poses (N, 3)."""
        if self._steps % self._clock_steps == 0:
            self._clock_publisher.publish(Clock(clock=stamp_message(now_ns)))
        if self._steps % self._truth_steps == 0:
            stamp_ns = np.array([now_ns], np.int64)
            for publisher, pose in zip(self._truths, poses, strict=True):
                publisher.publish(encode_pose_stamped("map", stamp_ns, pose[None])[0])
        self._steps += 1

    def run(self, stop: Stop) -> int:
        """Step and answer drivers until asked to stop and their robots stand; returns the exit status.

        All processes of a simulation get the signal to stop at once, and a robot whose world has ended
        cannot be stopped.
        """
        executor = EventsExecutor()
        executor.add_node(self)
        due_s = time.monotonic()
        while not stop.requested or self._is_needed():
            self.step()
            due_s = max(due_s + self._step_s / self.params.rate, time.monotonic() - _MAX_LAG_S)
            self.host.poll(0.0)
            while (left_s := due_s - time.monotonic()) > 0.0:
                self.host.poll(left_s)
            executor.spin_once(timeout_sec=0.0)
            while self._is_held() and not stop.requested:
                self.host.poll(0.0)
                executor.spin_once(timeout_sec=_HELD_WAKE_S)
        executor.shutdown()
        return 0

    def _is_needed(self) -> bool:
        """Whether drivers may have to stop their robots after this node was asked to stop."""
        now_s = time.monotonic()
        self._asked_s = min(self._asked_s, now_s)
        if self.host.is_used():
            self._used_s = now_s
        return now_s < min(max(self._asked_s, self._used_s) + _QUIET_S, self._asked_s + _FAREWELL_S)

    def destroy_node(self) -> None:
        """Close the robots' links, too."""
        self.host.close()
        super().destroy_node()
