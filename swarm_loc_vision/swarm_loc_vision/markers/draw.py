"""Draw markers, for printing and for simulated worlds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_vision.markers.families import Family

WHITE = 255


def draw_marker(
    family: Family, marker_id: int, pixels_per_cell: int = 8, margin: int = 1
) -> NDArray[np.uint8]:
    """A marker as seen by one who faces it upright, inside a white margin.

    Args:
        family: Of which family; it says how wide the black border is.
        marker_id: Which one.
        pixels_per_cell: Size of a cell, at least 1 [px].
        margin: Width of the white margin [cells]; the marker itself fills `family.side` cells.

    Returns:
        (n, n) of 0 and 255, n = (family.side + 2 margin) pixels_per_cell.

    Raises:
        ValueError: The family has no such id.
    """
    cells = np.pad(family.pattern(marker_id), margin, constant_values=1)
    return np.kron(cells, np.full((pixels_per_cell, pixels_per_cell), WHITE, np.uint8))
