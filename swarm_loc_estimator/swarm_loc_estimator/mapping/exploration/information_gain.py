"""What a robot would see from a place: unknown cells, and walls that are not known well."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.mapping.exploration.planning_grid import OPEN, UNKNOWN, WALL

_RAYS = 60
_SURE = 2.0
"""Log odds from which on a wall needs no more looks."""
_WALL_GAIN = 0.5


@cached_njit
def information_gain(
    state: NDArray[np.int8], evidence: FloatArray, cells: IntArray, reach: int
) -> FloatArray:
    """The gain (n,) of looking around from cells (n, 2), out to `reach` cells.

    Unknown cells count by the area that a ray stands for; behind two unknown ones a ray sees nothing more.
    """
    gains = np.zeros(len(cells))
    for n in range(len(cells)):
        for ray in range(_RAYS):
            angle = 2.0 * math.pi * ray / _RAYS
            cos, sin = math.cos(angle), math.sin(angle)
            was_unknown = False
            for k in range(1, reach):
                u = math.floor(cells[n, 0] + 0.5 + k * cos)
                v = math.floor(cells[n, 1] + 0.5 + k * sin)
                if not (0 <= u < state.shape[0] and 0 <= v < state.shape[1]):
                    break
                if state[u, v] == WALL:
                    gains[n] += max(0.0, 1.0 - evidence[u, v] / _SURE) * _WALL_GAIN * (1.0 - k / reach)
                    break
                if state[u, v] == UNKNOWN:
                    gains[n] += 2.0 * math.pi * k / _RAYS * (1.0 if k < 0.8 * reach else 0.5)
                    if was_unknown:
                        break
                was_unknown = state[u, v] != OPEN
    return gains
