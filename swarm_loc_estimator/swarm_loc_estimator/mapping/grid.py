"""Occupancy grid by log odds, ray tracing of scans, and visit counts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import transform_points
from swarm_loc_estimator.mapping.matching import Scans
from swarm_loc_estimator.mapping.scans import BINS, LINE, POINT, UNKNOWN, Lines

_FREE_STEP, _HIT_STEP = 0.25, 0.9  # Change of the log odds of a cell by one ray
_POINT_HIT = 0.25  # Share of `_HIT_STEP` for a reflection without a fitted line
_FREE_RANGE_SHARE = 0.76  # Share of the range of a laser pointer that counts as free without a reflection
_UNMET = 0.25  # Share of `_FREE_STEP` for a beam of a lidar that met nothing
_SHARP_M = 0.03  # Standard deviation of a wall above which the increase of the log odds is reduced


@cached_njit
def draw_stop(
    log_odds: FloatArray,
    corner: FloatArray,
    cell: float,
    pose: FloatArray,
    stop: int,
    lines: Lines,
    free: float,
) -> None:
    """Add the evidence of a stop to a grid; cells outside of it are ignored.

    Args:
        log_odds: (nx, ny).
        corner: (2,) lower left corner of the grid in map [m].
        cell: [m].
        pose: (3,) of the stop.
        stop: Its number.
        lines: Of all stops.
        free: Distance that is free in a direction without reflection [m].
    """
    for m in range(BINS):
        kind, distance = lines.kind[stop, m], lines.distance[stop, m]
        if kind == UNKNOWN:
            continue
        hit, end = 0.0, free
        if kind == LINE:
            sigma = distance * distance * math.sqrt(lines.variance[stop, m])
            hit, end = _HIT_STEP / (1.0 + (sigma / _SHARP_M) ** 2), distance - 0.03 - 1.5 * sigma
        elif kind == POINT:
            hit, end = _HIT_STEP * _POINT_HIT, distance - 0.12 - 0.02 * distance * distance
        angle = pose[2] + (m + 0.5) * 2.0 * math.pi / BINS
        cos, sin = math.cos(angle) / cell, math.sin(angle) / cell
        x, y = (pose[0] - corner[0]) / cell, (pose[1] - corner[1]) / cell
        _draw_free(log_odds, x, y, cos, sin, end, 0.7 * cell, _FREE_STEP)
        i, j = math.floor(x + distance * cos), math.floor(y + distance * sin)
        if hit > 0.0 and 0 <= i < log_odds.shape[0] and 0 <= j < log_odds.shape[1]:
            log_odds[i, j] += hit


class DrawnSweep(NamedTuple):
    """Beams (n,) of a sweep of a lidar, in the frame of its robot."""

    ends: NDArray[np.float32]  # (n, 2) [m]
    sigma: NDArray[np.float32]  # (n,) standard deviation of the distance [m]; infinite: nothing was met


@cached_njit
def draw_sweep(
    log_odds: FloatArray, corner: FloatArray, cell: float, pose: FloatArray, sweep: DrawnSweep
) -> None:
    """Add the evidence of a sweep to a grid, see `draw_stop`."""
    x, y = (pose[0] - corner[0]) / cell, (pose[1] - corner[1]) / cell
    for k in range(len(sweep.sigma)):
        sigma = float(sweep.sigma[k])
        distance = math.hypot(sweep.ends[k, 0], sweep.ends[k, 1])
        angle = pose[2] + math.atan2(sweep.ends[k, 1], sweep.ends[k, 0])
        cos, sin = math.cos(angle) / cell, math.sin(angle) / cell
        if math.isinf(sigma):  # glass reflects nothing, too
            _draw_free(log_odds, x, y, cos, sin, distance, 0.7 * cell, _UNMET * _FREE_STEP)
            continue
        _draw_free(log_odds, x, y, cos, sin, distance - 0.03 - 1.5 * sigma, 0.7 * cell, _FREE_STEP)
        i, j = math.floor(x + distance * cos), math.floor(y + distance * sin)
        if 0 <= i < log_odds.shape[0] and 0 <= j < log_odds.shape[1]:
            log_odds[i, j] += _HIT_STEP / (1.0 + (sigma / _SHARP_M) ** 2)


@cached_njit
def _draw_free(
    log_odds: FloatArray, x: float, y: float, cos: float, sin: float, end: float, step: float, change: float
) -> None:
    """Decrease each cell along a ray from (x, y) [cells] once; the direction is in cells per metre."""
    last_i, last_j = -1, -1
    for k in range(int(end / step) + 1 if end > 0.0 else 0):
        i, j = math.floor(x + k * step * cos), math.floor(y + k * step * sin)
        if (i != last_i or j != last_j) and 0 <= i < log_odds.shape[0] and 0 <= j < log_odds.shape[1]:
            log_odds[i, j] -= change
        last_i, last_j = i, j


CELL = 0.02  # Size of a cell as in the PushBot paper [m]
LOG_ODDS_CAP = 5.0  #: Maximum absolute log odds of a cell
_OCCUPIED, _FREE = 0.45, -0.2


@dataclass(frozen=True)
class OccupancyMap:
    """A grid in the frame map."""

    corner: FloatArray  #: (2,) its lower left corner [m], a multiple of the cell
    cell: float  #: [m]
    log_odds: FloatArray  #: (nx, ny) log odds of occupancy, 0: unknown, clipped to +-`LOG_ODDS_CAP`

    @property
    def occupied(self) -> BoolArray:
        """(nx, ny) True where occupied."""
        return self.log_odds > _OCCUPIED

    @property
    def free(self) -> BoolArray:
        """(nx, ny) True where free."""
        return self.log_odds < _FREE

    @property
    def percent(self) -> FloatArray:
        """Occupancy probability of each cell [%]; -1 where unknown."""
        probability = 100.0 / (1.0 + np.exp(-self.log_odds))
        return np.where(self.log_odds == 0.0, -1.0, probability)

    def centres(self, cells: BoolArray) -> FloatArray:
        """Centres (n, 2) of the cells where `cells` (nx, ny) is True [m]."""
        return self.corner + (np.argwhere(cells) + 0.5) * self.cell

    def index(self, points: FloatArray) -> IntArray:
        """Cells (n, 2) of points (n, 2) [m], which may lie outside."""
        return np.floor((np.asarray(points) - self.corner) / self.cell).astype(np.int64)


def draw_map(
    scans: Scans,
    count: int,
    max_cells: int,
    background: OccupancyMap | None = None,
    without: Collection[int] = (),
    sweeps: Mapping[int, DrawnSweep] = MappingProxyType({}),
) -> OccupancyMap:
    """Draw the map of the first stops; its size follows from their positions.

    Args:
        scans: All stops.
        count: Number of stops to draw.
        max_cells: Maximum number of cells; a larger map has larger cells. With a background it is cropped.
        background: A map with the same cell size, drawn below the stops.
        without: Stops that are not drawn.
        sweeps: Stops that are sweeps of lidars.
    """
    shown = [one for one in range(count) if one not in without]
    points = [scans.states[:count, :2]]
    for stop in shown:
        if stop in sweeps:
            met = np.isfinite(sweeps[stop].sigma)
            points.append(transform_points(scans.states[stop, :3], sweeps[stop].ends[met]))
        else:
            reach = scans.beams.reach[stop] + 0.1
            points.append(scans.states[stop, :2] + np.array([[-reach], [reach]]))
    if background is not None:
        points.append(background.corner + CELL * np.array([(0, 0), background.log_odds.shape]))
    cell, places = CELL, np.concatenate(points)
    while background is None and count and np.ptp(places / cell, axis=0).prod() > max_cells:
        cell *= 2.0
    corner, shape = grid_around(places, cell, max_cells)
    log_odds = np.zeros(shape)
    if background is not None:
        _lay_below(log_odds, corner, background)
    for stop in shown:
        pose = scans.states[stop, :3]
        if stop in sweeps:
            draw_sweep(log_odds, corner, cell, pose, sweeps[stop])
        else:
            draw_stop(
                log_odds, corner, cell, pose, stop, scans.lines, _FREE_RANGE_SHARE * scans.beams.reach[stop]
            )
    return OccupancyMap(corner, cell, np.clip(log_odds, -LOG_ODDS_CAP, LOG_ODDS_CAP, out=log_odds))


def _lay_below(log_odds: FloatArray, corner: FloatArray, background: OccupancyMap) -> None:
    """Copy the overlapping part of a map into a grid with the same cells."""
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
        limit = np.maximum(side, np.floor(max_cells / size[::-1]))  # keeps the aspect of a long hall
        size = np.minimum(size, limit)
        low = np.floor(0.5 * (low + high - size))
    return low * cell, (int(size[0]), int(size[1]))


_MAX_CELLS = 1_000_000


class VisitationMap:
    """Visit counts of the 3 x 3 cells around each pose, as in the PushBot paper (IV-B)."""

    def __init__(self) -> None:
        self._visits: Counter[tuple[int, int]] = Counter()
        self.dropped = 0

    def add(self, positions: FloatArray) -> None:
        """Count visits at positions (n, 2) in map [m]."""
        cells, counts = np.unique(np.floor(positions / CELL).astype(int), axis=0, return_counts=True)
        for (i, j), count in zip(cells.tolist(), counts.tolist(), strict=True):
            for cell in ((i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1)):
                if cell in self._visits or len(self._visits) < _MAX_CELLS:
                    self._visits[cell] += count
                else:
                    self.dropped += count

    def on(self, occupancy: OccupancyMap) -> IntArray:
        """Counts (nx, ny) on the cells of an occupancy map."""
        counts = np.zeros(occupancy.log_odds.shape, dtype=np.int64)
        if self._visits:
            cells = occupancy.index((np.array(list(self._visits)) + 0.5) * CELL)
            inside = ((cells >= 0) & (cells < counts.shape)).all(axis=1)
            np.add.at(counts, tuple(cells[inside].T), np.array(list(self._visits.values()))[inside])
        return counts
