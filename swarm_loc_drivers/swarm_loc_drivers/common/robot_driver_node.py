"""A node around the driver of one robot: it starts the driver, and stops the robot at the end.

Odometry, images and calibrations as ROS messages.
"""

from __future__ import annotations

import math
import time
from array import array
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Quaternion, Twist
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from swarm_loc_drivers.common.calibration_file import CameraCalibration
from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import NO_CLOCK, DriverParameters, RobotDriver, Velocity
from swarm_loc_estimator.common.health import PATIENCE_S, Level, Report, level_of
from swarm_loc_estimator.common.messages.poses import PLANE, TransformsEncoder, encode_odometry
from swarm_loc_estimator.common.node import ConfiguredNode, Stop

ODOMETRY_QOS = QoSProfile(depth=10)
_TF_QOS = QoSProfile(depth=100)

_FIXED_VARIANCE = 1e-9  # Variance of z, roll and pitch, and least variance of all other components


def stamp_message(stamp_ns: int) -> TimeMessage:
    """Convert a time [ns] to a message."""
    return Time(nanoseconds=stamp_ns).to_msg()


def yaw_quaternion(yaw: float) -> Quaternion:
    """Quaternion of a rotation about z [rad]."""
    return Quaternion(z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))


class OdometryOutput:
    """Publishes the odometry of one robot: the pose of `base_frame` in `odom_frame`.

    `transforms` is the publisher of /tf; None publishes no transform.
    """

    def __init__(
        self, node: Node, topic: str, odom_frame: str, base_frame: str, transforms: Publisher | None
    ) -> None:
        self._odometry = node.create_publisher(Odometry, topic, ODOMETRY_QOS)
        self._frames = odom_frame, base_frame
        self._transforms, self._encoder = transforms, TransformsEncoder(odom_frame, [base_frame])

    def publish(self, state: OdometryState) -> None:
        """Publish a state."""
        covariances = np.tile(_FIXED_VARIANCE * np.eye(6), (2, 1, 1))
        for whole, planar in zip(covariances, (state.covariance, state.twist_covariance), strict=True):
            whole[PLANE] += planar
        stamp_ns, pose, twist = np.array([state.stamp_ns]), state.pose[None], state.twist[None]
        self._odometry.publish(encode_odometry(*self._frames, stamp_ns, pose, twist, *covariances)[0])
        if self._transforms is not None:
            self._transforms.publish(self._encoder.encode(state.stamp_ns, np.ones(1, np.bool_), pose))


def image_message(pixels: NDArray[np.uint8], stamp_ns: int, frame_id: str) -> Image:
    """Pixels (height, width) of grey or (height, width, 3) of RGB as sensor_msgs/Image."""
    height, width = pixels.shape[:2]
    message = Image(
        header=Header(stamp=stamp_message(stamp_ns), frame_id=frame_id),
        height=height,
        width=width,
        encoding="mono8" if pixels.ndim == 2 else "rgb8",
        step=pixels[0].nbytes,
    )
    message.data = array("B", pixels.tobytes())  # setting a list would check every byte
    return message


def camera_info_message(calibration: CameraCalibration, header: Header) -> CameraInfo:
    """The calibration as sensor_msgs/CameraInfo, for an image with this header."""
    return CameraInfo(
        header=header,
        height=calibration.height,
        width=calibration.width,
        distortion_model=calibration.model,
        d=list(calibration.distortion),
        k=list(calibration.matrix),
        r=list(calibration.rectification),
        p=list(calibration.projection),
    )


_COMMAND_QOS = QoSProfile(depth=1)
_CLOCK_PATIENCE_S = 30.0  # Silence about a simulation that starts: its nodes may take long on a busy machine


Parameters = TypeVar("Parameters", bound=DriverParameters)


class RobotDriverNode(ConfiguredNode[Parameters]):
    """A node in a robot's namespace, with the robot's driver; arguments as of `ConfiguredNode`.

    A subclass creates the driver as `_driver`, with `_now_ns` for a clock.
    """

    _driver: RobotDriver[Any]

    def __init__(self, *arguments: Any, **node_arguments: Any) -> None:
        super().__init__(*arguments, **node_arguments)
        robot = self.get_namespace().strip("/")
        self._prefix = f"{robot}/" if robot else ""  # Of the robot's frames and of its status
        self._base_frame = f"{self._prefix}{self.params.base_frame}"
        # an absolute name because tf2 listens only there
        self._transforms = (
            self.create_publisher(TFMessage, "/tf", _TF_QOS) if self.params.publish_tf else None
        )

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
        if self._driver.may_run:
            self.get_logger().error(f"the robot may still be moving: {self._driver.trouble}")
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

    def _start_reports(self, address: str, rates: Sequence[str], wrong: Mapping[str, str]) -> None:
        """Publish counts and rates of the driver once a second, and log errors and changes of the link.

        Of the counts in `rates`, rates are published, too. Those in `wrong` are counts of errors, which the
        log warns of, and what they mean.
        """
        self._address, self._rates, self._wrong = address, rates, wrong
        self._reported: Counter[str] = Counter()
        self._reported_s = time.monotonic()
        self._was_in_trouble = bool(self._driver.trouble)
        self.start_diagnostics(self._report)

    def _report(self) -> None:
        trouble, warning = self._driver.trouble, self._driver.warning
        counts = Counter(self._driver.counts)
        # a robot that is being switched on, or a simulation that starts, does not answer at once
        first_s = _CLOCK_PATIENCE_S if trouble == NO_CLOCK else PATIENCE_S
        patience_s = 0.0 if counts["connections"] else first_s
        self.health.warn_of("link", {trouble: trouble} if trouble else {}, patience_s)
        if self._was_in_trouble and not trouble:
            self.get_logger().info(f"connected to {self._address}")
        self._was_in_trouble = bool(trouble)
        errors = {f"{name}: {meaning}": counts[name] for name, meaning in self._wrong.items()}
        self.health.warn_of_drops(errors, "errors")
        self.health.warn_of("robot", {warning: warning} if warning else {})
        self.health.warn_of("defect", dict(self._driver.defects))
        # the report, with rates since the last one
        now_s = time.monotonic()
        elapsed_s, self._reported_s = now_s - self._reported_s, now_s
        values: dict[str, object] = dict(sorted(counts.items()))
        for name in self._rates:
            values[f"{name} rate [1/s]"] = f"{(counts[name] - self._reported[name]) / elapsed_s:.4g}"
        self._reported = counts
        level, name = Level.ERROR if trouble else level_of(warning), f"{self._prefix}{self.get_name()}"
        self.publish_reports(Report(name, trouble or warning or "connected", level, values, self._address))

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)
