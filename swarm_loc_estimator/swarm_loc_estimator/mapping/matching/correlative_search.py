"""Search of a stop's pose over a lattice of offsets: the share of its beams that fit, softly."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.mapping.matching.beam_matching import (
    CAUCHY,
    FIT,
    UNUSABLE,
    Scans,
    beam_residual,
)

_APART_M = 0.2
"""Places further from the best one than this are other places."""
_BEAMS = 60
"""So many beams of a stop are enough to search with."""


class Lattice(NamedTuple):
    """Offsets to try around a pose.

    Attributes:
        reach: [m], along x and y of map.
        step: [m].
        turn_reach: [rad].
        turn_step: [rad].
    """

    reach: float
    step: float
    turn_reach: float
    turn_step: float


class Found(NamedTuple):
    """The best offset.

    Attributes:
        offset: (3,) x [m], y [m], theta [rad] to add to the pose.
        score: Share of beams that fit any of the stops searched against, less their losses.
        other: The best score of another place.
    """

    offset: FloatArray
    score: float
    other: float


def search_offsets(scans: Scans, parts: IntArray, against: IntArray, lattice: Lattice) -> Found:
    """Search the offset that moves stops (p,), as one body around the first of them, to fit others (q,)."""
    scores = np.zeros(_shape(lattice))
    for k in parts:
        stride = max(3, int(scans.beams.counts[k]) // _BEAMS)
        scores += _scores(scans, int(k), int(parts[0]), against, lattice, stride)
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    half = (np.array(scores.shape) - 1) // 2
    a, b, c = (int(index) for index in best - half)
    offset = np.array([b * lattice.step, c * lattice.step, a * lattice.turn_step])
    cells = np.arange(scores.shape[1])
    apart = np.hypot(cells[:, None] - best[1], cells[None, :] - best[2]) * lattice.step > _APART_M
    other = float(scores[:, apart].max()) if apart.any() else 0.0
    count = len(parts)
    return Found(offset, float(scores[best]) / count, other / count)


def _shape(lattice: Lattice) -> tuple[int, int, int]:
    cells = 2 * int(lattice.reach / lattice.step) + 1
    return 2 * int(lattice.turn_reach / lattice.turn_step) + 1, cells, cells


@cached_njit
def _scores(scans: Scans, k: int, pivot: int, against: IntArray, lattice: Lattice, stride: int) -> FloatArray:
    """The share of beams that fit, for all offsets."""
    turns, cells = int(lattice.turn_reach / lattice.turn_step), int(lattice.reach / lattice.step)
    scores = np.zeros((2 * turns + 1, 2 * cells + 1, 2 * cells + 1))
    states = scans.states
    before = states[k].copy()
    arm_x, arm_y = before[0] - states[pivot, 0], before[1] - states[pivot, 1]
    centre_x, centre_y = states[pivot, 0], states[pivot, 1]
    for a in range(-turns, turns + 1):
        turn = a * lattice.turn_step
        cos, sin = math.cos(turn), math.sin(turn)
        for b in range(-cells, cells + 1):
            for c in range(-cells, cells + 1):
                states[k, 0] = centre_x + cos * arm_x - sin * arm_y + b * lattice.step
                states[k, 1] = centre_y + sin * arm_x + cos * arm_y + c * lattice.step
                states[k, 2] = before[2] + turn
                scores[a + turns, b + cells, c + cells] = _score(scans, k, against, stride)
    states[k] = before
    return scores


@cached_njit
def _score(scans: Scans, k: int, against: IntArray, stride: int) -> float:
    """The share of every `stride`-th beam of a stop that fits any of others, each less its loss."""
    good, tried = 0.0, 0
    for i in range(0, scans.beams.counts[k], stride):
        if scans.beams.inverse[k, i] <= 0.0:
            continue
        best, can_tell = 0.0, False
        for j in against:
            fate, residual, variance, _, _, _, _ = beam_residual(scans, k, i, j, 0.0)
            can_tell = can_tell or fate != UNUSABLE
            if fate == FIT:
                best = max(best, 1.0 - math.log(1.0 + residual * residual / variance / CAUCHY))
        good += best
        tried += can_tell
    return good / max(1, tried)
