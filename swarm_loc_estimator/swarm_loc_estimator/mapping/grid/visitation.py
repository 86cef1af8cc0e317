"""The visitation map: how often robots were where, on cells of their own that grow with it."""

from __future__ import annotations

from collections import Counter

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.mapping.grid.occupancy import CELL, OccupancyMap

_MAX_CELLS = 1_000_000


class VisitationMap:
    """Counts of the 3 x 3 cells around each pose, as the PushBot paper has them (IV-B)."""

    def __init__(self) -> None:
        self._visits: Counter[tuple[int, int]] = Counter()
        self.dropped = 0

    def add(self, positions: FloatArray) -> None:
        """A robot was at positions (n, 2) in map [m]."""
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
            cells = np.array(list(self._visits)) - np.round(occupancy.corner / CELL).astype(int)
            inside = ((cells >= 0) & (cells < counts.shape)).all(axis=1)
            counts[tuple(cells[inside].T)] = np.array(list(self._visits.values()))[inside]
        return counts
