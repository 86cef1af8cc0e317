"""The inputs of the estimator: which topics a swarm has, what they carry, which must not stay silent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from swarm_loc_estimator.core.description.swarm import Robot, Swarm
from swarm_loc_estimator.io.messages.typestore import (
    ANONYMOUS_DETECTIONS,
    BRIGHTNESS,
    DETECTIONS,
    ODOMETRY,
    POSE_WITH_COVARIANCE,
)

THE_SWARM = -1
"""In place of a robot: a topic about all of them."""


class InputKind(Enum):
    """What a topic carries.

    Attributes:
        topic: Its name below the robot's, or its whole name where it is about the swarm.
        message_type: Type of its messages, such as nav_msgs/msg/Odometry.
        expected_of: Whether something is wrong when a robot sends none.
        of_each: Whether each robot has one; else it is one for the swarm, and never expected.
    """

    ODOMETRY = ("odom", ODOMETRY, lambda robot: not robot.stands)
    DETECTIONS = ("detections", DETECTIONS, lambda robot: robot.camera is not None)
    BRIGHTNESS = ("brightness", BRIGHTNESS, lambda robot: robot.ir is not None)
    FIXES = ("fix", POSE_WITH_COVARIANCE, lambda _: False)
    AERIAL = ("aerial/detections", ANONYMOUS_DETECTIONS, lambda _: False, False)

    def __init__(
        self, topic: str, message_type: str, expected_of: Callable[[Robot], bool], of_each: bool = True
    ) -> None:
        self.topic = topic
        self.message_type = message_type
        self.expected_of = expected_of
        self.of_each = of_each

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
    """All inputs of a swarm, robot by robot, then those about all of them."""
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
