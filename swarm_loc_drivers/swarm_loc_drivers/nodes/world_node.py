"""One simulated world of e-pucks as a ROS 2 node: robots that answer their drivers' bytes, cameras, /clock.

    ./run swarm_loc_drivers epuck_world_node --ros-args -p swarm_file:=swarm.yaml -p first_port:=20000

Drivers connect to tcp://localhost:20000, 20001, ... in the order of the swarm description, or with
`link_folder` to serial ports named like the robots. The node publishes `/clock`, per robot `ground_truth`
(for evaluation and steering) and, in the place of the camera board's own driver,
`image_raw` and `camera_info` of the 1280x960 camera; pictures that nobody listens to are not drawn. With
`answer_within` time does not run away from those who read them.
"""

from __future__ import annotations

import sys
import time
from array import array
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image

from swarm_loc_drivers.nodes.odometry_output import stamp_message
from swarm_loc_drivers.nodes.unanswered import Unanswered
from swarm_loc_drivers.nodes.world_parameters import WorldParameters, make_world
from swarm_loc_drivers.nodes.world_time import WorldTime
from swarm_loc_drivers.protocols.epuck import EPUCK_MODELS
from swarm_loc_drivers.sim.epuck_world import STEP_NS, Exposure, SimulatedEpuck
from swarm_loc_drivers.sim.firmware.host import FirmwareHost
from swarm_loc_drivers.sim.firmware.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.firmware.wifi_firmware import WifiFirmware
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_estimator.nodes.declare import declare_parameters
from swarm_loc_estimator.nodes.parameter_table import ParameterError
from swarm_loc_estimator.nodes.running import Stop, run_node
from swarm_loc_msgs.msg import MarkerDetectionArray

_CAMERA_QOS = QoSProfile(depth=5)
"""Reliable: who wants so gets every picture, and who listens with best effort gets what comes."""
_ANSWER_QOS = QoSProfile(depth=100)
_ANSWER_PATIENCE_S = 10.0
_THROTTLE_S = 30.0


class EpuckWorldNode(Node):
    """Steps the world, serves its robots' links, publishes what is to be seen of it.

    Args:
        node_arguments: Further arguments of `rclpy.node.Node`.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("epuck_world", **node_arguments)
        self._wishes = declare_parameters(self, WorldParameters)
        swarm, self._world = make_world(self._wishes)
        self._names = [robot.name for robot in swarm.robots]
        self._host = FirmwareHost()
        for robot, name in enumerate(self._names):
            self.get_logger().info(f"{name} answers at {self._serve(robot)}")
        rate, truth_rate = self._wishes.rate, self._wishes.truth_rate
        self._time = WorldTime(self, self._names, STEP_NS, rate, truth_rate)
        self._images = [self._publisher(Image, name, "image_raw") for name in self._names]
        self._infos = [self._publisher(CameraInfo, name, "camera_info") for name in self._names]
        self._held_since_s: float | None = None
        self._unanswered = Unanswered(self._wishes.answer_within)
        if self._wishes.answer_within > 0.0:
            for robot, name in enumerate(self._names):
                answered = partial(self._on_detections, robot)
                self.create_subscription(MarkerDetectionArray, f"{name}/detections", answered, _ANSWER_QOS)

    def run(self, stop: Stop) -> int:
        """Let time pass until asked to stop; the exit status."""
        self._time.run(self._step, self._host, stop, self._is_held)
        return 0

    def _is_held(self) -> bool:
        """Whether time stands still because a picture has not become detections; not for ever."""
        if not self._unanswered.is_late(self._world.now_ns):
            self._held_since_s = None
            return False
        now_s = time.monotonic()
        self._held_since_s = self._held_since_s or now_s
        if now_s > self._held_since_s + _ANSWER_PATIENCE_S:
            name, self._held_since_s = self._names[self._unanswered.give_up()], None
            self.get_logger().warning(
                f"a picture of {name} has not become {name}/detections; time goes on without",
                throttle_duration_sec=_THROTTLE_S,
            )
        return True

    def destroy_node(self) -> None:
        """Switch the robots off, too."""
        self._host.close()
        super().destroy_node()

    def _serve(self, robot: int) -> str:
        """Put a robot on its link; the address for its driver."""
        body, folder = SimulatedEpuck(self._world, robot), self._wishes.link_folder
        try:
            if folder:
                link = Path(folder) / self._names[robot]
                return str(self._host.serve_pty(SerialFirmware(body, EPUCK_MODELS[self._wishes.model]), link))
            port = self._wishes.first_port + robot if self._wishes.first_port else 0
            return f"tcp://localhost:{self._host.serve_tcp(WifiFirmware(body), port=port)}"
        except OSError as error:
            name, value = ("link_folder", folder) if folder else ("first_port", str(self._wishes.first_port))
            raise ParameterError(
                f"parameter {name} = {value} cannot be used for {self._names[robot]}: {error.strerror}."
            ) from error

    def _publisher(self, kind: type, robot: str, topic: str) -> Publisher:
        return self.create_publisher(kind, f"{robot}/{topic}", _CAMERA_QOS)

    def _step(self) -> None:
        """Let the world do a step; tell the time, and then what belongs to it."""
        taken = self._world.step()
        self._time.tell(self._world.now_ns, self._world.poses)
        for exposure in taken:
            if self._images[exposure.robot].get_subscription_count():
                self._publish_picture(exposure)

    def _publish_picture(self, exposure: Exposure) -> None:
        message = image_message(self._world.picture(exposure))
        message.header.stamp = stamp_message(exposure.stamp_ns)
        message.header.frame_id = f"{self._names[exposure.robot]}/camera_optical_frame"
        info = camera_info_message(self._wishes.camera)
        info.header = message.header
        self._infos[exposure.robot].publish(info)
        self._images[exposure.robot].publish(message)
        self._unanswered.ask(exposure.robot, exposure.stamp_ns, self._world.now_ns)

    def _on_detections(self, robot: int, message: MarkerDetectionArray) -> None:
        self._unanswered.answer(robot, Time.from_msg(message.header.stamp).nanoseconds)


def image_message(picture: NDArray[np.uint8]) -> Image:
    """A grey picture (height, width) as sensor_msgs/Image, without its header."""
    height, width = picture.shape
    message = Image(height=height, width=width, encoding="mono8", step=width)
    message.data = array("B", picture.tobytes())  # a list would be checked byte by byte
    return message


def camera_info_message(model: CameraModel) -> CameraInfo:
    """The calibration as sensor_msgs/CameraInfo, without its header."""
    fields = model.camera_info()
    return CameraInfo(**{**fields, "d": fields["d"].tolist()})


def main() -> int:
    """Run until SIGINT or SIGTERM; 1 when a parameter cannot be used."""
    return run_node("epuck_world_node", EpuckWorldNode, EpuckWorldNode.run)


if __name__ == "__main__":
    sys.exit(main())
