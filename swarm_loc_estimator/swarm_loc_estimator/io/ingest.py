"""The way into the estimator, the same for a live node and for replay: raw messages in, columns out.

A swarm has two inputs per robot, `<robot>/odom` and `<robot>/detections`. Bytes that are no message of the
topic's type are counted and go no further.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.arrivals import DetectionRows, IntArray, Messages, OdometryRows
from swarm_loc_estimator.core.compiled import compiled
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.io.cdr import decode_odometry
from swarm_loc_estimator.io.message_batch import MessageBatch
from swarm_loc_estimator.io.streams import DetectionReader, PoseReader
from swarm_loc_estimator.io.typestore import DETECTIONS, ODOMETRY


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


_STATISTICS_DTYPE = np.dtype(
    [
        (name, np.int64)
        for name in (
            "received",
            "malformed",
            "last_stamp_ns",
            "last_arrival_ns",
            "late_sum_ns",
            "late_max_ns",
            "late_count",
        )
    ]
)


class InputStatistics:
    """What came in on one topic.

    Args:
        row: (1,) of _STATISTICS_DTYPE, where it is counted.
    """

    def __init__(self, row: NDArray[np.void]) -> None:
        self._row = row

    @property
    def received(self) -> int:
        """Messages so far, malformed ones included."""
        return int(self._row["received"][0])

    @property
    def malformed(self) -> int:
        """Those that were no message of the topic's type."""
        return int(self._row["malformed"][0])

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the newest well-formed one; None before the first."""
        return int(self._row["last_stamp_ns"][0]) if self.received > self.malformed else None

    @property
    def last_arrival_ns(self) -> int | None:
        """When it arrived."""
        return int(self._row["last_arrival_ns"][0]) if self.received > self.malformed else None

    @property
    def late_count(self) -> int:
        """How many well-formed ones came since `restart`."""
        return int(self._row["late_count"][0])

    @property
    def late_sum_ns(self) -> int:
        """Sum of their arrivals minus their stamps."""
        return int(self._row["late_sum_ns"][0])

    @property
    def late_max_ns(self) -> int | None:
        """Largest one; None when nothing came."""
        return int(self._row["late_max_ns"][0]) if self.late_count else None

    def restart(self) -> None:
        """Begin a new interval for the lateness."""
        for name in ("late_sum_ns", "late_max_ns", "late_count"):
            self._row[name] = 0


class Ingest:
    """Reads the messages of a swarm's topics.

    Args:
        swarm: Whose topics they are.

    Attributes:
        topics: The inputs; their index here is the topic's number in a batch.
        handle_of: Topic name -> that number.
        statistics: Per topic what came in.
    """

    def __init__(self, swarm: Swarm) -> None:
        self.topics = input_topics(swarm)
        self.handle_of: Mapping[str, int] = {topic.name: handle for handle, topic in enumerate(self.topics)}
        self._robot = np.array([topic.robot for topic in self.topics], dtype=np.int64)
        self._is_odometry = np.array([topic.kind is InputKind.ODOMETRY for topic in self.topics], dtype=bool)
        self._poses = PoseReader(len(self.topics), decode_odometry, names=2)
        self._detections = DetectionReader(len(self.topics))
        self._counted = np.zeros(len(self.topics), dtype=_STATISTICS_DTYPE)
        self.statistics = [InputStatistics(self._counted[k : k + 1]) for k in range(len(self.topics))]

    def read(self, batch: MessageBatch) -> Iterator[Messages]:
        """Read messages, numbered as `topics`, in order of arrival.

        Yields:
            One part for each stretch in which time does not go back.
        """
        back = np.flatnonzero(batch.log_ns[1:] < batch.log_ns[:-1]) + 1
        for begin, end in itertools.pairwise([0, *back.tolist(), batch.size]):
            if begin < end:
                yield self._read_forwards(batch.chosen(slice(begin, end)))

    def frame_id(self, handle: int) -> str:
        """Frame of the newest message on a topic, "" before the first."""
        reader = self._poses if self._is_odometry[handle] else self._detections
        return reader.frame_ids[handle]

    def _read_forwards(self, batch: MessageBatch) -> Messages:
        is_odometry = self._is_odometry[batch.topic]
        reports, pictures = batch.chosen(is_odometry), batch.chosen(~is_odometry)
        poses, seen = self._poses.read(reports), self._detections.read(pictures)
        for part, columns in ((reports, poses), (pictures, seen)):
            _count(self._counted, part.topic, part.log_ns, columns.stamp_ns, columns.valid)
        odometry = OdometryRows(self._robot[reports.topic], poses.stamp_ns, poses.pose, reports.log_ns)
        per_detection = (self._robot[pictures.topic], seen.stamp_ns, pictures.log_ns)
        robot, stamp_ns, arrival_ns = (np.repeat(column, seen.count) for column in per_detection)
        return Messages(
            odometry if poses.valid.all() else odometry.chosen(poses.valid),
            DetectionRows(robot, stamp_ns, seen.detection, arrival_ns),
            begin_ns=int(batch.log_ns[0]),
            end_ns=int(batch.log_ns[-1]),
            malformed=int(np.sum(~poses.valid)) + int(np.sum(~seen.valid)),
        )


@compiled
def _count(
    counted: NDArray[np.void],
    topic: IntArray,
    arrival_ns: IntArray,
    stamp_ns: IntArray,
    valid: NDArray[np.bool_],
) -> None:
    """Note messages (n,) in the statistics (t,) of their topics."""
    for k in range(topic.size):
        one = counted[topic[k]]
        one.received += 1
        if not valid[k]:
            one.malformed += 1
            continue
        late_ns = arrival_ns[k] - stamp_ns[k]
        one.last_stamp_ns, one.last_arrival_ns = stamp_ns[k], arrival_ns[k]
        one.late_max_ns = max(one.late_max_ns, late_ns) if one.late_count else late_ns
        one.late_sum_ns += late_ns
        one.late_count += 1
