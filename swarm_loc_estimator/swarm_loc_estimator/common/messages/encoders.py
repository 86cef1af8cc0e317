"""Serialize what robots send and what bags hold: odometry, poses, detections, brightness matrices."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import (
    ANONYMOUS_DTYPE,
    DETECTION_DTYPE,
    DETECTION_GAP,
    DETECTION_PADDING,
)
from swarm_loc_estimator.common.messages.cdr_writer import CdrWriter
from swarm_loc_estimator.common.messages.planar import (
    PLANE,
    POSE_DOUBLES,
    planar_covariance,
    position_and_quaternion,
)

_COVARIANCE = POSE_DOUBLES + np.arange(36).reshape(6, 6)[PLANE].ravel()
"""Where a planar covariance stands behind a pose."""
UNKNOWN_COVARIANCE = np.diag([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
"""6x6; a negative first element says that the sender does not know (the convention of sensor_msgs)."""


def encode_odometry(
    frame_id: str,
    child_frame_id: str,
    stamp_ns: IntArray,
    pose: FloatArray,
    twist: FloatArray,
    covariance: FloatArray,
    twist_covariance: FloatArray,
) -> list[bytes]:
    """Serialize nav_msgs/Odometry of one robot.

    Args:
        frame_id: Frame of the pose, `<robot>/odom`.
        child_frame_id: Frame of the twist, `<robot>/base_link`.
        stamp_ns: (N,) acquisition times.
        pose: (N, 3) x [m], y [m], yaw [rad].
        twist: (N, 3) vx [m/s], vy [m/s], yaw rate [rad/s].
        covariance: (6, 6) of the pose, the same in all.
        twist_covariance: (6, 6) of the twist, the same in all.

    Returns:
        N messages.
    """
    numbers = np.zeros((len(stamp_ns), POSE_DOUBLES + 36 + 6 + 36))
    numbers[:, :POSE_DOUBLES] = position_and_quaternion(pose)
    numbers[:, 7:43] = covariance.reshape(36)
    numbers[:, [43, 44, 48]] = twist
    numbers[:, 49:] = twist_covariance.reshape(36)
    writer = CdrWriter.with_header(frame_id)
    writer.text(child_frame_id)
    return writer.messages(stamp_ns, numbers)


def encode_pose_stamped(frame_id: str, stamp_ns: IntArray, pose: FloatArray) -> list[bytes]:
    """Serialize geometry_msgs/PoseStamped; arguments as for `encode_odometry`."""
    return CdrWriter.with_header(frame_id).messages(stamp_ns, position_and_quaternion(pose))


def encode_poses(frame_id: str, stamp_ns: IntArray, pose: FloatArray, covariance: FloatArray) -> list[bytes]:
    """Serialize geometry_msgs/PoseWithCovarianceStamped of the plane.

    Args:
        frame_id: Frame of the poses, `map`.
        stamp_ns: (N,) when the robots were there.
        pose: (N, 3) x [m], y [m], yaw [rad].
        covariance: (N, 3, 3) of them.

    Returns:
        N messages.
    """
    numbers = np.zeros((len(pose), POSE_DOUBLES + 36))
    numbers[:, :POSE_DOUBLES] = position_and_quaternion(pose)
    numbers[:, POSE_DOUBLES:] = planar_covariance(0.0, 0.0, 0.0).reshape(36)
    numbers[:, _COVARIANCE] = covariance.reshape(-1, 9)
    return CdrWriter.with_header(frame_id).messages(stamp_ns, numbers)


def encode_fix(frame_id: str, stamp_ns: int, pose: npt.ArrayLike, covariance: npt.ArrayLike) -> bytes:
    """Serialize one pose (3,) with its covariance (3, 3), as `encode_poses` does."""
    one = (np.array([value], dtype=float) for value in (pose, covariance))
    return encode_poses(frame_id, np.array([stamp_ns]), *one)[0]


def encode_detections(frame_id: str, stamp_ns: int, detections: npt.NDArray[np.void]) -> bytes:
    """Serialize one swarm_loc_msgs/MarkerDetectionArray from (n,) detections of `DETECTION_DTYPE`."""
    writer = CdrWriter.with_header(frame_id, stamp_ns)
    add_detections(writer, detections)
    return writer.message()


def add_detections(writer: CdrWriter, detections: npt.NDArray[np.void]) -> None:
    """Add a sequence of swarm_loc_msgs/MarkerDetection from (n,) detections of `DETECTION_DTYPE`."""
    writer.count(len(detections))
    if len(detections):
        rows = detections.astype(DETECTION_DTYPE).view(np.uint8).reshape(len(detections), -1)
        rows[:, DETECTION_PADDING] = 0  # equal input must give equal bytes
        packed = rows.tobytes()
        writer.raw(4, packed[:DETECTION_GAP])
        writer.raw(8, packed[DETECTION_GAP:])


def encode_anonymous(frame_id: str, stamp_ns: int, detections: npt.NDArray[np.void]) -> bytes:
    """Serialize one swarm_loc_msgs/AnonymousDetectionArray from (n,) detections of `ANONYMOUS_DTYPE`."""
    writer = CdrWriter.with_header(frame_id, stamp_ns)
    writer.count(len(detections))
    if len(detections):
        writer.raw(8, detections.astype(ANONYMOUS_DTYPE).tobytes())
    return writer.message()


def encode_identities(
    frame_id: str, stamp_ns: int, names: Sequence[str], place: IntArray, probability: FloatArray
) -> bytes:
    """Serialize one swarm_loc_msgs/RobotIdentities.

    Args:
        frame_id: Frame of the aerial detections.
        stamp_ns: Of the image.
        names: N robots.
        place: (N,) which detection each is; -1: not known.
        probability: (N,) of that.
    """
    writer = CdrWriter.with_header(frame_id, stamp_ns)
    writer.count(len(names))
    for name, which, sure in zip(names, place.tolist(), probability.tolist(), strict=True):
        writer.text(name)
        writer.raw(4, struct.pack("<i", which))
        writer.raw(8, struct.pack("<d", sure))
    return writer.message()


def encode_brightness(
    frame_id: str,
    stamp_ns: int,
    pair: tuple[int, int],
    readings: npt.NDArray[Any],
    power: int = 0,
    saturation: int = 0,
) -> bytes:
    """Serialize one swarm_loc_msgs/BrightnessMatrix.

    Args:
        frame_id: base_link of the receiver.
        stamp_ns: Middle of the exchange.
        pair: Ids of receiver and transmitter.
        readings: (n, n) [count], [sensor, emitter].
        power: Index of the power mode.
        saturation: The reading from which on a sensor tells no more [count]; 0: not known.
    """
    writer = CdrWriter.with_header(frame_id, stamp_ns)
    writer.raw(4, struct.pack("<IIB3xI", *pair, len(readings), readings.size))
    writer.raw(4, readings.astype("<i4").tobytes())
    writer.raw(1, struct.pack("<B3xi", power, saturation))
    return writer.message()
