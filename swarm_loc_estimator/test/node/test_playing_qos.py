"""The player offers what the publishers of a bag's topics offered."""

from pathlib import Path

from node_world import T0_NS, Program, Ros, odometry_bytes
from rclpy.duration import Duration, Infinite
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import QosDurability, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer

from swarm_loc_estimator.common.bags.writer import RELIABLE, typestore
from swarm_loc_estimator.common.messages.cdr import ODOMETRY

BEST_EFFORT = RELIABLE._replace(reliability=QosReliability.BEST_EFFORT, deadline=QosTime(0, 500_000_000))
LATCHED = RELIABLE._replace(durability=QosDurability.TRANSIENT_LOCAL, depth=1)
VAGUE = RELIABLE._replace(reliability=QosReliability.SYSTEM_DEFAULT, durability=QosDurability.BEST_AVAILABLE)
TOPICS = {
    "best_effort": [BEST_EFFORT, BEST_EFFORT],
    "latched": [LATCHED],
    "vague": [VAGUE],
    "different": [RELIABLE, BEST_EFFORT],
    "unknown": [],
    "tf_static": [],
}


def _bag(path: Path) -> Path:
    """One message of each topic."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, profiles in TOPICS.items():
            topic = writer.add_connection(
                f"/{name}", ODOMETRY, typestore=typestore(), offered_qos_profiles=profiles
            )
            writer.write(topic, T0_NS, odometry_bytes(name, T0_NS))
    return path


def test_topics_offer_what_was_recorded_and_else_what_all_can_hear(ros: Ros, tmp_path: Path) -> None:
    parameters = {"bag": _bag(tmp_path / "bag"), "wait_for_subscribers": len(TOPICS)}
    with Program("play", tmp_path / "log", parameters):
        ros.until(lambda: all(ros.tester.count_publishers(name) for name in TOPICS))
        offered: dict[str, QoSProfile] = {
            name: ros.tester.get_publishers_info_by_topic(name)[0].qos_profile for name in TOPICS
        }

    unreliable = [name for name, qos in offered.items() if qos.reliability == ReliabilityPolicy.BEST_EFFORT]
    latched = [name for name, qos in offered.items() if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL]
    assert unreliable == ["best_effort"]
    assert latched == ["latched", "tf_static"]
    assert offered["best_effort"].deadline == Duration(nanoseconds=500_000_000)
    assert offered["latched"].deadline == offered["unknown"].deadline == Infinite
