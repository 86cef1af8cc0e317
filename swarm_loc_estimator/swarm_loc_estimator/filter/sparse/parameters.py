"""Parameters of robots in the sparse filter: blocks of three columns that change the error of their pose.

Between two updates the errors x of a robot's pose and z of the parameters of its motion become

    x + A z + w,    L z + v,    L diagonal,

where the noises w and v may be correlated. Blocks are eliminated before all bodies, those of each robot in
one front, whose border is the robot and what it has measured recently.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.filter.sparse.dissection import Order
from swarm_loc_estimator.filter.sparse.symbolic import Pattern
from swarm_loc_estimator.swarm.calibration_states import BLOCKS, DRIVES, ParameterTable


class Groups(NamedTuple):
    """The robots, bodies and blocks that belong together, for n bodies and blocks."""

    member: IntArray  # (N, 1 + BLOCKS) each robot's body and its blocks; -1: none
    owner: IntArray  # (n,) the robot of each block; a body is its own owner
    part: IntArray  # (n,) 0 for a body, else the number of the block within its robot

    @classmethod
    def of(cls, table: ParameterTable) -> Groups:
        """The groups of a parameter table."""
        robots = np.arange(table.column.shape[0])
        member = np.column_stack([robots, table.block_columns // DRIVES])
        owner = np.arange(table.filter_size // DRIVES)
        part = np.zeros_like(owner)
        for k in range(1, 1 + BLOCKS):
            there = member[:, k] >= 0
            owner[member[there, k]], part[member[there, k]] = robots[there], k
        return cls(member, owner, part)

    def columns(self, columns: IntArray) -> tuple[int, IntArray]:
        """The owner of columns (k,) of one body or one robot's blocks, and their numbers (k,) within it."""
        blocks, slots = np.divmod(columns, DRIVES)
        return int(self.owner[blocks[0]]), DRIVES * self.part[blocks] + slots


class Moves(NamedTuple):
    """Transition of the errors of n bodies and blocks."""

    beside: IntArray  # (n,) the block whose error changes each body's; -1: none
    gain: FloatArray  # (n, 3, 3) A
    left: FloatArray  # (n, 3) L

    def any(self) -> bool:
        """Whether the transition is not the identity."""
        return bool((self.beside >= 0).any() or (self.left != 1.0).any())


def active_blocks(groups: Groups, active: BoolArray) -> Order:
    """The active blocks in the order of their elimination: those of a robot together."""
    blocks = groups.member[:, 1:]
    there = (blocks >= 0) & active[blocks]
    counts = there.sum(axis=1)
    return Order(blocks[there], np.concatenate([[0], np.cumsum(counts[counts > 0])]))


def block_pairs(groups: Groups, active: BoolArray, measured: IntArray) -> IntArray:
    """Pairs (k, 2) that follow from blocks: among a robot, its blocks and what it has measured.

    Args:
        groups: Robots and their blocks.
        active: (n,) active bodies and blocks.
        measured: (m, 2) observers and what they have measured, all active.
    """
    robots = np.arange(len(groups.member))
    has_blocks = np.zeros(active.size, dtype=bool)
    pairs = [measured]
    for blocks in groups.member.T:
        there = (blocks >= 0) & active[np.maximum(blocks, 0)]
        pairs.append(np.column_stack([robots[there], blocks[there]]))
    for own in pairs[2:]:
        has_blocks[own[:, 0]] = True
    around = np.concatenate(pairs)
    return _cliques(around[has_blocks[around[:, 0]]], active.size)


@cached_njit
def _cliques(pairs: IntArray, bodies: int) -> IntArray:
    """All pairs (k, 2) among bodies that are paired with the same first body."""
    order = np.argsort(pairs[:, 0], kind="mergesort")
    seen, last = np.empty(order.size, dtype=np.int64), np.full(bodies, -1, dtype=np.int64)
    out, written, begin = np.empty((16 * order.size, 2), dtype=np.int64), 0, 0
    while begin < order.size:
        first, count, end = pairs[order[begin], 0], 0, begin
        while end < order.size and pairs[order[end], 0] == first:
            other = pairs[order[end], 1]
            if last[other] != first:
                last[other] = first
                seen[count] = other
                count += 1
            end += 1
        while written + count * count > len(out):
            out = np.concatenate((out, np.empty_like(out)))
        for a in range(count):
            for b in range(a):
                out[written, 0], out[written, 1] = seen[a], seen[b]
                written += 1
        begin = end
    found: IntArray = out[:written].copy()
    return found


@cached_njit
def move(covariance: FloatArray, pattern: Pattern, place: IntArray, moves: Moves) -> None:
    """Apply a transition to the covariances of all pairs of a pattern.

    Args:
        covariance: (n, n, 3, 3) changed; includes the pairs of the blocks that change a body.
        pattern: Pairs to change.
        place: Numbers of the pattern's bodies in `covariance`.
        moves: The transition.
    """
    room = np.empty((2, 3, 3))
    # blocks change after the bodies that depend on them: pairs of two such bodies first, then of one, of none
    for moved in (2, 1, 0):
        for f in range(pattern.pivot_begin.size - 1):
            for k in range(pattern.pivot_begin[f], pattern.pivot_begin[f + 1]):
                a = pattern.pivot[k]
                for q in range(k, pattern.pivot_begin[f + 1]):
                    b = pattern.pivot[q]
                    if (moves.beside[a] >= 0) + (moves.beside[b] >= 0) == moved:
                        _move_pair(covariance, a, b, place, moves, room)
                for q in range(pattern.border_begin[f], pattern.border_begin[f + 1]):
                    b = pattern.border[q]
                    if (moves.beside[a] >= 0) + (moves.beside[b] >= 0) == moved:
                        _move_pair(covariance, a, b, place, moves, room)


@inlined_njit
def _move_pair(
    covariance: FloatArray, a: int, b: int, place: IntArray, moves: Moves, room: FloatArray
) -> None:
    """Apply the transition to both blocks of a pair; `room` (2, 3, 3) is workspace."""
    row, column = place[a], place[b]
    by_a, by_b = moves.beside[a], moves.beside[b]
    for i in range(3):
        for j in range(3):
            room[0, i, j] = covariance[row, column, i, j]
            if by_a >= 0:
                room[1, i, j] = covariance[place[by_a], column, i, j]
    if by_b >= 0:
        for i in range(3):
            for j in range(3):
                for m in range(3):
                    room[0, i, j] += covariance[row, place[by_b], i, m] * moves.gain[b, j, m]
                    if by_a >= 0:
                        of_both = covariance[place[by_a], place[by_b], i, m]
                        room[1, i, j] += of_both * moves.gain[b, j, m]
    for i in range(3):
        for j in range(3):
            value = room[0, i, j]
            if by_a >= 0:
                for m in range(3):
                    value += moves.gain[a, i, m] * room[1, m, j]
            value *= moves.left[a, i] * moves.left[b, j]
            covariance[row, column, i, j] = covariance[column, row, j, i] = value


def moved_shares(shares: FloatArray, place: IntArray, moves: Moves) -> FloatArray:
    """The shares (n, 3, k) of copies after a transition; copies do not change."""
    out: FloatArray = shares.copy()
    bodies = np.flatnonzero(moves.beside >= 0)
    out[place[bodies]] += moves.gain[bodies] @ shares[place[moves.beside[bodies]]]
    waning = np.flatnonzero((moves.left != 1.0).any(axis=1))
    out[place[waning]] *= moves.left[waning, :, None]
    return out
