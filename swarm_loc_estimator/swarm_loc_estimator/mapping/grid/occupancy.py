"""The occupancy map: log odds of cells, drawn anew from all stops whenever these have moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.mapping.grid.drawing import draw_stop
from swarm_loc_estimator.mapping.matching.beam_matching import Scans

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

    @property
    def percent(self) -> FloatArray:
        """How probably each cell is occupied [%]; -1 where nothing is known."""
        probability = 100.0 / (1.0 + np.exp(-self.log_odds))
        known: FloatArray = np.where(self.log_odds == 0.0, -1.0, probability)
        return known

    def centres(self, chosen: BoolArray) -> FloatArray:
        """Middles (n, 2) of chosen cells (nx, ny) [m]."""
        centres: FloatArray = self.corner + (np.argwhere(chosen) + 0.5) * self.cell
        return centres

    def index(self, points: FloatArray) -> IntArray:
        """Cells (n, 2) of points (n, 2) [m], which may lie outside."""
        return np.floor((np.asarray(points) - self.corner) / self.cell).astype(np.int64)


def draw_map(
    scans: Scans, count: int, max_cells: int, background: OccupancyMap | None = None
) -> OccupancyMap:
    """The map that the first stops draw; its size follows from where they are.

    Args:
        scans: All stops.
        count: How many there are.
        max_cells: Of a larger map, what lies furthest from its middle is left out.
        background: A map with such cells below what is drawn.
    """
    reach = scans.max_range + 0.1
    places = scans.states[:count, :2]
    points = [places - reach, places + reach]
    if background is not None:
        points.append(background.corner + CELL * np.array([(0, 0), background.log_odds.shape]))
    corner, shape = grid_around(np.concatenate(points), CELL, max_cells)
    log_odds = np.zeros(shape)
    if background is not None:
        _lay_below(log_odds, corner, background)
    for stop in range(count):
        draw_stop(log_odds, corner, CELL, scans.states[stop, :3], stop, scans.lines, scans.max_range)
    return OccupancyMap(corner, CELL, np.clip(log_odds, -LOG_ODDS_CAP, LOG_ODDS_CAP))


def _lay_below(log_odds: FloatArray, corner: FloatArray, background: OccupancyMap) -> None:
    """Write a map into a grid with the same cells, as far as it lies there."""
    first = np.round((background.corner - corner) / CELL).astype(int)
    low = np.maximum(first, 0)
    high = np.minimum(first + background.log_odds.shape, log_odds.shape)
    if (low < high).all():
        here = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        there = tuple(slice(a, b) for a, b in zip(low - first, high - first, strict=True))
        log_odds[here] = background.log_odds[there]


def grid_around(points: FloatArray, cell: float, max_cells: int) -> tuple[FloatArray, tuple[int, int]]:
    """Corner (2,) and shape of the grid around points (n, 2) [m]; one cell without points."""
    if not len(points):
        return np.zeros(2), (1, 1)
    low, high = np.floor(points.min(axis=0) / cell), np.ceil(points.max(axis=0) / cell)
    size = np.maximum(high - low, 1.0)
    if size.prod() > max_cells:
        side = np.floor(np.sqrt(max_cells))
        limit = np.maximum(side, np.floor(max_cells / size[::-1]))  # a long hall may stay long
        size = np.minimum(size, limit)
        low = np.floor(0.5 * (low + high - size))
    return low * cell, (int(size[0]), int(size[1]))
