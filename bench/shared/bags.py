"""Bags for benchmarks and tests: their parts, ground truth received live, messages of many robots."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.reader import BagReader, BagTopic
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import (
    POSE_STAMPED,
    SWARM_DETECTIONS,
    SWARM_FIXES,
    SWARM_ODOMETRY,
    Rows,
    encode,
    stamp_rows,
)
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.recorded_bag import TruthReader
from swarm_loc_estimator.swarm.swarm import Swarm


def copy_part(
    bag: Path,
    folder: Path,
    end_s: float = math.inf,
    begin_s: float = 0.0,
    *,
    rename: Callable[[str, str], tuple[str, str]] = lambda name, kind: (name, kind),
    change: Callable[[str, int, bytes], tuple[int, bytes]] = lambda _, log_ns, data: (log_ns, data),
) -> int:
    """Copy some seconds of a bag to a new one.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file, which a crash may have cut off.
        folder: The new bag, created; must not exist.
        end_s: End of the part, by log time since the first message [s].
        begin_s: Its begin [s].
        rename: Name and type of a topic -> those in the new bag.
        change: Topic, log time [ns] and bytes of a message -> log time and bytes in the new bag.

    Returns:
        Number of messages.

    Raises:
        BagError: The bag cannot be read, or the new one not be created.
    """
    count = 0
    with BagReader(bag) as reader, BagWriter(folder) as writer:
        first_ns = reader.time_range_ns[0]
        begin_ns, end_ns = (
            first_ns + (round(1e9 * at) if math.isfinite(at) else at) for at in (begin_s, end_s)
        )
        for topic in reader.topics:
            writer.add_topic(*rename(topic.name, topic.type))
        for name, kind, log_ns, data in reader.messages():
            if log_ns > end_ns:
                break
            if log_ns >= begin_ns:
                writer.write(rename(name, kind)[0], *change(name, log_ns, bytes(data)))
                count += 1
    return count


def first_log_ns(bag: Path, topic: str) -> int:
    """Log time of the first message of a topic [ns]."""
    with BagReader(bag) as reader:
        return next(log_ns for name, _, log_ns, _ in reader.messages() if name == topic)


def read_truth(swarm: Swarm, messages: Mapping[str, Sequence[bytes]]) -> dict[str, Trajectory]:
    """Decode serialized ground truth.

    Args:
        swarm: The robots.
        messages: Robot name -> its serialized PoseStamped.
    """
    reader = TruthReader(swarm, [BagTopic(f"{name}/ground_truth", POSE_STAMPED) for name in messages])
    topics = ((swarm.index_of[name], data) for name, all_of in messages.items() for data in all_of)
    reader.add(MessageBatch.of([SerializedMessage(topic, data, 0) for topic, data in topics]))
    return reader.tracks()


class SharedHead(NamedTuple):
    """The beginning of a message of many robots; see `SharedMessage`."""

    stamp_ns: int
    frame_id: str
    swarm: int
    robot: IntArray
    reading_ns: IntArray


def encode_shared_numbers(head: SharedHead, *columns: FloatArray) -> bytes:
    """Serialize a SwarmOdometry from poses (n, 3), or SwarmFixes from these and covariances (n, 9)."""
    message = _written(head) | dict(zip(("pose", "covariance"), columns, strict=False))
    return encode(message, SWARM_ODOMETRY if len(columns) == 1 else SWARM_FIXES)


def encode_shared_detections(head: SharedHead, detections: Rows) -> bytes:
    """Serialize a SwarmDetections from (n,) detections of `DETECTION_DTYPE`."""
    return encode(_written(head) | {"detections": detections}, SWARM_DETECTIONS)


def _written(head: SharedHead) -> dict[str, Any]:
    header = {"stamp": head.stamp_ns, "frame_id": head.frame_id}
    return {"header": header, "swarm": head.swarm, "robot": head.robot, "stamp": stamp_rows(head.reading_ns)}


def message_header(stamp_ns: int, frame: str) -> dict[str, Any]:
    """A std_msgs/Header to encode."""
    return {"stamp": stamp_ns, "frame_id": frame}
