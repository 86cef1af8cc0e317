"""Large swarms: who sees whom and who sees landmarks in each shape, and the noise of what is seen."""

from __future__ import annotations

import math

import numpy as np
import pytest
from exact_sightings import exact_values

from bench.shared.grid import SENSOR, GridSettings, Shape, cells, simulate_grid
from swarm_loc_drivers.sim.run import SimulatedRun
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
