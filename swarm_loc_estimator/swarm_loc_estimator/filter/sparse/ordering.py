"""Order of elimination of an update: reused for some updates, then replaced.

The next order is computed from the situation of the previous update. So every recomputation that starts there
uses the same order, whatever measurements have arrived since, and the order is computed once.
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
"""An order is replaced after this number of updates, or when its largest front has grown by this factor."""
_NEAR_AGAIN = 9  # Number of updates after which near pairs are computed again


class Situation(NamedTuple):
    """The bodies and pairs of an update."""

    bodies: IntArray  # Active bodies, ascending
    blocks: Order  # Blocks of parameters, which are eliminated before all bodies
    places: FloatArray  # (n, 2) of all bodies
    # (k, 2) bodies of which one has measured the other recently, and pairs that follow from blocks
    pairs: IntArray

    def near(self) -> IntArray:
        """Pairs (k, 2) of near bodies."""
        pairs: IntArray = self.bodies[near_pairs(self.places[self.bodies])]
        return pairs

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

    def used_again(self) -> NearPairs:
        """The same pairs after one more update."""
        return self._replace(updates=self.updates + 1)


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
            return self.near.used_again()
        return NearPairs(self.situation.near(), 1)

    @cached_property
    def next_order(self) -> Order:
        """The order after this one."""
        return self.situation.order(self.next_near.pairs)


def ordered(situation: Situation, before: Ordering | None) -> Ordering:
    """The ordering of an update; `before` is that of the previous update, None at first."""
    if before is None or not situation.has_same(before.situation):
        near = NearPairs(situation.near(), 1)
        return _with_new_order(situation, situation.order(near.pairs), near)
    if before.updates >= _ORDERED_AGAIN:
        return _with_new_order(situation, before.next_order, before.next_near)
    pattern = situation.pattern(before.order, before.near.pairs)
    if pattern.width > _GROWN * before.width:
        return _with_new_order(situation, situation.order(before.next_near.pairs), before.next_near)
    near = before.near.used_again()
    return Ordering(situation, pattern, before.order, before.updates + 1, before.width, near)


def _with_new_order(situation: Situation, order: Order, near: NearPairs) -> Ordering:
    pattern = situation.pattern(order, near.pairs)
    return Ordering(situation, pattern, order, 1, pattern.width, near)
