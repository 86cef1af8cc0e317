"""Parameters of robots in the sparse filter: blocks of three columns that change the error of their pose.

Between two updates the errors x of a robot's pose and z of the parameters of its motion become

    x + A z + w,    L z + v,    L diagonal,

where the noises w and v may be correlated. Blocks are eliminated before all bodies, those of each robot in
one front, whose border is the robot and what it has measured recently.

Errors about a reference point of each body, well-conditioned also far from the origin of `map`.

The filter's columns are right-invariant errors xi, twists about the origin of `map`, in which a small heading
error moves a far body by much. Here they are eta = Ad(r) xi, twists about a reference point r near the body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.numerics import cholesky3, solve3
from swarm_loc_estimator.filter.sparse.ordering import Order, Pattern
from swarm_loc_estimator.swarm.calibration_states import BLOCKS, DRIVES, ParameterTable


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
    return across / covariances[:, 2, 2, None]


@cached_njit
def information_of(
    columns: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray, places: FloatArray
) -> Information:
    """Information of measurements (m,) about bodies, each about its reference point (n, 2).

    The columns (m, c) that each depends on are those of two bodies, then some of one block of parameters; the
    Jacobian (m, 3, c) is zero where there is no body.
    """
    measurements, count = columns.shape[0], 0
    first, second = np.empty(6 * measurements, dtype=np.int64), np.empty(6 * measurements, dtype=np.int64)
    block, gradient = np.zeros((6 * measurements, 3, 3)), np.zeros((len(places), 3))
    by, weighted, bodies = np.empty((3, 3, 3)), np.empty((3, 3, 3)), np.empty(3, dtype=np.int64)
    for k in range(measurements):
        factor = cholesky3(noise[k])
        for side in range(2):
            # by eta instead of xi, with the components as columns
            bodies[side], own = columns[k, 3 * side] // 3, jacobian[k, :, 3 * side : 3 * side + 3]
            place = places[bodies[side]]
            for i in range(3):
                by[side, 0, i], by[side, 1, i] = own[i, 0], own[i, 1]
                by[side, 2, i] = own[i, 2] + place[1] * own[i, 0] - place[0] * own[i, 1]
        bodies[2] = -1  # the block of parameters
        for c in range(6, columns.shape[1]):
            if jacobian[k, 0, c] != 0.0 or jacobian[k, 1, c] != 0.0 or jacobian[k, 2, c] != 0.0:
                if bodies[2] < 0:
                    by[2] = 0.0
                bodies[2] = columns[k, c] // 3
                for i in range(3):
                    by[2, columns[k, c] % 3, i] = jacobian[k, i, c]
        sides = 3 if bodies[2] >= 0 else 2
        for side in range(sides):
            for a in range(3):
                solve3(factor, by[side, a], weighted[side, a])
        for side in range(sides):
            body = bodies[side]
            if not by[side].any():
                continue
            for a in range(3):
                for i in range(3):
                    gradient[body, a] += weighted[side, a, i] * innovation[k, i]
            for other in range(side + 1):
                if by[other].any():
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
    newest, pairs = np.full(bodies, -1), 0
    before, kept, place_of = np.empty((3, count), dtype=np.int64)
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

    `active` (n,) are bodies and blocks, `measured` (m, 2) observers and what they have measured, all active.
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
    """Apply a transition to the covariances (n, n, 3, 3) of all pairs of a pattern.

    They include the pairs of the blocks that change a body; `place` has the numbers of the pattern's bodies.
    """
    room = np.empty((2, 3, 3))
    # blocks change after the bodies that depend on them: pairs of two such bodies first, then of one, of none
    for moved in (2, 1, 0):
        for f in range(pattern.pivot_begin.size - 1):
            border = pattern.border[pattern.border_begin[f] : pattern.border_begin[f + 1]]
            for k in range(pattern.pivot_begin[f], pattern.pivot_begin[f + 1]):
                a = pattern.pivot[k]
                for others in (pattern.pivot[k : pattern.pivot_begin[f + 1]], border):
                    for b in others:
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
