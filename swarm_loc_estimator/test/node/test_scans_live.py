"""Scans of a lidar over DDS: the estimator takes them and corrects a start by the map of the description."""

import math
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point, Pose, Quaternion, TransformStamped
from nav_msgs.msg import MapMetaData, OccupancyGrid, Odometry
from node_world import SECOND, T0_NS, Ros, Steps, odometry_bytes, overrides
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_msgs.msg import SwarmPose

BEAMS = 180
SWARM_YAML = """
fileversion: 1
map: floor.yaml
robots:
  alpha:
    camera: null
    lidar: {range_sigma: 0.01}
    start: {x: 0.1, y: -0.1, theta: 0.05}
    start_sigma: {x: 0.1, y: 0.1, theta: 0.1}
"""
MAP_YAML = """
image: floor.pgm
resolution: 0.05
origin: [-2.025, -1.525, 0.0]
occupied_thresh: 0.65
free_thresh: 0.196
"""
WIDTH, HEIGHT = 81, 61


def write_map(folder: Path) -> None:
    """A room of 4 x 3 m around the origin, with walls on centres of cells."""
    rows = [[0 if x in (0, WIDTH - 1) else 254 for x in range(WIDTH)] for _ in range(HEIGHT)]
    rows[0] = rows[-1] = [0] * WIDTH
    pixels = b"".join(bytes(row) for row in rows)
    (folder / "floor.pgm").write_bytes(f"P5 {WIDTH} {HEIGHT} 255\n".encode() + pixels)
    (folder / "floor.yaml").write_text(MAP_YAML, encoding="utf-8")


def scan_at(now_ns: int) -> LaserScan:
    """What a lidar sees from the middle of the room."""
    step = 2.0 * math.pi / BEAMS
    angles = [step * k for k in range(BEAMS)]
    ranges = [min(2.0 / max(abs(math.cos(one)), 1e-9), 1.5 / max(abs(math.sin(one)), 1e-9)) for one in angles]
    header = Header(stamp=Time(nanoseconds=now_ns).to_msg(), frame_id="alpha/base_scan")
    shape = {"angle_max": step * (BEAMS - 1), "angle_increment": step, "range_min": 0.1, "range_max": 8.0}
    return LaserScan(header=header, **shape, ranges=ranges)


def stand_while_scans_come(
    ros: Ros, tmp_path: Path, turned_by: int, static: TransformStamped | None = None
) -> None:
    """Stand in the map while scans come, whose beams begin at a later one, until alpha is where it is."""
    path = tmp_path / "swarm.yaml"
    path.write_text(SWARM_YAML, encoding="utf-8")
    write_map(tmp_path)
    ros.add(EstimatorNode(parameter_overrides=overrides(swarm_file=str(path), use_sim_time=True)))
    odometry = ros.tester.create_publisher(Odometry, "alpha/odom", 100)
    scans = ros.tester.create_publisher(LaserScan, "alpha/scan", qos_profile_sensor_data)
    publishers = [odometry, scans]
    if static is not None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publishers.append(ros.tester.create_publisher(TFMessage, "/tf_static", latched))
        publishers[-1].publish(TFMessage(transforms=[static]))
    steps = Steps(ros, *publishers)
    for step in range(10):
        now_ns = T0_NS + step * SECOND // 2
        scan = scan_at(now_ns)
        scan.ranges = [*scan.ranges[turned_by:], *scan.ranges[:turned_by]]
        steps.step(now_ns, (odometry, odometry_bytes("alpha", now_ns)), (scans, scan))

    (alpha,) = steps.poses[-1].robots
    assert alpha.status == SwarmPose.STATUS_TRACKED
    assert (alpha.x, alpha.y, alpha.theta) == pytest.approx((0.0, 0.0, 0.0), abs=0.02)


def test_scans_correct_a_start(ros: Ros, tmp_path: Path) -> None:
    stand_while_scans_come(ros, tmp_path, turned_by=0)


def test_a_mount_comes_from_static_transforms(ros: Ros, tmp_path: Path) -> None:
    """The lidar looks to the left; who does not know it takes the robot to look to the right."""
    turned = TransformStamped(header=Header(frame_id="alpha/base_link"), child_frame_id="alpha/base_scan")
    turned.transform.rotation.z = turned.transform.rotation.w = math.sqrt(0.5)
    stand_while_scans_come(ros, tmp_path, turned_by=BEAMS // 4, static=turned)


def grid(*, x: float = -2.025, frame: str = "map") -> OccupancyGrid:
    """The room as a message, with its left wall at an x."""
    edges = {0, WIDTH - 1}
    cells = [100 if k % WIDTH in edges or k // WIDTH in (0, HEIGHT - 1) else 0 for k in range(WIDTH * HEIGHT)]
    corner = Pose(position=Point(x=x, y=-1.525), orientation=Quaternion(w=1.0))
    about = MapMetaData(resolution=0.05, width=WIDTH, height=HEIGHT, origin=corner)
    return OccupancyGrid(header=Header(frame_id=frame), info=about, data=cells)


def test_a_map_by_topic_is_used_and_changed_at_run_time(ros: Ros, tmp_path: Path) -> None:
    """One is published before the node starts; alpha follows the walls of a later one."""
    path = tmp_path / "swarm.yaml"
    path.write_text(SWARM_YAML.replace("floor.yaml", "topic"), encoding="utf-8")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    maps = ros.tester.create_publisher(OccupancyGrid, "map", latched)
    maps.publish(grid())
    ros.add(EstimatorNode(parameter_overrides=overrides(swarm_file=str(path), use_sim_time=True)))
    odometry = ros.tester.create_publisher(Odometry, "alpha/odom", 100)
    scans = ros.tester.create_publisher(LaserScan, "alpha/scan", qos_profile_sensor_data)
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    steps, times = Steps(ros, maps, odometry, scans), count(T0_NS, SECOND // 2)

    def send_until(happened: Callable[[SwarmPose], bool]) -> SwarmPose:
        """Send data until something has happened; returns alpha."""
        for _ in range(1000):
            now_ns = next(times)
            steps.step(now_ns, (odometry, odometry_bytes("alpha", now_ns)), (scans, scan_at(now_ns)))
            alpha: SwarmPose = steps.poses[-1].robots[0]
            if happened(alpha):
                return alpha
        raise AssertionError(alpha)

    alpha = send_until(lambda alpha: alpha.status == SwarmPose.STATUS_TRACKED)
    assert (alpha.x, alpha.y, alpha.theta) == pytest.approx((0.0, 0.0, 0.0), abs=0.02)
    said = "map is in frame 'odom' but must be in 'map'"
    maps.publish(grid(frame="odom", x=-1.525))
    alpha = send_until(lambda _: any(said in one.message for array in diagnostics for one in array.status))
    assert alpha.status == SwarmPose.STATUS_TRACKED
    maps.publish(grid(x=-1.525))
    alpha = send_until(lambda alpha: alpha.status == SwarmPose.STATUS_TRACKED and alpha.x > 0.1)
    assert (alpha.x, alpha.y, alpha.theta) == pytest.approx((0.5, 0.0, 0.0), abs=0.02)
