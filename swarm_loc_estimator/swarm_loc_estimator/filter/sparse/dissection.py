"""Nested dissection: an order of elimination that keeps the fronts small.

Bodies are split by their positions into two halves and a separator, which no pair bypasses, and the halves
again until few bodies are left. A separator is eliminated after both of its halves.

George, "Nested dissection of a regular finite element mesh", SIAM J. Numer. Anal. 10 (1973).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.filter.sparse.neighbours import Adjacency

_LEAF = 24  # Sets of at most this size are not split
_CUTS = (0.5, 0.42, 0.58)
_FEW = 60  # Sets of at most this size are split in the middle only
_UNEQUAL = 1.15  # Factor by which the separator of an uneven split must be smaller
_DIRECTIONS = 4
_BELOW, _ABOVE, _SEPARATOR, _OUTSIDE = 0, 1, 2, -1


class Order(NamedTuple):
    """Groups of bodies in the order of their elimination."""

    body: IntArray  # (n,) bodies, group by group
    begin: IntArray  # (F + 1,) start of each group


@cached_njit
def dissect(bodies: IntArray, places: FloatArray, adjacency: Adjacency) -> Order:
    """Split bodies (k,), indices into places (n, 2), until each group is small."""
    count = bodies.size
    members, groups = bodies.copy(), np.empty(count, dtype=np.int64)
    begin, left = np.zeros(count + 2, dtype=np.int64), np.empty((count + 2, 2), dtype=np.int64)
    side, trial = np.full(len(places), _OUTSIDE), np.full(len(places), _OUTSIDE)
    written, number, waiting = 0, 0, 1
    left[0, 0], left[0, 1] = 0, count
    while waiting:
        waiting -= 1
        first, last = left[waiting, 0], left[waiting, 1]
        part = members[first:last]
        if 0 < part.size <= _LEAF:
            for body in part:
                groups[written] = body
                written += 1
            number += 1
            begin[number] = written
        elif part.size:
            _part(part, places, adjacency, side, trial)
            below, separators = _sort(part, side)
            for k in range(part.size - separators, part.size):
                groups[written] = part[k]
                written += 1
            if separators:
                number += 1
                begin[number] = written
            left[waiting, 0], left[waiting, 1] = first, first + below
            left[waiting + 1, 0], left[waiting + 1, 1] = first + below, last - separators
            waiting += 2
    # found from the root downwards, eliminated from the leaves upwards
    order = Order(np.empty(count, dtype=np.int64), np.zeros(number + 1, dtype=np.int64))
    written = 0
    for group in range(number - 1, -1, -1):
        for k in range(begin[group], begin[group + 1]):
            order.body[written] = groups[k]
            written += 1
        order.begin[number - group] = written
    return order


@cached_njit
def _part(part: IntArray, places: FloatArray, adjacency: Adjacency, side: IntArray, trial: IntArray) -> None:
    """Write the side of each body of a part, by the cut with the smallest separator; `trial` is workspace."""
    smallest, along = math.inf, np.empty(part.size)
    for direction in range(_DIRECTIONS):
        angle = direction * math.pi / _DIRECTIONS
        for k in range(part.size):
            along[k] = math.cos(angle) * places[part[k], 0] + math.sin(angle) * places[part[k], 1]
        order = np.argsort(along, kind="mergesort")
        for cut in range(1 if part.size <= _FEW else len(_CUTS)):
            below = int(_CUTS[cut] * part.size)
            for k in range(part.size):
                trial[part[order[k]]] = _BELOW if k < below else _ABOVE
            size = _separate(part, adjacency, trial) * (_UNEQUAL if cut else 1.0)
            if size < smallest:
                smallest = size
                for body in part:
                    side[body] = trial[body]
    for body in part:
        trial[body] = _OUTSIDE


@cached_njit
def _separate(part: IntArray, adjacency: Adjacency, side: IntArray) -> int:
    """Move bodies to the separator until no pair crosses, those of most pairs first; return their number."""
    degree, border, count = np.zeros(part.size, dtype=np.int64), np.empty(part.size, dtype=np.int64), 0
    for body in part:
        across = _across(body, adjacency, side)
        if across:
            border[count], degree[count] = body, across
            count += 1
    size = 0
    while count:
        most = 0
        for k in range(count):
            most = k if degree[k] > degree[most] else most
        if degree[most] == 0:
            break
        side[border[most]] = _SEPARATOR
        size += 1
        kept = 0
        for k in range(count):
            if side[border[k]] != _SEPARATOR:
                border[kept] = border[k]
                degree[kept] = _across(border[k], adjacency, side)
                kept += degree[kept] > 0
        count = kept
    return size


@cached_njit
def _across(body: int, adjacency: Adjacency, side: IntArray) -> int:
    """Number of neighbours of a body on the other side."""
    count = 0
    for k in range(adjacency.begin[body], adjacency.begin[body + 1]):
        other = side[adjacency.neighbour[k]]
        count += other + side[body] == 1 and other >= 0 and side[body] >= 0
    return count


@cached_njit
def _sort(part: IntArray, side: IntArray) -> tuple[int, int]:
    """Sort a part by its sides, in place, and reset them; return the sizes of lower half and separator."""
    old, counts, place = part.copy(), np.zeros(3, dtype=np.int64), 0
    for which in (_BELOW, _ABOVE, _SEPARATOR):
        for body in old:
            if side[body] == which:
                part[place] = body
                counts[which] += 1
                place += 1
    for body in part:
        side[body] = _OUTSIDE
    return counts[_BELOW], counts[_SEPARATOR]
