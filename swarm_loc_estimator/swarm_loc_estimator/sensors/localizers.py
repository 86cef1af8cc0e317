"""Poses of tracked bodies, by motion capture and other localisers, as poses of the robots that carry them.

Messages may be those of rclpy or of `common.messages.cdr`, whose fields have the same names. No ROS here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.health import Health
from swarm_loc_estimator.common.messages import cdr
from swarm_loc_estimator.common.messages.poses import (
    HEADING_UNKNOWN,
    PLANE,
    encode_fix,
    encode_pose_stamped,
    yaw_of,
)
from swarm_loc_estimator.common.parameters import ParameterError, text
from swarm_loc_estimator.sensors.fix import has_heading, is_unknown
from swarm_loc_estimator.swarm.swarm import BODY, BODY_TOPIC, Localizer

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
        name, header.frame_id, cdr.nanoseconds(header.stamp), (place.x, place.y, yaw), tilt, covariance
    )


def _of_pose_with_covariance(message: Any) -> Iterator[BodyPose]:
    pose, covariance = message.pose.pose, np.reshape(message.pose.covariance, (6, 6))[PLANE]
    yield _body("", message.header, pose.position, pose.orientation, covariance)


def _of_transforms(message: Any) -> Iterator[BodyPose]:
    for one in message.transforms:
        yield _body(one.child_frame_id, one.header, one.transform.translation, one.transform.rotation)


def _of_poses(message: Any, poses: str = "", name: str = "") -> Iterator[BodyPose]:
    """Those in a field of the message, named by one of theirs, or its own pose."""
    for one in getattr(message, poses) if poses else [message]:
        body = getattr(one, name) if name else ""
        yield _body(body, message.header, one.pose.position, one.pose.orientation)


SOURCES: Mapping[str, LocalizerSource] = {
    "pose": LocalizerSource(cdr.POSE_STAMPED, BODY_TOPIC, _of_poses),
    "pose_with_covariance": LocalizerSource(
        cdr.POSE_WITH_COVARIANCE, f"{BODY}/amcl_pose", _of_pose_with_covariance
    ),
    "odometry": LocalizerSource(cdr.ODOMETRY, f"{BODY}/odometry/global", _of_pose_with_covariance),
    "tf": LocalizerSource(cdr.TRANSFORMS, "/tf", _of_transforms),
    "named_poses": LocalizerSource(
        "motion_capture_tracking_interfaces/msg/NamedPoseArray",
        "/poses",
        partial(_of_poses, poses="poses", name="name"),
    ),
    "rigid_bodies": LocalizerSource(
        "mocap4r2_msgs/msg/RigidBodies",
        "/rigid_bodies",
        partial(_of_poses, poses="rigidbodies", name="rigid_body_name"),
    ),
}
"""Kinds of messages by name."""


@dataclass(frozen=True)
class BridgeParameters(Localizer):
    """Parameters of `localizer_bridge`."""

    swarm_file: str = text("", "path of the swarm description", required=True)


_IN_TOPICS = re.compile(r"[A-Za-z0-9_/]+")
_MAX_OFFSET_M = 10.0
_MAX_STRANGERS = 100  # Maximum number of names of bodies that are kept only to name them
_NO_HEADING = 1e3 * HEADING_UNKNOWN  # Variance of a heading that was not measured [rad^2]


class RobotPose(NamedTuple):
    """Pose of a robot in `map`."""

    robot: str  # Its name
    stamp_ns: int  # Time of measurement
    pose: FloatArray  # (3,) x [m], y [m], heading [rad]; 0 if it was not measured
    covariance: FloatArray  # (3, 3) of the pose; the variance of a heading that was not measured is huge


class _UnusableError(Exception):
    """A pose that is dropped, with the reason and a sentence."""

    def __init__(self, reason: str, sentence: str) -> None:
        super().__init__(sentence)
        self.reason = reason


class LocalizedRobots:
    """Converts poses of bodies to poses of robots; what was dropped and seen goes to `health`.

    Raises ParameterError if a parameter cannot be used.
    """

    def __init__(self, parameters: Localizer, robots: Collection[str], health: Health) -> None:
        self._parameters, self._health = parameters, health
        # which body is which robot, and where on it
        self.robot_of = _robots_of_bodies(parameters.bodies, robots)  # Body -> robot
        offsets = _offsets(parameters.offsets, self.robot_of.values())
        self._to_robot = {one: se2.inverse(offsets.get(one, np.zeros(3))) for one in self.robot_of.values()}
        # what poses must be in, and the topics that they come on
        expected = parameters.source_frame
        self._frames = [expected] if expected else [parameters.map_frame, "world"]
        # The topic, with `BODY` if each body has its own
        self.topic = topic = parameters.topic or SOURCES[parameters.source].topic
        has_own = BODY in SOURCES[parameters.source].topic
        if has_own != (BODY in topic):
            raise ParameterError(
                f"parameter topic = '{topic}' must {'' if has_own else 'not '}contain {BODY}:"
                f" messages of the source '{parameters.source}' {'do not ' if has_own else ''}name bodies."
            )
        # Topic -> the body that it is about, "" for a topic that names bodies itself
        self.topics = {topic.replace(BODY, body): body for body in self.robot_of} if has_own else {topic: ""}
        # Body -> what its poses come from, for messages to users
        self.label_of = {
            body: topic.replace(BODY, body) if has_own else f"{topic} about body '{body}'"
            for body in self.robot_of
        }
        for body in self.robot_of if has_own else ():
            if not _IN_TOPICS.fullmatch(body):
                raise ParameterError(
                    f"parameter bodies: '{body}' cannot be part of a topic; name the body as its topic does."
                )
        # what is counted, and the noise of poses without covariance
        self.strangers: set[str] = set()  # Names of bodies of no robot
        self.used = 0  # Number of poses that were converted
        sigma = parameters.position_sigma
        self._variances = np.diag([sigma**2, sigma**2, parameters.heading_sigma**2])

    def convert(self, bodies: Iterable[BodyPose], of_topic: str, arrival_ns: int) -> Iterator[RobotPose]:
        """The poses of robots by those of the bodies of one message; what cannot be used is counted.

        `of_topic` is the body that its topic is about, "" if it names bodies itself.
        """
        for body in bodies:
            name = body.name or of_topic
            if name not in self.robot_of:
                if self._parameters.source != "tf":  # which carries frames of all kinds
                    self._health.drop("unknown_body")
                    self.note_stranger(name)
                continue
            self._health.received(self.label_of[name])
            try:
                yield self._robot_pose(name, body, arrival_ns)
            except _UnusableError as error:
                self._health.drop(error.reason, str(error))
            else:
                self.used += 1

    def serialized(self, message: Any, of_topic: str, arrival_ns: int) -> Iterator[tuple[str, bytes]]:
        """The robots of one message, each with its pose as a message of the output; see `convert`."""
        bodies, frame = SOURCES[self._parameters.source].bodies(message), self._parameters.map_frame
        for one in self.convert(bodies, of_topic, arrival_ns):
            if self._parameters.output == "fix":
                yield one.robot, encode_fix(frame, one.stamp_ns, one.pose, one.covariance)
            else:
                yield one.robot, encode_pose_stamped(frame, np.array([one.stamp_ns]), one.pose[None])[0]

    def note_stranger(self, name: str) -> None:
        """Note a body of no robot."""
        if len(self.strangers) < _MAX_STRANGERS:
            self.strangers.add(name)

    def _robot_pose(self, name: str, body: BodyPose, arrival_ns: int) -> RobotPose:
        parameters, robot, frames = self._parameters, self.robot_of[name], self._frames
        # refuse what cannot be used
        if body.frame_id not in frames:
            raise _UnusableError(
                "foreign_frame",
                f"the poses of body '{name}' are in frame '{body.frame_id}', not {' or '.join(frames)}:"
                " is source_frame right?",
            )
        stamp_ns = arrival_ns if parameters.stamp_on_arrival else body.stamp_ns
        if stamp_ns == 0:
            raise _UnusableError(
                "no_stamp", f"the poses of body '{name}' have no stamps: set stamp_on_arrival"
            )
        if body.tilt > parameters.max_tilt:
            lean = f"the z axis of body '{name}' leans by {math.degrees(body.tilt):.0f} deg"
            raise _UnusableError("tilted", f"{lean}: does the localiser's z axis point up?")
        covariance = self._variances if is_unknown(body.covariance[None])[0] else body.covariance
        if not (np.isfinite(body.pose[:2]).all() and np.isfinite(covariance).all()):
            raise _UnusableError("not_finite", f"a number in the poses of body '{name}' is NaN or infinite")
        # without heading, only a body at base_link tells where its robot is
        pose, to_robot = np.array(body.pose), self._to_robot[robot]
        if math.isnan(pose[2]) or not has_heading(covariance[None])[0]:
            if to_robot.any() or parameters.output == "ground_truth":
                raise _UnusableError(
                    "no_heading", f"the poses of body '{name}' have no heading, which is needed"
                )
            pose, covariance = np.array([*pose[:2], 0.0]), covariance.copy()
            covariance[2, :], covariance[:, 2] = 0.0, 0.0
            covariance[2, 2] = _NO_HEADING
        # from the body to base_link; the lever between them turns with the heading
        placed = se2.compose(pose, to_robot)
        by_heading = np.eye(3)
        by_heading[:2, 2] = pose[1] - placed[1], placed[0] - pose[0]
        stamp_ns -= round(parameters.latency_s * 1e9)
        return RobotPose(robot, stamp_ns, placed, by_heading @ covariance @ by_heading.T)


def _robots_of_bodies(selected: Collection[str], robots: Collection[str]) -> dict[str, str]:
    """Body -> robot; raises ParameterError if there is no such robot, or if one is named twice."""
    robot_of: dict[str, str] = {}
    for one in selected or robots:
        body, _, robot = one.rpartition("=")
        body = body or robot
        _check_robot("bodies", robot, robots)
        if body in robot_of or robot in robot_of.values():
            raise ParameterError(f"parameter bodies: '{one}' names a body or a robot a second time.")
        robot_of[body] = robot
    return robot_of


def _offsets(selected: Collection[str], robots: Collection[str]) -> Mapping[str, FloatArray]:
    """Robot -> pose (3,) of its body in base_link; raises ParameterError for another robot, or no pose."""
    offset_of: dict[str, FloatArray] = {}
    for one in selected:
        robot, _, numbers = one.partition("=")
        _check_robot("offsets", robot, robots)
        try:
            offset = np.array([float(number) for number in numbers.split(",")])
        except ValueError:
            offset = np.zeros(0)
        if offset.shape != (3,) or not (np.abs(offset) <= _MAX_OFFSET_M).all():
            raise ParameterError(
                f"parameter offsets: '{one}' must be a robot and x, y, yaw of its body,"
                f" such as epuck1=0.01,0,1.5708, each at most {_MAX_OFFSET_M:g} [m, rad]."
            )
        offset_of[robot] = offset
    return offset_of


def _check_robot(parameter: str, robot: str, robots: Collection[str]) -> None:
    if robot not in robots:
        raise ParameterError(
            f"parameter {parameter}: there is no robot '{robot}', but {', '.join(robots) or 'none'}."
        )
