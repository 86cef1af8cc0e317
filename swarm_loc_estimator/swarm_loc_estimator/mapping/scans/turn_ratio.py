"""True turn over turn by odometry, from a scan of two turns: the second must see what the first did."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit

MIN_OVERLAP = 50
"""So many beams of the first turn must have one of the second beside them."""
_LOW, _HIGH, _STEP = 0.90, 1.02, 0.0005
_OUTLIER = 9.0


@cached_njit
def turn_ratio(turn: FloatArray, inverse: FloatArray, sigma: float) -> float:
    """The ratio at which beams (n,) agree best with those one turn later; NaN where too few overlap.

    Args:
        turn: (n,) by odometry, increasing or decreasing throughout [rad].
        inverse: (n,) inverse distances, 0: nothing [1/m].
        sigma: Of an inverse distance [1/m].
    """
    forward = np.abs(turn - turn[0])
    best, found = math.inf, math.nan
    for m in range(round((_HIGH - _LOW) / _STEP) + 1):
        ratio = _HIGH - m * _STEP
        cost, count = _disagreement(forward, inverse, sigma, 2.0 * math.pi / ratio)
        if count >= MIN_OVERLAP and cost / count < best:
            best, found = cost / count, ratio
    return found


@cached_njit
def _disagreement(turn: FloatArray, inverse: FloatArray, sigma: float, later: float) -> tuple[float, int]:
    """Sum of capped squares between each beam and that a turn `later` [rad], and their number."""
    cost, count, j = 0.0, 0, 0
    for i in range(len(turn)):
        wanted = turn[i] + later
        while j + 1 < len(turn) and turn[j + 1] < wanted:
            j += 1
        if j + 1 >= len(turn):
            break
        count += 1
        if (inverse[i] > 0.0) != (inverse[j] > 0.0):
            cost += _OUTLIER
        elif inverse[i] > 0.0 and inverse[j + 1] > 0.0:
            gap = turn[j + 1] - turn[j]
            share = (wanted - turn[j]) / gap if gap > 0.0 else 0.0
            off = (inverse[i] - (1.0 - share) * inverse[j] - share * inverse[j + 1]) / (1.3 * sigma)
            cost += min(off * off, _OUTLIER)
    return cost, count
