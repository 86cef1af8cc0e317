"""Method 1 of the aerial self-localization paper: a robot that turns on the spot is the one that turned so.

Algorithm 1 as printed writes `mini` and compares with `min`, so every test passes and the last robot is
always the answer; and it compares absolute differences of angles that are not wrapped.
"""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle


def turn_misfits(headings: FloatArray, own_turns: FloatArray) -> FloatArray:
    """By how much each robot in a series of images turned otherwise: sums of squared differences (..., n).

    Args:
        headings: (..., k + 1, n) of the robots in each image [rad]; they stand, so each keeps its place.
        own_turns: (..., k) own turn between consecutive images, with its sign [rad].
    """
    turned = np.diff(headings, axis=-2)
    misfit: FloatArray = np.sum(wrap_angle(turned - own_turns[..., None]) ** 2, axis=-2)
    return misfit


def identify_by_turns(headings: FloatArray, own_turns: FloatArray) -> int:
    """Which robot (of n) one that turned so is; arguments as for `turn_misfits`."""
    return int(np.argmin(turn_misfits(headings, own_turns)))
