"""Room for the likelihood to solve pairs in, allocated once for all of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.infrared.solvers.cost import Costs, Scratch, new_costs, new_scratch
from swarm_loc_estimator.infrared.solvers.start_table import (
    Float32Array,
    StartRoom,
    StartTable,
    new_start_room,
)

TABLE_STARTS = 3
"""How many starts are taken of the table at most."""


class Room(NamedTuple):
    """Room to work in.

    Attributes:
        plain: To search the pose only.
        full: To search gains besides where they are not known, else the same.
        start: To look for starts.
        starts: (S, 4) range, bearing, heading, misfit.
        pattern: (F,) compressed readings.
        present: (F,) 1 where there is a reading, else 0.
        cut, stable, kinds: (F,) of `Pair`.
        exact, soft: What readings cost by either model.
        prior: (2, 2) of `Pair`.
        minima: (2, 4) range, bearing, heading and cost of the best two minima that lie apart.
        best: (P,) the best with its gains.
        found: (P,) another one.
        first: (4,) the table's best start.
        covariance: (3, 3) of its pose.
    """

    plain: Scratch
    full: Scratch
    start: StartRoom
    starts: FloatArray
    pattern: Float32Array
    present: Float32Array
    cut: FloatArray
    stable: FloatArray
    kinds: NDArray[np.int8]
    exact: Costs
    soft: Costs
    prior: FloatArray
    minima: FloatArray
    best: FloatArray
    found: FloatArray
    first: FloatArray
    covariance: FloatArray


@cached_njit
def new_room(table: StartTable, modes: int, n: int, known: bool) -> Room:
    """Room for one platform, with gains known or not."""
    plain = new_scratch(modes, n, False)
    full = plain if known else new_scratch(modes, n, True)
    readings = modes * n * n
    return Room(
        plain,
        full,
        new_start_room(table),
        np.empty((1 + TABLE_STARTS, 4)),
        np.empty(readings, np.float32),
        np.empty(readings, np.float32),
        np.empty(readings),
        np.empty(readings),
        np.empty(readings, np.int8),
        new_costs(readings),
        new_costs(readings),
        np.empty((2, 2)),
        np.empty((2, 4)),
        np.empty(full.at.size),
        np.empty(full.at.size),
        np.empty(4),
        np.empty((3, 3)),
    )
