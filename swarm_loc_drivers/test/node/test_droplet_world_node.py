"""The whole chain of Droplets over DDS: steering, drivers, consoles, one world, its clock and its tracker."""

import signal
import threading
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_world import Program, Ros, overrides, stamp_ns
from rosgraph_msgs.msg import Clock

from bench.scenarios.droplets_run import DropletRunSettings, describe_droplets
from swarm_loc_drivers.droplet.droplet_nodes import DropletFleetNode
from swarm_loc_drivers.sim.scenarios.droplets import starts
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_msgs.msg import BrightnessMatrix

ROBOTS = 3
POWERS = {BrightnessMatrix.POWER_FAR, BrightnessMatrix.POWER_NEAR}
SETTINGS = DropletRunSettings(robots=ROBOTS, start_known=True)


@pytest.fixture
def swarm_file(tmp_path: Path) -> Path:
    path = tmp_path / "swarm.yaml"
    swarm = describe_droplets(SETTINGS, starts(SETTINGS.seed, SETTINGS.robots))
    save_swarm(swarm, path)
    return path


def way_of(odometry: list[Odometry]) -> float:
    place = odometry[-1].pose.pose.position
    return float(np.hypot(place.x, place.y))


def way_between(one: PoseStamped, other: PoseStamped) -> float:
    first, last = one.pose.position, other.pose.position
    return float(np.hypot(last.x - first.x, last.y - first.y))


@pytest.mark.usefixtures("ros")
def test_the_drivers_of_a_table_share_what_is_set_and_begin_when_all_are_made(
    swarm_file: Path, tmp_path: Path
) -> None:
    shared = {"model": "audio_droplet", "walk_noise": 0.002, "far_power": 200, "publish_tf": False}
    values = {"swarm_file": str(swarm_file), "link_folder": str(tmp_path), "parts": 2, **shared}
    table = DropletFleetNode(parameter_overrides=overrides(**values))
    told = {"address": str(tmp_path / "droplet3"), "turns": ROBOTS, "turn": 2, **shared}
    _, driver = table._drivers
    assert {name: driver.get_parameter(name).value for name in told} == told
    assert not [one for one in threading.enumerate() if one.name.startswith("driver of")]
    table.destroy_node()  # as when interrupted before it works


def test_droplets_wander_and_measure_each_other(ros: Ros, swarm_file: Path, tmp_path: Path) -> None:
    clock: list[Clock] = ros.listen(Clock, "/clock")
    truth: list[PoseStamped] = ros.listen(PoseStamped, "droplet2/ground_truth")
    odometry: list[Odometry] = ros.listen(Odometry, "droplet2/odom")
    fixes: list[PoseWithCovarianceStamped] = ros.listen(PoseWithCovarianceStamped, "droplet3/fix")
    matrices: list[BrightnessMatrix] = ros.listen(BrightnessMatrix, "droplet1/brightness")
    with ExitStack() as running:

        def start(name: str, log: str, parameters: dict[str, object]) -> Program:
            program = Program(name, tmp_path / log, parameters, package="swarm_loc_drivers")
            return running.enter_context(program)

        swarm = {"swarm_file": swarm_file}
        seen = {"fixed": '["droplet3"]', "fix_rate": 5.0}
        world = start(
            "droplet_world_node", "world.log", {**swarm, **seen, "link_folder": tmp_path, "rate": 2.0}
        )
        ros.until(lambda: clock)
        start("droplet_fleet_node", "table.log", {**swarm, "link_folder": tmp_path, "use_sim_time": "true"})
        start("droplet_steering_node", "steering.log", {**swarm, "use_sim_time": "true"})
        ros.until(lambda: any(one.twist.twist.linear.x or one.twist.twist.linear.y for one in odometry))
        ros.until(lambda: len({one.transmitter for one in matrices}) == 2 and len(fixes) > 5)
        ros.until(lambda: {one.power for one in matrices} == POWERS)
        ros.until(lambda: way_of(odometry) > 0.005 and way_between(truth[0], truth[-1]) > 0.003)
        assert world.end(signal.SIGINT) == 0, world.output
    times = np.array([one.clock.sec + 1e-9 * one.clock.nanosec for one in clock])
    assert (np.diff(times) > 0).all()
    assert {one.receiver for one in matrices} == {0x1001}
    assert all(stamp_ns(one) > 0 for one in matrices)
    there = starts(SETTINGS.seed, SETTINGS.robots)[2]
    for fix in fixes:
        place, turn = fix.pose.pose.position, fix.pose.pose.orientation
        pose = [place.x, place.y, 2.0 * np.arctan2(turn.z, turn.w)]
        error = np.subtract(pose, there)
        error[2] = se2.wrap_angle(error[2])
        assert np.abs(error / (0.003, 0.003, 0.02)).max() < 6.0
        assert fix.header.frame_id == "map"
