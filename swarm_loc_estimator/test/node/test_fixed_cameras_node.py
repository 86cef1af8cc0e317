"""Fixed cameras over DDS: detections in the namespace of a camera locate a robot; a silent one is named."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from node_world import (
    SECOND,
    SETTINGS,
    T0_NS,
    Ros,
    detection_bytes,
    newest_status,
    odometry_bytes,
    overrides,
    stamp_ns,
    values_of,
)
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_msgs.msg import MarkerDetectionArray, SwarmPose, SwarmPoses

SWARM = """
fileversion: 1
robots:
  alpha: {camera: null, faces: {top: {z: 0.1, yaw: 0.0, size: 0.05, lies: true}}, ids: {top: 4}}
cameras:
  ceiling1: {x: 1.0, y: 0.5, z: 2.1}
  ceiling2: {x: 3.0, y: 0.5, z: 2.1}
"""
STEP_NS = SECOND // 10


def below(marker_id: int) -> Any:
    """A marker 2 m under the camera whose right points to the top of the image, to map's x."""
    one = np.zeros(1, DETECTION_DTYPE)
    one["id"], one["content"], one["position"] = marker_id, 2, (-0.2, 0.0, 2.0)
    half = math.sqrt(0.5)
    one["orientation"] = (half, -half, 0.0, 0.0)  # its x is up in the image, its z towards the camera
    one["covariance"] = np.diag([1e-8, 1e-8, 1e-4, 1e-3, 1e-3, 1e-5])
    return one


@pytest.fixture
def estimator(ros: Ros, tmp_path: Path) -> EstimatorNode:
    path = tmp_path / "swarm.yaml"
    path.write_text(SWARM, encoding="utf-8")
    given = overrides(swarm_file=str(path), use_sim_time=True, **SETTINGS)
    node: EstimatorNode = ros.add(EstimatorNode(parameter_overrides=given))
    return node


def test_detections_of_a_fixed_camera_locate_a_robot(ros: Ros, estimator: EstimatorNode) -> None:
    tester = ros.tester
    clock = tester.create_publisher(Clock, "/clock", 10)
    odometry = tester.create_publisher(Odometry, "alpha/odom", 100)
    detections = tester.create_publisher(MarkerDetectionArray, "ceiling1/detections", 100)
    poses: list[SwarmPoses] = ros.listen(SwarmPoses, "swarm/poses")
    diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
    publishers = (clock, odometry, detections)
    ros.until(lambda: all(publisher.get_subscription_count() for publisher in publishers))
    ros.until(lambda: tester.count_publishers("swarm/poses") and tester.count_publishers("/diagnostics"))
    (topic,) = tester.get_subscriptions_info_by_topic("/ceiling2/detections")
    assert topic.node_name == estimator.get_name()

    def step(now_ns: int) -> None:
        clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))
        odometry.publish(odometry_bytes("alpha", now_ns))
        for marker_id in (4, 99):
            detections.publish(detection_bytes("ceiling1", now_ns, below(marker_id)))
        ros.until(lambda: any(stamp_ns(one) == now_ns for one in poses))

    for k in range(30):
        step(T0_NS + k * STEP_NS)
    (alpha,) = poses[-1].robots
    assert alpha.status == SwarmPose.STATUS_TRACKED
    assert (alpha.x, alpha.y, alpha.theta) == pytest.approx((1.0, 0.7, 0.0), abs=2e-3)
    ros.until(lambda: "dropped: unknown_id" in values_of(newest_status(diagnostics, "estimator: ceiling1")))
    assert newest_status(diagnostics, "estimator: ceiling1").message == "seeing"
    missing = newest_status(diagnostics, "estimator: ceiling2").message
    assert missing.startswith("no messages received on ceiling2/detections")
