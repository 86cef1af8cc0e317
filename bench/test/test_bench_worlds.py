"""Worlds of benchmarks: who sees whom in large swarms, and what is scored of them."""

import math

import numpy as np
import pytest
from exact_sightings import exact_values

from bench.peers.scaling import ShapeRuns, measure_shape, scored
from bench.scenarios.eight_run import EightSettings, simulate_eight
from bench.scenarios.lived_run import SimulatedRun
from bench.shared.common import rms
from bench.shared.grid import SENSOR, GridSettings, Shape, cells, simulate_grid
from bench.shared.simulated_run import (
    detection_rows,
    fitted_errors,
    inputs_between,
    odometry_rows,
    ticks,
    without_delay,
)
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import IntArray

ROBOTS = 9


def seen(run: SimulatedRun) -> tuple[IntArray, IntArray]:
    """Observers and what they see (m,), as numbers of markers."""
    observer = np.repeat(run.frames["robot"].astype(np.int64), run.frames["count"])
    return observer, run.sightings["marker_id"].astype(np.int64)


@pytest.mark.parametrize("shape", Shape)
def test_sightings_are_of_robots_and_landmarks_within_reach(shape: Shape) -> None:
    run = simulate_grid(GridSettings(ROBOTS, duration_s=4.0, shape=shape))
    observer, marker = seen(run)
    of_robots = marker < ROBOTS
    assert of_robots.any()
    assert not np.any(observer[of_robots] == marker[of_robots])
    by_landmark = set(observer[~of_robots].tolist())
    if shape.one_sees:
        assert by_landmark <= {0}
        assert len(run.swarm.landmarks) == 1
    assert np.hypot(*run.sightings["value"][:, :2].T).max() < 1.0


def test_two_clusters_are_joined_by_the_last_robot_alone() -> None:
    homes = Shape.CLUSTERS.homes(51)
    near = np.hypot(*(homes[:, None] - homes[None]).transpose(2, 0, 1)) < 0.8
    across = near[:25, 25:50]
    assert not across.any()
    assert near[50, :25].any()
    assert near[50, 25:50].any()


def test_wandering_robots_meet_ever_new_neighbours() -> None:
    pairs = {}
    for shape in (Shape.CORNER, Shape.WANDER_CORNER):
        observer, marker = seen(simulate_grid(GridSettings(25, duration_s=20.0, shape=shape)))
        pairs[shape] = len({*zip(observer[marker < 25].tolist(), marker[marker < 25].tolist(), strict=True)})
    assert pairs[Shape.WANDER_CORNER] > 1.5 * pairs[Shape.CORNER]


def test_the_same_seed_gives_the_same_grid_and_another_does_not() -> None:
    grids = [simulate_grid(GridSettings(robots=9, seed=seed, duration_s=5.0)) for seed in (7, 7, 8)]
    assert grids[0].sightings.tobytes() == grids[1].sightings.tobytes() != grids[2].sightings.tobytes()
    assert grids[0].swarm == grids[1].swarm


def test_a_grid_sees_about_three_neighbours_with_its_noise() -> None:
    run = simulate_grid(GridSettings(robots=100, duration_s=6.0))
    exact, robot, own = exact_values(run)
    assert (own >= 0).sum() / len(run.frames) == pytest.approx(3.0, abs=0.3)
    assert set(np.unique(robot[own < 0])) <= {i for i in range(100) if i % 10 in (0, 9) or i // 10 in (0, 9)}
    error = run.sightings["value"] - exact
    error[:, 2] = se2.wrap_angle(error[:, 2])
    sigma = np.array([SENSOR.forward_sigma, SENSOR.left_sigma, SENSOR.heading_sigma])
    np.testing.assert_allclose(error.std(axis=0), sigma, rtol=4.0 / math.sqrt(2 * len(error)))


def test_grid_robots_stay_in_their_cells_among_a_closed_border() -> None:
    run = simulate_grid(GridSettings(robots=20, duration_s=20.0))
    away = np.linalg.norm(run.truth.poses[..., :2] - cells(20), axis=-1)
    assert away.max() < 0.2
    assert away.max(axis=0).min() > 0.05  # each one moves
    marks = Shape.BORDER.landmarks(cells(20))
    assert len(marks) == len(np.unique(marks, axis=0)) == 22
    assert np.linalg.norm(marks[:, None] - cells(20), axis=-1).min() == pytest.approx(0.5)


def test_a_pose_that_is_not_tracked_is_counted_and_not_scored() -> None:
    errors = np.tile([0.003, 0.004, 0.0], (4, 5, 1))
    covariances = np.tile(1e-5 * np.eye(3), (4, 5, 1, 1))
    errors[2, 3] = np.nan
    covariances[2, 3] = np.nan
    figures = scored(errors, covariances)
    assert figures["tracked_share"] == pytest.approx(0.95)
    assert figures["position_rmse_mm"] == pytest.approx(5.0)
    assert figures["nees"] == pytest.approx(2.5)


def test_a_small_swarm_of_a_shape_is_the_exact_filter_itself() -> None:
    figures = measure_shape(Shape.CORNER, 5, ShapeRuns(duration_s=3.0, exact_s=3.0, seeds=(1, 2)))
    assert figures["position_rmse_ratio_to_exact"] == pytest.approx(1.0, abs=1e-12)
    assert figures["tracked_share"] == figures["exact_tracked_share"] == 1.0
    assert figures["nees"] == pytest.approx(figures["exact_nees"], rel=1e-12)


def test_each_reading_is_given_once_in_the_tick_in_which_it_arrives() -> None:
    run = simulate_eight(EightSettings(seed=2, duration_s=3.0))
    odometry, detections, tick_ns = odometry_rows(run), detection_rows(run), ticks(run)
    parts = inputs_between(tick_ns, odometry=odometry, detections=detections)
    for name, arrivals_ns in (("odometry", odometry.arrival_ns), ("detections", detections.arrival_ns)):
        assert arrivals_ns.size > 50
        cut = [part[name].arrival_ns for part in parts]
        np.testing.assert_array_equal(np.concatenate(cut), arrivals_ns)
        begins_ns = [0, *tick_ns[:-1]]
        for begin_ns, end_ns, arrival_ns in zip(begins_ns, tick_ns, cut, strict=True):
            assert ((arrival_ns > begin_ns) & (arrival_ns <= end_ns)).all()


def test_a_moved_frame_costs_nothing_and_unknown_places_stay_unknown() -> None:
    truth = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [3.0, 1.0]])
    places = se2.transform_points([0.3, -0.2, 1.1], truth)
    places[1] = math.nan
    errors = fitted_errors(places, truth)
    assert np.isnan(errors[1]).all()
    np.testing.assert_allclose(np.delete(errors, 1, axis=0), 0.0, atol=1e-12)


def test_the_root_mean_square_is_that_of_all_numbers() -> None:
    assert rms([[3.0, 4.0], [0.0, 0.0]]) == 2.5


def test_without_delay_all_is_there_in_the_order_in_which_it_happened() -> None:
    grid = simulate_grid(GridSettings(robots=50, duration_s=8.0))
    run = without_delay(grid)
    for late, prompt in ((grid.odometry, run.odometry), (grid.frames, run.frames)):
        assert len(late) == len(prompt)
        assert np.all(np.diff(prompt["stamp_ns"]) >= 0)
        np.testing.assert_array_equal(prompt["arrival_ns"], prompt["stamp_ns"])
    assert sorted(seen_by(run)) == sorted(seen_by(grid))
    assert seen_by(run) != seen_by(grid)


def seen_by(run: SimulatedRun) -> list[tuple[int, int, tuple[float, ...]]]:
    """Who saw each sighting when, and what."""
    who = (np.repeat(run.frames[name], run.frames["count"]).tolist() for name in ("robot", "stamp_ns"))
    first = np.cumsum(run.frames["count"]) - run.frames["count"]
    np.testing.assert_array_equal(run.frames["first"], first)
    return list(zip(*who, map(tuple, run.sightings["value"].tolist()), strict=True))
