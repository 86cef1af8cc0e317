"""What a run teaches of cameras, odometry and landmarks: near the truth, and good for the next run."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_messages import SECOND, T0
from core_run import covariance_of_places, errors, on_time, play, ticks
from core_world import MOUNT, Plan, World, lasting_errors, simulate

from bench.shared.bags import copy_part
from swarm_loc_estimator.cli.replay import main
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import ODOMETRY, decode, encode
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.offline.report.report import SELF_CALIBRATED
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import SwarmFileError, load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.self_calibration import learns
from swarm_loc_estimator.timeline.settings import Settings

BAG = Path(__file__).parents[3] / "bags" / "eight_five_robots_w2"
PLAN = Plan(2, 40.0, speed=0.15, lasting=1.0, survey=1.0)


def run(world: World, settings: Settings | None = None) -> tuple[Swarm, FloatArray]:
    """What a run teaches, and its errors (T, N, 3)."""
    estimator = Estimator(world.swarm, settings)
    estimates = play(estimator, on_time(world), ticks(T0, int(world.stamp_ns[-1]), 1.0))
    return estimator.learned(), errors(world, estimates)


@pytest.mark.parametrize("sparse_from", [2, 250])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_is_learned_is_near_the_truth_and_as_sure_as_it_says(seed: int, sparse_from: int) -> None:
    world, true = simulate(PLAN, seed), lasting_errors(PLAN, seed)
    taught, _ = run(world, Settings(sparse_from=sparse_from))
    off, before = [], []
    for i, (robot, described) in enumerate(zip(taught.robots, world.swarm.robots, strict=True)):
        odometry, sensor = robot.odometry, robot.sensor
        assert robot.camera is not None
        assert described.camera is not None
        off += [
            (odometry.distance_scale / (1.0 + true.distance_scale[i]) - 1.0) / odometry.distance_scale_sigma,
            (odometry.turn_scale / (1.0 + true.turn_scale[i]) - 1.0) / odometry.turn_scale_sigma,
            (robot.camera.yaw - MOUNT.yaw - true.yaw[i]) / robot.camera.yaw_sigma,
            (sensor.distance_scale / (1.0 + true.stretch[i]) - 1.0) / sensor.distance_scale_sigma,
        ]
        before.append(robot.camera.yaw_sigma / described.camera.yaw_sigma)
    sigmas = np.sqrt(np.diag(covariance_of_places(taught))).reshape(-1, 2)
    for mark, surveyed, place, sigma in zip(
        taught.landmarks, world.swarm.landmarks, true_landmarks(world), sigmas, strict=True
    ):
        off += ((np.array([mark.x, mark.y]) - place) / sigma).tolist()
        before.append(np.sqrt(np.mean(sigma**2)) / surveyed.position_sigma)
    assert np.abs(off).max() < 4.5
    assert max(before) < 0.6


def true_landmarks(world: World) -> FloatArray:
    angles = 2.0 * np.pi * np.arange(PLAN.landmarks) / PLAN.landmarks
    assert len(world.swarm.landmarks) == PLAN.landmarks
    return PLAN.arena * np.column_stack([np.cos(angles), np.sin(angles)])


@pytest.mark.parametrize("seed", [1, 2])
def test_a_landmark_is_named_while_it_is_elsewhere(seed: int) -> None:
    """Somebody pushes it by 20 cm, and puts it back after ten seconds."""
    world = simulate(Plan(3, 60.0, speed=0.15), seed)
    mark, estimator, named = world.swarm.landmarks[2], Estimator(world.swarm), []
    for second in range(60):
        begin_ns, end_ns, events = T0 + second * SECOND, T0 + (second + 1) * SECOND, []
        for event in (one for one in world.events if begin_ns <= one.stamp_ns < end_ns):
            rows, heading = event.detections.copy(), world.at(event.stamp_ns)[event.robot, 2] + MOUNT.yaw
            if 10 <= second < 20:
                ahead, left = 0.2 * math.cos(heading), -0.2 * math.sin(heading)
                rows["position"][rows["id"] == mark.id] += [-left, 0.0, ahead]
            events.append((event.stamp_ns, replace(event, detections=rows)))
        play(estimator, events, [end_ns])
        about = [one.about for one in estimator.contradictions(end_ns)]
        named.append([one for one in about if one.startswith("landmark")])
    assert {one for names in named for one in names} == {f"landmark {mark.id}"}
    assert named[19]
    assert not named[59]


def exact(swarm: Swarm) -> Swarm:
    """The swarm as it is described, nothing of which is estimated but poses and what changes."""
    robots = (
        replace(
            robot,
            odometry=replace(robot.odometry, distance_scale_sigma=0.0, turn_scale_sigma=0.0),
            camera=robot.camera and replace(robot.camera, yaw_sigma=0.0),
            sensor=replace(robot.sensor, distance_scale_sigma=0.0),
        )
        for robot in swarm.robots
    )
    landmarks = (replace(mark, position_sigma=0.0, yaw_sigma=0.0) for mark in swarm.landmarks)
    return Swarm(tuple(robots), tuple(landmarks))


def test_what_was_learned_may_be_trusted_from_then_on() -> None:
    before: list[float] = []
    after: list[float] = []
    for seed in range(3):
        world = simulate(PLAN, 10 + seed)
        taught, _ = run(world)
        for swarm, squared in ((world.swarm, before), (taught, after)):
            _, errors = run(replace(world, swarm=exact(swarm)), Settings(max_fault_score=1e9))
            squared.append(float(np.nanmean(np.square(errors[5:, :, :2]))))  # not a number where one got lost
    assert np.mean(after) < 0.25 * np.mean(before)


def test_there_is_nothing_to_learn_where_nothing_has_a_sigma() -> None:
    assert not learns(simulate(Plan(1, 1.0), 0).swarm)
    assert learns(simulate(Plan(1, 1.0, lasting=1.0), 0).swarm)
    assert learns(simulate(Plan(1, 1.0, survey=1.0), 0).swarm)


def test_a_robot_that_was_not_located_keeps_its_description() -> None:
    swarm = simulate(Plan(1, 1.0, lasting=1.0), 0).swarm
    assert Estimator(swarm).learned() == swarm


def test_the_replay_command_writes_what_it_learned_and_reports_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy_part(BAG, tmp_path / "bag", 15.0)
    learned, command = tmp_path / "learned.yaml", [str(tmp_path / "bag"), "--out", str(tmp_path)]
    assert main([*command, "--swarm", str(BAG / "self_calibrating.yaml"), "--learned", str(learned)]) == 0
    before, after = load_swarm(BAG / "self_calibrating.yaml"), load_swarm(learned)
    for old, new in zip(before.robots, after.robots, strict=True):
        assert old.camera is not None
        assert new.camera is not None
        assert 0.0 < new.camera.yaw_sigma < 0.5 * old.camera.yaw_sigma
    shown = capsys.readouterr().out
    assert "Self-calibration" in shown
    assert "20 landmarks are " in shown
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert all(title in page for title in SELF_CALIBRATED)
    assert "20 landmarks are " in page
    exact = [*command, "--swarm", str(BAG / "swarm.yaml"), "--learned", str(learned)]
    assert main(exact) == 0  # what is described as exact is contradicted
    assert any(robot.camera and robot.camera.yaw_sigma > 0.0 for robot in load_swarm(learned).robots)
    assert main([*exact, "--set", "max_fault_score=1e9"]) == 1
    assert "nothing to learn" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("what", "description", "key"),
    [("path", "swarm.yaml", "distance_scale"), ("turn", "self_calibrating.yaml", "turn_scale")],
)
def test_odometry_with_a_swapped_sign_is_named_and_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str, description: str, key: str
) -> None:
    copy_part(
        BAG,
        tmp_path / "bag",
        20.0,
        change=lambda name, at, data: (at, swapped(data, what) if name == "epuck2/odom" else data),
    )
    learned = tmp_path / "learned.yaml"
    command = [str(tmp_path / "bag"), "--swarm", str(BAG / description), "--out", str(tmp_path / "out")]
    assert main([*command, "--learned", str(learned)]) == 1
    named, unwritten = capsys.readouterr().err.strip().splitlines()
    assert named.startswith(f"epuck2: its odometry reports the {what} with the wrong sign ({key} is -")
    assert "negate the" in named
    assert unwritten == f"{learned} was not written."
    assert not learned.exists()
    assert named in (tmp_path / "out" / "report.txt").read_text(encoding="utf-8")
    found = replay(tmp_path / "bag", load_swarm(BAG / description)).self_calibrated
    assert found is not None
    assert all(0.0 < getattr(robot.odometry, f"{key}_sigma") <= 1.0 for robot in found.robots)


def swapped(data: bytes, what: str) -> bytes:
    """Odometry with the sign of path or turn negated, as that of a robot with exchanged wires."""
    message: Any = decode(data, ODOMETRY)
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    twist = message.twist.twist
    if what == "path":
        position.x, position.y, twist.linear.x = -position.x, -position.y, -twist.linear.x
    else:
        position.y, orientation.z, twist.angular.z = -position.y, -orientation.z, -twist.angular.z
    return encode(message, ODOMETRY)


@pytest.mark.parametrize("scale", [-1.0, 0.05, 20.0])
def test_the_writer_refuses_what_the_reader_refuses(tmp_path: Path, scale: float) -> None:
    swarm = Swarm((Robot("a", odometry=OdometryModel(distance_scale=scale)),))
    with pytest.raises(SwarmFileError, match=r"swarm.yaml: robots.a.odometry.distance_scale .* \[0.1, 10\]"):
        save_swarm(swarm, tmp_path / "swarm.yaml")
    assert not any(tmp_path.iterdir())
