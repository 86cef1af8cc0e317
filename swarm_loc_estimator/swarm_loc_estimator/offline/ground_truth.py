"""Ground truth of a recording, used only by evaluation and calibration: poses of several message types."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.bags.bag_file import BagTopic
from swarm_loc_estimator.common.messages.cdr import (
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    TRANSFORM_STAMPED,
    decode,
    nanoseconds,
)
from swarm_loc_estimator.common.messages.poses import (
    FixMessage,
    OdometryMessage,
    PoseMessage,
    decode_fix,
    decode_odometry,
    decode_pose_stamped,
    yaw_of,
)
from swarm_loc_estimator.common.messages.streams import MessageBatch, PoseReader
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.result import Spool
from swarm_loc_estimator.swarm.swarm import Swarm


def _decode_transform(data: bytes) -> PoseMessage:
    message = decode(data, TRANSFORM_STAMPED)
    place, turn = message.transform.translation, message.transform.rotation
    pose = place.x, place.y, yaw_of(turn.x, turn.y, turn.z, turn.w)
    return PoseMessage(nanoseconds(message.header.stamp), message.header.frame_id, pose)


_READ: Mapping[str, tuple[Callable[[bytes], OdometryMessage | PoseMessage | FixMessage], int]] = {
    POSE_STAMPED: (decode_pose_stamped, 1),
    POSE_WITH_COVARIANCE: (decode_fix, 1),
    ODOMETRY: (decode_odometry, 2),
    TRANSFORM_STAMPED: (_decode_transform, 2),
}
"""Type of a message -> its reader, and the number of frame names before its pose."""


def truth_topics(swarm: Swarm) -> list[str]:
    """The topic of the ground truth of each robot."""
    return [f"{robot.name}/ground_truth" for robot in swarm.robots]


class TruthReader:
    """Collects `<robot>/ground_truth`: PoseStamped, PoseWithCovarianceStamped, Odometry or TransformStamped.

    Args:
        swarm: The robots.
        recorded: The topics of the recording, which declare the types.

    Attributes:
        topics: The index of a topic is its number in a batch.
    """

    def __init__(self, swarm: Swarm, recorded: Iterable[BagTopic]) -> None:
        self.topics = truth_topics(swarm)
        self._names = [robot.name for robot in swarm.robots]
        declared = {topic.name: topic.type for topic in recorded}
        self._types = [declared.get(topic, "") for topic in self.topics]
        count = len(self.topics)
        self._readers = {name: PoseReader(count, *_READ[name]) for name in {*self._types} & {*_READ}}
        self._spool = Spool()
        self._malformed: Counter[int] = Counter()

    def add(self, batch: MessageBatch) -> None:
        """Add messages."""
        for message_type, reader in self._readers.items():
            typed = np.array([name == message_type for name in self._types])
            part = batch.chosen(typed[batch.topic])
            if part.size:
                self._add(part, reader)

    def tracks(self) -> dict[str, Trajectory]:
        """Robot name -> ground truth, for robots that have any; may be called once."""
        return {name: track for index, name in enumerate(self._names) if (track := self._track(index))}

    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user."""
        return (
            *(
                f"{topic} has the type {found}, which is no ground truth; allowed are {', '.join(_READ)}."
                for topic, found in zip(self.topics, self._types, strict=True)
                if found and found not in _READ
            ),
            *(
                f"{count} messages on {self.topics[index]} are malformed: no {self._types[index]} of ROS 2."
                for index, count in sorted(self._malformed.items())
            ),
        )

    def _add(self, batch: MessageBatch, reader: PoseReader) -> None:
        columns = reader.read(batch)
        self._malformed.update(batch.topic[~columns.valid].tolist())
        usable = np.flatnonzero(columns.valid & np.isfinite(columns.pose).all(axis=1))
        robot = batch.topic[usable]
        order = usable[np.lexsort([columns.stamp_ns[usable], robot])]
        ends = np.searchsorted(batch.topic[order], np.arange(len(self.topics) + 1))
        for index in np.flatnonzero(np.diff(ends)).tolist():
            rows = order[ends[index] : ends[index + 1]]
            self._spool.append((index, "stamp_ns"), columns.stamp_ns[rows])
            self._spool.append((index, "pose"), columns.pose[rows])

    def _track(self, index: int) -> Trajectory | None:
        stamp_ns: IntArray = self._spool.array((index, "stamp_ns"), np.int64)
        pose = self._spool.array((index, "pose"), np.float64, 3)
        if np.any(stamp_ns[1:] < stamp_ns[:-1]):
            order = np.argsort(stamp_ns, kind="stable")
            stamp_ns, pose = stamp_ns[order], pose[order]
        return Trajectory(stamp_ns, pose) if stamp_ns.size else None
