"""Messages of motion capture and of other localisers, as poses of named bodies. No ROS here.

Messages may be those of rclpy or of `common.messages.cdr`, whose fields have the same names.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import (
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    TRANSFORMS,
    nanoseconds,
)
from swarm_loc_estimator.common.messages.poses import PLANE, yaw_of

BODY = "<body>"  # Stands for the name of a body in a topic
_UNKNOWN: FloatArray = np.zeros((3, 3))


class BodyPose(NamedTuple):
    """Pose of a body."""

    name: str  # Its name in the message; "": the message is about the body of its topic
    frame_id: str  # Frame of the pose
    stamp_ns: int  # Stamp of the message
    pose: tuple[float, float, float]  # x [m], y [m] and yaw [rad], NaN if it was not measured
    tilt: float  # Angle between the z axes of the body and of the frame [rad]; 0 without orientation
    covariance: FloatArray = _UNKNOWN  # (3, 3) of the pose; zeros: unknown


@dataclass(frozen=True)
class LocalizerSource:
    """Kind of messages of localisers."""

    message_type: str  # Such as geometry_msgs/msg/PoseStamped
    topic: str  # Default topic; contains `BODY` if each body has its own
    bodies: Callable[[Any], Iterable[BodyPose]]  # Reads the poses of a message


def _body(name: str, header: Any, place: Any, turn: Any, covariance: FloatArray = _UNKNOWN) -> BodyPose:
    """A body at a geometry_msgs/Point or Vector3 with a Quaternion."""
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    norm = x * x + y * y + z * z + w * w
    yaw, tilt = math.nan, 0.0
    if math.isfinite(norm) and norm > 0.0:  # zeros or NaN: bodies that are tracked without orientation
        yaw, tilt = yaw_of(x, y, z, w), math.acos(max(1.0 - 2.0 * (x * x + y * y) / norm, -1.0))
    return BodyPose(
        name, header.frame_id, nanoseconds(header.stamp), (place.x, place.y, yaw), tilt, covariance
    )


def _of_pose(message: Any) -> Iterator[BodyPose]:
    yield _body("", message.header, message.pose.position, message.pose.orientation)


def _of_pose_with_covariance(message: Any) -> Iterator[BodyPose]:
    pose, covariance = message.pose.pose, np.reshape(message.pose.covariance, (6, 6))[PLANE]
    yield _body("", message.header, pose.position, pose.orientation, covariance)


def _of_transforms(message: Any) -> Iterator[BodyPose]:
    for one in message.transforms:
        yield _body(one.child_frame_id, one.header, one.transform.translation, one.transform.rotation)


def _of_named_poses(message: Any) -> Iterator[BodyPose]:
    for one in message.poses:
        yield _body(one.name, message.header, one.pose.position, one.pose.orientation)


def _of_rigid_bodies(message: Any) -> Iterator[BodyPose]:
    for one in message.rigidbodies:
        yield _body(one.rigid_body_name, message.header, one.pose.position, one.pose.orientation)


SOURCES: Mapping[str, LocalizerSource] = {
    "pose": LocalizerSource(POSE_STAMPED, f"/vrpn_mocap/{BODY}/pose", _of_pose),
    "pose_with_covariance": LocalizerSource(
        POSE_WITH_COVARIANCE, f"{BODY}/amcl_pose", _of_pose_with_covariance
    ),
    "odometry": LocalizerSource(ODOMETRY, f"{BODY}/odometry/global", _of_pose_with_covariance),
    "tf": LocalizerSource(TRANSFORMS, "/tf", _of_transforms),
    "named_poses": LocalizerSource(
        "motion_capture_tracking_interfaces/msg/NamedPoseArray", "/poses", _of_named_poses
    ),
    "rigid_bodies": LocalizerSource("mocap4r2_msgs/msg/RigidBodies", "/rigid_bodies", _of_rigid_bodies),
}
"""Kinds of messages by name."""
