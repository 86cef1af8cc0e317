"""The pattern on a robot's top: a black disc, in its front half a white half-disc; the same on all robots.

The disc's rim gives the place, the straight edge of the half-disc across the robot's middle the heading. On a
dark floor a white margin sets the disc off; it does not count to the disc's diameter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray

MARK_RADIUS = 0.58
"""Of the white half-disc, in radii of the black disc."""
MARGIN = 0.2
"""Width of the white margin, in radii of the black disc."""


def inside_mark(places: FloatArray) -> FloatArray:
    """(...) how deep places (..., 2) lie in the mark, negative outside; radii of the disc, x to the front."""
    return np.asarray(np.minimum(MARK_RADIUS - np.linalg.norm(places, axis=-1), places[..., 0]))


def draw_pattern(side_px: int) -> NDArray[np.uint8]:
    """The pattern with its margin as a picture (side, side) to be printed; the front is to the right."""
    fine = 4
    axis = (np.arange(side_px * fine) + 0.5) / (side_px * fine) * 2.0 - 1.0
    places = np.stack(np.meshgrid(axis, -axis), axis=-1) * (1.0 + MARGIN)
    white = (np.linalg.norm(places, axis=-1) > 1.0) | (inside_mark(places) > 0.0)
    shares = white.reshape(side_px, fine, side_px, fine).mean(axis=(1, 3))
    return np.asarray(np.rint(255.0 * shares), np.uint8)
