"""Errors about a reference point of each body, well-conditioned also far from the origin of `map`.

The filter's columns are right-invariant errors xi, twists about the origin of `map`, in which a small heading
error moves a far body by much. Here they are eta = Ad(r) xi, twists about a reference point r near the body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.small_matrix import cholesky3, solve3


class Information(NamedTuple):
    """Information of measurements: H^T R^-1 H in blocks, and H^T R^-1 y."""

    first: IntArray  # (k,) bodies; a block of two bodies is given once
    second: IntArray  # (k,)
    block: FloatArray  # (k, 3, 3)
    gradient: FloatArray  # (n, 3)


def translation_adjoints(places: FloatArray) -> FloatArray:
    """Ad(r) (n, 3, 3) of reference points (n, 2); the inverse is that of -r."""
    out = np.tile(np.eye(3), (len(places), 1, 1))
    out[:, 0, 2], out[:, 1, 2] = -places[:, 1], places[:, 0]
    return out


def carried(places: FloatArray, covariances: FloatArray) -> FloatArray:
    """Covariances (n, 3, 3) of Ad(r) e for errors e of covariances (n, 3, 3)."""
    return carried_pairs(places, covariances, places)


@cached_njit
def carried_pairs(places: FloatArray, across: FloatArray, others: FloatArray) -> FloatArray:
    """Ad(r) C Ad(s)^T (n, 3, 3) for points r (n, 2), matrices C (n, 3, 3) and points s (n, 2)."""
    out = np.empty((across.shape[0], 3, 3))
    for k in range(across.shape[0]):
        x, y = places[k, 0], places[k, 1]
        for j in range(3):
            out[k, 0, j] = across[k, 0, j] - y * across[k, 2, j]
            out[k, 1, j] = across[k, 1, j] + x * across[k, 2, j]
            out[k, 2, j] = across[k, 2, j]
        x, y = others[k, 0], others[k, 1]
        for i in range(3):
            out[k, i, 0] -= y * out[k, i, 2]
            out[k, i, 1] += x * out[k, i, 2]
    return out


def centres(covariances: FloatArray) -> FloatArray:
    """Points (n, 2) whose position errors are uncorrelated with the heading, for covariances (n, 3, 3)."""
    across = np.column_stack([-covariances[:, 1, 2], covariances[:, 0, 2]])
    places: FloatArray = across / covariances[:, 2, 2, None]
    return places


@cached_njit
def information_of(
    columns: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray, places: FloatArray
) -> Information:
    """Information of measurements about bodies, each about its reference point.

    Args:
        columns: (m, c) filter columns that each depends on: those of two bodies, then some of one block of
            parameters.
        jacobian: (m, 3, c), zero where there is no body.
        innovation: (m, 3) measured minus predicted.
        noise: (m, 3, 3) covariances.
        places: (n, 2) reference points.
    """
    measurements, count = columns.shape[0], 0
    first, second = np.empty(6 * measurements, dtype=np.int64), np.empty(6 * measurements, dtype=np.int64)
    block, gradient = np.zeros((6 * measurements, 3, 3)), np.zeros((len(places), 3))
    by, weighted, bodies = np.empty((3, 3, 3)), np.empty((3, 3, 3)), np.empty(3, dtype=np.int64)
    for k in range(measurements):
        factor = cholesky3(noise[k])
        for side in range(2):
            bodies[side] = columns[k, 3 * side] // 3
            _about_place(jacobian[k, :, 3 * side : 3 * side + 3], places[bodies[side]], by[side])
        bodies[2] = _by_parameters(columns[k], jacobian[k], by[2])
        sides = 3 if bodies[2] >= 0 else 2
        for side in range(sides):
            for a in range(3):
                solve3(factor, by[side, a], weighted[side, a])
        for side in range(sides):
            body = bodies[side]
            if not _depends(by[side]):
                continue
            for a in range(3):
                for i in range(3):
                    gradient[body, a] += weighted[side, a, i] * innovation[k, i]
            for other in range(side + 1):
                if _depends(by[other]):
                    first[count], second[count] = body, bodies[other]
                    for a in range(3):
                        for b in range(3):
                            for i in range(3):
                                block[count, a, b] += weighted[side, a, i] * by[other, b, i]
                    count += 1
    return Information(first[:count], second[:count], block[:count], gradient)


@cached_njit
def summed(measured: Information) -> Information:
    """The same information with repeated blocks summed into the first of them."""
    count, bodies = measured.first.size, len(measured.gradient)
    newest, before, kept = (
        np.full(bodies, -1),
        np.empty(count, dtype=np.int64),
        np.empty(count, dtype=np.int64),
    )
    place_of, pairs = np.empty(count, dtype=np.int64), 0
    for k in range(count):
        place = newest[measured.first[k]]
        while place >= 0 and measured.second[kept[place]] != measured.second[k]:
            place = before[place]
        if place < 0:
            place, pairs = pairs, pairs + 1
            kept[place], before[place], newest[measured.first[k]] = k, newest[measured.first[k]], place
        place_of[k] = place
    number, written = np.empty(pairs, dtype=np.int64), 0
    for body in range(bodies):
        place = newest[body]
        while place >= 0:
            number[place] = written
            place, written = before[place], written + 1
    first, second = np.empty(pairs, dtype=np.int64), np.empty(pairs, dtype=np.int64)
    block = np.zeros((pairs, 3, 3))
    for k in range(count):
        place = number[place_of[k]]
        first[place], second[place] = measured.first[k], measured.second[k]
        for i in range(3):
            for j in range(3):
                block[place, i, j] += measured.block[k, i, j]
    return Information(first, second, block, measured.gradient)


@cached_njit
def _about_place(jacobian: FloatArray, place: FloatArray, out: FloatArray) -> None:
    """Write the columns of a Jacobian with respect to xi (3, 3) as rows with respect to eta."""
    for i in range(3):
        out[0, i], out[1, i] = jacobian[i, 0], jacobian[i, 1]
        out[2, i] = jacobian[i, 2] + place[1] * jacobian[i, 0] - place[0] * jacobian[i, 1]


@cached_njit
def _by_parameters(columns: IntArray, jacobian: FloatArray, out: FloatArray) -> int:
    """Write the parameter columns of a Jacobian (3, c) as rows of their block; return it, -1: none."""
    block = -1
    for c in range(6, columns.size):
        if jacobian[0, c] != 0.0 or jacobian[1, c] != 0.0 or jacobian[2, c] != 0.0:
            if block < 0:
                out[:] = 0.0
            block = columns[c] // 3
            for i in range(3):
                out[columns[c] % 3, i] = jacobian[i, c]
    return block


@cached_njit
def _depends(rows: FloatArray) -> bool:
    """Whether any entry of a matrix (3, 3) is not zero."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += abs(rows[i, j])
    return total > 0.0
