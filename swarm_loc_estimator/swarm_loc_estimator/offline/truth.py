"""Ground truth trajectories from `<robot>/ground_truth`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.messages.cdr import decode_pose_stamped
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.common.messages.streams import PoseReader
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.spool import Spool
from swarm_loc_estimator.swarm.swarm import Swarm


def read_truth(swarm: Swarm, messages: Mapping[str, Sequence[bytes]]) -> dict[str, Trajectory]:
    """Ground truth that did not come from a bag.

    Args:
        swarm: Whose.
        messages: Robot name -> its serialized PoseStamped.
    """
    reader = TruthReader(swarm)
    topics = ((swarm.index_of[name], data) for name, all_of in messages.items() for data in all_of)
    reader.add(MessageBatch.of([(topic, data, 0) for topic, data in topics]))
    return reader.tracks()


class TruthReader:
    """Collects ground truth; nothing of it reaches the estimator.

    Args:
        swarm: Whose.

    Attributes:
        topics: Topics; their place here is the topic's number in a batch.
    """

    def __init__(self, swarm: Swarm) -> None:
        self.topics = [f"{robot.name}/ground_truth" for robot in swarm.robots]
        self._names = [robot.name for robot in swarm.robots]
        self._reader = PoseReader(len(self.topics), decode_pose_stamped, names=1)
        self._spool = Spool()
        self._malformed = 0

    def add(self, batch: MessageBatch) -> None:
        """Take messages in."""
        if not batch.size:
            return
        columns = self._reader.read(batch)
        self._malformed += int(np.sum(~columns.valid))
        usable = np.flatnonzero(columns.valid & np.isfinite(columns.pose).all(axis=1))
        robot = batch.topic[usable]
        order = usable[np.lexsort([columns.stamp_ns[usable], robot])]
        ends = np.searchsorted(batch.topic[order], np.arange(len(self.topics) + 1))
        for index in np.flatnonzero(np.diff(ends)).tolist():
            rows = order[ends[index] : ends[index + 1]]
            self._spool.append((index, "stamp_ns"), columns.stamp_ns[rows])
            self._spool.append((index, "pose"), columns.pose[rows])

    def tracks(self) -> dict[str, Trajectory]:
        """Per robot that has ground truth; may be called once."""
        return {name: track for index, name in enumerate(self._names) if (track := self._track(index))}

    def remarks(self) -> tuple[str, ...]:
        """What else must be said."""
        return (f"{self._malformed} messages of ground truth are malformed.",) if self._malformed else ()

    def _track(self, index: int) -> Trajectory | None:
        stamp_ns: IntArray = self._spool.array((index, "stamp_ns"), np.int64)
        pose = self._spool.array((index, "pose"), np.float64, 3)
        if np.any(stamp_ns[1:] < stamp_ns[:-1]):
            order = np.argsort(stamp_ns, kind="stable")
            stamp_ns, pose = stamp_ns[order], pose[order]
        return Trajectory(stamp_ns, pose) if stamp_ns.size else None
