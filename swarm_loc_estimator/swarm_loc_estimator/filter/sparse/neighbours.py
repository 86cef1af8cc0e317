"""The graph of bodies with correlated errors: pairs that measured each other recently, and near pairs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit

_NEAREST = 8


class Adjacency(NamedTuple):
    """Neighbours of each of n bodies."""

    begin: IntArray  # (n + 1,) start of the neighbours of each body
    neighbour: IntArray  # (k,) bodies


def adjacency(count: int, pairs: IntArray) -> Adjacency:
    """The neighbours of `count` bodies by pairs (k, 2), which may repeat."""
    return _adjacency(count, np.ascontiguousarray(pairs))


@cached_njit
def _adjacency(count: int, pairs: IntArray) -> Adjacency:
    """The neighbours of each body in ascending order, without sorting."""
    named = np.zeros(count + 1, dtype=np.int64)
    for k in range(len(pairs)):
        for body in pairs[k]:
            named[body + 1] += 1
    begin = np.cumsum(named)
    naming, place = np.empty(begin[count], dtype=np.int64), begin[:count].copy()
    for k in range(len(pairs)):
        for side in range(2):
            naming[place[pairs[k, side]]] = pairs[k, 1 - side]
            place[pairs[k, side]] += 1
    neighbour, place, last = np.empty_like(naming), begin[:count].copy(), np.full(count, -1)
    for body in range(count):  # ascending, so that each is written after smaller ones
        for other in naming[begin[body] : begin[body + 1]]:
            if other != body and last[other] != body:
                neighbour[place[other]] = last[other] = body
                place[other] += 1
    kept, written = np.zeros(count + 1, dtype=np.int64), 0
    for body in range(count):
        for k in range(begin[body], place[body]):
            neighbour[written] = neighbour[k]
            written += 1
        kept[body + 1] = written
    return Adjacency(kept, neighbour[:written].copy())


def near_pairs(places: FloatArray) -> IntArray:
    """Pairs (k, 2) of positions (n, 2): nearest neighbours, and the Gabriel graph, which is connected."""
    count = len(places)
    nearest = min(_NEAREST, count - 1)
    if nearest < 1:
        return np.zeros((0, 2), dtype=np.int64)
    _, found = scipy.spatial.cKDTree(places).query(places, nearest + 1)
    of_each = np.column_stack([np.repeat(np.arange(count), nearest + 1), found.reshape(-1)])
    return np.concatenate([of_each, _gabriel(places)]).astype(np.int64)


def _gabriel(places: FloatArray) -> IntArray:
    """Pairs (k, 2) in whose diametral circle no other position lies."""
    try:
        begin, neighbour = scipy.spatial.Delaunay(places).vertex_neighbor_vertices
    except (scipy.spatial.QhullError, ValueError):  # fewer than four places, or all in a line
        order = np.lexsort((places[:, 1], places[:, 0]))
        return np.column_stack([order[:-1], order[1:]])
    pairs = np.column_stack([np.repeat(np.arange(len(places)), np.diff(begin)), neighbour])
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    a, b = places[pairs[:, 0]], places[pairs[:, 1]]
    nearest, _ = scipy.spatial.cKDTree(places).query(0.5 * (a + b))
    empty = nearest**2 >= 0.25 * np.sum((a - b) ** 2, axis=1) * (1.0 - 1e-9)
    gabriel: IntArray = pairs[empty]
    return gabriel


def spread(places: FloatArray, count: int) -> IntArray:
    """A subset (count,) of positions (n, 2) that lie far apart; the first is nearest to the mean."""
    if not min(count, len(places)):
        return np.zeros(0, dtype=np.int64)
    picked = [int(np.argmin(np.sum((places - places.mean(axis=0)) ** 2, axis=1)))]
    distance = np.sum((places - places[picked[0]]) ** 2, axis=1)
    while len(picked) < min(count, len(places)):
        picked.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.sum((places - places[picked[-1]]) ** 2, axis=1))
    return np.array(picked, dtype=np.int64)
