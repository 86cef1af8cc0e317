"""The marker detector as a managed node, and several of them with an estimator in one process."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from managed_node import ACTIVATE, CLEANUP, CONFIGURE, DEACTIVATE, Manager
from node_world import PATIENCE_S, Ros, newest_status, overrides, write_swarm
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from test_marker_detector_node import FAMILY, camera_info, image

from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_msgs.msg import MarkerDetectionArray, SwarmPoses
from swarm_loc_vision.markers.marker_nodes import MarkerDetectorNode

pytestmark = pytest.mark.usefixtures("frequent_diagnostics")


def test_a_detector_detects_while_it_is_active(ros: Ros, tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    given = overrides(autostart=False, family=FAMILY, swarm_file=str(path))
    ros.add(MarkerDetectorNode(parameter_overrides=given))
    manager = Manager(ros, "marker_detector")
    heard: list[MarkerDetectionArray] = ros.listen(MarkerDetectionArray, "detections")
    told: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
    images = ros.tester.create_publisher(Image, "image_raw", qos_profile_sensor_data)
    info = ros.tester.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)

    def sees() -> bool:
        info.publish(camera_info())
        images.publish(image(1))
        return bool(heard)

    assert not manager.change(CONFIGURE)
    assert manager.state() == "unconfigured"
    path.write_text("fileversion: 1\nrobots: {a: {}}\n", encoding="utf-8")
    assert manager.changes(CONFIGURE, ACTIVATE) == "active"
    ros.until(sees)

    assert manager.changes(DEACTIVATE) == "inactive"
    ros.until(lambda: not ros.tester.count_publishers("detections"))
    assert not ros.tester.count_subscribers("image_raw")
    inactive = "inactive: nothing is published"
    ros.until(lambda: newest_status(told, "marker_detector").message == inactive)
    heard.clear()
    assert manager.changes(ACTIVATE) == "active"
    ros.until(sees)
    assert manager.changes(DEACTIVATE, CLEANUP) == "unconfigured"


@pytest.fixture
def tester() -> Iterator[Node]:
    """A node apart from those that are tested."""
    rclpy.init(args=[])
    yield rclpy.create_node("tester")
    rclpy.shutdown()


@pytest.mark.parametrize("executor_class", [SingleThreadedExecutor, EventsExecutor])
def test_detectors_and_an_estimator_share_a_process(
    tester: Node, tmp_path: Path, executor_class: Callable[[], Any]
) -> None:
    swarm = {"swarm_file": str(write_swarm(tmp_path))}
    heard: dict[str, list[Any]] = {name: [] for name in ("alpha", "beta", "swarm")}
    nodes = [tester, EstimatorNode(parameter_overrides=overrides(**swarm))]
    executor = executor_class()
    publishers = []
    for robot in ("alpha", "beta"):
        own = overrides(**swarm, family=FAMILY, robot=robot)
        nodes.append(MarkerDetectorNode(namespace=robot, parameter_overrides=own))
        for kind, topic, message in (
            (CameraInfo, "camera_info", camera_info()),
            (Image, "image_raw", image(1)),
        ):
            name = f"{robot}/{topic}"
            publishers.append((tester.create_publisher(kind, name, qos_profile_sensor_data), message))
        tester.create_subscription(MarkerDetectionArray, f"{robot}/detections", heard[robot].append, 10)
    tester.create_subscription(SwarmPoses, "swarm/poses", heard["swarm"].append, 10)
    for node in nodes:
        executor.add_node(node)
    end_s = time.monotonic() + PATIENCE_S
    while not all(heard.values()):
        assert time.monotonic() < end_s, {name: len(messages) for name, messages in heard.items()}
        for publisher, message in publishers:
            publisher.publish(message)
        executor.spin_once(timeout_sec=0.02)
    for node in nodes:
        executor.remove_node(node)
    executor.shutdown()
    for node in nodes:
        node.destroy_node()
