"""Shapes of large swarms: who sees whom, and who sees landmarks."""

from __future__ import annotations

import numpy as np
import pytest

from swarm_loc_drivers.sim.run import SimulatedRun
from swarm_loc_drivers.sim.scenarios.grid import GridSettings, Shape, simulate_grid
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
