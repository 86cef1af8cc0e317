"""The way into the estimator, the same for a live node and for replay: raw messages by topic in, calls out.

A swarm has two inputs per robot, `<robot>/odom` and `<robot>/detections`. Bytes that are no message of the
topic's type are counted as `bad_message` and go no further.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.io.cdr import CdrError
from swarm_loc_estimator.io.streams import DetectionStream, OdometryStream, Pose2
from swarm_loc_estimator.io.typestore import DETECTIONS, ODOMETRY

Content = TypeVar("Content")
Content_co = TypeVar("Content_co", covariant=True)


class InputKind(Enum):
    """What a topic carries; the value is its name below the robot's."""

    ODOMETRY = "odom"
    DETECTIONS = "detections"

    @property
    def message_type(self) -> str:
        """Type of its messages, such as nav_msgs/msg/Odometry."""
        return ODOMETRY if self is InputKind.ODOMETRY else DETECTIONS


@dataclass(frozen=True)
class InputTopic:
    """One input.

    Attributes:
        name: Relative topic name, `<robot>/odom` or `<robot>/detections`.
        kind: What it carries.
        robot: Index into `Swarm.robots`.
        expected: Whether something is wrong when nothing comes; a robot without camera detects nothing.
    """

    name: str
    kind: InputKind
    robot: int
    expected: bool = True


def input_topics(swarm: Swarm) -> tuple[InputTopic, ...]:
    """All inputs of a swarm, robot by robot."""
    return tuple(
        InputTopic(
            f"{robot.name}/{kind.value}", kind, index, kind is InputKind.ODOMETRY or robot.camera is not None
        )
        for index, robot in enumerate(swarm.robots)
        for kind in InputKind
    )


class EstimatorPort(Protocol):
    """What the inputs need of `core.estimator.SwarmEstimator`."""

    def add_odometry(self, robot: int, stamp_ns: int, pose: Pose2, now_ns: int, /) -> None:
        """Take in one odometry message."""

    def add_detections(self, robot: int, stamp_ns: int, detections: NDArray[np.void], now_ns: int, /) -> None:
        """Take in what a robot's camera saw in one picture."""

    def drop(self, reason: str, count: int = 1, /) -> None:
        """Count data that could not even be handed in."""


@dataclass
class InputStatistics:
    """What came in on one topic.

    Attributes:
        received: Messages so far, malformed ones included.
        malformed: Those that were no message of the topic's type.
        last_stamp_ns: Stamp of the newest well-formed one; None before the first.
        last_arrival_ns: When it arrived.
        late_sum_ns: Sum of arrival minus stamp since `restart`.
        late_max_ns: Largest one since `restart`; None when nothing came.
        late_count: How many since `restart`.
    """

    received: int = 0
    malformed: int = 0
    last_stamp_ns: int | None = None
    last_arrival_ns: int | None = None
    late_sum_ns: int = 0
    late_max_ns: int | None = None
    late_count: int = 0

    def note(self, stamp_ns: int, now_ns: int) -> None:
        """Count a well-formed message."""
        late_ns = now_ns - stamp_ns
        self.received += 1
        self.last_stamp_ns, self.last_arrival_ns = stamp_ns, now_ns
        self.late_sum_ns += late_ns
        self.late_count += 1
        if self.late_max_ns is None or late_ns > self.late_max_ns:
            self.late_max_ns = late_ns

    def restart(self) -> None:
        """Begin a new interval for the lateness."""
        self.late_sum_ns, self.late_max_ns, self.late_count = 0, None, 0


class _Stream(Protocol[Content_co]):
    """Reads the messages of one topic."""

    @property
    def frame_id(self) -> str:
        """Frame of the newest message."""

    def read(self, data: bytes) -> tuple[int, Content_co]:
        """Stamp [ns] and content."""


class _Input(Generic[Content]):
    """One topic: its reader, its statistics, and where the content goes."""

    def __init__(
        self, robot: int, stream: _Stream[Content], hand_on: Callable[[int, int, Content, int], None]
    ) -> None:
        self.stream = stream
        self.statistics = InputStatistics()
        self._robot = robot
        self._hand_on = hand_on

    def receive(self, data: bytes, now_ns: int) -> None:
        """Read one message and hand it on; raises CdrError."""
        stamp_ns, content = self.stream.read(data)
        self.statistics.note(stamp_ns, now_ns)
        self._hand_on(self._robot, stamp_ns, content, now_ns)


def _input(topic: InputTopic, estimator: EstimatorPort) -> _Input[Pose2] | _Input[NDArray[np.void]]:
    if topic.kind is InputKind.ODOMETRY:
        return _Input(topic.robot, OdometryStream(), estimator.add_odometry)
    return _Input(topic.robot, DetectionStream(), estimator.add_detections)


class Ingest:
    """Hands the messages of a swarm's topics to its estimator.

    Args:
        swarm: Whose topics they are.
        estimator: Where they go.

    Attributes:
        topics: The inputs; their index here is the handle for `receive`.
        handle_of: Topic name -> handle.
        statistics: Per handle what came in.
    """

    def __init__(self, swarm: Swarm, estimator: EstimatorPort) -> None:
        self.topics = input_topics(swarm)
        self.handle_of: Mapping[str, int] = {topic.name: handle for handle, topic in enumerate(self.topics)}
        self._estimator = estimator
        self._inputs = [_input(topic, estimator) for topic in self.topics]
        self.statistics = [source.statistics for source in self._inputs]

    def receive(self, handle: int, data: bytes, now_ns: int) -> None:
        """Take in one message.

        Args:
            handle: Which topic it came on, see `handle_of`.
            data: The serialized message with its encapsulation header.
            now_ns: When it arrived.
        """
        try:
            self._inputs[handle].receive(data, now_ns)
        except CdrError:
            self.statistics[handle].received += 1
            self.statistics[handle].malformed += 1
            self._estimator.drop("bad_message")

    def frame_id(self, handle: int) -> str:
        """Frame of the newest message on a topic, "" before the first."""
        return self._inputs[handle].stream.frame_id
