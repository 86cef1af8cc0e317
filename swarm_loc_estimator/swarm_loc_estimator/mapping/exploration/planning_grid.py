"""Where a robot can drive: free cells, far enough from walls and other robots, and paths over them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.mapping.grid.occupancy import OccupancyMap
from swarm_loc_estimator.mapping.settings import MapperSettings

UNKNOWN, OPEN, WALL = 0, 1, 2


class PlanningGrid(NamedTuple):
    """Coarse cells.

    Attributes:
        corner: (2,) lower left corner in map [m].
        cell: [m].
        state: (nx, ny) `UNKNOWN`, `OPEN` or `WALL`.
        evidence: (nx, ny) the largest log odds in each.
        passable: (nx, ny) whether the middle of a robot may be there.
    """

    corner: FloatArray
    cell: float
    state: NDArray[np.int8]
    evidence: FloatArray
    passable: BoolArray

    def cell_of(self, point: FloatArray) -> tuple[int, int]:
        """The cell of a point (2,) in the grid [m]."""
        i, j = np.floor((np.asarray(point) - self.corner) / self.cell).astype(int).tolist()
        return min(max(i, 0), self.state.shape[0] - 1), min(max(j, 0), self.state.shape[1] - 1)

    def point(self, index: tuple[int, int]) -> FloatArray:
        """Middle (2,) of a cell [m]."""
        middle: FloatArray = self.corner + (np.array(index) + 0.5) * self.cell
        return middle


def planning_grid(
    occupancy: OccupancyMap, position: FloatArray, others: FloatArray, settings: MapperSettings
) -> PlanningGrid:
    """Coarse cells around a robot at a position (2,), with other robots at (r, 2) as obstacles [m]."""
    shape = tuple(size // 2 for size in occupancy.log_odds.shape)
    blocks = occupancy.log_odds[: 2 * shape[0], : 2 * shape[1]].reshape(shape[0], 2, shape[1], 2)
    cell, highest = 2.0 * occupancy.cell, blocks.max(axis=(1, 3))
    state = np.where(highest > 0.2, WALL, np.where(blocks.min(axis=(1, 3)) < 0.0, OPEN, UNKNOWN))
    kept = settings.robot_radius + settings.margin
    passable = (state == OPEN) & (distance_transform_edt(state != WALL) * cell > kept)
    middles = occupancy.corner[:, None, None] + (np.indices(shape) + 0.5) * cell
    own = np.hypot(*(middles - position[:, None, None]))
    passable |= (own < kept + cell) & (state == OPEN)  # a robot beside a wall must get away from it
    for other in others:
        passable &= (
            np.hypot(*(middles - other[:, None, None])) > 2.0 * settings.robot_radius + settings.margin
        )
    grid = PlanningGrid(occupancy.corner, cell, state.astype(np.int8), highest, passable)
    grid.passable[grid.cell_of(position)] = True
    return grid


@cached_njit
def paths_from(passable: BoolArray, i: int, j: int) -> tuple[FloatArray, IntArray]:
    """Shortest paths from a cell to all others over passable ones, to eight neighbours each.

    Returns:
        (nx, ny) their lengths in cells, infinite where there is none; and (nx, ny) the cell before, as a flat
        index, -1 at the beginning.
    """
    nx, ny = passable.shape
    length, before = np.full((nx, ny), math.inf), np.full((nx, ny), -1)
    queued = np.zeros((nx, ny), dtype=np.bool_)
    queue = np.zeros(nx * ny + 1, dtype=np.int64)  # a ring: each cell is in it once at most
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
