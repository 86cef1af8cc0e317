"""What event cameras see in a hall."""

import math

import numpy as np
import pytest

from swarm_loc_drivers.sim.pushbot.event_camera import Blinking, CameraEvents, CameraNoise
from swarm_loc_drivers.sim.pushbot.floor_plan import outline
from swarm_loc_drivers.sim.pushbot.optics import CENTRE_PX, FOCAL_PX, HallSight, assembled_robots
from swarm_loc_estimator.common.arrays import FloatArray

STILL = CameraNoise(noise_rate=0.0)
DARK = (Blinking(), Blinking(), Blinking())
BOX = outline([(-4.0, -4.0, 4.0, 4.0)], [])


def seen_turning(walls: FloatArray, begin: float, end: float) -> CameraEvents:
    """What a robot in the middle sees while it turns between two headings in 50 ms."""
    sight = HallSight(walls, assembled_robots(1, 1), STILL, np.random.default_rng(1))
    poses = [np.array([[0.0, 0.0, angle]]) for angle in (begin, end)]
    return sight.look(0, poses[0], poses[1], (0, 50_000), [DARK])


def test_a_corner_that_passes_is_seen_where_it_passes() -> None:
    seen = seen_turning(BOX, 0.25 * math.pi - 0.05, 0.25 * math.pi)
    columns = np.unique(seen.x)
    assert columns.min() >= CENTRE_PX - FOCAL_PX * math.tan(0.07)
    assert columns.max() <= CENTRE_PX + 1.0
    assert len(seen.x) > 100


@pytest.mark.parametrize("piece", [(1.0, -4.0, 2.0, 4.0), (-4.0, 1.0, 4.0, 2.0)])
def test_a_wall_of_several_pieces_has_no_corners_between(piece: tuple[float, float, float, float]) -> None:
    cut = outline([(-4.0, -4.0, 4.0, 4.0), piece], [])
    assert len(cut) > len(BOX)
    assert not len(seen_turning(cut, 0.02, 0.10).x)


def test_corners_behind_walls_are_not_seen() -> None:
    cabinet = outline([(-4.0, -4.0, 4.0, 4.0)], [(2.0, -1.5, 2.5, 1.5)])
    behind = np.vstack([cabinet, outline([(3.0, -0.5, 3.5, 0.5)], [])])
    counts = [len(seen_turning(walls, -0.02, 0.02).x) for walls in (cabinet, behind)]
    assert counts == [0, 0]
