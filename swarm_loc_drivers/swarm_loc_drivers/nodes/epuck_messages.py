"""What an e-puck reports, as ROS messages."""

from __future__ import annotations

import math
from array import array

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image, Range
from std_msgs.msg import Header

from swarm_loc_drivers.core.epuck_session import Photo
from swarm_loc_drivers.core.wheel_odometry import OdometryState
from swarm_loc_drivers.io.calibration_file import CameraCalibration
from swarm_loc_drivers.protocols.epuck import PROXIMITY_BEARINGS, PROXIMITY_RADIUS_M
from swarm_loc_drivers.protocols.epuck_proximity import FIELD_OF_VIEW, MAX_RANGE_M, MIN_RANGE_M, range_of_raw

PROXIMITY_NAMES = tuple(f"ps{sensor}" for sensor in range(len(PROXIMITY_BEARINGS)))

_FIXED_VARIANCE = 1e-9
"""Of what the plane fixes: z, roll, pitch, and motion to the side."""
_XYYAW = np.ix_((0, 1, 5), (0, 1, 5))
_FORWARD_YAW = np.ix_((0, 5), (0, 5))


def stamp_message(stamp_ns: int) -> TimeMessage:
    """A time [ns] as a message."""
    return Time(nanoseconds=stamp_ns).to_msg()


def yaw_quaternion(yaw: float) -> Quaternion:
    """A rotation about z [rad]."""
    return Quaternion(z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))


def odometry_message(state: OdometryState, odom_frame: str, base_frame: str) -> Odometry:
    """The state as nav_msgs/Odometry, its covariances over x, y, z, and rotation about X, Y, Z."""
    message = Odometry(
        header=Header(stamp=stamp_message(state.stamp_ns), frame_id=odom_frame), child_frame_id=base_frame
    )
    position, twist = message.pose.pose.position, message.twist.twist
    position.x, position.y, yaw = (float(value) for value in state.pose)
    message.pose.pose.orientation = yaw_quaternion(yaw)
    twist.linear.x, twist.angular.z = (float(value) for value in state.twist)
    covariance, twist_covariance = np.eye(6) * _FIXED_VARIANCE, np.eye(6) * _FIXED_VARIANCE
    covariance[_XYYAW] = state.covariance
    twist_covariance[_FORWARD_YAW] = state.twist_covariance
    message.pose.covariance = covariance.ravel()
    message.twist.covariance = twist_covariance.ravel()
    return message


def odometry_transform(odometry: Odometry) -> TransformStamped:
    """The transform that the odometry is."""
    pose = odometry.pose.pose
    return TransformStamped(
        header=odometry.header,
        child_frame_id=odometry.child_frame_id,
        transform=Transform(
            translation=Vector3(x=pose.position.x, y=pose.position.y), rotation=pose.orientation
        ),
    )


def _proximity_frames(prefix: str) -> list[str]:
    """Names of the sensors' frames, x out of the sensor."""
    return [f"{prefix}{name}" for name in PROXIMITY_NAMES]


def proximity_transforms(stamp_ns: int, base_frame: str, prefix: str) -> list[TransformStamped]:
    """Where the proximity sensors sit."""
    header = Header(stamp=stamp_message(stamp_ns), frame_id=base_frame)
    transforms = []
    for frame, bearing in zip(_proximity_frames(prefix), PROXIMITY_BEARINGS, strict=True):
        place = Vector3(x=PROXIMITY_RADIUS_M * math.cos(bearing), y=PROXIMITY_RADIUS_M * math.sin(bearing))
        transform = Transform(translation=place, rotation=yaw_quaternion(bearing))
        transforms.append(TransformStamped(header=header, child_frame_id=frame, transform=transform))
    return transforms


def range_messages(stamp_ns: int, raw: NDArray[np.int64], prefix: str) -> list[Range]:
    """The proximity sensors' raw values (8,) as ranges, ps0 first."""
    stamp = stamp_message(stamp_ns)
    return [
        Range(
            header=Header(stamp=stamp, frame_id=frame),
            radiation_type=Range.INFRARED,
            field_of_view=FIELD_OF_VIEW,
            min_range=MIN_RANGE_M,
            max_range=MAX_RANGE_M,
            range=distance,
        )
        for frame, distance in zip(_proximity_frames(prefix), range_of_raw(raw).tolist(), strict=True)
    ]


def image_message(photo: Photo, frame_id: str) -> Image:
    """The picture as sensor_msgs/Image."""
    height, width, channels = photo.pixels.shape
    message = Image(
        header=Header(stamp=stamp_message(photo.stamp_ns), frame_id=frame_id),
        height=height,
        width=width,
        encoding="rgb8",
        step=width * channels,
    )
    message.data = array("B", photo.pixels.tobytes())  # a list would be checked byte by byte
    return message


def camera_info_message(image: Image, calibration: CameraCalibration) -> CameraInfo:
    """The calibration that goes with a picture."""
    return CameraInfo(
        header=image.header,
        height=calibration.height,
        width=calibration.width,
        distortion_model=calibration.model,
        d=list(calibration.distortion),
        k=list(calibration.matrix),
        r=list(calibration.rectification),
        p=list(calibration.projection),
    )
