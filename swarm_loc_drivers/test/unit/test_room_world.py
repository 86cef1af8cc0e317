"""Rooms: walls, robots that drive about, and sensors whose messages locate them by what `new` has written."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.shared.room_run import placed_world, record_room
from swarm_loc_drivers.sim.pushbot.floor_plan import FLOOR_PLANS, clearance
from swarm_loc_drivers.sim.room.sensors import CeilingCameras, Lidar, Radios, cast, sensors_of
from swarm_loc_drivers.sim.room.world import STEP_NS, drawn, room_of, room_starts
from swarm_loc_drivers.sim.worlds import WorldError
from swarm_loc_estimator.cli import new
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.messages.cdr import RANGE, decode
from swarm_loc_estimator.mapping.messages import decode_scan
from swarm_loc_estimator.offline.calibration.models import Options, fit_models
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.error_models import LidarModel
from swarm_loc_estimator.swarm.swarm import Localizer, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimator import Status

NOBODY = np.empty((0, 2))


def described(folder: Path, *options: str) -> Swarm:
    """What `new` writes."""
    file, mapped = folder / "swarm.yaml", ["--map", str(folder / "map.yaml")] if "map" in str(options) else []
    assert new.main([str(file), "--yes", *options, *mapped]) == 0
    return load_swarm(file)


@pytest.mark.parametrize("plan", FLOOR_PLANS)
def test_a_drawn_map_has_the_walls_and_the_room_between(plan: str) -> None:
    hall = FLOOR_PLANS[plan]
    grid = drawn(hall.walls)
    assert grid.free[tuple(grid.index(hall.starts).T)].all()
    for x, y in grid.centres(grid.occupied)[::7].tolist():
        assert clearance(hall.walls, NOBODY, 0.0, x, y) <= grid.cell
    middles = 0.5 * (hall.walls[:, :2] + hall.walls[:, 2:])
    assert grid.occupied[tuple(grid.index(middles).T)].all()
    low, high = hall.walls.reshape(-1, 2).min(axis=0), hall.walls.reshape(-1, 2).max(axis=0)
    free = grid.centres(grid.free)
    assert ((free > low) & (free < high)).all()


def test_robots_drive_about_and_touch_neither_walls_nor_each_other(tmp_path: Path) -> None:
    swarm = described(tmp_path, "--type", "turtlebot4", "--robots", "6", "--sensors", "lidar,map")
    world = placed_world(swarm, "w2", 3, "office")
    driven, radius = np.zeros(6), float(world.radii[0])
    for _ in range(60_000_000_000 // STEP_NS):
        before = world.poses
        world.step()
        driven += np.hypot(*(world.poses - before)[:, :2].T)
        away = np.hypot(*(world.poses[:, None, :2] - world.poses[None, :, :2]).T) + 10.0 * np.eye(6)
        assert away.min() > 2.0 * radius
    assert driven.min() > 3.0
    assert min(clearance(world.walls, NOBODY, 0.0, x, y) for x, y, _ in world.poses.tolist()) > radius
    # odometry reports the commands, and true scales are hidden
    assert np.abs(world.reported).max() > 1.0


def test_a_command_drives_a_robot_for_half_a_second() -> None:
    robot = Robot("a", camera=None, start=(0.0, 0.0, 0.0))
    world = placed_world(Swarm((robot,)), "w0", 1)
    world.command(0, 0.1, 0.0)
    before = world.poses.copy()
    for _ in range(20):
        world.step()
    assert math.dist(world.poses[0, :2], before[0, :2]) == pytest.approx(0.02, abs=0.003)
    for _ in range(80):
        world.step()
    assert world.velocities[0, 0] != 0.1


def test_a_room_that_is_too_small_is_named() -> None:
    swarm = Swarm(tuple(Robot(f"r{k}", camera=None) for k in range(900)))
    with pytest.raises(WorldError, match=r"the room has places for \d+ robots, not 900\."):
        room_starts(swarm, room_of(swarm, ""), 1)


def test_motion_capture_of_another_kind_is_named() -> None:
    swarm = Swarm((Robot("a", camera=None, start=(0.0, 0.0, 0.0)),), localizer=Localizer("named_poses"))
    with pytest.raises(WorldError, match=r"localizer.source is 'named_poses', and .* has only 'pose'\."):
        sensors_of(placed_world(swarm, "w0", 1))


def test_ranges_are_distances_in_space_with_the_biases_of_both_ends(tmp_path: Path) -> None:
    swarm = described(tmp_path, "--type", "turtlebot4", "--robots", "3", "--sensors", "uwb", "--arena", "6x5")
    robots = tuple(
        replace(one, uwb=replace(one.uwb, range_sigma=1e-9, range_bias=0.1 * k, z=0.4))
        for k, one in enumerate(swarm.robots)
        if one.uwb is not None
    )
    world = placed_world(replace(swarm, robots=robots), "w0", 2)
    (radios,) = (one for one in sensors_of(world) if isinstance(one, Radios))
    assert len(radios.topics) == 3 + 3 * 4
    places = {str(k + 1): (world.poses[k, 0], world.poses[k, 1], 0.4) for k in range(3)}
    places |= {one.word: (one.x, one.y, one.z) for one in swarm.anchors}
    world.now_ns += 10**9
    heard = dict(message for _ in range(6) for _, message in radios.messages())
    assert len(heard) >= 12
    for topic, data in heard.items():
        _, a, b, _ = topic.replace("n_", "").split("/")
        biases = sum(0.1 * (int(word) - 1) for word in (a, b) if int(word) <= 3)
        assert decode(data, RANGE).range == pytest.approx(math.dist(places[a], places[b]) + biases, abs=1e-5)


def test_a_sweep_of_a_robot_that_stands_shows_walls_and_the_other_robot() -> None:
    names = ("a", "b")
    robots = tuple(Robot(name, camera=None, start=(0.5 * k, 0.0, 0.0)) for k, name in enumerate(names))
    others = {"scan_rear": {"yaw": math.pi}}
    robots = tuple(replace(one, lidar=LidarModel(range_sigma=1e-9, others=others)) for one in robots)
    swarm = Swarm(tuple(replace(one, said=frozenset({"lidar.yaw"})) for one in robots))
    world = placed_world(swarm, "w0", 1)
    world.poses = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    (lidar,) = (one for one in sensors_of(world) if isinstance(one, Lidar))
    world.now_ns += 10**9
    scans = {topic: decode_scan(data) for _, (topic, data) in lidar.messages()}
    assert [*scans] == ["a/scan", "a/scan_rear", "b/scan", "b/scan_rear"]
    scan, rear = scans["a/scan"], scans["a/scan_rear"]
    assert (scan.frame_id, rear.frame_id) == ("a/laser", "a/scan_rear_laser")
    assert np.roll(rear.ranges, 180) == pytest.approx(scan.ranges, abs=0.05)
    assert scan.ranges[180] == pytest.approx(0.5 - world.radii[1], abs=0.03)  # ahead
    assert scan.ranges[0] == pytest.approx(1.2, abs=0.05)  # behind
    assert scan.ranges[90] == pytest.approx(0.8, abs=0.05)  # to the right


def test_each_beam_of_a_sweep_is_measured_where_the_robot_then_is() -> None:
    """Also where its turn rate changes during the sweep."""
    lidar = LidarModel(range_sigma=1e-9, range_sigma_per_m=0.0, max_range=50.0, x=0.1)
    robot = Robot("a", camera=None, start=(0.0, 0.0, 0.3), lidar=lidar, said=frozenset({"lidar.x"}))
    world = placed_world(Swarm((robot,)), "w0", 5, "office")
    (sensor,) = (one for one in sensors_of(world) if isinstance(one, Lidar))
    track, off = [world.poses[0]], []
    for _ in range(400):
        world.step()
        track.append(world.poses[0])
        for _, (_, data) in sensor.messages():
            at = np.arange(360) * 20 / 360
            steps = np.floor(at).astype(int)
            before, after = (np.array(track[-21:])[steps + k] for k in (0, 1))
            share = (at - steps)[:, None]
            rays = se2.compose(
                se2.compose(before, se2.exp(share * se2.log(se2.between(before, after)))), [0.1, 0.0, 0.0]
            )
            angles = rays[:, 2] - math.pi + np.arange(360) * math.pi / 180.0
            seen = cast(world.walls, NOBODY, 0.1, rays[:, :2], angles)
            off.append(np.abs(decode_scan(data).ranges - seen).max())
    assert len(off) == 20
    assert max(off) < 1e-3


@pytest.mark.timeout(300)  # starts that are found from ranges take a while on a busy machine
@pytest.mark.parametrize(
    ("options", "error_m"),
    [
        ("--type turtlebot4 --robots 3 --sensors lidar,map,imu", 0.05),
        ("--type epuck2 --robots 4 --sensors ceiling,imu", 0.12),
        ("--type turtlebot4 --robots 2 --sensors uwb --arena 6x5", 0.3),
        ("--type turtlebot4 --robots 3 --sensors mocap", 0.01),
        ("--type dotbot --robots 3 --sensors fix", 0.05),
    ],
)
def test_a_description_by_new_locates_simulated_robots(tmp_path: Path, options: str, error_m: float) -> None:
    swarm = described(tmp_path, *options.split())
    record_room(placed_world(swarm, "w2", 4, "office" if "map" in options else ""), 25.0, tmp_path / "bag")
    result = replay(tmp_path / "bag", swarm)
    assert (result.status[-1] == Status.TRACKED).all()
    assert result.overall.position_rmse < error_m
    assert result.overall.nees < 6.0


@pytest.mark.parametrize("seed", [1, 2])
def test_ceiling_cameras_are_placed_by_robots_that_they_see(tmp_path: Path, seed: int) -> None:
    """They hang 5 cm and .05 rad off, as described, and no robot sees anything."""
    swarm = described(tmp_path, "--type", "epuck2", "--robots", "3", "--sensors", "ceiling")
    world = placed_world(swarm, "w2", seed)
    (ceiling,) = (one for one in sensors_of(world) if isinstance(one, CeilingCameras))
    record_room(world, 60.0, tmp_path / "bag")
    blind = replace(read_recording(tmp_path / "bag", swarm), truth={})
    found = fit_models(blind, swarm, Options(alone=True), unwatched).swarm
    hung, placed = (np.array([(one.x, one.y, one.yaw) for one in each.cameras]) for each in (swarm, found))
    true = hung + ceiling.offsets
    # where one is as the other has it; of where both are, the description alone tells
    before, after = (
        np.abs(se2.between(each[0], each[1]) - se2.between(true[0], true[1])) for each in (hung, placed)
    )
    assert before.max() > 0.03
    assert after.max() < 0.004
    shared = found.map_error
    assert shared.position_sigma == pytest.approx(0.05 / np.sqrt(2.0), rel=0.1)
    assert np.abs((placed - true).mean(axis=0)[:2]).max() < 3.0 * shared.position_sigma
    assert max(one.position_sigma for one in found.cameras) < 0.005
