"""Symbolic elimination: the bodies of each front, and the rows of an old factor that a new pattern needs.

A front eliminates its pivots J given its border B: all bodies eliminated later that are paired with a pivot,
or with a body eliminated earlier whose border contains a pivot. The pairs within all J and B are the pattern.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.filter.sparse.dissection import Order
from swarm_loc_estimator.filter.sparse.neighbours import Adjacency


class Pattern(NamedTuple):
    """Fronts in the order of their elimination."""

    pivot: IntArray  # Pivots, front by front
    pivot_begin: IntArray  # (F + 1,) start of each front's pivots
    border: IntArray  # Borders, front by front
    border_begin: IntArray  # (F + 1,) start of each front's border
    front: IntArray  # (n,) the front of which each body is a pivot; -1: none

    @property
    def fronts(self) -> int:
        """Number of fronts."""
        return self.pivot_begin.size - 1

    @property
    def width(self) -> int:
        """Bodies in the largest front."""
        return int((np.diff(self.pivot_begin) + np.diff(self.border_begin)).max(initial=0))


def pattern_of(order: Order, adjacency: Adjacency) -> Pattern:
    """The fronts of an order of n bodies."""
    front = np.full(adjacency.begin.size - 1, -1, dtype=np.int64)
    front[order.body] = np.repeat(np.arange(order.begin.size - 1), np.diff(order.begin))
    border, border_begin = _borders(order, front, adjacency)
    return Pattern(order.body, order.begin, border, border_begin, front)


@cached_njit
def _borders(order: Order, front: IntArray, adjacency: Adjacency) -> tuple[IntArray, IntArray]:
    """The borders of all fronts, concatenated, and the start of each (F + 1,)."""
    pivot, begin = order.body, order.begin
    fronts, seen = begin.size - 1, np.full(front.size, -1, dtype=np.int64)
    borders, border_begin = np.empty(64 * front.size, dtype=np.int64), np.zeros(fronts + 1, dtype=np.int64)
    child, sibling = np.full(fronts, -1, dtype=np.int64), np.full(fronts, -1, dtype=np.int64)
    end = 0
    for f in range(fronts):
        if end + front.size > borders.size:
            borders = np.concatenate((borders, np.empty_like(borders)))
        first = end
        for body in pivot[begin[f] : begin[f + 1]]:
            neighbours = adjacency.neighbour[adjacency.begin[body] : adjacency.begin[body + 1]]
            end = _take(neighbours, f, front, seen, borders, end)
        below = child[f]
        while below >= 0:
            end = _take(borders[border_begin[below] : border_begin[below + 1]], f, front, seen, borders, end)
            below = sibling[below]
        border_begin[f + 1] = end
        if end > first:
            parent = front[borders[first:end]].min()
            sibling[f], child[parent] = child[parent], f
    return borders[:end].copy(), border_begin


@cached_njit
def _take(bodies: IntArray, f: int, front: IntArray, seen: IntArray, borders: IntArray, end: int) -> int:
    """Append the bodies that are pivots after front f to the borders; return the new end."""
    for body in bodies:
        if front[body] > f and seen[body] != f:
            seen[body] = f
            borders[end] = body
            end += 1
    return end


def wanted_rows(
    old: Pattern, new: Pattern, place: IntArray, derived: int, beside: IntArray
) -> tuple[IntArray, IntArray]:
    """Covariances of an old factor, outside its pattern, that a new pattern needs.

    Args:
        old: Pattern of the old factor, with its own numbers of bodies.
        new: The new pattern.
        place: (n,) numbers of the new pattern's bodies in the old one.
        derived: Number of first fronts with borders whose pairs may be in no front.
        beside: (n,) body whose pairs are needed together with those of another one; -1: none.

    Returns:
        Bodies, front by front of the old pattern, whose covariances with its pivots are needed, and the start
        of each front's bodies (F + 1,).
    """
    position = np.empty_like(old.front)
    position[old.pivot] = np.arange(old.pivot.size)
    wanted = np.zeros((old.fronts, old.pivot.size), dtype=np.bool_)
    _want_pairs(_Sequence(old.front, position), new, place, beside, wanted)
    return _close(old, position, wanted, derived)


class _Sequence(NamedTuple):
    """Order of elimination: the front and the position of each body."""

    front: IntArray
    position: IntArray


@cached_njit
def _want_pairs(old: _Sequence, new: Pattern, place: IntArray, beside: IntArray, wanted: BoolArray) -> None:
    """Mark all pairs of the new pattern, and of bodies beside, at the front of the earlier body."""
    for f in range(new.pivot_begin.size - 1):
        for k in range(new.pivot_begin[f], new.pivot_begin[f + 1]):
            a = new.pivot[k]
            if beside[a] >= 0:
                _want(old, place[a], place[beside[a]], wanted)
            for q in range(k + 1, new.pivot_begin[f + 1]):
                _want_with(old, a, new.pivot[q], place, beside, wanted)
            for q in range(new.border_begin[f], new.border_begin[f + 1]):
                _want_with(old, a, new.border[q], place, beside, wanted)


@cached_njit
def _want_with(old: _Sequence, a: int, b: int, place: IntArray, beside: IntArray, wanted: BoolArray) -> None:
    """Mark a pair of bodies, and the pairs of the bodies beside them."""
    _want(old, place[a], place[b], wanted)
    if beside[a] >= 0:
        _want(old, place[beside[a]], place[b], wanted)
        if beside[b] >= 0:
            _want(old, place[beside[a]], place[beside[b]], wanted)
    if beside[b] >= 0:
        _want(old, place[a], place[beside[b]], wanted)


@cached_njit
def _want(old: _Sequence, a: int, b: int, wanted: BoolArray) -> None:
    """Mark a pair of bodies; pairs within a front are known."""
    if old.front[a] < old.front[b]:
        wanted[old.front[a], old.position[b]] = True
    elif old.front[b] < old.front[a]:
        wanted[old.front[b], old.position[a]] = True


@cached_njit
def _close(old: Pattern, position: IntArray, wanted: BoolArray, derived: int) -> tuple[IntArray, IntArray]:
    """Mark the pairs that marked ones depend on: a pair of a pivot depends on those of its border."""
    sequence, fronts = _Sequence(old.front, position), old.pivot_begin.size - 1
    begin, end = np.zeros(fronts + 1, dtype=np.int64), 0
    for f in range(fronts):
        border = old.border[old.border_begin[f] : old.border_begin[f + 1]]
        for body in border:
            wanted[f, position[body]] = False
            for other in border if f < derived else border[:0]:
                _want(sequence, body, other, wanted)
        end += _follow(old, position, wanted, f)
        begin[f + 1] = end
    rows, end = np.empty(end, dtype=np.int64), 0
    for f in range(fronts):
        for k in range(old.pivot_begin[f + 1], old.pivot.size):
            if wanted[f, k]:
                rows[end] = old.pivot[k]
                end += 1
    return rows, begin


@cached_njit
def _follow(old: Pattern, position: IntArray, wanted: BoolArray, f: int) -> int:
    """Mark the pairs of the border of front f with all bodies marked there; return their number."""
    border = old.border[old.border_begin[f] : old.border_begin[f + 1]]
    for body in border:  # bodies eliminated after it
        front = old.front[body]
        for k in range(old.pivot_begin[front + 1], old.pivot.size):
            wanted[front, k] |= wanted[f, k]
    count, newest = 0, -1
    for k in range(old.pivot_begin[f + 1], old.pivot.size):
        if wanted[f, k]:
            count, front = count + 1, old.front[old.pivot[k]]
            for body in border if front != newest else border[:0]:
                if old.front[body] > front:
                    wanted[front, position[body]] = True
            newest = front
    return count
