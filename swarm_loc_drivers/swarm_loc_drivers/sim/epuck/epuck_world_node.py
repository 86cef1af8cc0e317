"""One simulated world of e-pucks as a ROS 2 node: robots that answer their drivers' bytes, cameras, /clock.

    ./run swarm_loc_drivers epuck_world_node --ros-args -p swarm_file:=swarm.yaml -p first_port:=20000

Drivers connect to tcp://localhost:20000, 20001, ... in the order of the swarm description, or with
`link_folder` to serial ports named like the robots. The node publishes `/clock`, per robot `ground_truth`
(for evaluation and steering) and, in the place of the camera board's own driver,
`image_raw` and `camera_info` of the 1280x960 camera; with `aerial_rate` those of an
overhead camera, too, under `aerial/`. Images without subscribers are not drawn. With
`answer_within` simulated time waits for those who read them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from swarm_loc_drivers.common.calibration_file import CameraCalibration
from swarm_loc_drivers.common.robot_driver_node import camera_info_message, image_message, stamp_message
from swarm_loc_drivers.epuck.hardware import EPUCK_MODELS
from swarm_loc_drivers.sim.epuck.parts import Unanswered
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.wifi_firmware import WifiFirmware
from swarm_loc_drivers.sim.epuck.world import (
    OVERHEAD,
    STEP_NS,
    EpuckWorldParameters,
    SimulatedEpuck,
    make_world,
)
from swarm_loc_drivers.sim.render.rigs import overhead_model
from swarm_loc_drivers.sim.world_node import WorldNode
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.node import run_node
from swarm_loc_msgs.msg import AnonymousDetectionArray, MarkerDetectionArray

_CAMERA_QOS = QoSProfile(depth=5)  # Reliable, so that subscribers can choose: each image, or best effort


class CameraOutput:
    """Publishes `image_raw` and `camera_info` of one simulated camera, in a robot's namespace or its own."""

    def __init__(self, node: Node, robot: str, calibration: CameraCalibration) -> None:
        self._calibration = calibration
        self._frame_id = f"{robot}/camera_optical_frame"
        self._infos = node.create_publisher(CameraInfo, f"{robot}/camera_info", _CAMERA_QOS)
        self._images = node.create_publisher(Image, f"{robot}/image_raw", _CAMERA_QOS)
        self._sent_to = self._received_by = 0  # subscribers to camera_info: at the last, at a received one

    def publish(self, stamp_ns: int, draw: Callable[[], NDArray[np.uint8]]) -> bool:
        """Publish the calibration, and an image if it has subscribers; returns whether it was published.

        Images are held back until all subscribers have a calibration, since they would drop them without.
        `draw` makes the image (height, width).
        """
        listeners = self._infos.get_subscription_count()
        if self._infos.wait_for_all_acked(Duration()):
            self._received_by = self._sent_to
        header = Header(stamp=stamp_message(stamp_ns), frame_id=self._frame_id)
        self._infos.publish(camera_info_message(self._calibration, header))
        self._sent_to = listeners
        if not self._images.get_subscription_count() or self._received_by < listeners:
            return False
        self._images.publish(image_message(draw(), stamp_ns, self._frame_id))
        return True


_AERIAL = "aerial"  # Namespace of the overhead camera
_ANSWER_QOS = QoSProfile(depth=100)
_THROTTLE_S = 30.0


class EpuckWorldNode(WorldNode[EpuckWorldParameters]):
    """Steps the world, serves its robots' links, publishes clock, true poses and images."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("epuck_world", EpuckWorldParameters, **node_arguments)
        params = self.params
        swarm, self._world = make_world(params)
        self._names = [robot.name for robot in swarm.robots]

        # robots: their firmware, links, clock and true poses
        def firmware_of(robot: int) -> SerialFirmware | WifiFirmware:
            body = SimulatedEpuck(self._world, robot)
            return (
                SerialFirmware(body, EPUCK_MODELS[params.model]) if params.link_folder else WifiFirmware(body)
            )

        self.serve(self._names, firmware_of, params.link_folder, first_port=params.first_port)
        self.begin(self._names, STEP_NS)
        # cameras, on the robots and above
        calibration = params.camera.calibration
        self._cameras = [CameraOutput(self, name, calibration) for name in self._names]
        if params.overhead.is_there:  # Python counts -1, which stands for it, from the end
            self._names.append(_AERIAL)
            self._cameras.append(CameraOutput(self, _AERIAL, overhead_model(params.overhead).calibration))
        # detections for which simulated time waits
        self._unanswered = Unanswered(params.answer_within)
        if params.answer_within > 0.0:
            for robot, name in enumerate(robot.name for robot in swarm.robots):
                answered = partial(self._on_detections, robot)
                self.create_subscription(MarkerDetectionArray, f"{name}/detections", answered, _ANSWER_QOS)
            answered = partial(self._on_detections, OVERHEAD)
            self.create_subscription(AnonymousDetectionArray, f"{_AERIAL}/detections", answered, _ANSWER_QOS)

    def step(self) -> None:
        """Step the world; publish the time and then the images of that time."""
        taken = self._world.step()
        now_ns = self._world.now_ns
        self.publish_step(now_ns, self._world.poses)
        for exposure in taken:
            if self._cameras[exposure.robot].publish(exposure.stamp_ns, partial(self._world.image, exposure)):
                self._unanswered.ask(exposure.robot, exposure.stamp_ns, now_ns)

    def waits(self) -> bool:
        """Whether simulated time waits for the detections of an image."""
        return self._unanswered.is_late(self._world.now_ns)

    def give_up(self) -> None:
        """Go on without the detections of the oldest image."""
        name = self._names[self._unanswered.give_up()]
        self.get_logger().warning(
            f"an image of {name} gave no {name}/detections; simulated time continues without them",
            throttle_duration_sec=_THROTTLE_S,
        )

    def _on_detections(self, robot: int, message: MarkerDetectionArray | AnonymousDetectionArray) -> None:
        self._unanswered.answer(robot, nanoseconds(message.header.stamp))


main = partial(run_node, "epuck_world_node", EpuckWorldNode)
