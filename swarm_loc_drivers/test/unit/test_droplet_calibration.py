"""Droplets calibrated from one recording are located better in another one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.scenarios.bags import write_droplet_bag
from bench.scenarios.droplets_run import DropletRunSettings, simulate_droplets
from swarm_loc_estimator.cli import calibrate_ir
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm

SETTINGS = DropletRunSettings(seed=1, duration_s=40.0, robots=8, start_known=True, boards=1)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two recordings of robots that have the same elements and move differently."""
    folder = tmp_path_factory.mktemp("bags")
    for seed in (1, 51):
        write_droplet_bag(simulate_droplets(replace(SETTINGS, seed=seed)), folder / f"{seed}", "", seed)
    return [folder / "1", folder / "51"]


def position_rmse(bag: Path, swarm: Swarm) -> float:
    return replay(bag, swarm).overall.position_rmse


@pytest.fixture(scope="module")
def plain_rmse(bags: list[Path]) -> float:
    """Of the second recording, not calibrated."""
    return position_rmse(bags[1], load_swarm(bags[1] / "swarm.yaml"))


@pytest.mark.parametrize("options", [(), ("--without-truth",)])
def test_a_calibration_helps_in_another_recording(
    bags: list[Path], plain_rmse: float, tmp_path: Path, options: tuple[str, ...]
) -> None:
    out = tmp_path / "calibrated.yaml"
    assert calibrate_ir.main([str(bags[0]), "--out", str(out), *options]) == 0
    plain = load_swarm(bags[1] / "swarm.yaml")
    boards = {robot.name: robot.ir for robot in load_swarm(out).robots}
    known = replace(plain, robots=tuple(replace(robot, ir=boards[robot.name]) for robot in plain.robots))
    assert position_rmse(bags[1], known) < 0.8 * plain_rmse


def test_boards_fix_the_gains_of_elements_and_nothing_else() -> None:
    short = replace(SETTINGS, duration_s=4.0, robots=4, calibrated=True)
    first, moved, other = (
        simulate_droplets(one) for one in (short, replace(short, seed=2), replace(short, boards=2))
    )
    gains = [
        np.array([robot.ir.gains.sensor for robot in run.swarm.robots if robot.ir and robot.ir.gains])
        for run in (first, moved, other)
    ]
    np.testing.assert_allclose(gains[0], gains[1], rtol=0.2)  # told to 2 %
    assert np.abs(gains[0] / gains[2] - 1.0).max() > 0.2
    assert np.abs(first.truth.poses[0] - moved.truth.poses[0]).max() > 0.01
    np.testing.assert_array_equal(first.truth.poses[0], other.truth.poses[0])
