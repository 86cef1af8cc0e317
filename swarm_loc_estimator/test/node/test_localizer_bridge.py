"""The bridge over DDS: poses of bodies come out as fixes and truth of robots, and what is missing is told."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from node_world import T0_NS, Ros, newest_status, overrides, stamp_ns, values_of
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.time import Time
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.nodes.localizer_bridge import LocalizerBridge

pytestmark = pytest.mark.usefixtures("frequent_diagnostics")

RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
POSES = {"alpha": (1.0, 2.0), "beta": (-1.0, 0.5)}


class Bridged:
    """A bridge, and what it says."""

    def __init__(self, ros: Ros, swarm_file: Path, **parameters: Any) -> None:
        self._ros = ros
        given = overrides(swarm_file=str(swarm_file), **parameters)
        ros.add(LocalizerBridge(parameter_overrides=given))
        self._diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")

    def status(self) -> DiagnosticStatus:
        """Its newest diagnostics."""
        return newest_status(self._diagnostics, "localizer_bridge")

    def says(self, words: str) -> None:
        """Wait until its diagnostics have these words."""
        self._ros.until(lambda: words in self.status().message)


def header_of(message: Any, frame: str = "world") -> Any:
    message.header.frame_id = frame
    message.header.stamp = Time(nanoseconds=T0_NS).to_msg()
    return message


def test_the_description_names_the_localizer(ros: Ros, swarm_file: Path, tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    localizer = "localizer: {source: odometry, topic: <body>/mocap, bodies: [cf1=alpha], latency_s: 0.5}\n"
    path.write_text(swarm_file.read_text(encoding="utf-8") + localizer)
    bridged = Bridged(ros, path, latency_s=0.25)  # a parameter wins
    fixes = ros.listen(PoseWithCovarianceStamped, "alpha/fix")
    message = header_of(Odometry())
    message.pose.pose.orientation.w = 1.0
    publisher = ros.tester.create_publisher(Odometry, "cf1/mocap", RELIABLE)
    ros.publish_until(publisher, message, fixes.__len__)
    assert stamp_ns(fixes[0]) == T0_NS - 250_000_000
    bridged.says("bridging")


@pytest.mark.parametrize("qos", [qos_profile_sensor_data, RELIABLE])
def test_a_topic_of_each_body_becomes_a_fix_of_its_robot(ros: Ros, swarm_file: Path, qos: QoSProfile) -> None:
    bridged = Bridged(ros, swarm_file, bodies=["cf1=alpha", "beta"], latency_s=0.5)
    bridged.says("no messages received on /vrpn_mocap/cf1/pose (no publisher), /vrpn_mocap/beta/pose")
    assert bridged.status().level == DiagnosticStatus.WARN
    for robot, body in (("alpha", "cf1"), ("beta", "beta")):
        fixes = ros.listen(PoseWithCovarianceStamped, f"{robot}/fix")
        message = header_of(PoseStamped())
        message.pose.position.x, message.pose.position.y = POSES[robot]
        message.pose.orientation.w = 1.0
        publisher = ros.tester.create_publisher(PoseStamped, f"/vrpn_mocap/{body}/pose", qos)
        ros.publish_until(publisher, message, fixes.__len__)
        assert fixes[0].header.frame_id == "map"
        assert stamp_ns(fixes[0]) == T0_NS - 500_000_000
        assert (fixes[0].pose.pose.position.x, fixes[0].pose.pose.position.y) == POSES[robot]
        assert fixes[0].pose.covariance[[0, 7, 35]] == pytest.approx([1e-6, 1e-6, 25e-6])
    bridged.says("bridging")
    assert bridged.status().level == DiagnosticStatus.OK


def test_transforms_become_ground_truth(ros: Ros, swarm_file: Path) -> None:
    bridged = Bridged(ros, swarm_file, source="tf", output="ground_truth", offsets=["beta=0.5,0,0"])
    truths = {robot: ros.listen(PoseStamped, f"{robot}/ground_truth") for robot in POSES}
    transforms = []
    for robot, (x, y) in POSES.items():
        one = header_of(TransformStamped(child_frame_id=robot), "map")
        one.transform.translation.x, one.transform.translation.y = x, y
        one.transform.rotation.w = 1.0
        transforms.append(one)
    transforms.append(header_of(TransformStamped(child_frame_id="alpha/base_link"), "alpha/odom"))
    publisher = ros.tester.create_publisher(TFMessage, "/tf", RELIABLE)
    ros.publish_until(publisher, TFMessage(transforms=transforms), lambda: all(truths.values()))
    assert truths["alpha"][0].pose.position.x == POSES["alpha"][0]
    assert truths["beta"][0].pose.position.x == POSES["beta"][0] - 0.5
    bridged.says("bridging")
    assert values_of(bridged.status())["bodies of no robot"] == ""


def test_odometry_keeps_its_covariance_and_its_frame_is_checked(ros: Ros, swarm_file: Path) -> None:
    bridged = Bridged(ros, swarm_file, source="odometry", topic="<body>/odometry", bodies=["alpha"])
    fixes = ros.listen(PoseWithCovarianceStamped, "alpha/fix")
    message = header_of(Odometry(), "odom")
    message.pose.pose.orientation.w = 1.0
    message.pose.covariance = np.diag([0.01, 0.02, 0.0, 0.0, 0.0, 0.03]).ravel()
    publisher = ros.tester.create_publisher(Odometry, "alpha/odometry", RELIABLE)
    ros.publish_until(publisher, message, lambda: bridged.status().message.startswith("no pose can be used"))
    assert "dropped: foreign_frame" in values_of(bridged.status())
    assert not fixes
    message.header.frame_id = "map"
    ros.publish_until(publisher, message, lambda: fixes)
    assert fixes[0].pose.covariance[[0, 7, 35]] == pytest.approx([0.01, 0.02, 0.03])
    bridged.says("bridging")
    message.header.frame_id = "odom"  # the source changes its frame, after good poses
    ros.publish_until(publisher, message, lambda: bridged.status().message.startswith("no pose can be used"))


def test_bodies_that_nobody_describes_are_named(ros: Ros, swarm_file: Path) -> None:
    bridged = Bridged(ros, swarm_file, bodies=["alpha"])
    publisher = ros.tester.create_publisher(PoseStamped, "/vrpn_mocap/alhpa/pose", RELIABLE)
    bridged.says("body 'alhpa' is of no robot: name it in bodies")
    assert "no messages received on /vrpn_mocap/alpha/pose (no publisher)" in bridged.status().message
    assert publisher.get_subscription_count() == 0


def test_a_body_of_which_a_shared_topic_says_nothing_is_named(ros: Ros, swarm_file: Path) -> None:
    bridged = Bridged(ros, swarm_file, source="tf")
    one = header_of(TransformStamped(child_frame_id="alpha"), "map")
    one.transform.rotation.w = 1.0
    publisher = ros.tester.create_publisher(TFMessage, "/tf", RELIABLE)
    words = "no messages received on /tf about body 'beta'"
    ros.publish_until(publisher, TFMessage(transforms=[one]), lambda: bridged.status().message == words)


@pytest.mark.parametrize(
    ("source", "package"),
    [("named_poses", "motion-capture-tracking-interfaces"), ("rigid_bodies", "mocap4r2-msgs")],
)
@pytest.mark.skipif(
    any(map(find_spec, ("motion_capture_tracking_interfaces", "mocap4r2_msgs"))), reason="they are installed"
)
def test_a_source_whose_package_is_missing_ends_the_start(
    ros: Ros, swarm_file: Path, source: str, package: str
) -> None:
    with pytest.raises(UserError, match=f"install ros-jazzy-{package}, or build"):
        Bridged(ros, swarm_file, source=source)
