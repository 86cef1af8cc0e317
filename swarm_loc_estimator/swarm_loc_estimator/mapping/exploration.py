"""Exploration: the next goal of a robot by information gain and reachable paths."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, uniform_filter

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.settings import MapperSettings

UNKNOWN, OPEN, WALL = 0, 1, 2


class PlanningGrid(NamedTuple):
    """Coarse occupancy grid for path planning."""

    corner: FloatArray  # (2,) lower left corner in map [m]
    cell: float  # [m]
    state: NDArray[np.int8]  # (nx, ny) `UNKNOWN`, `OPEN` or `WALL`
    evidence: FloatArray  # (nx, ny) the largest log odds in each
    passable: BoolArray  # (nx, ny) True where the centre of a robot may be

    def cell_of(self, point: FloatArray) -> tuple[int, int]:
        """The cell of a point (2,) in the grid [m]."""
        i, j = np.floor((np.asarray(point) - self.corner) / self.cell).astype(int).tolist()
        return min(max(i, 0), self.state.shape[0] - 1), min(max(j, 0), self.state.shape[1] - 1)

    def point(self, index: tuple[int, int]) -> FloatArray:
        """Centre (2,) of a cell [m]."""
        return self.corner + (np.array(index) + 0.5) * self.cell


def planning_grid(
    occupancy: OccupancyMap, position: FloatArray, others: FloatArray, settings: MapperSettings
) -> PlanningGrid:
    """Planning grid around a robot at a position (2,), with other robots at (r, 2) as obstacles [m]."""
    shape = tuple(size // 2 for size in occupancy.log_odds.shape)
    blocks = occupancy.log_odds[: 2 * shape[0], : 2 * shape[1]].reshape(shape[0], 2, shape[1], 2)
    cell, highest = 2.0 * occupancy.cell, blocks.max(axis=(1, 3))
    state = np.where(highest > 0.2, WALL, np.where(blocks.min(axis=(1, 3)) < 0.0, OPEN, UNKNOWN))
    kept = settings.robot_radius + settings.margin
    passable = (state == OPEN) & (distance_transform_edt(state != WALL) * cell > kept)
    middles = occupancy.corner[:, None, None] + (np.indices(shape) + 0.5) * cell
    own = np.hypot(*(middles - position[:, None, None]))
    passable |= (own < kept + cell) & (state == OPEN)  # a robot next to a wall must get away from it
    for other in others:
        away = np.hypot(*(middles - other[:, None, None]))
        passable &= away > 2.0 * settings.robot_radius + settings.margin
    grid = PlanningGrid(occupancy.corner, cell, state.astype(np.int8), highest, passable)
    grid.passable[grid.cell_of(position)] = True
    return grid


@cached_njit
def paths_from(passable: BoolArray, i: int, j: int) -> tuple[FloatArray, IntArray]:
    """Shortest paths from a cell to all others over passable ones, to eight neighbours each.

    Returns:
        (nx, ny) path lengths in cells, infinite where unreachable; and (nx, ny) flat index of the preceding
        cell, -1 at the start.
    """
    nx, ny = passable.shape
    length, before = np.full((nx, ny), math.inf), np.full((nx, ny), -1)
    queued = np.zeros((nx, ny), dtype=np.bool_)
    queue = np.zeros(nx * ny + 1, dtype=np.int64)  # ring buffer: contains each cell at most once
    queue[0], first, last = i * ny + j, 0, 1
    length[i, j] = 0.0
    while first != last:
        a, b = queue[first] // ny, queue[first] % ny
        first = (first + 1) % len(queue)
        queued[a, b] = False
        for da in range(-1, 2):
            for db in range(-1, 2):
                u, v = a + da, b + db
                if not (0 <= u < nx and 0 <= v < ny) or not passable[u, v]:
                    continue
                through = length[a, b] + math.sqrt(da * da + db * db)
                if through < length[u, v] - 1e-9:
                    length[u, v], before[u, v] = through, a * ny + b
                    if not queued[u, v]:
                        queued[u, v], queue[last] = True, u * ny + v
                        last = (last + 1) % len(queue)
    return length, before


# The constants of exploration are checked by `make bench-pushbot`: corridor, office and ring, 20 seeds each.
_RAYS = 60  # Number of directions in which the gain of a scan is summed
_SURE = 2.0  # Log odds above which a wall yields no information gain
_WALL_GAIN = 0.5  # Gain of a wall of no evidence; that of unknown space is its area in cells


@cached_njit
def information_gain(
    state: NDArray[np.int8], evidence: FloatArray, cells: IntArray, reach: int
) -> FloatArray:
    """Expected information gain (n,) of scans from cells (n, 2), out to `reach` cells.

    Unknown cells count by the area that a ray represents; a ray ends after two unknown cells.
    """
    gains = np.zeros(len(cells))
    for n in range(len(cells)):
        for ray in range(_RAYS):
            angle = 2.0 * math.pi * ray / _RAYS
            cos, sin = math.cos(angle), math.sin(angle)
            was_unknown = False
            for k in range(1, reach):
                u = math.floor(cells[n, 0] + 0.5 + k * cos)
                v = math.floor(cells[n, 1] + 0.5 + k * sin)
                if not (0 <= u < state.shape[0] and 0 <= v < state.shape[1]):
                    break
                if state[u, v] == WALL:
                    gains[n] += max(0.0, 1.0 - evidence[u, v] / _SURE) * _WALL_GAIN * (1.0 - k / reach)
                    break
                if state[u, v] == UNKNOWN:
                    gains[n] += 2.0 * math.pi * k / _RAYS * (1.0 if k < 0.8 * reach else 0.5)
                    if was_unknown:
                        break
                was_unknown = state[u, v] != OPEN
    return gains


@dataclass(frozen=True)
class Goal:
    """Goal of a robot for its next scan."""

    number: int  #: Counter of the goals of a robot, from 1 on
    position: FloatArray  #: (2,) in map [m]
    #: (2,) the goal in the odom frame for a turn followed by a straight drive by odometry [m]
    odometry: FloatArray
    stamp_ns: int  #: Time of the decision
    pose: FloatArray  #: (3,) pose of the robot in map at that time


def goal_by_odometry(pose: FloatArray, odometry: FloatArray, goal: FloatArray, ratio: float) -> FloatArray:
    """Goal (2,) in the odom frame for a turn followed by a straight drive by odometry [m].

    Args:
        pose: (3,) pose of the robot in map.
        odometry: (3,) pose of the robot by odometry.
        goal: (2,) in map [m].
        ratio: True turn over turn by odometry.
    """
    way = goal - pose[:2]
    turn = float(wrap_angle(math.atan2(way[1], way[0]) - pose[2])) / ratio
    course = odometry[2] + turn
    ahead = np.array([math.cos(course), math.sin(course)])
    return np.asarray(odometry[:2] + math.hypot(way[0], way[1]) * ahead)


_LATTICE, _CANDIDATES = 0.2, 260  # Distance of possible goals [m], and their maximum number
_MIN_PATH = 0.3  # Minimum length of the path to a goal [m]
_REACH_SHARE = 0.72  # Share of the laser's range within which walls are measured accurately
_MIN_WALL = 0.6  # Length of walls in sight below which a place is in the open; false echoes are shorter [m]
_CROWD_RADIUS, _GOAL_RADIUS, _GOAL_WEIGHT = 0.45, 2.0, 0.8
"""Distances within which earlier stops and goals of others make a goal less valuable [m], and how much."""


def next_stop(
    occupancy: OccupancyMap,
    position: FloatArray,
    stops: FloatArray,
    others: FloatArray,
    goals: FloatArray,
    settings: MapperSettings,
    home: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Next stop and goal of a robot.

    Args:
        occupancy: The map.
        position: (2,) position of the robot [m].
        stops: (k, 2) positions of all scans [m].
        others: (r, 2) positions of the other robots [m].
        goals: (g, 2) goals of the other robots [m].
        settings: Settings of the mapper.
        home: (2,) position to approach instead of exploring [m]; None: explore.

    Returns:
        (2,) the next stop, on a straight line from here, and (2,) the final goal [m]; the position itself if
        no path exists.
    """
    grid = planning_grid(occupancy, position, others, settings)
    here = grid.cell_of(position)
    length, before = paths_from(grid.passable, *here)
    cells = _candidates(length, grid.cell)
    if not len(cells):
        return position, position
    points = grid.corner + (cells + 0.5) * grid.cell
    reach = int(_REACH_SHARE * settings.max_range / grid.cell)
    size = 2 * reach + 1
    walls = size**2 * uniform_filter((grid.state == WALL).astype(float), size, mode="constant")
    sees_walls = walls[tuple(cells.T)] * grid.cell > _MIN_WALL
    if home is not None:
        values = -np.hypot(*(points - home).T)
    elif not sees_walls.any():  # straight away from all former stops, until a wall is in sight
        values = np.hypot(*(points - stops.mean(axis=0)).T)
    else:
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
    """Reachable cells (n, 2) on a lattice, not too near; nearer ones if there are no others."""
    reached: BoolArray = np.isfinite(length)
    far = np.argwhere(reached & (length * cell > _MIN_PATH))
    step = round(_LATTICE / cell)
    on_lattice = far[(far % step == 0).all(axis=1)]
    cells = on_lattice if len(on_lattice) else np.argwhere(reached & (length > 1.0))
    return np.asarray(cells[np.linspace(0, len(cells) - 1, min(len(cells), _CANDIDATES)).astype(int)])


def first_hop(
    grid: PlanningGrid, before: IntArray, here: tuple[int, int], goal: tuple[int, int], max_hop: float
) -> FloatArray:
    """The farthest point (2,) of the path to a goal within a straight collision-free drive [m]."""
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
