"""What nodes publish: attributes, publishers and shared topics."""

import ast
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from node_world import (
    PATIENCE_S,
    SETTINGS,
    STEP_NS,
    T0_NS,
    TRUE_POSES,
    Program,
    Robots,
    Ros,
    Steps,
    newest_status,
    odometry_bytes,
    overrides,
    sight,
    stamp_ns,
    values_of,
)
from rcl_interfaces.msg import Log, ParameterType
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from tf2_msgs.msg import TFMessage

from bench.shared.bags import SharedHead, encode_shared_detections, encode_shared_numbers
from swarm_loc_estimator.common.messages.detections import swarm_key
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_msgs.msg import SwarmDetections, SwarmOdometry
from workspace.layout import PACKAGES, ROOT

FLOOD = """
import sys
import rclpy
from nav_msgs.msg import Odometry
rclpy.init()
node = rclpy.create_node("flood")
publisher = node.create_publisher(Odometry, sys.argv[1], 10)
data = bytes.fromhex(sys.argv[2])
while True:
    publisher.publish(data)
"""
FLOOD_S = 4.0
MEGABYTE = 1 << 20


def test_best_effort_publishers_are_heard_and_named(ros: Ros, swarm_file: Path) -> None:
    log = ros.listen(Log, "/rosout")
    ros.add(EstimatorNode(parameter_overrides=overrides(swarm_file=str(swarm_file), use_sim_time=True)))
    ros.until(lambda: any("ready" in entry.msg for entry in log))
    robots = Robots(ros, QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT))
    robots.wait_for_estimator()
    robots.run(T0_NS, 20)
    assert robots.located("alpha")
    assert robots.located("beta")
    ros.until(lambda: sum("published best effort" in entry.msg for entry in log) == 4)


def test_publishers_that_should_not_be_are_named_once_per_change(ros: Ros, robots: Robots) -> None:
    log, heard = ros.listen(Log, "/rosout"), ros.listen(DiagnosticArray, "/diagnostics")
    others = ros.add(Node("other"))
    second = others.create_publisher(Odometry, "alpha/odom", 10)
    robots.run(T0_NS, 4)
    sentence = "alpha/odom has 2 publishers: /other, /tester"
    ros.until(lambda: sentence in newest_status(heard, "estimator: alpha").message)
    assert newest_status(heard, "estimator: alpha").level == DiagnosticStatus.WARN
    count = len(heard)
    ros.until(lambda: len(heard) > count + 1)
    assert sum(entry.msg == sentence for entry in log) == 1
    others.destroy_publisher(second)
    ros.until(lambda: "publishers" not in newest_status(heard, "estimator: alpha").message)


def test_a_second_estimator_and_a_second_clock_are_named(ros: Ros, robots: Robots, swarm_file: Path) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    ros.add(Node("other")).create_publisher(Clock, "/clock", 10)
    parameters = overrides(swarm_file=str(swarm_file), use_sim_time=True)
    ros.add(EstimatorNode(namespace="copy", parameter_overrides=parameters))
    ros.add(EstimatorNode(parameter_overrides=parameters))
    robots.run(T0_NS, 4)
    sentences = (
        "swarm/poses has 2 publishers: /estimator, /estimator",
        "/clock has 2 publishers: /other, /tester",
    )  # the copy tells of the clocks alone
    ros.until(lambda: all(one in newest_status(heard, "estimator").message for one in sentences))


def test_a_static_transform_into_a_robots_odom_frame_is_named(ros: Ros, robots: Robots) -> None:
    log, heard = ros.listen(Log, "/rosout"), ros.listen(DiagnosticArray, "/diagnostics")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    transforms = [TransformStamped(child_frame_id=name) for name in ("alpha/odom", "alpha/camera")]
    for transform in transforms:
        transform.header.frame_id = "world"
    ros.add(Node("other")).create_publisher(TFMessage, "/tf_static", latched).publish(
        TFMessage(transforms=transforms)
    )
    robots.run(T0_NS, 4)
    sentence = "/tf_static has a transform from 'world' to 'alpha/odom', which only the estimator may publish"
    ros.until(lambda: sentence in newest_status(heard, "estimator").message)
    assert newest_status(heard, "estimator").level == DiagnosticStatus.WARN
    ros.until(lambda: sum(entry.msg == sentence for entry in log) == 1)
    assert "alpha/camera" not in newest_status(heard, "estimator").message


def test_the_clock_cannot_be_changed_while_the_node_runs(ros: Ros, robots: Robots) -> None:
    robots.run(T0_NS, 2)
    parameter = ParameterMessage(name="use_sim_time")
    parameter.value.type = ParameterType.PARAMETER_BOOL
    response = ros.call(
        SetParameters, "estimator/set_parameters", SetParameters.Request(parameters=[parameter])
    )
    (result,) = response.results
    assert (result.successful, result.reason) == (
        False,
        "use_sim_time is read at the start only: restart the node.",
    )
    robots.run(T0_NS + 2 * STEP_NS, 2)


def test_a_pose_estimate_of_rviz_sets_a_robot(ros: Ros, robots: Robots) -> None:
    log = ros.listen(Log, "/rosout")
    publisher = ros.tester.create_publisher(PoseWithCovarianceStamped, "beta/initialpose", 1)
    robots.tell_time(T0_NS)
    for name in ("alpha", "beta"):
        robots.odometry(name, odometry_bytes(name, T0_NS))
    robots.tell_time(T0_NS + STEP_NS)
    ros.until(lambda: robots.located("alpha") and publisher.get_subscription_count())
    assert not robots.located("beta")

    pose = PoseWithCovarianceStamped()
    pose.header.frame_id = "odom"
    pose.pose.pose.position.x = 3.0
    pose.pose.covariance[0] = pose.pose.covariance[7] = 0.25
    pose.pose.covariance[35] = 0.07
    publisher.publish(pose)
    ros.until(lambda: any("in frame 'odom' but must be in 'map'" in entry.msg for entry in log))
    pose.header.frame_id = "map"
    covariance, pose.pose.covariance = pose.pose.covariance, [0.0] * 36
    publisher.publish(pose)
    ros.until(lambda: any("nothing was changed: the covariance is zero." in entry.msg for entry in log))
    pose.pose.covariance = covariance
    publisher.publish(pose)
    ros.until(lambda: any("by beta/initialpose: Robot 'beta' is at x 3.000 m" in entry.msg for entry in log))
    robots.tell_time(T0_NS + 2 * STEP_NS)
    ros.until(lambda: robots.located("beta"))
    assert robots.newest("beta").x == pytest.approx(3.0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_flood_is_dropped_and_counted_memory_stays_and_a_signal_ends_the_node(
    ros: Ros, tmp_path: Path, swarm_file: Path, number: signal.Signals
) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    now_ns = time.time_ns()
    command = [sys.executable, "-c", FLOOD, "alpha/odom", odometry_bytes("alpha", now_ns).hex()]
    with Program("estimator_node", tmp_path / "log", {"swarm_file": swarm_file}) as program:
        program.wait_for("ready")
        flood = subprocess.Popen(command)
        try:
            ros.until(lambda: "were lost in queues" in newest_status(heard, "estimator").message)
            assert "dropped: overload" in values_of(newest_status(heard, "estimator"))
            before, begin_s = resident_bytes(program.process.pid), time.monotonic()
            ros.until(lambda: time.monotonic() > begin_s + FLOOD_S)
            grown = resident_bytes(program.process.pid) - before
            took_s = program.seconds_to_end(number)
            status = program.end()
        finally:
            flood.kill()
            flood.wait(PATIENCE_S)
        assert status == 0
        assert "Traceback" not in program.output
    assert grown < 5 * MEGABYTE
    assert took_s < 2.0


def resident_bytes(pid: int) -> int:
    return int(Path("/proc", str(pid), "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


FILES = [path for package in PACKAGES for path in sorted(ROOT.glob(f"{package}/{package}/**/*.py"))]


@pytest.fixture
def taken() -> Iterator[frozenset[str]]:
    context = rclpy.Context()
    rclpy.init(context=context)
    node = Node("bare", context=context)
    yield frozenset(dir(node))
    node.destroy_node()
    rclpy.shutdown(context=context)


def _own_attributes(source: str) -> set[str]:
    """What the classes that derive from Node, or from others that are called nodes, assign to themselves."""
    classes = [
        found
        for found in ast.walk(ast.parse(source))
        if isinstance(found, ast.ClassDef)
        and any(ast.unparse(base).partition("[")[0].endswith("Node") for base in found.bases)
    ]
    stored = [
        ast.unparse(part)
        for found in classes
        for part in ast.walk(found)
        if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store)
    ]
    return {name.removeprefix("self.") for name in stored if name.startswith("self.")}


def test_no_attribute_of_rclpy_is_replaced(taken: frozenset[str]) -> None:
    own = {str(path): _own_attributes(path.read_text(encoding="utf-8")) for path in FILES}

    assert any(own.values())
    assert {name: names & taken for name, names in own.items() if names & taken} == {}


KEY = swarm_key(TRUE_POSES)


def head(robot: list[int], now_ns: int) -> SharedHead:
    """Readings of now; two more of a robot that there is not are no obstacle."""
    indices = np.array([*robot, 77])
    return SharedHead(now_ns, "odom", KEY, indices, np.full(indices.size, now_ns))


def test_robots_are_located_by_topics_that_they_share(ros: Ros, swarm_file: Path) -> None:
    parameters = overrides(swarm_file=str(swarm_file), use_sim_time=True, shared_topics=True, **SETTINGS)
    node = ros.add(EstimatorNode(parameter_overrides=parameters))
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    odometry = [ros.tester.create_publisher(SwarmOdometry, "swarm/odom", 10) for _ in TRUE_POSES]
    seen = ros.tester.create_publisher(SwarmDetections, "swarm/detections", 10)
    steps = Steps(ros, *odometry, seen)
    for step in range(30):
        now_ns = T0_NS + step * STEP_NS
        moved = [
            (gateway, encode_shared_numbers(head([robot], now_ns), np.zeros((2, 3))))
            for robot, gateway in enumerate(odometry)
        ]
        images = [sight(pose) for pose in TRUE_POSES.values()]
        robots = np.repeat(range(len(images)), [len(image) for image in images]).tolist()
        markers = np.concatenate([*images, images[0][:1]], dtype=images[0].dtype)
        steps.step(now_ns, *moved, (seen, encode_shared_detections(head(robots, now_ns), markers)))
    for pose in steps.poses[-1].robots:
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
