"""The graph of who shares errors with whom: who has measured whom of late, and who stands near whom."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from swarm_loc_estimator.numerics.arrays import FloatArray, IntArray

_NEAREST = 6


class Adjacency(NamedTuple):
    """Neighbours of each of n bodies.

    Attributes:
        begin: (n + 1,) where those of each begin.
        neighbour: Who they are.
    """

    begin: IntArray
    neighbour: IntArray


def adjacency(count: int, pairs: IntArray) -> Adjacency:
    """Who the neighbours of `count` bodies are by pairs (k, 2), each named once or more."""
    a, b = pairs[:, 0], pairs[:, 1]
    apart = a != b
    keys = np.unique(np.concatenate([a[apart] * count + b[apart], b[apart] * count + a[apart]]))
    begin: IntArray = np.searchsorted(keys, count * np.arange(count + 1))
    return Adjacency(begin, keys % count)


def near_pairs(places: FloatArray) -> IntArray:
    """Pairs (k, 2) of places (n, 2): each with its nearest, and the Gabriel graph, which is connected."""
    count = len(places)
    nearest = min(_NEAREST, count - 1)
    if nearest < 1:
        return np.zeros((0, 2), dtype=np.int64)
    _, found = cKDTree(places).query(places, nearest + 1)
    of_each = np.column_stack([np.repeat(np.arange(count), nearest + 1), found.reshape(-1)])
    return np.concatenate([of_each, _gabriel(places)]).astype(np.int64)


def _gabriel(places: FloatArray) -> IntArray:
    """Pairs (k, 2) in whose diametral circle no other place lies."""
    try:
        begin, neighbour = Delaunay(places).vertex_neighbor_vertices
    except (QhullError, ValueError):  # fewer than four places, or all in a line
        order = np.lexsort((places[:, 1], places[:, 0]))
        return np.column_stack([order[:-1], order[1:]])
    pairs = np.column_stack([np.repeat(np.arange(len(places)), np.diff(begin)), neighbour])
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    a, b = places[pairs[:, 0]], places[pairs[:, 1]]
    nearest, _ = cKDTree(places).query(0.5 * (a + b))
    empty = nearest**2 >= 0.25 * np.sum((a - b) ** 2, axis=1) * (1.0 - 1e-9)
    chosen: IntArray = pairs[empty]
    return chosen


def spread(places: FloatArray, count: int) -> IntArray:
    """So many of places (n, 2) that lie far from each other; the first is the one nearest to their middle."""
    if not min(count, len(places)):
        return np.zeros(0, dtype=np.int64)
    chosen = [int(np.argmin(np.sum((places - places.mean(axis=0)) ** 2, axis=1)))]
    distance = np.sum((places - places[chosen[0]]) ** 2, axis=1)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.sum((places - places[chosen[-1]]) ** 2, axis=1))
    return np.array(chosen, dtype=np.int64)
