"""Layouts of square markers: where their cells lie, and how cells become words.

A word holds the data cells row by row from the upper left, the first one in the highest bit; 1 is white.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray

Words = NDArray[np.uint64]
Cells = NDArray[np.uint8]


@dataclass(frozen=True)
class Layout:
    """Places of the cells of a marker.

    A marker is a black border around cells of data. In a surrounded one, as of AprilTag's Standard families,
    the border is white, lies in a black ring, and a ring of further data cells surrounds that.
    """

    cells: int  # Cells along a side inside the border
    border: int  # Width of the border [cells]
    # Whether data surround the border; the detector sees such a marker with light and dark swapped
    surrounded: bool = False

    @property
    def side(self) -> int:
        """Cells along a side, border included."""
        return self.cells + 2 * self.border

    @property
    def outside(self) -> int:
        """Cells of the marker beyond its border, on each side."""
        return 2 if self.surrounded else 0

    @property
    def area(self) -> int:
        """Cells along a side of the area with data and the border's inner ring, or with the outer data."""
        return self.side + 4 if self.surrounded else self.cells + 2

    @property
    def grid(self) -> int:
        """Cells that are read along a side: the area and a ring around it."""
        return self.area + 2

    @cached_property
    def data(self) -> IntArray:
        """(bits, 2) rows and columns of the data cells in the area, in the order of bits."""
        distance = self._distance(self.area)
        is_data = (distance < 0.5 * self.cells) | (distance > 0.5 * self.side + 1.0)
        return np.ascontiguousarray(np.argwhere(is_data))

    @cached_property
    def ring(self) -> IntArray:
        """(k, 2) rows and columns of the border's inner ring in the area."""
        return np.ascontiguousarray(np.argwhere(self._distance(self.area) == 0.5 * (self.cells + 1)))

    @cached_property
    def margin(self) -> IntArray:
        """(k, 2) rows and columns in the grid of the ring around the border; outermost for a thick one."""
        place = 0.5 * (self.side + 1) if self.surrounded else 0.5 * (self.grid - 1)
        return np.ascontiguousarray(np.argwhere(self._distance(self.grid) == place))

    @staticmethod
    def _distance(count: int) -> NDArray[np.float64]:
        """(count, count) larger one of the distances along rows and columns of cells from the middle."""
        row, column = np.abs(np.mgrid[:count, :count] - 0.5 * (count - 1))
        return np.asarray(np.maximum(row, column))

    @property
    def bits(self) -> int:
        """Number of data cells."""
        return len(self.data)

    def packed(self, areas: Cells) -> Words:
        """Words (N,) of areas (N, area, area), 1 white."""
        shifts = np.arange(self.bits - 1, -1, -1, dtype=np.uint64)
        row, column = self.data.T
        words: Words = np.bitwise_or.reduce(areas[:, row, column].astype(np.uint64) << shifts, axis=1)
        return words

    def unpacked(self, words: Words) -> Cells:
        """Areas (N, area, area) of words (N,), 1 white; all but data is 0."""
        shifts = np.arange(self.bits - 1, -1, -1, dtype=np.uint64)
        areas = np.zeros((len(words), self.area, self.area), np.uint8)
        row, column = self.data.T
        areas[:, row, column] = (words[:, None] >> shifts) & np.uint64(1)
        return areas

    def rotated(self, words: Words, quarters: int) -> Words:
        """The words (N,) of markers after counter-clockwise quarter turns."""
        return self.packed(np.rot90(self.unpacked(words), quarters, axes=(1, 2)))

    def inner(self, words: Words) -> Cells:
        """(N, cells, cells) data inside the border, 1 white."""
        first = (self.area - self.cells) // 2
        inside = slice(first, first + self.cells)
        return np.asarray(self.unpacked(words)[:, inside, inside])

    def pattern(self, word: np.uint64) -> Cells:
        """Cells (side + 2 outside, side + 2 outside) of a marker, 1 white."""
        area = np.asarray(self.unpacked(np.array([word]))[0])
        if not self.surrounded:
            return np.asarray(np.pad(area, self.border - 1))
        area[tuple(self.ring.T)] = 1
        return area
