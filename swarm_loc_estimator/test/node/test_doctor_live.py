"""The doctor over DDS: it hears the topics of a live graph, and knows their publishers."""

import time
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from node_world import Ros, detection_bytes, odometry_bytes, repeated, sight
from rclpy.qos import QoSProfile, ReliabilityPolicy

from swarm_loc_estimator.doctor.doctor import examine
from swarm_loc_estimator.doctor.listener import Listener
from swarm_loc_estimator.doctor.proposal import is_proposed_from, proposed
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_msgs.msg import MarkerDetectionArray

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.mark.parametrize("namespace", ["", "lab"])
def test_a_live_graph_is_heard(ros: Ros, swarm_file: Path, namespace: str) -> None:
    """Alpha is well but for its QoS; beta has another type, no detector, and its odometry elsewhere."""
    prefix = f"/{namespace}/" if namespace else "/"
    odometry = ros.tester.create_publisher(Odometry, f"{prefix}alpha/odom", BEST_EFFORT)
    detections = ros.tester.create_publisher(MarkerDetectionArray, f"{prefix}alpha/detections", 10)
    ros.tester.create_publisher(PoseStamped, f"{prefix}beta/odom", 10)
    ros.tester.create_publisher(Odometry, f"{prefix}beta/wheels", 10)
    listener = Listener(load_swarm(swarm_file), namespace, use_sim_time=False)

    def drive() -> None:
        now_ns = time.time_ns()
        odometry.publish(odometry_bytes("alpha", now_ns))
        detections.publish(detection_bytes("alpha", now_ns, sight((0.0, 0.0, 0.0))))

    with repeated(drive):
        evidence = listener.listen(4.0, unwatched)
    listener.destroy_node()
    assert len(evidence.topics["alpha/odom"].messages) > 20
    assert {one.node for one in evidence.topics["alpha/odom"].publishers} == {"/tester"}
    # on a busy machine messages may really pause
    found = [(one.about, one.problem) for one in examine(evidence) if "pauses for" not in one.problem]
    assert found == [
        ("beta/odom", "has the type geometry_msgs/msg/PoseStamped, not nav_msgs/msg/Odometry"),
        ("beta/detections", "has no messages"),
        ("alpha/odom", "is published best effort, so lost messages are missing"),
    ]


def test_a_live_graph_is_described(ros: Ros) -> None:
    """What `new --live` does: two robots, one with odometry of another name."""
    names = {"alpha": "lab/alpha/odom", "beta": "lab/beta/odom"}
    publishers = {one: ros.tester.create_publisher(Odometry, name, 10) for one, name in names.items()}
    listener = Listener(Swarm(), "", is_proposed_from, use_sim_time=False)

    def drive() -> None:
        for name, publisher in publishers.items():
            publisher.publish(odometry_bytes(name, time.time_ns()))

    with repeated(drive):
        evidence = listener.listen(3.0, unwatched)
    listener.destroy_node()
    found = proposed(evidence.topics, lambda likely: likely)
    assert [robot.name for robot in found.swarm.robots] == [*names]
    assert found.swarm.topics == {"<robot>/odom": "lab/<robot>/odom"}
    assert found.asked == [
        "alpha, beta: each has an unknown start. Write start, or leave it to the estimator."
    ]
