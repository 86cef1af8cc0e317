"""Grids, planning, and map files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.mapping.exploration import goal_by_odometry, next_stop, paths_from
from swarm_loc_estimator.mapping.grid import CELL, OccupancyMap, VisitationMap, grid_around
from swarm_loc_estimator.mapping.map_file import load_map, save_map
from swarm_loc_estimator.mapping.settings import MapperSettings

SETTINGS = MapperSettings()
NOBODY = np.zeros((0, 2))


def hall() -> OccupancyMap:
    """Three metres by two, free inside its walls; a wall in the middle leaves a door at the top."""
    log_odds = np.zeros((160, 110))
    log_odds[5:155, 5:105] = -2.0
    for wall in (np.s_[5, 5:105], np.s_[155, 5:105], np.s_[5:156, 5], np.s_[5:156, 105], np.s_[80, 5:70]):
        log_odds[wall] = 3.0
    return OccupancyMap(np.zeros(2), CELL, log_odds)


def test_paths_go_around_walls() -> None:
    passable = np.ones((21, 11), dtype=bool)
    passable[10, :10] = False
    length, before = paths_from(passable, 5, 0)
    assert length[15, 0] == pytest.approx(2.0 * (10 + 0) - 2 * 5 + 10 * math.sqrt(2.0))
    cell, steps = (15, 0), [(15, 0)]
    while before[cell] >= 0:
        previous = divmod(int(before[cell]), 11)
        cell = (int(previous[0]), int(previous[1]))
        steps.append(cell)
    assert steps[-1] == (5, 0)
    assert (10, 10) in steps


def test_paths_do_not_lead_through_closed_doors() -> None:
    passable = np.ones((9, 9), dtype=bool)
    passable[4] = False
    length, _ = paths_from(passable, 0, 0)
    assert np.isinf(length[5:]).all()


def test_a_hop_is_straight_free_and_not_too_long() -> None:
    occupancy, position = hall(), np.array([0.8, 0.5])
    hop, goal = next_stop(
        occupancy, position, position[None], NOBODY, NOBODY, SETTINGS, home=np.array([2.6, 0.5])
    )
    assert goal[0] > 1.8  # through the door
    assert 0.1 < math.dist(hop, position) <= SETTINGS.max_hop + 1e-9
    for share in np.linspace(0.0, 1.0, 50):
        point = position + share * (hop - position)
        nearest = np.hypot(*(occupancy.centres(occupancy.occupied) - point).T).min()
        assert nearest > SETTINGS.robot_radius


def test_robots_spread_and_keep_off_each_other() -> None:
    occupancy, position = hall(), np.array([0.8, 1.2])
    free = next_stop(occupancy, position, position[None], NOBODY, NOBODY, SETTINGS)[1]
    apart = next_stop(occupancy, position, position[None], NOBODY, free[None], SETTINGS)[1]
    assert math.dist(free, apart) > 0.3
    blocked = next_stop(occupancy, position, position[None], free[None], NOBODY, SETTINGS)[1]
    assert math.dist(blocked, free) > 2.0 * SETTINGS.robot_radius


def test_a_robot_with_no_way_out_stays() -> None:
    occupancy = OccupancyMap(np.zeros(2), CELL, np.zeros((100, 100)))
    position = np.array([1.0, 1.0])
    hop, goal = next_stop(occupancy, position, position[None], NOBODY, NOBODY, SETTINGS)
    assert np.array_equal(hop, position)
    assert np.array_equal(goal, position)


def test_a_goal_by_odometry_counts_the_slip() -> None:
    there = goal_by_odometry(np.array([1.0, 1.0, 0.0]), np.zeros(3), np.array([1.0, 2.0]), 0.9)
    angle = 0.5 * math.pi / 0.9
    assert np.allclose(there, [math.cos(angle), math.sin(angle)])


@given(
    points=st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=20),
    limit=st.integers(10_000, 10_000_000),
)
def test_grids_are_bounded_and_hold_the_points_if_they_can(
    points: list[tuple[float, float]], limit: int
) -> None:
    corner, shape = grid_around(np.array(points), CELL, limit)
    assert 1 <= shape[0] * shape[1] <= limit
    assert np.allclose(corner / CELL, np.round(corner / CELL))
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    if np.prod((high - low) / CELL + 3) < limit:
        assert (corner <= low + 1e-9).all()
        assert (corner + np.array(shape) * CELL >= high - 1e-9).all()


def test_visits_are_counted_on_nine_cells() -> None:
    visits = VisitationMap()
    visits.add(np.array([[0.5, 0.5], [0.5, 0.5], [0.5, 0.9]]))
    counts = visits.on(hall())
    assert counts.sum() == 27
    assert counts[25, 25] == counts[24, 26] == 2


def test_maps_survive_a_file(tmp_path: Path) -> None:
    occupancy = hall()
    path, image = save_map(occupancy, tmp_path / "maps" / "hall.yaml")
    loaded = load_map(path, CELL)
    assert np.array_equal(loaded.occupied, occupancy.occupied)
    assert np.array_equal(loaded.free, occupancy.free)
    assert np.allclose(loaded.corner, occupancy.corner)
    assert image.read_bytes().startswith(b"P5\n#")
    assert "resolution: 0.02" in path.read_text()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("resolution: 0.02", "resolution: 0.05", "cells of 0.05 m but the mapper's have 0.02 m"),
        ("image: hall.pgm", "image: other.pgm", "cannot be read"),
        ("origin: [0.0, 0.0, 0.0]", "origin: [0.0, 0.0]", "origin must be a list"),
        ("origin: [0.0, 0.0, 0.0]", "origin: [0.0, 0.0, 0.5]", "yaw 0, not 0.5"),
        ("free_thresh: 0.196", "free_thresh: much", "free_thresh must be a number above 0"),
    ],
)
def test_a_wrong_description_is_told_in_a_sentence(tmp_path: Path, old: str, new: str, said: str) -> None:
    path, _ = save_map(hall(), tmp_path / "hall")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(UserError, match=said):
        load_map(path, CELL)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"P5\n160 110\n255\n" + bytes(99), "160 x 110 pixels but holds 99"),
        (b"P2\n1 1\n255\n0", "no binary PGM"),
        (b"", "no binary PGM"),
    ],
)
def test_an_image_of_another_size_is_told_in_a_sentence(tmp_path: Path, data: bytes, said: str) -> None:
    path, image = save_map(hall(), tmp_path / "hall")
    image.write_bytes(data)
    with pytest.raises(UserError, match=said):
        load_map(path, CELL)
