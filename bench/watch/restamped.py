"""Publish a bag's odometry and detections as if they were made now: python -m bench.watch.restamped BAG.

The estimator then works by the wall clock, and the age of its poses can be told when a page has painted them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.messages.cdr import DETECTIONS, ENCAPSULATION, ODOMETRY, SECOND_NS
from swarm_loc_estimator.common.messages.poses import STAMP_SIZE, stamp_bytes
from swarm_loc_msgs.msg import MarkerDetectionArray

_CLASSES = {ODOMETRY: Odometry, DETECTIONS: MarkerDetectionArray}


def messages(bag: Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Topic, type, time of arrival [ns] and bytes of the inputs in a bag."""
    with BagReader(bag) as reader:
        for topic, kind, log_ns, data in reader.messages():
            if kind in _CLASSES and topic.endswith(("/odom", "/detections")):
                yield topic, kind, log_ns, bytes(data)


def moved(data: bytes, later_ns: int) -> bytes:
    """A message whose header's stamp is so much later."""
    end = ENCAPSULATION + STAMP_SIZE
    seconds, rest_ns = np.frombuffer(data, "<i4", 2, ENCAPSULATION).tolist()
    stamp = stamp_bytes(np.array([seconds * SECOND_NS + rest_ns + later_ns])).tobytes()
    return data[:ENCAPSULATION] + stamp + data[end:]


def main() -> None:
    """Publish the bag once."""
    rclpy.init()
    node = rclpy.create_node("robots")
    all_of = list(messages(Path(sys.argv[1])))
    kinds = {topic: kind for topic, kind, _, _ in all_of}
    publishers = {
        topic: node.create_publisher(_CLASSES[kind], topic, QoSProfile(depth=10))
        for topic, kind in kinds.items()
    }
    while any(not one.get_subscription_count() for one in publishers.values()):
        time.sleep(0.1)
    later_ns = time.time_ns() - all_of[0][2]
    for topic, _, log_ns, data in all_of:
        time.sleep(max(0.0, 1e-9 * (log_ns + later_ns - time.time_ns())))
        publishers[topic].publish(moved(data, later_ns))


if __name__ == "__main__":
    main()
