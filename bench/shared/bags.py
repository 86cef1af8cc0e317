"""Bags for benchmarks and tests: their beginnings, ground truth received live, messages of many robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader, BagTopic
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import Rows, encode, stamp_rows
from swarm_loc_estimator.common.messages.definitions import (
    POSE_STAMPED,
    SWARM_DETECTIONS,
    SWARM_FIXES,
    SWARM_ODOMETRY,
)
from swarm_loc_estimator.common.messages.detections import SharedHead
from swarm_loc_estimator.common.messages.message_batch import MessageBatch, SerializedMessage
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.ground_truth import TruthReader
from swarm_loc_estimator.swarm.swarm import Swarm


def copy_beginning(bag: Path, folder: Path, duration_s: float) -> int:
    """Copy the first seconds of a bag to a new one.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file, which a crash may have cut off.
        folder: The new bag, created; must not exist.
        duration_s: How much to copy, by log time [s].

    Returns:
        Number of messages.

    Raises:
        BagError: The bag cannot be read, or the new one not be created.
    """
    count = 0
    with BagReader(bag) as reader, BagWriter(folder) as writer:
        end_ns = reader.time_range_ns[0] + round(duration_s * 1e9)
        for topic in reader.topics:
            writer.add_topic(topic.name, topic.type)
        for name, _, log_ns, data in reader.messages():
            if log_ns > end_ns:
                break
            writer.write(name, log_ns, bytes(data))
            count += 1
    return count


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
