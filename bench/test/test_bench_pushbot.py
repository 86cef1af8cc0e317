"""The measures of maps."""

import math

import numpy as np
import pytest

from bench.pushbot.mapping import MappingEffort, figures_of, planned
from bench.pushbot.runs import RunResult, RunSettings, coverage, run, wall_distance_cm, wall_points
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan


def test_walls_are_covered_by_cells_on_them() -> None:
    plan = floor_plan("ring")
    points = wall_points(plan, 0.04)
    assert coverage(points, points) == 1.0
    assert coverage(np.zeros((0, 2)), points) == 0.0
    assert coverage(points + 1.0, points) < 0.3
    assert wall_distance_cm(points, plan) < 0.6
    inside = np.array([[0.75, 0.75]])
    assert wall_distance_cm(inside, plan) == pytest.approx(75.0, abs=1.0)


def test_every_kind_of_run_is_planned() -> None:
    jobs = planned(MappingEffort(20, 3, 20.0, 2))
    assert [len(jobs[name]) for name in ("corridor", "office", "ring", "five_robots")] == [20, 20, 20, 3]
    assert {one.slip for one in jobs["ring"]} == {0.0, 0.02, 0.05}
    assert len({one.seed for one in jobs["ring"]}) == 20
    assert jobs["five_robots"][0].minutes == 10.0
    assert [(one.slip, one.seed) for one in jobs["lidar.ring"]] == [(0.02, 1), (0.035, 2), (0.05, 3)]


def _result(seed: int, **values: float) -> RunResult:
    given = {"position_cm": 1.0, "heading_deg": 0.1, "worst_cm": 5.0, "online_position_cm": 2.0}
    given |= {"online_worst_cm": 9.0, "aligned_cm": 1.0, "wall_cm": 2.0, "wall_aligned_cm": 1.0}
    given |= {"coverage": 1.0, "coverage_90_s": math.nan, "cpu_s_per_s": 0.01, **values}
    settings, empty = RunSettings("ring", 0.0, seed), np.zeros((0, 2))
    return RunResult(settings=settings, bumps=0, cells=empty, path=empty, **given)


def test_figures_count_what_diverged_and_what_never_came() -> None:
    runs = [_result(1), _result(2, worst_cm=31.0), _result(3, online_worst_cm=40.0, coverage_90_s=200.0)]
    figures = figures_of({"ring": runs, "speed1": runs})
    assert figures["ring.diverged"] == 1.0
    assert figures["ring.online_diverged"] == 1.0
    assert figures["ring.good_share"] == 1.0
    assert figures["ring.coverage_90_share"] == pytest.approx(1 / 3)
    assert "ring.coverage_90_s" not in figures  # most runs never came so far
    assert all(math.isfinite(value) for value in figures.values())
    assert not any(name.startswith("speed1") for name in figures)


def test_a_laser_that_sees_no_walls_at_first_misleads_nobody() -> None:
    """The covariance says that the heading gets lost, and the first wall tells how the wheels slipped."""
    settings = RunSettings("open12", 0.05, 7, minutes=4.0, checks_covariances=True)
    found = run(settings)
    figures = figures_of({"open12": [found]})
    assert figures["open12.misleading_share"] == 0.0
    assert figures["open12.diverged_unreported"] == 0.0
    assert found.worst_cm < 100.0
    assert found.heading_deg < 15.0


def test_a_short_run_is_scored() -> None:
    found = run(RunSettings("office", 0.02, 5, minutes=2.0))
    assert found.worst_cm < 30.0
    assert 0.05 < found.coverage < 0.9
    assert found.wall_aligned_cm < 4.0


def test_a_lidar_maps_a_hall_with_wheels_that_slip() -> None:
    found = run(RunSettings("office", 0.05, 1, minutes=0.5, lidar=True))
    assert found.wall_cm < 3.0
    assert found.worst_cm < 6.0
    assert found.coverage > 0.15
    assert 0.0 < found.sweep_ms < 200.0
    figures = figures_of({"lidar.office": [found]})
    assert figures["lidar.office.diverged"] == 0.0
    assert figures["lidar.office.worst_wall_cm"] == found.wall_cm
