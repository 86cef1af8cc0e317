"""Odometry, images and calibrations as ROS messages."""

from __future__ import annotations

import math
from array import array

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
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
from swarm_loc_estimator.common.messages.poses import PLANE

ODOMETRY_QOS = QoSProfile(depth=10)
_TF_QOS = QoSProfile(depth=100)

_FIXED_VARIANCE = 1e-9  # Variance of z, roll and pitch, and least variance of all other components


def stamp_message(stamp_ns: int) -> TimeMessage:
    """Convert a time [ns] to a message."""
    return Time(nanoseconds=stamp_ns).to_msg()


def yaw_quaternion(yaw: float) -> Quaternion:
    """Quaternion of a rotation about z [rad]."""
    return Quaternion(z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))


def odometry_message(state: OdometryState, odom_frame: str, base_frame: str) -> Odometry:
    """The state as nav_msgs/Odometry, its covariances over x, y, z, and rotation about X, Y, Z."""
    message = Odometry(
        header=Header(stamp=stamp_message(state.stamp_ns), frame_id=odom_frame), child_frame_id=base_frame
    )
    position, twist = message.pose.pose.position, message.twist.twist
    position.x, position.y, yaw = (float(value) for value in state.pose)
    message.pose.pose.orientation = yaw_quaternion(yaw)
    twist.linear.x, twist.linear.y, twist.angular.z = (float(value) for value in state.twist)
    covariance, twist_covariance = np.eye(6) * _FIXED_VARIANCE, np.eye(6) * _FIXED_VARIANCE
    covariance[PLANE] += state.covariance
    twist_covariance[PLANE] += state.twist_covariance
    message.pose.covariance = covariance.ravel()
    message.twist.covariance = twist_covariance.ravel()
    return message


def odometry_transform(odometry: Odometry) -> TransformStamped:
    """The transform from the odometry's frame to that of the robot."""
    pose = odometry.pose.pose
    return TransformStamped(
        header=odometry.header,
        child_frame_id=odometry.child_frame_id,
        transform=Transform(
            translation=Vector3(x=pose.position.x, y=pose.position.y), rotation=pose.orientation
        ),
    )


class OdometryOutput:
    """Publishes the odometry of one robot: the pose of `base_frame` in `odom_frame`.

    `transforms` is the publisher of /tf; None publishes no transform.
    """

    def __init__(
        self, node: Node, topic: str, odom_frame: str, base_frame: str, transforms: Publisher | None
    ) -> None:
        self._odometry = node.create_publisher(Odometry, topic, ODOMETRY_QOS)
        self._frames = odom_frame, base_frame
        self._transforms = transforms

    def publish(self, state: OdometryState) -> None:
        """Publish a state."""
        message = odometry_message(state, *self._frames)
        self._odometry.publish(message)
        if self._transforms is not None:
            self._transforms.publish(TFMessage(transforms=[odometry_transform(message)]))


def transform_publisher(node: Node) -> Publisher:
    """The publisher of /tf, an absolute name because tf2 listens only there."""
    return node.create_publisher(TFMessage, "/tf", _TF_QOS)


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
