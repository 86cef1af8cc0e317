"""The inputs of the estimator: which topics a swarm has, what they carry, which must not stay silent."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from enum import Enum

from swarm_loc_estimator.common.messages.definitions import (
    ANONYMOUS_DETECTIONS,
    BRIGHTNESS,
    DETECTIONS,
    ODOMETRY,
    POSE_WITH_COVARIANCE,
    SWARM_DETECTIONS,
    SWARM_FIXES,
    SWARM_ODOMETRY,
)
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

THE_SWARM = -1
"""In place of a robot: a topic about all of them."""


def _moves(robot: Robot) -> bool:
    return not robot.stands


def _has_camera(robot: Robot) -> bool:
    return robot.camera is not None


def _has_ir(robot: Robot) -> bool:
    return robot.ir is not None


def _never(_: Robot) -> bool:
    return False


class InputKind(Enum):
    """What a topic carries.

    Attributes:
        topic: Its name below the robot's, or its whole name where it is about the swarm.
        message_type: Type of its messages, such as nav_msgs/msg/Odometry.
        expected_of: Whether something is wrong when a robot sends none.
        of_each: Whether each robot has one; else it is one for the swarm.
        stands_for: Columns of the kind that each robot has, where this carries the same of many robots;
            else "".
    """

    ODOMETRY = ("odom", ODOMETRY, _moves)
    DETECTIONS = ("detections", DETECTIONS, _has_camera)
    BRIGHTNESS = ("brightness", BRIGHTNESS, _has_ir)
    FIXES = ("fix", POSE_WITH_COVARIANCE, _never)
    AERIAL = ("aerial/detections", ANONYMOUS_DETECTIONS, _never, False)
    SWARM_ODOMETRY = ("swarm/odom", SWARM_ODOMETRY, _moves, False, "odometry")
    SWARM_DETECTIONS = ("swarm/detections", SWARM_DETECTIONS, _has_camera, False, "detections")
    SWARM_FIXES = ("swarm/fixes", SWARM_FIXES, _never, False, "fixes")

    def __init__(
        self,
        topic: str,
        message_type: str,
        expected_of: Callable[[Robot], bool],
        of_each: bool = True,
        stands_for: str = "",
    ) -> None:
        self.topic = topic
        self.message_type = message_type
        self.expected_of = expected_of
        self.of_each = of_each
        self.stands_for = stands_for

    @property
    def rows(self) -> str:
        """Which columns of the estimator's inputs it fills."""
        return self.stands_for or self.name.lower()

    @property
    def pattern(self) -> str:
        """Names of its topics, such as `<robot>/odom`."""
        return f"<robot>/{self.topic}" if self.of_each else self.topic


@dataclass(frozen=True)
class InputTopic:
    """One input.

    Attributes:
        name: Relative topic name, such as `<robot>/odom`.
        kind: What it carries.
        robot: Index into `Swarm.robots`, or THE_SWARM.
        expected: Whether something is wrong when nothing comes; a robot without camera detects nothing.
    """

    name: str
    kind: InputKind
    robot: int
    expected: bool = True


def input_topics(swarm: Swarm) -> tuple[InputTopic, ...]:
    """All inputs that a swarm may have, robot by robot, then those about all of them."""
    of_robots = (
        InputTopic(f"{robot.name}/{kind.topic}", kind, index, kind.expected_of(robot))
        for index, robot in enumerate(swarm.robots)
        for kind in InputKind
        if kind.of_each
    )
    of_swarm = (
        InputTopic(kind.topic, kind, THE_SWARM, expected=False) for kind in InputKind if not kind.of_each
    )
    return (*of_robots, *of_swarm)


def live_topics(swarm: Swarm, *, shared: bool) -> tuple[InputTopic, ...]:
    """What to listen to: topics of each robot, or in their place those that carry the same of many."""
    stood_for = {kind.stands_for for kind in InputKind if kind.stands_for}
    if not shared:
        return tuple(topic for topic in input_topics(swarm) if not topic.kind.stands_for)
    return tuple(
        replace(topic, expected=any(map(topic.kind.expected_of, swarm.robots)))
        if topic.kind.stands_for
        else topic
        for topic in input_topics(swarm)
        if topic.kind.rows == "aerial" or topic.kind.stands_for or _is_sent(topic, swarm, stood_for)
    )


def _is_sent(topic: InputTopic, swarm: Swarm, stood_for: Collection[str]) -> bool:
    """Whether a robot has what it sends on a topic of its own that no other one stands for."""
    return topic.kind.rows not in stood_for and topic.kind.expected_of(swarm.robots[topic.robot])
