"""The bags of PushBots give the maps that are said of them, byte for byte the same twice, and their poses."""

import math
from pathlib import Path

import numpy as np
import pytest

from bench.shared.bags import copy_part
from swarm_loc_estimator.cli.replay_map import main, read_walls
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.offline.map_replay import MapFigures, map_figures, replay_map, truth_of
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.swarm_file import load_swarm

BAGS = Path(__file__).parents[3] / "bags"
LEDS = {"pushbot1": 1000.0, "pushbot2": 1111.111}


def figures_of(name: str, leds: dict[str, float]) -> MapFigures:
    bag = BAGS / name
    swarm = load_swarm(bag / "swarm.yaml")
    mapper, feed, _ = replay_map(bag, swarm, MapperSettings(), leds, lambda *_: None)
    assert set(feed.all_drops) <= {"light_of_nobody"}
    tracks = truth_of(bag, swarm)
    truth = {number: tracks[robot.name] for number, robot in enumerate(swarm.robots)}
    return map_figures(mapper, truth, read_walls(bag / "walls.csv"))


def test_one_pushbot_makes_the_same_map_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, files = BAGS / "pushbot_one", []
    copy_part(bag, tmp_path / "bag", 90.0)
    beside = ["--swarm", str(bag / "swarm.yaml"), "--walls", str(bag / "walls.csv")]
    for name in ("a", "b"):
        out = tmp_path / name
        assert main([str(tmp_path / "bag"), "--out", str(out), *beside]) == 0
        files.append({path.name: path.read_bytes() for path in out.iterdir()})
    assert set(files[0]) == {"map.yaml", "map.pgm", "map.png", "stops.csv"}
    assert files[0] == files[1]
    assert "% of the walls" in capsys.readouterr().out


def test_the_map_of_one_pushbot_is_as_good_as_is_said() -> None:
    """8.0 cm and .73 degrees after seven minutes without having come back, 70 % of the walls, 5.4 cm off."""
    figures = figures_of("pushbot_one", {})
    assert figures.stops > 35
    assert figures.position_m < 0.10
    assert math.degrees(figures.heading_rad) < 1.0
    assert figures.coverage > 0.65
    assert figures.wall_m < 0.07


def test_two_pushbots_map_more_of_the_hall_in_less_time() -> None:
    """2.1 cm and .82 degrees after five minutes, all of the walls, 1.8 cm off."""
    figures = figures_of("pushbots_two", LEDS)
    assert figures.stops > 60
    assert figures.position_m < 0.06
    assert math.degrees(figures.heading_rad) < 1.2
    assert figures.coverage > 0.88
    assert figures.wall_m < 0.045


def test_the_estimator_follows_the_mappers_fixes_and_finds_the_slip() -> None:
    """7 cm on the way, as the fixes were when published, with a covariance that says so."""
    result = replay(BAGS / "pushbots_two", load_swarm(BAGS / "pushbots_two" / "swarm.yaml"))
    errors = result.overall
    assert np.isfinite(result.poses[-1]).all()
    assert errors.position_rmse < 0.14
    assert 0.3 < errors.nees < 3.5
    assert result.counters["measurements used"] == result.counters["messages on <robot>/fix"] == 48


def test_a_map_without_anything_to_compare_with_has_no_figures() -> None:
    figures = map_figures(CooperativeMapper(), {}, np.zeros((0, 4)))
    assert not figures.stops
    assert math.isnan(figures.position_m)
    assert math.isnan(figures.coverage)
    assert not figures.sentence()
