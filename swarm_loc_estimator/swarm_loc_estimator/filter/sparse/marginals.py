"""Covariances of each body with its own parameters, and their changes since the newest factor."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.sparse.factor import Derived
from swarm_loc_estimator.filter.sparse.parameters import Groups, Moves, translation_adjoints
from swarm_loc_estimator.swarm.calibration_states import BLOCKS, DRIVES

_DRIVEN = slice(3, 3 + DRIVES)


class Marginals:
    """The marginal covariance of each body with its parameters, as predictions change it.

    Args:
        groups: Which bodies have blocks of parameters.

    Attributes:
        groups: Which bodies have blocks of parameters.
        current: (n, w, w) see `JointFilter.marginal`.
        transition: (robots, 3 + BLOCKS, DRIVES) see `JointFilter.transition`.
    """

    def __init__(self, groups: Groups) -> None:
        self.groups = groups
        count, width = groups.owner.size, _width(groups)
        self.current: FloatArray = np.zeros((count, width, width))
        self.current[:, :3, :3] = np.eye(3)
        self._settled = self.current.copy()
        self.transition = _no_transition(groups)

    def copy(self) -> Marginals:
        """An independent copy."""
        other = Marginals.__new__(Marginals)
        arrays = {name: array.copy() for name, array in vars(self).items() if name != "groups"}
        vars(other).update(arrays | {"groups": self.groups})
        return other

    def append_columns(self, groups: Groups) -> None:
        """Append bodies or blocks, without error."""
        self.groups, transition = groups, _no_transition(groups)
        transition[: len(self.transition)] = self.transition
        self.current, self._settled, self.transition = (
            _enlarged(self.current, groups),
            _enlarged(self._settled, groups),
            transition,
        )

    def set_prior(self, bodies: IntArray, own: IntArray, covariances: FloatArray) -> None:
        """Give columns (c,) of bodies (k,) covariances (k, c, c), independent of their other columns."""
        for known in (self.current, self._settled):
            known[bodies[:, None], own], known[bodies[:, None], :, own] = 0.0, 0.0
            known[bodies[:, None, None], own[:, None], own] = covariances
        if own[0] < 3:
            self.transition[bodies[bodies < len(self.transition)], :3] = 0.0

    def settle(self, bodies: IntArray) -> None:
        """Take the present marginals of bodies (k,) as those of the newest factor."""
        self._settled[bodies] = self.current[bodies]
        robots = bodies[bodies < len(self.transition)]
        self.transition[robots, :3], self.transition[robots, 3:] = 0.0, 1.0

    def within(self, bodies: IntArray) -> Iterator[tuple[tuple[slice, slice], IntArray, IntArray, IntArray]]:
        """Pairs of parts of bodies (k,); a part is the body or one of its blocks.

        Yields:
            Rows and columns of both parts, indices (m,) into `bodies`, and the two parts (m,).
        """
        parts = range(self.current.shape[1] // 3)
        first = np.arange(bodies.size)
        yield (slice(3), slice(3)), first, bodies, bodies
        robots = np.flatnonzero(bodies < len(self.transition))
        member = self.groups.member[bodies[robots]]
        for row, column in itertools.product(parts, parts):
            there = (member[:, row] >= 0) & (member[:, column] >= 0)
            if row + column and there.any():
                where = slice(3 * row, 3 * row + 3), slice(3 * column, 3 * column + 3)
                yield where, robots[there], member[there, row], member[there, column]

    def since(self, bodies: IntArray, places: FloatArray) -> tuple[FloatArray, Moves]:
        """Changes of the errors of bodies (k,) since the newest factor, about reference points (n, 2).

        Returns:
            Process noise (k, w, w) of bodies and parameters, and the transition.
        """
        count, before, adjoint = (
            self.groups.owner.size,
            self._settled[bodies],
            translation_adjoints(places[bodies]),
        )
        moves = Moves(np.full(count, -1), np.zeros((count, 3, 3)), np.ones((count, 3)))
        if len(self.transition):
            of_robots = np.flatnonzero(bodies < len(self.transition))
            robots, own = bodies[of_robots], np.arange(3, before.shape[1])
            transition, blocks = self.transition[robots], self.groups.member[robots, 1:]
            follow = np.tile(np.eye(before.shape[1]), (bodies.size, 1, 1))
            follow[of_robots, :3, _DRIVEN] = transition[:, :3]
            follow[of_robots[:, None], own, own] = transition[:, 3:].reshape(robots.size, own.size)
            before = follow @ before @ follow.transpose(0, 2, 1)
            moved = transition[:, :3].any(axis=(1, 2))
            moves.beside[robots[moved]] = blocks[moved, 0]
            moves.gain[robots] = adjoint[of_robots] @ transition[:, :3]
            moves.left[blocks[blocks >= 0]] = transition[:, 3:][blocks >= 0]
        noise = self.current[bodies] - before
        noise[:, :3] = adjoint @ noise[:, :3]
        noise[:, :, :3] = noise[:, :, :3] @ adjoint.transpose(0, 2, 1)
        return noise, moves


def _width(groups: Groups) -> int:
    """Columns of a body with its parameters, or of the body alone where there are no parameters."""
    return 3 * (1 + BLOCKS) if (groups.member[:, 1:] >= 0).any() else 3


def _enlarged(known: FloatArray, groups: Groups) -> FloatArray:
    """Covariances (n, w, w) with more bodies and blocks, without error."""
    out = np.zeros((groups.owner.size, _width(groups), _width(groups)))
    out[: len(known), : known.shape[1], : known.shape[1]] = known
    return out


def _no_transition(groups: Groups) -> FloatArray:
    """The identity transition; for no robot where there are no parameters."""
    robots = len(groups.member) if _width(groups) > 3 else 0
    return np.tile(np.vstack([np.zeros((3, DRIVES)), np.ones((BLOCKS, DRIVES))]), (robots, 1, 1))


def derived_by(
    moves: Moves, robot: int, blocks: IntArray, noise: FloatArray, numbers: IntArray
) -> list[Derived]:
    """The blocks and the pose of one robot after a transition, to be appended.

    Args:
        moves: The transition.
        robot: The robot.
        blocks: (BLOCKS,) its blocks, of which the first one changes its pose; -1: none.
        noise: (w, w) process noise of the pose and the blocks; diagonal within the first block.
        numbers: (2 + BLOCKS,) of the pose and the blocks before, and of the next body; -1: none.

    Returns:
        The new blocks in their order, then the pose.
    """
    out: list[Derived] = []
    gain, left = moves.gain[robot], moves.left[blocks[0]]
    for k in range(1, 1 + BLOCKS):
        if numbers[k] >= 0:
            own = noise[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
            out.append(Derived(numbers[k : k + 1], np.diag(moves.left[blocks[k - 1]]), own))
    if numbers[0] < 0:
        return out
    if numbers[1] < 0:
        return [*out, Derived(numbers[:1], np.eye(3), noise[:3, :3])]
    variance = np.maximum(np.diag(noise)[3:6], 0.0)
    share = np.divide(noise[:3, 3:6], variance, out=np.zeros((3, 3)), where=variance > 0.0)
    weights = np.hstack([np.eye(3), gain - share * left, share])
    rest = noise[:3, :3] - (share * variance) @ share.T
    return [*out, Derived(numbers[[0, 1, -1]], weights.T.copy(), rest)]
