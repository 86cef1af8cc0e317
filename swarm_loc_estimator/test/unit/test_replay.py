"""Replay: the same poses twice, good ones, and a bag that was cut off still gives what it holds."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from swarm_loc_estimator.core.metrics import pool, summarise
from swarm_loc_estimator.io.bag_cut import copy_beginning
from swarm_loc_estimator.io.swarm_file import load_swarm
from swarm_loc_estimator.replay import replay

DEMO = Path(__file__).parents[3] / "bags" / "eight_five_robots"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first seconds of the demo's bag."""
    folder = tmp_path_factory.mktemp("bags") / "short"
    copy_beginning(DEMO, folder, 10.0)
    return folder


def test_a_bag_gives_the_same_poses_twice_byte_for_byte(bag: Path) -> None:
    swarm = load_swarm(DEMO / "swarm.yaml")
    first, second = replay(bag, swarm), replay(bag, swarm)

    assert first.stamp_ns.tobytes() == second.stamp_ns.tobytes()
    assert first.pose.tobytes() == second.pose.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()
    assert np.isfinite(first.pose[-1]).all()
    assert summarise(pool([*first.errors.values()])).position_rmse < 0.01


def test_a_bag_cut_in_the_middle_gives_the_poses_up_to_there(tmp_path: Path) -> None:
    swarm = load_swarm(DEMO / "swarm.yaml")
    whole = replay(DEMO, swarm)
    file = next(DEMO.glob("*.mcap"))
    cut = tmp_path / "cut.mcap"
    shutil.copy(file, cut)
    with cut.open("r+b") as stream:
        stream.truncate(file.stat().st_size // 2)
    part = replay(cut, swarm)

    assert part.remarks
    same = len(part.stamp_ns) - 3  # the last ones lack what the cut has taken
    assert 0.3 < same / len(whole.stamp_ns) < 0.6
    np.testing.assert_array_equal(part.stamp_ns[:same], whole.stamp_ns[:same])
    np.testing.assert_array_equal(part.pose[:same], whole.pose[:same])
