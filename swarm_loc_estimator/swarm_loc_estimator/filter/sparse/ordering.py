"""Order of elimination of an update: reused for some updates, then replaced.

The next order is computed from the situation of the previous update. So every recomputation that starts there
uses the same order, whatever measurements have arrived since, and the order is computed once.

Nested dissection: an order of elimination that keeps the fronts small.

Bodies are split by their positions into two halves and a separator, which no pair bypasses, and the halves
again until few bodies are left. A separator is eliminated after both of its halves.

George, "Nested dissection of a regular finite element mesh", SIAM J. Numer. Anal. 10 (1973).

Symbolic elimination: the bodies of each front, and the rows of an old factor that a new pattern needs.

A front eliminates its pivots J given its border B: all bodies eliminated later that are paired with a pivot,
or with a body eliminated earlier whose border contains a pivot. The pairs within all J and B are the pattern.

The graph of bodies with correlated errors: pairs that measured each other recently, and near pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit

_LEAF = 24  # Sets of at most this size are not split
_CUTS = (0.5, 0.42, 0.58)  # Shares of the bodies on the lower side; checked by `make bench-scaling`
_FEW = 60  # Sets of at most this size are split in the middle only
_UNEQUAL = 1.15  # Factor by which the separator of an uneven split must be smaller
_DIRECTIONS = 4  # Number of directions in which a set is cut
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
        # a small part is a group; of a larger one the separator is, and its halves are left
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

    `place` (n,) are the numbers of the new pattern's bodies in the old one, `derived` the number of first
    fronts with borders whose pairs may be in no front, and `beside` (n,) the body whose pairs are needed
    together with those of another one; -1: none.

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
    """Mark all pairs of the new pattern and of `beside` at the front of the earlier body."""
    for f in range(new.pivot_begin.size - 1):
        border = new.border[new.border_begin[f] : new.border_begin[f + 1]]
        for k in range(new.pivot_begin[f], new.pivot_begin[f + 1]):
            a = new.pivot[k]
            if beside[a] >= 0:
                _want(old, place[a], place[beside[a]], wanted)
            for others in (new.pivot[k + 1 : new.pivot_begin[f + 1]], border):
                for b in others:
                    for one in (a, beside[a]):  # and those beside both
                        for other in (b, beside[b]):
                            if one >= 0 and other >= 0:
                                _want(old, place[one], place[other], wanted)


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


_NEAREST = 8  # Number of nearest bodies that are neighbours; checked by `make bench-scaling`


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
    return np.asarray(pairs[empty])


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


_ORDERED_AGAIN = 3  # Number of updates after which an order is replaced
_GROWN = 1.2  # Growth of its largest front at which it is replaced earlier
_NEAR_AGAIN = 9  # Number of updates after which near pairs are computed again


class Situation(NamedTuple):
    """The bodies and pairs of an update."""

    bodies: IntArray  # Active bodies, ascending
    blocks: Order  # Blocks of parameters, which are eliminated before all bodies
    places: FloatArray  # (n, 2) of all bodies
    # (k, 2) bodies of which one has measured the other recently, and pairs that follow from blocks
    pairs: IntArray

    def near(self) -> NearPairs:
        """Pairs of near bodies."""
        return NearPairs(self.bodies[near_pairs(self.places[self.bodies])], 1)

    def pattern(self, order: Order, near: IntArray) -> Pattern:
        """The pattern that contains all pairs."""
        return pattern_of(order, adjacency(len(self.places), np.concatenate([self.pairs, near])))

    def order(self, near: IntArray) -> Order:
        """A new order, by nested dissection."""
        graph = adjacency(len(self.places), np.concatenate([self.pairs, near]))
        blocks, dissected = self.blocks, dissect(self.bodies, self.places, graph)
        return Order(
            np.concatenate([blocks.body, dissected.body]),
            np.concatenate([blocks.begin[:-1], blocks.begin[-1] + dissected.begin]),
        )

    def has_same(self, other: Situation) -> bool:
        """Whether bodies and blocks are the same as in another situation."""
        same = np.array_equal(self.bodies, other.bodies)
        return same and np.array_equal(self.blocks.body, other.blocks.body)


class NearPairs(NamedTuple):
    """Pairs (k, 2) of near bodies, and the number of updates that have used them."""

    pairs: IntArray
    updates: int


@dataclass(frozen=True, eq=False)
class Ordering:
    """An order of elimination and the pattern of one update."""

    situation: Situation  # Bodies and pairs of the update
    pattern: Pattern  # Contains all pairs of the situation
    order: Order  # Of all active bodies and blocks
    updates: int  # Number of updates that have used the order
    width: int  # Size of its largest front at first use
    near: NearPairs  # Near pairs

    @cached_property
    def next_near(self) -> NearPairs:
        """The near pairs of the next order."""
        if self.near.updates < _NEAR_AGAIN:
            return NearPairs(self.near.pairs, self.near.updates + 1)
        return self.situation.near()

    @cached_property
    def next_order(self) -> Order:
        """The order after this one."""
        return self.situation.order(self.next_near.pairs)


def ordered(situation: Situation, before: Ordering | None) -> Ordering:
    """The ordering of an update; `before` is that of the previous update, None at first."""
    if before is None or not situation.has_same(before.situation):
        near = situation.near()
        return _with_new_order(situation, situation.order(near.pairs), near)
    if before.updates >= _ORDERED_AGAIN:
        return _with_new_order(situation, before.next_order, before.next_near)
    pattern = situation.pattern(before.order, before.near.pairs)
    if pattern.width > _GROWN * before.width:
        return _with_new_order(situation, situation.order(before.next_near.pairs), before.next_near)
    near = NearPairs(before.near.pairs, before.near.updates + 1)
    return Ordering(situation, pattern, before.order, before.updates + 1, before.width, near)


def _with_new_order(situation: Situation, order: Order, near: NearPairs) -> Ordering:
    pattern = situation.pattern(order, near.pairs)
    return Ordering(situation, pattern, order, 1, pattern.width, near)
