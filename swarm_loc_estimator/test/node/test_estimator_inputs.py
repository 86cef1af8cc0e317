"""Infrared matrices and absolute fixes over DDS: robots without odometry are located, faults are named."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_world import SECOND, T0_NS, Ros, newest_status, odometry_bytes, overrides, stamp_ns, values_of
from rclpy.publisher import Publisher
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from swarm_loc_estimator.common.messages.detections import encode_brightness
from swarm_loc_estimator.common.messages.poses import encode_fix
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_estimator.swarm.ir_board import load_ir_platform
from swarm_loc_msgs.msg import BrightnessMatrix, SwarmPose, SwarmPoses

SWARM_YAML = """
fileversion: 1
types:
  droplet: {odometry: null, camera: null, ir: {platform: droplet}}
robots:
  alpha: {type: droplet, odometry: {}, ir: {id: 1}, start: {x: 0.0, y: 0.0, theta: 0.0}}
  beta: {type: droplet, ir: {id: 2}}
  gamma: {type: droplet, ir: null}
"""
BETA = (0.1, 0.5, -1.0)  # Range, bearing and heading of beta, from alpha at the origin
GAMMA = (0.3, 0.2, 1.5)
KINDS = {"odom": Odometry, "brightness": BrightnessMatrix, "fix": PoseWithCovarianceStamped}


class Droplets:
    """The swarm's drivers."""

    def __init__(self, ros: Ros) -> None:
        self._ros = ros
        self._clock: Publisher = ros.tester.create_publisher(Clock, "/clock", 10)
        self._publisher = {
            topic: ros.tester.create_publisher(KINDS[topic.partition("/")[2]], topic, 100)
            for topic in ("alpha/odom", "alpha/brightness", "gamma/fix")
        }
        self.poses: list[SwarmPoses] = ros.listen(SwarmPoses, "swarm/poses")
        self._bright = np.minimum(np.rint(expected_brightness(load_ir_platform("droplet"), BETA)[0]), 255)

    def wait_for_estimator(self) -> None:
        """Return once it hears all topics and is heard."""
        inputs = [self._clock, *self._publisher.values()]
        self._ros.until(lambda: all(publisher.get_subscription_count() for publisher in inputs))
        self._ros.until(lambda: self._ros.tester.count_publishers("swarm/poses"))

    def step(self, now_ns: int, frame: str = "map", transmitter: int = 2) -> None:
        """What comes in a step; wait for the estimate that follows."""
        heard = len(self.poses)
        self._clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))
        self._publisher["alpha/odom"].publish(odometry_bytes("alpha", now_ns))
        for power, readings in enumerate(self._bright):
            light = encode_brightness("alpha/base_link", now_ns, (1, transmitter), readings, power)
            self._publisher["alpha/brightness"].publish(light)
        covariance = np.diag([1e-6, 1e-6, 1e-4])
        self._publisher["gamma/fix"].publish(encode_fix(frame, now_ns, GAMMA, covariance))
        self._ros.until(lambda: any(stamp_ns(pose) == now_ns for pose in self.poses[heard:]))

    def newest(self, robot: str) -> SwarmPose:
        """The last estimate of a robot."""
        (pose,) = [pose for pose in self.poses[-1].robots if pose.name == robot]
        return pose


@pytest.fixture
def droplets(ros: Ros, tmp_path: Path) -> Droplets:
    """The drivers, heard by an estimator."""
    path = tmp_path / "swarm.yaml"
    path.write_text(SWARM_YAML, encoding="utf-8")
    parameters = overrides(swarm_file=str(path), use_sim_time=True, fusion_load=1.0)
    ros.add(EstimatorNode(parameter_overrides=parameters))
    droplets = Droplets(ros)
    droplets.wait_for_estimator()
    return droplets


def report(heard: list[DiagnosticArray], name: str) -> tuple[DiagnosticStatus, dict[str, str]]:
    """The newest diagnostics of one name, and its values."""
    status = newest_status(heard, name)
    return status, values_of(status)


def until_told(ros: Ros, heard: list[DiagnosticArray], now_ns: int) -> None:
    """Wait for diagnostics that are newer."""
    ros.until(lambda: bool(heard) and stamp_ns(heard[-1]) >= now_ns)


def xytheta(pose: SwarmPose) -> Any:
    return np.array([pose.x, pose.y, pose.theta])


def test_robots_without_odometry_are_located_by_light_and_by_fixes(ros: Ros, droplets: Droplets) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    for step in range(8):
        now_ns = T0_NS + step * SECOND // 2
        droplets.step(now_ns)
    until_told(ros, heard, now_ns)

    away, bearing, heading = BETA
    beta = [away * math.cos(bearing), away * math.sin(bearing), heading]
    for name, pose in (("alpha", (0.0, 0.0, 0.0)), ("beta", beta), ("gamma", GAMMA)):
        assert droplets.newest(name).status == SwarmPose.STATUS_TRACKED, name
        assert xytheta(droplets.newest(name)) == pytest.approx(pose, abs=0.01), name
    assert droplets.newest("beta").fix_age_s == -1.0
    assert droplets.newest("gamma").fix_age_s == pytest.approx(0.0)
    status, values = report(heard, "estimator: alpha")
    assert (status.level, values["brightness received"]) == (DiagnosticStatus.OK, "16")
    status, values = report(heard, "estimator: gamma")
    assert (status.level, values["fix received"]) == (DiagnosticStatus.OK, "8")
    assert "odom received" not in values
    status, values = report(heard, "estimator")
    assert values["infrared exchanges measured"] == "8"
    assert "no messages received on beta/brightness (no publisher)" in status.message
    assert "gamma" not in status.message
    assert not [key for key in values if key.startswith("dropped: ir")]


def test_light_of_strangers_and_fixes_in_a_foreign_frame_are_dropped_and_named(
    ros: Ros, droplets: Droplets
) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    for step in range(3):
        now_ns = T0_NS + step * SECOND // 2
        droplets.step(now_ns, frame="world", transmitter=77)
    until_told(ros, heard, now_ns)

    _, values = report(heard, "estimator")
    assert (values["dropped: ir_unknown_id"], values["dropped: fix_frame"]) == ("6", "3")
    status, _ = report(heard, "estimator: gamma")
    assert status.message == "gamma/fix is in frame 'world' but must be in 'map'"
    assert droplets.newest("beta").status == droplets.newest("gamma").status == SwarmPose.STATUS_WAITING
