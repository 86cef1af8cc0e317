"""Families of square markers: layouts of cells, and a word of bits for each id.

A word holds the data cells row by row from the upper left, the first one in the highest bit; 1 is white.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

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


_BCH_IDS = 4096

_BCH_GENERATOR = 0x1DB2777  # The generator polynomial, degree 24, lowest power in bit 0
_BCH_PARITY_BITS = 24
_BCH_MASK = 0x8F80B8750


def bch_words() -> Words:
    """(4096,) words of the BCH code of ARToolKitPlus.

    BCH(63, 39), t = 4, over GF(64) with x^6 + x + 1, shortened to (36, 12). A codeword has the remainder in
    bits 0 to 23 and the id above; a mask inverts some bits so that no id looks plain. Words are at least 9
    bits apart in one orientation.
    """
    words = np.arange(_BCH_IDS, dtype=np.uint64) << np.uint64(_BCH_PARITY_BITS)
    remainder = words.copy()
    for bit in range(35, _BCH_PARITY_BITS - 1, -1):
        set_here = (remainder >> np.uint64(bit)) & np.uint64(1)
        remainder ^= set_here * np.uint64(_BCH_GENERATOR << (bit - _BCH_PARITY_BITS))
    cells: Words = (words | remainder) ^ np.uint64(_BCH_MASK)
    return cells


CODE_ARTOOLKIT_BCH = 0
CODE_ARUCO_MIP_36H12 = 1
CODE_APRILTAG_36H11 = 2
CODE_OTHER = 255


@dataclass(frozen=True, eq=False)
class Family:
    """One kind of marker."""

    name: str  # Name in parameters
    code: int  # FAMILY_* of swarm_loc_msgs/MarkerDetection
    layout: Layout  # Places of the cells
    words: Words  # (N,) words of the ids
    touching: bool = False  # Whether the corners touch those of other dark squares, as in Kalibr's grids

    @property
    def side(self) -> int:
        """Cells along a side, border included."""
        return self.layout.side

    def whole_size(self, size: float) -> float:
        """Side of a marker with the data around its border, by the side of its border [m]."""
        return size * (self.side + 2 * self.layout.outside) / self.side

    def pattern(self, marker_id: int) -> Cells:
        """Cells of a marker, see `Layout.pattern`; 1 where a cell is white, upper left first.

        Raises:
            ValueError: The family has no such id.
        """
        if not 0 <= marker_id < len(self.words):
            raise ValueError(f"{self.name} has ids 0 to {len(self.words) - 1}, not {marker_id}.")
        return self.layout.pattern(self.words[marker_id])


def _published_words(name: str) -> Words:
    """(N,) words of a family from its file in `words/`, where it says who published them."""
    lines = (Path(__file__).parent / "words" / f"{name}.txt").read_text(encoding="ascii").splitlines()
    words = [int(word, 16) for line in lines if not line.startswith("#") for word in line.split()]
    return np.array(words, np.uint64)


@lru_cache(maxsize=1)
def families() -> dict[str, Family]:
    """All families by name; AprilTags are upright as published, not as in OpenCV."""
    bch, tags = bch_words(), _published_words("apriltag_36h11")
    known = [
        Family("artoolkit_bch_thin", CODE_ARTOOLKIT_BCH, Layout(6, 1), bch),
        Family("artoolkit_bch_thick", CODE_ARTOOLKIT_BCH, Layout(6, 3), bch),
        Family("aruco_mip_36h12", CODE_ARUCO_MIP_36H12, Layout(6, 1), _published_words("aruco_mip_36h12")),
        Family("apriltag_36h11", CODE_APRILTAG_36H11, Layout(6, 1), tags),
        Family("apriltag_36h11_thick", CODE_APRILTAG_36H11, Layout(6, 2), tags, touching=True),
        Family("apriltag_16h5", CODE_OTHER, Layout(4, 1), _published_words("apriltag_16h5")),
        Family("apriltag_25h9", CODE_OTHER, Layout(5, 1), _published_words("apriltag_25h9")),
        Family(
            "apriltag_standard_41h12",
            CODE_OTHER,
            Layout(3, 1, surrounded=True),
            _published_words("apriltag_standard_41h12"),
        ),
    ]
    for cells in (4, 5, 6, 7):
        words = _published_words(f"aruco_{cells}x{cells}")
        known += [
            Family(f"aruco_{cells}x{cells}_{count}", CODE_OTHER, Layout(cells, 1), words[:count])
            for count in (50, 100, 250, 1000)
        ]
    return {family.name: family for family in known}


def family_named(name: str) -> Family:
    """The family of a name.

    Raises:
        ValueError: There is none; the message lists the families.
    """
    known = families()
    if name not in known:
        raise ValueError(f"there is no marker family '{name}', only {', '.join(known)}.")
    return known[name]


WHITE = 255


def draw_marker(
    family: Family, marker_id: int, pixels_per_cell: int = 8, margin: int = 1
) -> NDArray[np.uint8]:
    """An image (n, n) of 0 and 255 of an upright marker with a white margin [cells].

    Its side n is (cells of pattern + 2 margin) pixels_per_cell.

    Raises:
        ValueError: The family has no such id.
    """
    cells = np.pad(family.pattern(marker_id), margin, constant_values=1)
    return np.kron(cells, np.full((pixels_per_cell, pixels_per_cell), WHITE, np.uint8))
