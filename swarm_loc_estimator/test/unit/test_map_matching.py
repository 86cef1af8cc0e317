"""Matching of sweeps to a known map: laws of the match, corridors, beams that do not fit, refusals."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping_world import distance_in_room, room_map

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.map_file import MapFileError
from swarm_loc_estimator.timeline.map_scans import (
    BLOCKED,
    FAR,
    FITS,
    OFF_MAP,
    UNDETERMINED_SIGMA,
    Match,
    WallMap,
    match,
    normal_equations,
    wall_map,
)

CELL = 0.05
PRIOR = np.diag([0.1**2, 0.1**2, 0.1**2])
ORIGIN = np.zeros(2)
HERE = np.array([1.5, 1.1, 0.4])


def beams(pose: FloatArray, count: int = 360) -> FloatArray:
    """Exact ends (count, 2) of a sweep in the room, in the frame of the robot."""
    angles = 2.0 * math.pi / count * np.arange(count)
    ranges = np.array([distance_in_room(pose[0], pose[1], pose[2] + angle) for angle in angles])
    ends: FloatArray = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return ends


def matched(walls: WallMap, ends: FloatArray, predicted: FloatArray) -> Match:
    return match(walls, ends, ORIGIN, np.full(len(ends), 0.02**2), predicted, PRIOR)


@settings(deadline=None, max_examples=30)
@given(st.tuples(*[st.floats(-0.15, 0.15)] * 3), st.floats(-math.pi, math.pi))
def test_a_match_finds_the_pose(shift: tuple[float, float, float], heading: float) -> None:
    pose = np.array([1.5, 1.1, heading])
    found = matched(wall_map(room_map(CELL), Path("room.yaml")), beams(pose), pose + shift)
    assert (found.outcome, found.determined) == (FITS, 3)
    assert found.pose[:2] == pytest.approx(pose[:2], abs=0.5 * CELL)
    assert float(wrap_angle(found.pose[2] - heading)) == pytest.approx(0.0, abs=0.01)
    assert found.fitting > 0.95
    assert found.through == 0.0


@pytest.mark.parametrize("beam", range(3, 360, 31))
def test_the_jacobian_is_that_of_finite_differences(beam: int) -> None:
    """One beam: the gradient is w J r and the information w J J^T, so J r = gradient / w."""
    walls, end, variance = wall_map(room_map(CELL), Path("a")), beams(HERE)[beam : beam + 1], np.array([1e-4])
    pose = HERE + np.array([0.03, 0.02, 0.01])

    def equations(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        information, _, gradient = normal_equations(walls, end, ORIGIN, variance, at, 0.3)
        return information, gradient

    information, gradient = equations(pose)
    weight = information[0, 0] + information[1, 1]
    main = int(np.argmax(np.diag(information)[:2]))
    normal = math.sqrt(information[main, main] / weight)  # its sign is that of this component
    jacobian = information[main] / (weight * normal)

    def residual(at: FloatArray) -> float:
        now, slope = equations(at)
        return float(slope[main] / (now[main, main] / normal))

    step = 1e-5 * np.eye(3)
    numeric = [(residual(pose - one) - residual(pose + one)) / 2e-5 for one in step]
    assert numeric == pytest.approx(jacobian, abs=1e-6)
    assert abs(gradient[main]) > 0.0


@pytest.mark.parametrize("angle", [0.0, 0.5, math.pi / 4.0, 2.0])
def test_a_corridor_tells_nothing_along(angle: float) -> None:
    """Two walls, longer than the lidar reaches, in any direction."""
    along, across = (
        np.array([math.cos(angle), math.sin(angle)]),
        np.array([-math.sin(angle), math.cos(angle)]),
    )
    x, y = np.meshgrid(*[np.arange(-8.0, 8.0, CELL) + 0.5 * CELL] * 2, indexing="ij")
    aside = np.abs(x * across[0] + y * across[1])
    log_odds = np.where(np.abs(aside - 1.0) < 0.5 * CELL, 5.0, np.where(aside < 1.0, -5.0, 0.0))
    walls = wall_map(OccupancyMap(np.array([-8.0, -8.0]), CELL, log_odds), Path("corridor.yaml"))
    bearings = angle + np.concatenate([np.linspace(0.3, 2.8, 100), np.linspace(-2.8, -0.3, 100)])
    ranges = 1.0 / np.abs(np.sin(bearings - angle))
    ends = ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
    predicted = np.array([*(0.2 * along + 0.05 * across), 0.02])
    found = matched(walls, ends, predicted)
    assert (found.outcome, found.determined) == (FITS, 2)
    assert math.sqrt(along @ found.covariance[:2, :2] @ along) > 0.99 * UNDETERMINED_SIGMA
    assert math.sqrt(across @ found.covariance[:2, :2] @ across) < 0.05
    assert along @ found.pose[:2] == pytest.approx(0.2, abs=0.02)
    assert across @ found.pose[:2] == pytest.approx(0.0, abs=0.6 * CELL)


def test_more_beams_do_not_make_a_map_exact() -> None:
    walls = wall_map(room_map(CELL), Path("a"))
    sigmas = [
        np.sqrt(np.diag(matched(walls, beams(HERE, count), HERE).covariance)) for count in (360, 36_000)
    ]
    assert (sigmas[1] > 0.5 * sigmas[0]).all()
    assert sigmas[1][0] > CELL / math.sqrt(12.0) / 2.0


def test_beams_on_people_do_not_move_the_match() -> None:
    ends, pose = beams(HERE), HERE + np.array([0.05, -0.04, 0.03])
    ends[100:190] *= (0.6 / np.hypot(*ends[100:190].T))[:, None]
    found = matched(wall_map(room_map(CELL), Path("a")), ends, pose)
    assert found.outcome == FITS
    assert found.fitting == pytest.approx(0.75, abs=0.03)
    assert found.pose == pytest.approx(HERE, abs=0.02)


def test_a_crowd_is_not_used() -> None:
    ends = beams(HERE)
    ends[:300] *= (0.5 / np.hypot(*ends[:300].T))[:, None]
    assert matched(wall_map(room_map(CELL), Path("a")), ends, HERE).outcome == BLOCKED


@pytest.mark.parametrize("shift", [(1.0, 0.0, 0.0), (-0.9, 0.0, 0.0), (0.0, -0.8, 0.0), (0.0, 0.0, 1.0)])
def test_beams_through_walls_contradict_the_map(shift: tuple[float, float, float]) -> None:
    found = matched(wall_map(room_map(CELL), Path("a")), beams(HERE), HERE + shift)
    assert found.outcome in (OFF_MAP, FAR)


@pytest.mark.parametrize(("log_odds", "what"), [(0.0, "occupied"), (-5.0, "occupied"), (5.0, "free")])
def test_a_map_without_walls_or_space_is_refused(log_odds: float, what: str) -> None:
    empty = OccupancyMap(np.zeros(2), CELL, np.full((4, 5), log_odds))
    with pytest.raises(MapFileError) as error:
        wall_map(empty, Path("hall.yaml"))
    assert str(error.value) == f"The map 'hall.yaml' has 20 cells but none that is {what}."
