"""Which order of elimination is used for how many updates.

The next order is found from what was known at the update before. So all that begins from there has the same
one, whatever has come of the newest measurements as yet, and it is sought once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.sparse.dissection import Order, dissect
from swarm_loc_estimator.filter.sparse.neighbours import adjacency, near_pairs
from swarm_loc_estimator.filter.sparse.symbolic import Pattern, pattern_of

_ORDERED_AGAIN = 3
_GROWN = 1.2
"""An order is replaced after so many updates, or when its largest front has grown so much."""
_NEAR_AGAIN = 9
"""After so many updates it is found out again who is near whom."""


class Situation(NamedTuple):
    """What an order is sought for.

    Attributes:
        bodies: Those that are there, ascending.
        blocks: Of parameters, which are eliminated before all bodies.
        places: (n, 2) of all bodies.
        pairs: (k, 2) bodies of which one has measured the other of late, and those that follow from blocks.
    """

    bodies: IntArray
    blocks: Order
    places: FloatArray
    pairs: IntArray

    def near(self) -> IntArray:
        """Pairs (k, 2) of bodies that are near each other."""
        pairs: IntArray = self.bodies[near_pairs(self.places[self.bodies])]
        return pairs

    def pattern(self, order: Order, near: IntArray) -> Pattern:
        """The pattern in which all pairs lie."""
        return pattern_of(order, adjacency(len(self.places), np.concatenate([self.pairs, near])))

    def order(self, near: IntArray) -> Order:
        """An order of its own."""
        graph = adjacency(len(self.places), np.concatenate([self.pairs, near]))
        blocks, dissected = self.blocks, dissect(self.bodies, self.places, graph)
        return Order(
            np.concatenate([blocks.body, dissected.body]),
            np.concatenate([blocks.begin[:-1], blocks.begin[-1] + dissected.begin]),
        )

    def has_same(self, other: Situation) -> bool:
        """Whether the same are there as in another one."""
        same = np.array_equal(self.bodies, other.bodies)
        return same and np.array_equal(self.blocks.body, other.blocks.body)


@dataclass(frozen=True, eq=False)
class Ordering:
    """An order of elimination, and the pattern that it gives one update.

    Attributes:
        situation: At the update.
        pattern: In which all pairs of the situation lie.
        order: Of all active bodies and blocks.
        updates: For how many it has been used.
        width: Of its largest front at first.
        near: (k, 2) pairs of bodies that are near each other.
        near_updates: For how many updates these have been used.
    """

    situation: Situation
    pattern: Pattern
    order: Order
    updates: int
    width: int
    near: IntArray
    near_updates: int

    @cached_property
    def next_near(self) -> tuple[IntArray, int]:
        """Who is near whom from the next order on, and for how many updates that has been used by then."""
        if self.near_updates < _NEAR_AGAIN:
            return self.near, self.near_updates + 1
        return self.situation.near(), 1

    @cached_property
    def next_order(self) -> Order:
        """What follows this order."""
        return self.situation.order(self.next_near[0])


def ordered(situation: Situation, before: Ordering | None) -> Ordering:
    """The ordering of an update after another one; None: there was none."""
    if before is None or not situation.has_same(before.situation):
        near = situation.near()
        return _begun(situation, situation.order(near), (near, 1))
    if before.updates >= _ORDERED_AGAIN:
        return _begun(situation, before.next_order, before.next_near)
    near, near_updates = before.near, before.near_updates + 1
    pattern = situation.pattern(before.order, near)
    if pattern.width > _GROWN * before.width:
        return _begun(situation, situation.order(before.next_near[0]), before.next_near)
    return Ordering(situation, pattern, before.order, before.updates + 1, before.width, near, near_updates)


def _begun(situation: Situation, order: Order, near: tuple[IntArray, int]) -> Ordering:
    """An ordering with a new order."""
    pattern = situation.pattern(order, near[0])
    return Ordering(situation, pattern, order, 1, pattern.width, *near)
