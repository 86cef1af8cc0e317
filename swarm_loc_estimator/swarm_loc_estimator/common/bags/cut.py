"""Copy the beginning of a bag to a bag of its own."""

from __future__ import annotations

from pathlib import Path

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter


def copy_beginning(bag: Path, folder: Path, duration_s: float) -> int:
    """Copy what was logged within the first seconds of a bag.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file; may have been cut off.
        folder: The new bag, created; must not exist.
        duration_s: How much of it [s].

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
