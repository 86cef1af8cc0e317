"""The mapper over DDS: a robot in a small room, a map that late subscribers get, goals, fixes, files."""

import math
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from mapping_world import LIDAR, LidarRobot, RoomRobot, scan_bytes, static
from nav_msgs.msg import OccupancyGrid, Odometry
from node_world import T0_NS, Ros, odometry_bytes, overrides, stamp_ns, values_of
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.serialization import serialize_message
from rclpy.time import Time
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.mapping.grid import CELL
from swarm_loc_estimator.mapping.map_file import load_map
from swarm_loc_estimator.mapping.mapper_feed import MapperInput
from swarm_loc_estimator.mapping.scans import Readings
from swarm_loc_estimator.nodes.mapper_node import MapperNode
from swarm_loc_msgs.msg import LaserDistance

START = (1.0, 1.0, 0.3)
YAML = """
fileversion: 1
defaults: {fix: {systematic_share: 1.0}}
robots:
  alpha: {start: {x: 1.0, y: 1.0, theta: 0.3}, start_sigma: {x: 0.001, y: 0.001, theta: 0.001}}
  beta: {start: {x: 2.0, y: 1.0, theta: 0.0}}
"""


def laser_bytes(at_ns: int, inverse: float, sigma: float) -> bytes:
    message = LaserDistance()
    message.header.stamp = Time(nanoseconds=at_ns).to_msg()
    message.header.frame_id = "alpha/base_link"
    message.distance = 1.0 / inverse if inverse else math.nan
    message.sigma = sigma / inverse**2 if inverse else math.nan
    return bytes(serialize_message(message))


class Driver:
    """Alpha's driver and tracker, which never send more than may wait for the node."""

    def __init__(self, ros: Ros, node: MapperNode) -> None:
        self._ros, self._node, self._sent = ros, node, 0
        self.odometry = ros.tester.create_publisher(Odometry, "alpha/odom", QoSProfile(depth=200))
        self.laser = ros.tester.create_publisher(LaserDistance, "alpha/laser", QoSProfile(depth=200))
        ros.until(lambda: self.odometry.get_subscription_count() and self.laser.get_subscription_count())

    def send(self, readings: Readings) -> None:
        """Publish readings, and wait again and again until the node has taken them."""
        rows = zip(readings.stamp_ns, readings.odometry, readings.inverse, strict=True)
        for number, (at_ns, pose, inverse) in enumerate(rows, 1):
            stamp = T0_NS + int(at_ns)
            self.laser.publish(laser_bytes(stamp, float(inverse), readings.sigma))
            self.odometry.publish(odometry_bytes("alpha", stamp, tuple(pose.tolist())))
            self._sent += 2
            if number % 100 == 0 or number == len(readings.stamp_ns):
                self._ros.until(lambda: self._node.feed.received.total() == self._sent)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    (tmp_path / "swarm.yaml").write_text(YAML, encoding="utf-8")
    return tmp_path


def mapper(ros: Ros, files: Path, **parameters: Any) -> MapperNode:
    given = {"swarm_file": str(files / "swarm.yaml"), "map_period_s": 0.1, **parameters}
    node: MapperNode = ros.add(
        MapperNode(parameter_overrides=overrides(save_map=str(files / "map.yaml"), **given))
    )
    return node


def test_a_robot_looks_around_and_gets_a_map_a_fix_and_a_goal(ros: Ros, files: Path) -> None:
    node = mapper(ros, files, robots=["alpha"])
    goals = ros.listen(PoseStamped, "alpha/goal")
    fixes = ros.listen(PoseWithCovarianceStamped, "alpha/fix")
    driver, robot = Driver(ros, node), RoomRobot(START, 0.02, np.random.default_rng(1))
    for angle, rate in ((0.5 * math.pi, 0.5), (4.0 * math.pi, 1.0)):
        driver.send(robot.turn(angle, rate))
    ros.until(lambda: goals and fixes)
    assert goals[0].header.frame_id == fixes[0].header.frame_id == "map"
    assert 0.1 < math.dist((goals[0].pose.position.x, goals[0].pose.position.y), START[:2]) < 1.3
    place = fixes[0].pose.pose.position
    assert math.dist((place.x, place.y), START[:2]) < 0.02
    assert stamp_ns(fixes[0]) > T0_NS
    assert 0.02**2 <= fixes[0].pose.covariance[0] < 0.05**2

    maps: list[OccupancyGrid] = []  # a late subscriber gets the newest
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    ros.until(lambda: ros.tester.count_publishers("map"))
    ros.tester.create_subscription(OccupancyGrid, "map", maps.append, latched)
    ros.until(lambda: any(100 in one.data or max(one.data) > 60 for one in maps))
    info = maps[-1].info
    cells = np.array(maps[-1].data).reshape(info.height, info.width)
    at = np.floor((np.array(START[:2]) + 0.3 - [info.origin.position.x, info.origin.position.y]) / CELL)
    assert 0 <= cells[int(at[1]), int(at[0])] < 40
    assert info.resolution == pytest.approx(CELL)
    assert (cells == -1).any()

    done = ros.call(Trigger, "mapper/save_map", Trigger.Request())
    assert done.success, done.message
    assert load_map(files / "map.yaml", CELL).occupied.sum() > 100
    assert ros.call(Trigger, "mapper/reset", Trigger.Request()).success
    assert node.feed.received.total() == 0


def more_scans(node: MapperNode, before: int) -> bool:
    return node.feed.received[0, MapperInput.SCAN] > before


@pytest.mark.parametrize("by_transforms", [False, True])
def test_a_lidar_is_read_by_best_effort_and_locates_a_robot_that_drives(
    ros: Ros, files: Path, by_transforms: bool
) -> None:
    """With its mount in the description, or in the latched transforms of its URDF."""
    robot = LidarRobot(np.random.default_rng(1))
    start = dict(zip(("x", "y", "theta"), robot.start.tolist(), strict=True))
    sigma = dict.fromkeys(start, 0.001)
    lidar = {
        key: value
        for key, value in asdict(LIDAR).items()
        if key not in ("x", "y", "yaw") or not by_transforms
    }
    about = f"{{start: {start}, start_sigma: {sigma}, lidar: {lidar}}}".replace("'", "")
    text = f"fileversion: 1\ndefaults: {{fix: {{systematic_share: 1.0}}}}\nrobots: {{alpha: {about}}}\n"
    (files / "swarm.yaml").write_text(text, encoding="utf-8")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    transforms = ros.tester.create_publisher(TFMessage, "/tf_static", latched)
    if by_transforms:
        joint = ("base_link", "a/base_scan", (LIDAR.x, LIDAR.y, 0.2), (LIDAR.yaw, 0.0, 0.0))
        transforms.publish(static(joint))
    node = mapper(ros, files)
    ros.until(transforms.get_subscription_count)
    goals = ros.listen(PoseStamped, "alpha/goal")
    fixes = ros.listen(PoseWithCovarianceStamped, "alpha/fix")
    odometry = ros.tester.create_publisher(Odometry, "alpha/odom", QoSProfile(depth=200))
    scans = ros.tester.create_publisher(LaserScan, "alpha/scan", qos_profile_sensor_data)
    ros.until(lambda: odometry.get_subscription_count() and scans.get_subscription_count())
    for at_ns in range(T0_NS, T0_NS + 5_000_000_000, 200_000_000):
        pose = robot.odometry(np.array([at_ns - T0_NS]))[0]
        odometry.publish(odometry_bytes("alpha", at_ns, tuple(pose.tolist())))
        scan = scan_bytes(robot.scan(at_ns - T0_NS)._replace(stamp_ns=at_ns))
        ros.publish_until(scans, scan, partial(more_scans, node, node.feed.received[0, MapperInput.SCAN]))
    ros.until(lambda: len(fixes) >= 4)
    for fix in fixes:
        truth = robot.pose(stamp_ns(fix) - T0_NS)
        place = fix.pose.pose.position
        assert math.dist((place.x, place.y), truth[:2]) < 0.03
        assert 0.02**2 <= fix.pose.covariance[0] < 0.05**2
    assert not goals
    assert set(node.feed.all_drops) <= {"scan_too_old"}  # what is sent again


def test_what_is_missing_and_what_is_wrong_is_told(ros: Ros, files: Path) -> None:
    node = mapper(ros, files)
    reports = ros.listen(DiagnosticArray, "/diagnostics")
    driver = Driver(ros, node)
    ros.until(lambda: reports)
    first = reports[0].status[0]
    assert first.message.startswith("no messages received on alpha/odom")
    assert "beta/laser (no publisher)" in first.message
    driver.laser.publish(b"\0\1\0\0\1")
    driver.laser.publish(laser_bytes(T0_NS, 0.0, 1.0))
    ros.until(lambda: values_of(reports[-1].status[0])["<robot>/laser received"] == "2")
    assert values_of(reports[-1].status[0])["dropped: bad_message"] == "1"
    assert "alpha/laser" not in reports[-1].status[0].message


def test_a_description_that_takes_fixes_for_independent_ends_the_start(ros: Ros, files: Path) -> None:
    text = YAML.replace("systematic_share: 1.0", "systematic_share: 0.5")
    (files / "swarm.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=r"robot 'alpha' maps: .* needs 'fix: {systematic_share: 1.0}'"):
        mapper(ros, files)


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"robots": ["gamma"]}, "there is no robot 'gamma'"),
        ({"led_frequencies": ["alpha"]}, "'alpha' must be the name of a robot"),
        ({"load_map": "nowhere.yaml"}, "nowhere.yaml cannot be read"),
        ({"max_range": 0.0}, "parameter max_range = 0.0 must lie in"),
    ],
)
def test_a_wrong_parameter_ends_the_start(
    ros: Ros, files: Path, parameters: dict[str, Any], said: str
) -> None:
    with pytest.raises(UserError, match=said):
        mapper(ros, files, **parameters)
