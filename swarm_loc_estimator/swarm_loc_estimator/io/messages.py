"""Messages out of numbers: objects for a few, ready bytes for many.

All odometry messages of one robot have the same length and differ in numbers only, as do detection arrays of
the same count. So one message is serialized by the type store, and the numbers of all others are written
into copies of it at once.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.io.cdr import (
    DETECTION_DTYPE,
    DETECTION_GAP,
    DETECTION_PADDING,
    ENCAPSULATION,
    ODOMETRY_DOUBLES,
)
from swarm_loc_estimator.io.planar import PLANE, POSE_DOUBLES, planar_covariance, position_and_quaternion
from swarm_loc_estimator.io.typestore import (
    BRIGHTNESS,
    DETECTION,
    DETECTIONS,
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    encode,
    typestore,
)

Array = npt.NDArray[np.float64]

_NANOSECONDS = 1_000_000_000
UNKNOWN_COVARIANCE = np.diag([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
"""6x6; a negative first element says that the sender does not know (the convention of sensor_msgs)."""


def encode_odometry(
    frame_id: str,
    child_frame_id: str,
    stamp_ns: npt.NDArray[np.int64],
    pose: Array,
    twist: Array,
    covariance: Array,
    twist_covariance: Array,
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
    template = _odometry_template(frame_id, child_frame_id)
    rows = _stamped_rows(template, stamp_ns)
    body = np.zeros((len(stamp_ns), ODOMETRY_DOUBLES))
    body[:, :POSE_DOUBLES] = position_and_quaternion(pose)
    body[:, 7:43] = covariance.reshape(36)
    body[:, [43, 44, 48]] = twist
    body[:, 49:] = twist_covariance.reshape(36)
    rows[:, -8 * ODOMETRY_DOUBLES :] = body.view(np.uint8)
    return _split(rows)


def encode_pose_stamped(frame_id: str, stamp_ns: npt.NDArray[np.int64], pose: Array) -> list[bytes]:
    """Serialize geometry_msgs/PoseStamped; arguments as for `encode_odometry`."""
    rows = _stamped_rows(_pose_template(frame_id), stamp_ns)
    rows[:, -8 * POSE_DOUBLES :] = position_and_quaternion(pose).view(np.uint8)
    return _split(rows)


def encode_detections(frame_id: str, stamp_ns: int, detections: npt.NDArray[np.void]) -> bytes:
    """Serialize one swarm_loc_msgs/MarkerDetectionArray from (n,) detections of `DETECTION_DTYPE`."""
    template = _detection_template(frame_id, len(detections))
    row: npt.NDArray[np.uint8] = _stamped_rows(template, np.array([stamp_ns], np.int64))[0]
    if len(detections):
        packed = detections.astype(DETECTION_DTYPE).view(np.uint8)
        packed.reshape(len(detections), -1)[:, DETECTION_PADDING] = 0  # equal input must give equal bytes
        behind_gap = len(packed) - DETECTION_GAP
        row[-behind_gap:] = packed[DETECTION_GAP:]
        start = _detections_start(frame_id)
        row[start : start + DETECTION_GAP] = packed[:DETECTION_GAP]
    return row.tobytes()


def encode_fix(frame_id: str, stamp_ns: int, pose: npt.ArrayLike, covariance: npt.ArrayLike) -> bytes:
    """Serialize one geometry_msgs/PoseWithCovarianceStamped of the plane.

    Args:
        frame_id: Frame of the pose, `map`.
        stamp_ns: When the robot was there.
        pose: (3,) x [m], y [m], yaw [rad].
        covariance: (3, 3) of it.
    """
    types, whole = typestore().types, planar_covariance(0.0, 0.0, 0.0)
    whole[PLANE] = covariance
    place = _pose(position_and_quaternion(np.asarray(pose, dtype=float)[None])[0])
    body = types["geometry_msgs/msg/PoseWithCovariance"](place, whole.reshape(36))
    return encode(types[POSE_WITH_COVARIANCE](_header(frame_id, stamp_ns), body), POSE_WITH_COVARIANCE)


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
    message = typestore().types[BRIGHTNESS](
        header=_header(frame_id, stamp_ns),
        receiver=pair[0],
        transmitter=pair[1],
        n=len(readings),
        readings=readings.reshape(-1).astype(np.int32),
        power=power,
        saturation=saturation,
    )
    return encode(message, BRIGHTNESS)


def _detections_start(frame_id: str) -> int:
    """Offset of the first detection: behind stamp, frame and count, the latter aligned to 4."""
    end = ENCAPSULATION + 12 + len(frame_id.encode()) + 1
    return end + -end % 4 + 4


def _stamped_rows(template: bytes, stamp_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """(N, length) copies of a message with a header, each with its stamp."""
    rows = np.tile(np.frombuffer(template, np.uint8), (len(stamp_ns), 1))
    stamp = np.empty((len(stamp_ns), 2), "<i4")
    stamp[:, 0], stamp[:, 1] = np.divmod(stamp_ns, _NANOSECONDS)
    rows[:, ENCAPSULATION : ENCAPSULATION + 8] = stamp.view(np.uint8)
    return rows


def _split(rows: npt.NDArray[np.uint8]) -> list[bytes]:
    """Rows as separate messages."""
    length, joined = rows.shape[1], rows.tobytes()
    return [joined[begin : begin + length] for begin in range(0, len(joined), length)]


def _header(frame_id: str, stamp_ns: int = 0) -> Any:
    """A std_msgs/Header."""
    types = typestore().types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, _NANOSECONDS))
    return types["std_msgs/msg/Header"](stamp, frame_id)


def _pose(numbers: npt.ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) -> Any:
    """A geometry_msgs/Pose of position and quaternion (7,)."""
    types = typestore().types
    x, y, z, *quaternion = np.asarray(numbers, dtype=float).tolist()
    point = types["geometry_msgs/msg/Point"](x, y, z)
    return types["geometry_msgs/msg/Pose"](point, types["geometry_msgs/msg/Quaternion"](*quaternion))


@lru_cache(maxsize=1024)
def _odometry_template(frame_id: str, child_frame_id: str) -> bytes:
    """An odometry message with all numbers zero."""
    types = typestore().types
    zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = types["geometry_msgs/msg/Twist"](zero, zero)
    message = types[ODOMETRY](
        _header(frame_id),
        child_frame_id,
        types["geometry_msgs/msg/PoseWithCovariance"](_pose(), np.zeros(36)),
        types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
    )
    return encode(message, ODOMETRY)


@lru_cache(maxsize=1024)
def _pose_template(frame_id: str) -> bytes:
    """A stamped pose with all numbers zero."""
    return encode(typestore().types[POSE_STAMPED](_header(frame_id), _pose()), POSE_STAMPED)


@lru_cache(maxsize=1024)
def _detection_template(frame_id: str, count: int) -> bytes:
    """An array of `count` detections with all numbers zero."""
    types = typestore().types
    pose = types["geometry_msgs/msg/PoseWithCovariance"](_pose(), np.zeros(36))
    one = types[DETECTION](
        id=0,
        family=0,
        content=0,
        id_margin=0.0,
        corners_px=np.zeros(8),
        pose=pose,
        alternative=_pose(),
        alternative_ratio=0.0,
    )
    return encode(types[DETECTIONS](_header(frame_id), [one] * count), DETECTIONS)
