"""Families of square markers: a layout of cells, and a word of bits for each id."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swarm_loc_vision.markers.layouts import Cells, Layout, Words

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
    """An image (n, n) of 0 and 255 of an upright marker, n = (cells of pattern + 2 margin) pixels_per_cell.

    Args:
        family: Family of the marker.
        marker_id: Its id.
        pixels_per_cell: Size of a cell [px].
        margin: Width of the white margin [cells].

    Raises:
        ValueError: The family has no such id.
    """
    cells = np.pad(family.pattern(marker_id), margin, constant_values=1)
    return np.kron(cells, np.full((pixels_per_cell, pixels_per_cell), WHITE, np.uint8))
