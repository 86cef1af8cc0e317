"""A simulated swarm of Droplets: where they go, what they measure, and what a bag of it holds."""

from pathlib import Path

import numpy as np
import pytest

from bench.scenarios.droplets_run import DropletRun, DropletRunSettings, simulate_droplets
from bench.scenarios.generate_bag import main
from swarm_loc_drivers.sim.scenarios.droplets import PITCH, starts
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.messages.poses import decode_fix
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.sensors.infrared import BrightnessSensor
from swarm_loc_estimator.swarm.ir_board import PairGains
from swarm_loc_estimator.swarm.swarm_file import load_swarm

SETTINGS = DropletRunSettings(seed=2, duration_s=20.0, robots=6, calibrated=True)


@pytest.fixture(scope="module")
def run() -> DropletRun:
    return simulate_droplets(SETTINGS)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "droplets"
    options = ["--seed", "2", "--duration", "20", "--robots", "6", "--calibrated"]
    assert main(["droplets", str(path), *options]) == 0
    return path


@pytest.mark.parametrize("robots", [1, 2, 20])
def test_robots_begin_apart(robots: int) -> None:
    places = starts(1, robots)[:, :2]
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + np.eye(robots)
    assert apart.min() > 0.6 * PITCH
    assert np.ptp(places, axis=0).max() < 0.2 * np.sqrt(robots)


def test_every_other_robot_wanders_around_its_place(run: DropletRun) -> None:
    away = np.linalg.norm(run.truth.poses[:, :, :2] - run.truth.poses[0, :, :2], axis=-1)
    assert not away[:, ::2].any()
    assert (away[:, 1::2].max(axis=0) > 0.003).all()
    assert away[:, 1::2].max() > 0.01
    assert away.max() < 0.04


def test_matrices_show_the_robots_where_they_were(run: DropletRun) -> None:
    boards = [robot.ir for robot in run.swarm.robots]
    index_of = {board.id: index for index, board in enumerate(boards) if board is not None}
    misfits = []
    for one in run.matrices:
        receiver, transmitter = one.receiver, index_of[one.brightness.transmitter]
        poses = run.truth.at(np.array([receiver, transmitter]), np.int64(one.brightness.stamp_ns))
        seen = se2.between(poses[0], poses[1])
        pose = [np.hypot(seen[0], seen[1]), np.arctan2(seen[1], seen[0]), seen[2]]
        known = [boards[robot] for robot in (receiver, transmitter)]
        gains = PairGains.of(*([board.gains] for board in known if board and board.gains))
        platform = known[0].platform if known[0] else None
        assert platform is not None
        exact = expected_brightness(platform, pose, gains)[0, one.brightness.power]
        misfits.append(np.median(np.abs(one.brightness.readings - np.minimum(exact, 250.0))))
    assert len(misfits) > 60
    assert np.median(misfits) < 2.0


def test_the_bag_holds_what_was_published_late_and_not_all_of_it(run: DropletRun, bag: Path) -> None:
    assert load_swarm(bag / "swarm.yaml") == run.swarm
    with BagReader(bag) as reader:
        names = {topic.name for topic in reader.topics}
        messages = list(reader.messages())
    robots = range(1, SETTINGS.robots + 1)
    kinds = ("odom", "brightness", "ground_truth")
    assert names == {f"droplet{k}/{kind}" for k in robots for kind in kinds} | {
        f"droplet{k}/fix" for k in (1, SETTINGS.robots)
    }
    decode = BrightnessSensor.decode
    matrices = [(log_ns, decode(data)) for name, _, log_ns, data in messages if "bright" in name]
    assert 0.8 * len(run.matrices) < len(matrices) < len(run.matrices)
    late_s = np.array([log_ns - one.stamp_ns for log_ns, one in matrices]) * 1e-9
    assert late_s.min() > 0.2
    assert late_s.max() < 2.0
    fixes = [(log_ns, decode_fix(data)) for name, _, log_ns, data in messages if name == "droplet1/fix"]
    errors = np.array([one.pose for _, one in fixes]) - run.truth.poses[0, 0]
    assert np.abs(errors / (0.003, 0.003, 0.02)).max() < 6.0
