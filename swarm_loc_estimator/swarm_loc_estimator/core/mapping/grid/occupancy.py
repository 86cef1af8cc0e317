"""The occupancy map: log odds of cells, drawn anew from all stops whenever these have moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.core.mapping.grid.drawing import draw_stop
from swarm_loc_estimator.core.mapping.matching.beam_matching import Scans
from swarm_loc_estimator.numerics.arrays import BoolArray, FloatArray, IntArray

CELL = 0.02
"""Size of a cell, that of the PushBot paper [m]."""
LOG_ODDS_CAP = 5.0
"""No cell gets surer than this, for or against."""
_OCCUPIED, _FREE = 0.45, -0.2


@dataclass(frozen=True)
class OccupancyMap:
    """A grid in the frame map.

    Attributes:
        corner: (2,) its lower left corner [m], a multiple of the cell.
        cell: [m].
        log_odds: (nx, ny) of being occupied, 0: unknown, at most `LOG_ODDS_CAP` both ways.
    """

    corner: FloatArray
    cell: float
    log_odds: FloatArray

    @property
    def occupied(self) -> BoolArray:
        """(nx, ny) where there is something."""
        occupied: BoolArray = self.log_odds > _OCCUPIED
        return occupied

    @property
    def free(self) -> BoolArray:
        """(nx, ny) where there is nothing."""
        free: BoolArray = self.log_odds < _FREE
        return free

    def centres(self, chosen: BoolArray) -> FloatArray:
        """Middles (n, 2) of chosen cells (nx, ny) [m]."""
        centres: FloatArray = self.corner + (np.argwhere(chosen) + 0.5) * self.cell
        return centres

    def index(self, points: FloatArray) -> IntArray:
        """Cells (n, 2) of points (n, 2) [m], which may lie outside."""
        return np.floor((np.asarray(points) - self.corner) / self.cell).astype(np.int64)


def draw_map(scans: Scans, count: int, max_cells: int, cell: float = CELL) -> OccupancyMap:
    """The map that the first stops draw; its size follows from where they are.

    Args:
        scans: All stops.
        count: How many there are.
        max_cells: Of a larger map, what lies furthest from its middle is left out.
        cell: [m].
    """
    corner, shape = grid_around(scans.states[:count, :2], scans.max_range + 0.1, cell, max_cells)
    log_odds = np.zeros(shape)
    for stop in range(count):
        draw_stop(log_odds, corner, cell, scans.states[stop, :3], stop, scans.lines, scans.max_range)
    return OccupancyMap(corner, cell, np.clip(log_odds, -LOG_ODDS_CAP, LOG_ODDS_CAP))


def grid_around(
    points: FloatArray, margin: float, cell: float, max_cells: int
) -> tuple[FloatArray, tuple[int, int]]:
    """Corner (2,) and shape of the grid around points (n, 2) with a margin [m]; one cell without points."""
    if not len(points):
        return np.zeros(2), (1, 1)
    low = np.floor((points.min(axis=0) - margin) / cell)
    high = np.ceil((points.max(axis=0) + margin) / cell)
    size = np.maximum(high - low, 1.0)
    if size.prod() > max_cells:
        side = np.sqrt(max_cells)
        limit = np.minimum(size, [max(side, max_cells / size[1]), max(side, max_cells / size[0])]) // 1
        middle = (low + high) // 2
        size = np.minimum(limit, max_cells // limit[::-1])
        low = middle - size // 2
    return low * cell, (int(size[0]), int(size[1]))
