"""Beams of all stops, in arrays that grow by doubling; the beams of one stop are bounded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray

MAX_BEAMS = 768
"""Of one stop; where there are more, every second one is left out."""


class Beams(NamedTuple):
    """Beams of stops (k,).

    Attributes:
        turn: (k, MAX_BEAMS) turn by odometry since the robot came to this stop [rad].
        inverse: (k, MAX_BEAMS) inverse distance [1/m], 0: nothing seen.
        counts: (k,) how many beams there are.
        sigma: (k,) standard deviation of an inverse distance [1/m].
    """

    turn: FloatArray
    inverse: FloatArray
    counts: IntArray
    sigma: FloatArray


def no_beams(capacity: int) -> Beams:
    """Room for the beams of so many stops."""
    shape = (capacity, MAX_BEAMS)
    return Beams(np.zeros(shape), np.zeros(shape), np.zeros(capacity, dtype=np.int64), np.ones(capacity))


def set_beams(beams: Beams, stop: int, turn: FloatArray, inverse: FloatArray) -> None:
    """Set the beams (n,) of a stop."""
    every = -(-len(turn) // MAX_BEAMS) or 1
    turn, inverse = turn[::every], inverse[::every]
    beams.turn[stop, : len(turn)], beams.inverse[stop, : len(turn)] = turn, inverse
    beams.counts[stop] = len(turn)
