"""A node around the driver of one robot: it starts the driver, and stops the robot at the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from geometry_msgs.msg import Twist
from rclpy.qos import QoSProfile

from swarm_loc_drivers.common.robot_driver import RobotDriver
from swarm_loc_drivers.common.ros_messages import OdometryOutput, transform_publisher
from swarm_loc_drivers.common.velocity_command import Velocity
from swarm_loc_estimator.common.node import ConfiguredNode, Stop

_COMMAND_QOS = QoSProfile(depth=1)


class DriverParameters(Protocol):
    """Parameters that all drivers have."""

    @property
    def odom_frame(self) -> str:
        """Frame of the pose, without the robot's name."""

    @property
    def base_frame(self) -> str:
        """Frame of the robot, without its name."""

    @property
    def publish_tf(self) -> bool:
        """Whether to publish the transform between them."""


Parameters = TypeVar("Parameters", bound=DriverParameters)


class RobotDriverNode(ConfiguredNode[Parameters]):
    """A node in a robot's namespace, with the robot's driver; arguments as of `ConfiguredNode`.

    A subclass creates the driver as `_driver`, with `_now_ns` for a clock.
    """

    _driver: RobotDriver[Any]

    def __init__(self, *arguments: Any, **node_arguments: Any) -> None:
        super().__init__(*arguments, **node_arguments)
        robot = self.get_namespace().strip("/")
        self._prefix = f"{robot}/" if robot else ""
        """Prefix of the robot's frames and of its status."""
        self._base_frame = f"{self._prefix}{self.params.base_frame}"
        self._transforms = transform_publisher(self) if self.params.publish_tf else None

    def start(self) -> None:
        """Start the driver; not when constructed, since an interrupt there would not stop the robot."""
        self._driver.start()

    def run(self, stop: Stop) -> int:
        """Drive the robot until asked to stop; the exit status."""
        self.start()
        return super().run(stop)

    def begin_to_stop(self) -> None:
        """Begin to stop the robot; `destroy_node` waits until it stands."""
        self._driver.begin_to_stop()

    def destroy_node(self) -> None:
        """Stop the robot first."""
        self._driver.stop()
        super().destroy_node()

    def _odometry_output(self, topic: str, prefix: str) -> OdometryOutput:
        """Publishers of a robot's odometry; `prefix` is that of its frames."""
        odom_frame, base_frame = f"{prefix}{self.params.odom_frame}", f"{prefix}{self.params.base_frame}"
        return OdometryOutput(self, topic, odom_frame, base_frame, self._transforms)

    def _follow(self, topic: str, set_velocity: Callable[[Velocity], None]) -> None:
        """Hand the velocities of a topic to the driver."""

        def on_cmd_vel(message: Twist) -> None:
            set_velocity((message.linear.x, message.linear.y, message.angular.z))

        self.create_subscription(Twist, topic, on_cmd_vel, _COMMAND_QOS)

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)
