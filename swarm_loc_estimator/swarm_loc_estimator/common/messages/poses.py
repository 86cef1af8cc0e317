"""Poses of the plane as ROS messages: nav_msgs/Odometry, stamped poses, swarm/poses and transforms.

Names hardly ever change from one message to the next: a message is laid out once, then only its numbers are
read or replaced. To read or build message objects would cost 20 us and more per robot and message.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages import cdr
from swarm_loc_estimator.common.messages.cdr import ENCAPSULATION, CdrError, decode, encode, nanoseconds

POSE_DOUBLES = 7  # Numbers of a geometry_msgs/Pose: position and quaternion
PLANE = np.ix_((0, 1, 5), (0, 1, 5))  # Where x, y and yaw stand in a 6x6 covariance
HEADING_UNKNOWN = math.pi**2
"""Variance from which a heading counts as not measured [rad^2]; it exceeds that of uniform headings."""
UNKNOWN_COVARIANCE = np.diag([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
"""6x6; a negative first element says that the sender does not know (the convention of sensor_msgs)."""
STAMP_SIZE = 8
_COVARIANCE = POSE_DOUBLES + np.arange(36).reshape(6, 6)[PLANE].ravel()  # Of the plane, after a pose


class PoseMessage(NamedTuple):
    """A stamped pose in the plane: a nav_msgs/Odometry, or one of geometry_msgs."""

    stamp_ns: int  # When the robot was there
    frame_id: str  # Frame of the pose
    pose: tuple[float, float, float]  # (x [m], y [m], yaw [rad]); yaw is NaN when the quaternion is zero
    covariance: FloatArray = np.full((3, 3), np.nan)  # Of x, y, yaw, as published; NaN: it has none
    twist: tuple[float, float, float] = (math.nan,) * 3  # (vx [m/s], vy [m/s], yaw rate [rad/s])
    child_frame_id: str = ""  # Frame of the twist


@cached_njit
def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """The yaw [rad] of a quaternion, which need not be normalised; NaN if all are zero."""
    sine, cosine = 2.0 * (w * z + x * y), w * w + x * x - y * y - z * z
    return math.atan2(sine, cosine) if sine != 0.0 or cosine != 0.0 else math.nan


def planar_pose(pose: Any) -> tuple[float, float, float]:
    """X [m], y [m] and yaw [rad] of a geometry_msgs/Pose."""
    turn = pose.orientation
    return pose.position.x, pose.position.y, yaw_of(turn.x, turn.y, turn.z, turn.w)


def decode_odometry(data: bytes) -> PoseMessage:
    """Read a nav_msgs/Odometry; raises CdrError unless the bytes are a whole one."""
    message = decode(data, cdr.ODOMETRY)
    twist = message.twist.twist
    known = (twist.linear.x, twist.linear.y, twist.angular.z), message.child_frame_id
    return _with_covariance(message, *known)


def decode_pose_stamped(data: bytes) -> PoseMessage:
    """Read a geometry_msgs/PoseStamped; raises CdrError unless the bytes are a whole one."""
    message = decode(data, cdr.POSE_STAMPED)
    return PoseMessage(nanoseconds(message.header.stamp), message.header.frame_id, planar_pose(message.pose))


def decode_fix(data: bytes) -> PoseMessage:
    """Read a geometry_msgs/PoseWithCovarianceStamped; raises CdrError unless the bytes are a whole one."""
    return _with_covariance(decode(data, cdr.POSE_WITH_COVARIANCE))


def _with_covariance(message: Any, *known: Any) -> PoseMessage:
    """What a message says whose pose has a covariance, and what else is known of it."""
    header, covariance = message.header, message.pose.covariance.reshape(6, 6)[PLANE]
    pose = planar_pose(message.pose.pose)
    return PoseMessage(nanoseconds(header.stamp), header.frame_id, pose, covariance, *known)


def position_and_quaternion(poses: FloatArray) -> FloatArray:
    """(N, 7) x, y, z [m] and quaternion x, y, z, w of planar poses (N, 3)."""
    columns = np.zeros((len(poses), POSE_DOUBLES))
    columns[:, :2] = poses[:, :2]
    columns[:, 5] = np.sin(poses[:, 2] / 2.0)
    columns[:, 6] = np.cos(poses[:, 2] / 2.0)
    return columns


def planar_covariance(x: float, y: float, yaw: float) -> FloatArray:
    """6x6 covariance from three variances; z, roll and pitch, which the plane fixes, get a tiny one."""
    return np.diag([x, y, 1e-9, 1e-9, 1e-9, yaw])


def encode_odometry(
    frame_id: str,
    child_frame_id: str,
    stamp_ns: IntArray,
    pose: FloatArray,
    twist: FloatArray,
    covariance: FloatArray = UNKNOWN_COVARIANCE,
    twist_covariance: FloatArray = UNKNOWN_COVARIANCE,
) -> list[bytes]:
    """Serialize N nav_msgs/Odometry of one robot, with frames `<robot>/odom` and `<robot>/base_link`.

    `stamp_ns` (N,) are acquisition times, `pose` (N, 3) x [m], y [m], yaw [rad], and `twist` (N, 3) vx [m/s],
    vy [m/s], yaw rate [rad/s]. The covariances (6, 6) of both are the same in all.
    """
    numbers = np.zeros((len(stamp_ns), POSE_DOUBLES + 36 + 6 + 36))
    numbers[:, :POSE_DOUBLES] = position_and_quaternion(pose)
    numbers[:, 7:43] = covariance.reshape(36)
    numbers[:, [43, 44, 48]] = twist
    numbers[:, 49:] = twist_covariance.reshape(36)
    model = {"header": {"frame_id": frame_id}, "child_frame_id": child_frame_id}
    return _copies(encode(model, cdr.ODOMETRY), stamp_ns, numbers)


def encode_pose_stamped(frame_id: str, stamp_ns: IntArray, pose: FloatArray) -> list[bytes]:
    """Serialize geometry_msgs/PoseStamped; arguments as for `encode_odometry`."""
    model = encode({"header": {"frame_id": frame_id}}, cdr.POSE_STAMPED)
    return _copies(model, stamp_ns, position_and_quaternion(pose))


def encode_poses(frame_id: str, stamp_ns: IntArray, pose: FloatArray, covariance: FloatArray) -> list[bytes]:
    """N PoseWithCovarianceStamped of poses (N, 3) x [m], y [m], yaw [rad] and covariances (N, 3, 3)."""
    numbers = np.zeros((len(pose), POSE_DOUBLES + 36))
    numbers[:, :POSE_DOUBLES] = position_and_quaternion(pose)
    numbers[:, POSE_DOUBLES:] = planar_covariance(0.0, 0.0, 0.0).reshape(36)
    numbers[:, _COVARIANCE] = covariance.reshape(-1, 9)
    return _copies(encode({"header": {"frame_id": frame_id}}, cdr.POSE_WITH_COVARIANCE), stamp_ns, numbers)


def encode_fix(frame_id: str, stamp_ns: int, pose: ArrayLike, covariance: ArrayLike) -> bytes:
    """Serialize one pose (3,) with its covariance (3, 3), as `encode_poses` does."""
    one = (np.array([value], dtype=float) for value in (pose, covariance))
    return encode_poses(frame_id, np.array([stamp_ns]), *one)[0]


def stamp_bytes(stamp_ns: IntArray) -> NDArray[np.uint8]:
    """(n, 8) bytes of stamps (n,), as builtin_interfaces/Time has them."""
    return cdr.stamp_rows(stamp_ns).view(np.uint8).reshape(-1, STAMP_SIZE)


def _copies(model: bytes, stamp_ns: IntArray, numbers: FloatArray) -> list[bytes]:
    """Copies (N,) of a message with other stamps (N,) in the header, and other doubles (N, k) at the end."""
    rows = np.tile(np.frombuffer(model, np.uint8), (len(stamp_ns), 1))
    rows[:, ENCAPSULATION : ENCAPSULATION + STAMP_SIZE] = stamp_bytes(stamp_ns)
    rows[:, -8 * numbers.shape[1] :] = np.ascontiguousarray(numbers, dtype="<f8").view(np.uint8)
    copies = rows.tobytes()
    return [copies[begin : begin + len(model)] for begin in range(0, len(copies), len(model))]


_DOUBLES = 3 + 9 + 1  # Numbers of a robot in swarm/poses: pose, covariance and age of the fix
_STAMP = slice(ENCAPSULATION, ENCAPSULATION + STAMP_SIZE)


class EstimateMessage(NamedTuple):
    """One swarm/poses."""

    stamp_ns: int  # The instant
    frame_id: str  # Frame of the poses
    names: tuple[str, ...]  # N robots
    pose: FloatArray  # (N, 3) x [m], y [m], theta [rad]; NaN: not located
    covariance: FloatArray  # (N, 3, 3); NaN: not located
    fix_age_s: FloatArray  # (N,) [s]; -1: never
    status: NDArray[np.uint8]  # (N,) of `Status`
    heading_known: BoolArray  # (N,)


def _bytes_from(offsets: Sequence[int], size: int) -> NDArray[np.intp]:
    """Indices (n, size) of the bytes from each offset on."""
    return np.array(offsets, dtype=np.intp).reshape(-1, 1) + np.arange(size)


class _Layout:
    """Where the numbers stand in a SwarmPoses, as long as its other bytes are the same."""

    def __init__(self, data: bytes) -> None:
        places: dict[str, list[int]] = {}
        message = decode(data, cdr.SWARM_POSES, places)
        self.frame_id: str = message.header.frame_id  # Frame of the poses
        self.names = tuple(robot.name for robot in message.robots)  # N robots
        # (N, 104) indices of the bytes of each robot's numbers
        self.numbers = _bytes_from(places.get("robots.x", []), 8 * _DOUBLES)
        # (N, 2) indices of the status, and of whether the heading is known
        self.states = _bytes_from(places.get("robots.status", []), 2)
        is_other = np.ones(len(data), dtype=np.bool_)
        is_other[_STAMP] = is_other[self.numbers] = is_other[self.states] = False
        self.others = np.flatnonzero(is_other)  # (m,) indices of all bytes but these and the stamp
        self.expected = np.frombuffer(data, np.uint8)[self.others]  # (m,) these bytes


class SwarmPosesReader:
    """Reads serialized SwarmPoses."""

    def __init__(self) -> None:
        self._layout = _Layout(encode({}, cdr.SWARM_POSES))
        self._length = -1

    def read(self, data: bytes) -> EstimateMessage:
        """The columns of a message; raises CdrError unless it is a whole SwarmPoses of little-endian CDR."""
        raw, layout = np.frombuffer(data, dtype=np.uint8), self._layout
        if len(data) != self._length or not np.array_equal(raw[layout.others], layout.expected):
            if bytes(data[:2]) != b"\x00\x01":
                raise CdrError("the message is not plain little-endian CDR.")
            layout = self._layout = _Layout(data)
            self._length = len(data)
        seconds, rest_ns = struct.unpack_from("<iI", data, ENCAPSULATION)
        numbers = raw[layout.numbers].view("<f8").reshape(-1, _DOUBLES)
        return EstimateMessage(
            seconds * cdr.SECOND_NS + rest_ns,
            layout.frame_id,
            layout.names,
            numbers[:, :3],
            numbers[:, 3:12].reshape(-1, 3, 3),
            numbers[:, 12],
            raw[layout.states[:, 0]],
            raw[layout.states[:, 1]] != 0,
        )


class SwarmPosesEncoder:
    """Serializes swarm_loc_msgs/SwarmPoses of robots with these names, in one frame."""

    def __init__(self, names: list[str], frame_id: str) -> None:
        robots = [{"name": name} for name in names]
        message = encode({"header": {"frame_id": frame_id}, "robots": robots}, cdr.SWARM_POSES)
        self._layout = _Layout(message)
        self._message = np.frombuffer(bytearray(message), dtype=np.uint8)

    def encode(
        self,
        stamp_ns: int,
        poses: FloatArray,
        covariances: FloatArray,
        fix_age_s: FloatArray,
        status: NDArray[np.uint8],
        heading_known: BoolArray,
    ) -> bytes:
        """The message for poses (N, 3), covariances (N, 3, 3), ages, status and known headings (N,)."""
        message = self._message
        message[_STAMP] = stamp_bytes(np.array([stamp_ns]))
        numbers = np.column_stack([poses, covariances.reshape(-1, 9), fix_age_s])
        message[self._layout.numbers] = np.ascontiguousarray(numbers, "<f8").view(np.uint8)
        message[self._layout.states] = np.column_stack([status, heading_known])
        return message.tobytes()


class TransformsEncoder:
    """Serializes tf2_msgs/TFMessage from one frame to the child frames of all robots."""

    def __init__(self, frame_id: str, children: list[str]) -> None:
        self._header = {"frame_id": frame_id}
        self._children = children
        self._lay_out(np.zeros(len(children), dtype=np.bool_))

    def encode(self, stamp_ns: int, included: BoolArray, transforms: FloatArray) -> bytes:
        """The message for those robots that are `included` (N,) among transforms (N, 3)."""
        if not np.array_equal(included, self._included):
            self._lay_out(included)
        message, numbers = self._message, position_and_quaternion(transforms[included])
        message[self._stamps] = stamp_bytes(np.array([stamp_ns]))
        message[self._numbers] = np.ascontiguousarray(numbers, "<f8").view(np.uint8)
        return message.tobytes()

    def _lay_out(self, included: BoolArray) -> None:
        children = [self._children[index] for index in np.flatnonzero(included)]
        transforms = [{"header": self._header, "child_frame_id": child} for child in children]
        message = encode({"transforms": transforms}, cdr.TRANSFORMS)
        places: dict[str, list[int]] = {}
        decode(message, cdr.TRANSFORMS, places)
        self._included = included.copy()
        self._message = np.frombuffer(bytearray(message), dtype=np.uint8)
        self._stamps = _bytes_from(places.get("transforms.header.stamp.sec", []), STAMP_SIZE)
        self._numbers = _bytes_from(places.get("transforms.transform.translation.x", []), 8 * POSE_DOUBLES)
