"""Choose the next stop of a robot: the place whose sight tells most for the way there."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.mapping.exploration.information_gain import information_gain
from swarm_loc_estimator.mapping.exploration.planning_grid import (
    PlanningGrid,
    paths_from,
    planning_grid,
)
from swarm_loc_estimator.mapping.grid.occupancy import OccupancyMap
from swarm_loc_estimator.mapping.settings import MapperSettings

_LATTICE, _CANDIDATES = 0.2, 260
_MIN_PATH = 0.3
_REACH_SHARE = 0.72
"""Of the laser's range: walls further off are not known well from there."""
_CROWD_RADIUS, _GOAL_RADIUS, _GOAL_WEIGHT = 0.45, 2.0, 0.8


def next_stop(
    occupancy: OccupancyMap,
    position: FloatArray,
    stops: FloatArray,
    others: FloatArray,
    goals: FloatArray,
    settings: MapperSettings,
    home: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Where a robot should go next.

    Args:
        occupancy: The map.
        position: (2,) of the robot [m].
        stops: (k, 2) where robots have looked around [m].
        others: (r, 2) where the other robots are [m].
        goals: (g, 2) where these want to go [m].
        settings: Of the mapper.
        home: (2,) go as near to this as can be, and do not explore; None: explore [m].

    Returns:
        (2,) the next stop, in a straight line from here, and (2,) the goal behind it [m]; the position itself
        where there is no way at all.
    """
    grid = planning_grid(occupancy, position, others, settings)
    here = grid.cell_of(position)
    length, before = paths_from(grid.passable, *here)
    cells = _candidates(length, grid.cell)
    if not len(cells):
        return position, position
    points = grid.corner + (cells + 0.5) * grid.cell
    if home is not None:
        values = -np.hypot(*(points - home).T)
    else:
        reach = int(_REACH_SHARE * settings.max_range / grid.cell)
        gains = information_gain(grid.state, grid.evidence, cells, reach)
        crowd = (np.hypot(*(points[:, None] - stops).transpose(2, 0, 1)) < _CROWD_RADIUS).sum(axis=1)
        values = (gains + 2.0) / (1.0 + crowd) / (length[tuple(cells.T)] * grid.cell + 1.0)
        for goal in goals:
            near = np.exp(-np.square(np.hypot(*(points - goal).T) / _GOAL_RADIUS))
            values *= 1.0 - _GOAL_WEIGHT * near
    best = cells[int(np.argmax(values))]
    goal_cell = (int(best[0]), int(best[1]))
    return first_hop(grid, before, here, goal_cell, settings.max_hop), grid.point(goal_cell)


def _candidates(length: FloatArray, cell: float) -> IntArray:
    """Cells (n, 2) on a lattice that can be reached, not too near; nearer ones where there are no others."""
    reached: BoolArray = np.isfinite(length)
    far = np.argwhere(reached & (length * cell > _MIN_PATH))
    step = round(_LATTICE / cell)
    on_lattice = far[(far % step == 0).all(axis=1)]
    cells = on_lattice if len(on_lattice) else np.argwhere(reached & (length > 1.0))
    chosen: IntArray = cells[np.linspace(0, len(cells) - 1, min(len(cells), _CANDIDATES)).astype(int)]
    return chosen


def first_hop(
    grid: PlanningGrid, before: IntArray, here: tuple[int, int], goal: tuple[int, int], max_hop: float
) -> FloatArray:
    """The farthest point (2,) of the path to a goal that a straight free drive reaches [m]."""
    start = grid.point(here)
    cell = goal
    while before[cell] >= 0:
        point = grid.point(cell)
        if np.hypot(*(point - start)) <= max_hop and _is_straight(grid, here, cell):
            return point
        previous = divmod(int(before[cell]), grid.state.shape[1])
        if previous == here:
            return point
        cell = (int(previous[0]), int(previous[1]))
    return start


def _is_straight(grid: PlanningGrid, begin: tuple[int, int], end: tuple[int, int]) -> bool:
    """Whether a robot may be everywhere on the line between two cells."""
    count = 2 * max(abs(end[0] - begin[0]), abs(end[1] - begin[1])) + 2
    line = np.round(np.linspace(begin, end, count)).astype(int)
    return bool(grid.passable[tuple(line.T)].all())
