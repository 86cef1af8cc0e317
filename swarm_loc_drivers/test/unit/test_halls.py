"""Floor plans: rays and clearances in them, and the built-in halls."""

import math

import numpy as np
import pytest

from bench.pushbot.runs import wall_points
from swarm_loc_drivers.sim.pushbot.floor_plan import (
    FLOOR_PLANS,
    FloorPlan,
    FloorPlanError,
    clearance,
    floor_plan,
    is_visible,
    outline,
    polygon,
    ray_distance,
)

ROOM = FloorPlan("room", outline([(0, 0, 4, 3)], [(2, 1, 2.5, 2)]), np.array([[1.0, 1.5], [3.5, 1.5]]))


def test_rays_end_at_walls_and_robots() -> None:
    discs = np.array([[1.0, 2.5]])
    assert ray_distance(ROOM.walls, discs, 0.06, 1.0, 1.5, 0.0) == pytest.approx(1.0)
    assert ray_distance(ROOM.walls, discs, 0.06, 1.0, 1.5, math.pi / 2) == pytest.approx(0.94)
    assert ray_distance(ROOM.walls, discs, 0.06, 1.0, 1.5, math.pi) == pytest.approx(1.0)
    assert clearance(ROOM.walls, discs, 0.06, 1.8, 1.5) == pytest.approx(0.2)
    assert clearance(ROOM.walls, discs, 0.06, 1.0, 2.3) == pytest.approx(0.14)
    assert is_visible(ROOM.walls, 1.0, 2.5, 3.5, 2.5)
    assert not is_visible(ROOM.walls, 1.0, 1.5, 3.5, 1.5)


def test_rays_end_at_slanted_walls() -> None:
    walls = polygon([(0, 0), (2, 0), (0, 2)])
    assert ray_distance(walls, np.zeros((0, 2)), 0.06, 0.5, 0.5, math.pi / 4) == pytest.approx(math.sqrt(0.5))


@pytest.mark.parametrize("name", sorted(FLOOR_PLANS))
def test_robots_start_inside_closed_halls(name: str) -> None:
    plan = floor_plan(name)
    nobody = np.zeros((0, 2))
    for x, y in plan.starts:
        assert clearance(plan.walls, nobody, 0.0, x, y) > 0.3
        assert all(
            math.isfinite(ray_distance(plan.walls, nobody, 0.0, x, y, a)) for a in np.linspace(0, 6, 50)
        )
    lengths = np.hypot(*(plan.walls[:, 2:] - plan.walls[:, :2]).T)
    assert len(wall_points(plan, 0.1)) >= lengths.sum() / 0.1


def test_an_unknown_hall_is_told() -> None:
    with pytest.raises(FloorPlanError, match="no floor plan 'cave': it must be one of corridor,"):
        floor_plan("cave")
