"""Robots that send by topics which they share, over DDS, from two gateways."""

from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from node_world import (
    SETTINGS,
    STEP_NS,
    T0_NS,
    TRUE_POSES,
    Ros,
    newest_status,
    overrides,
    sight,
    stamp_ns,
    values_of,
)
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from bench.shared.bags import SharedHead, encode_shared_detections, encode_shared_numbers
from swarm_loc_estimator.common.messages.detections import swarm_key
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_msgs.msg import SwarmDetections, SwarmOdometry, SwarmPoses

KEY = swarm_key(TRUE_POSES)


def head(robot: list[int], now_ns: int) -> SharedHead:
    """Readings of now; two more of a robot that there is not are no obstacle."""
    indices = np.array([*robot, 77])
    return SharedHead(now_ns, "odom", KEY, indices, np.full(indices.size, now_ns))


def test_robots_are_located_by_topics_that_they_share(ros: Ros, swarm_file: Path) -> None:
    parameters = overrides(swarm_file=str(swarm_file), use_sim_time=True, shared_topics=True, **SETTINGS)
    node = ros.add(EstimatorNode(parameter_overrides=parameters))
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    poses: list[SwarmPoses] = ros.listen(SwarmPoses, "swarm/poses")
    clock = ros.tester.create_publisher(Clock, "/clock", 10)
    odometry = [ros.tester.create_publisher(SwarmOdometry, "swarm/odom", 10) for _ in TRUE_POSES]
    seen = ros.tester.create_publisher(SwarmDetections, "swarm/detections", 10)
    ros.until(lambda: all(one.get_subscription_count() for one in (clock, *odometry, seen)))
    ros.until(lambda: ros.tester.count_publishers("swarm/poses"))
    for step in range(30):
        now_ns = T0_NS + step * STEP_NS
        clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))
        for robot, gateway in enumerate(odometry):
            gateway.publish(encode_shared_numbers(head([robot], now_ns), np.zeros((2, 3))))
        images = [sight(pose) for pose in TRUE_POSES.values()]
        robots = np.repeat(range(len(images)), [len(image) for image in images]).tolist()
        markers = np.concatenate([*images, images[0][:1]], dtype=images[0].dtype)
        seen.publish(encode_shared_detections(head(robots, now_ns), markers))
        ros.until(lambda now_ns=now_ns: bool(poses) and stamp_ns(poses[-1]) == now_ns)  # type: ignore[misc]
    for pose in poses[-1].robots:
        assert (pose.x, pose.y, pose.theta) == pytest.approx(TRUE_POSES[pose.name], abs=0.02)
        assert pose.status == pose.STATUS_TRACKED

    def is_well() -> bool:
        """Whether diagnostics of the last poses find nothing wrong; ticks may have taken all of the time."""
        told = bool(heard) and stamp_ns(heard[-1]) == now_ns
        return told and newest_status(heard, "estimator").level == DiagnosticStatus.OK

    ros.until(is_well)
    values = values_of(newest_status(heard, "estimator"))
    assert values["swarm/odom received"] == "60"
    assert values["swarm/detections received"] == "30"
    assert values["dropped: unknown_robot"] == "90"
    names = {name for name, _ in node.get_subscriber_names_and_types_by_node("estimator", "/")}
    assert not [name for name in names if name.startswith(("/alpha/", "/beta/"))]


def test_what_is_missing_is_named_by_the_shared_topic(ros: Ros, swarm_file: Path) -> None:
    parameters = overrides(swarm_file=str(swarm_file), shared_topics=True)
    ros.add(EstimatorNode(parameter_overrides=parameters))
    heard = ros.listen(DiagnosticArray, "/diagnostics")

    def sentence() -> str:
        return " ".join(one.message for one in heard[-1].status if one.name == "estimator") if heard else ""

    ros.until(lambda: "no messages received on swarm/odom, swarm/detections (no publisher)" in sentence())
