"""One simulated world of e-pucks as a ROS 2 node: robots that answer their drivers' bytes, cameras, /clock.

    ./run swarm_loc_drivers epuck_world_node --ros-args -p swarm_file:=swarm.yaml -p first_port:=20000

Drivers connect to tcp://localhost:20000, 20001, ... in the order of the swarm description, or with
`link_folder` to serial ports named like the robots. The node publishes `/clock`, per robot `ground_truth`
(for evaluation and steering) and, in the place of the camera board's own driver,
`image_raw` and `camera_info` of the 1280x960 camera; with `aerial_rate` those of an
overhead camera, too, under `aerial/`. Images that nobody listens to are not drawn. With
`answer_within` time does not run away from those who read them.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.qos import QoSProfile

from swarm_loc_drivers.common.odometry_output import nanoseconds
from swarm_loc_drivers.epuck.camera_output import CameraOutput
from swarm_loc_drivers.epuck.hardware import EPUCK_MODELS
from swarm_loc_drivers.epuck.pending_images import Unanswered
from swarm_loc_drivers.sim.epuck.epuck_world_parameters import WorldParameters, make_world
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.wifi_firmware import WifiFirmware
from swarm_loc_drivers.sim.epuck.world import OVERHEAD, STEP_NS, SimulatedEpuck
from swarm_loc_drivers.sim.render.rigs import overhead_model
from swarm_loc_drivers.sim.world_node import Pace, WorldNode
from swarm_loc_estimator.common.node import run_node
from swarm_loc_msgs.msg import AnonymousDetectionArray, MarkerDetectionArray

_AERIAL = "aerial"
"""Namespace of the overhead camera."""
_ANSWER_QOS = QoSProfile(depth=100)
_ANSWER_PATIENCE_S = 10.0
_THROTTLE_S = 30.0


class EpuckWorldNode(WorldNode[WorldParameters]):
    """Steps the world, serves its robots' links, publishes what is to be seen of it."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("epuck_world", WorldParameters, **node_arguments)
        chosen = self.params
        swarm, self._world = make_world(chosen)
        self._names = [robot.name for robot in swarm.robots]
        serve = partial(self._serve_serial if chosen.link_folder else self._serve_wifi, chosen)
        link = (
            f"link_folder = {chosen.link_folder}"
            if chosen.link_folder
            else f"first_port = {chosen.first_port}"
        )
        self.begin(self._names, Pace(STEP_NS, chosen.rate, chosen.truth_rate), serve, link)
        calibration = chosen.camera.calibration
        self._cameras = [CameraOutput(self, name, calibration) for name in self._names]
        if chosen.overhead.is_there:  # Python counts -1, which stands for it, from the end
            self._names.append(_AERIAL)
            self._cameras.append(CameraOutput(self, _AERIAL, overhead_model(chosen.overhead).calibration))
        self._held_since_s: float | None = None
        self._unanswered = Unanswered(chosen.answer_within)
        if chosen.answer_within > 0.0:
            for robot, name in enumerate(robot.name for robot in swarm.robots):
                answered = partial(self._on_detections, robot)
                self.create_subscription(MarkerDetectionArray, f"{name}/detections", answered, _ANSWER_QOS)
            answered = partial(self._on_detections, OVERHEAD)
            self.create_subscription(AnonymousDetectionArray, f"{_AERIAL}/detections", answered, _ANSWER_QOS)

    def _serve_serial(self, chosen: WorldParameters, robot: int) -> str:
        firmware = SerialFirmware(SimulatedEpuck(self._world, robot), EPUCK_MODELS[chosen.model])
        return str(self.host.serve_pty(firmware, Path(chosen.link_folder) / self._names[robot]))

    def _serve_wifi(self, chosen: WorldParameters, robot: int) -> str:
        firmware = WifiFirmware(SimulatedEpuck(self._world, robot))
        port = self.host.serve_tcp(firmware, port=chosen.first_port and chosen.first_port + robot)
        return f"tcp://localhost:{port}"

    def step(self) -> None:
        """Let the world do a step; tell the time, and then what belongs to it."""
        taken = self._world.step()
        now_ns = self._world.now_ns
        self.tell(now_ns, self._world.poses)
        for exposure in taken:
            if self._cameras[exposure.robot].publish(exposure.stamp_ns, partial(self._world.image, exposure)):
                self._unanswered.ask(exposure.robot, exposure.stamp_ns, now_ns)

    def is_held(self) -> bool:
        """Whether time stands still because an image has not become detections; not for ever."""
        if not self._unanswered.is_late(self._world.now_ns):
            self._held_since_s = None
            return False
        now_s = time.monotonic()
        self._held_since_s = self._held_since_s or now_s
        if now_s > self._held_since_s + _ANSWER_PATIENCE_S:
            name, self._held_since_s = self._names[self._unanswered.give_up()], None
            self.get_logger().warning(
                f"an image of {name} has not become {name}/detections; time goes on without",
                throttle_duration_sec=_THROTTLE_S,
            )
        return True

    def _on_detections(self, robot: int, message: MarkerDetectionArray | AnonymousDetectionArray) -> None:
        self._unanswered.answer(robot, nanoseconds(message.header.stamp))


main = partial(run_node, "epuck_world_node", EpuckWorldNode)
