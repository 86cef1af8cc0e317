"""The sparse filter: errors of bodies and parameters, a Gaussian on the chordal pattern of recent pairs.

Low-rank correction: errors that far bodies share, through copies of the errors of some bodies.

    x_i = G_i a + y_i,

where a are independent combinations, of unit variance, of the errors of the copies, and y is independent of a
and represented by the factor. Measurements of x have information T about y, T G about both, and G^T T G about
a: y is eliminated with T G on the right-hand side, and a is one dense block at the end.

Covariances of each body with its own parameters, and their changes since the newest factor.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, reassociated_njit
from swarm_loc_estimator.common.numerics import invert_factor
from swarm_loc_estimator.filter.joint_filter import Robots
from swarm_loc_estimator.filter.sparse import parameters
from swarm_loc_estimator.filter.sparse.factor import (
    EMPTY,
    Derived,
    Factor,
    Prior,
    add_rows,
    eliminate,
    solve,
    with_derived,
    write_fronts,
    write_rows,
)
from swarm_loc_estimator.filter.sparse.ordering import (
    Ordering,
    Pattern,
    Situation,
    ordered,
    spread,
    wanted_rows,
)
from swarm_loc_estimator.swarm.calibration_states import BLOCKS, DRIVES, ParameterTable

_DRIVEN = slice(3, 3 + DRIVES)


class Marginals:
    """The marginal covariance of each body with its parameters, as predictions change it."""

    def __init__(self, groups: parameters.Groups) -> None:
        self.groups = groups  # Which bodies have blocks of parameters
        count, width = groups.owner.size, _width(groups)
        # (n, w, w) and (robots, 3 + BLOCKS, DRIVES), see `JointFilter`
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

    def append_columns(self, groups: parameters.Groups) -> None:
        """Append bodies or blocks, without error."""
        self.groups, transition = groups, _no_transition(groups)
        transition[: len(self.transition)] = self.transition
        self.current, self._settled = (_enlarged(one, groups) for one in (self.current, self._settled))
        self.transition = transition

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

    def since(self, bodies: IntArray, places: FloatArray) -> tuple[FloatArray, parameters.Moves]:
        """Changes of the errors of bodies (k,) since the newest factor, about reference points (n, 2).

        Returns:
            Process noise (k, w, w) of bodies and parameters, and the transition.
        """
        count, before = self.groups.owner.size, self._settled[bodies]
        adjoint = parameters.translation_adjoints(places[bodies])
        moves = parameters.Moves(np.full(count, -1), np.zeros((count, 3, 3)), np.ones((count, 3)))
        if (bodies < len(self.transition)).any():
            of_robots = np.flatnonzero(bodies < len(self.transition))
            robots, own = bodies[of_robots], np.arange(3, before.shape[1])
            transition, blocks = self.transition[robots], self.groups.member[robots, 1:]
            follow = np.tile(np.eye(before.shape[1]), (bodies.size, 1, 1))
            follow[of_robots, :3, _DRIVEN] = transition[:, :3]
            follow[of_robots[:, None], own, own] = transition[:, 3:].reshape(robots.size, -1)[:, : own.size]
            before = follow @ before @ follow.transpose(0, 2, 1)
            moved = transition[:, :3].any(axis=(1, 2))
            moves.beside[robots[moved]] = blocks[moved, 0]
            moves.gain[robots] = adjoint[of_robots] @ transition[:, :3]
            moves.left[blocks[blocks >= 0]] = transition[:, 3:][blocks >= 0]
        noise = self.current[bodies] - before
        noise[:, :3] = adjoint @ noise[:, :3]
        noise[:, :, :3] = noise[:, :, :3] @ adjoint.transpose(0, 2, 1)
        return noise, moves


def _width(groups: parameters.Groups) -> int:
    """Columns of a body with its parameters, up to the last block that any robot has."""
    return 3 * (1 + int(np.flatnonzero((groups.member >= 0).any(axis=0)).max(initial=0)))


def _enlarged(known: FloatArray, groups: parameters.Groups) -> FloatArray:
    """Covariances (n, w, w) with more bodies and blocks, without error."""
    out = np.zeros((groups.owner.size, _width(groups), _width(groups)))
    out[: len(known), : known.shape[1], : known.shape[1]] = known
    return out


def _no_transition(groups: parameters.Groups) -> FloatArray:
    """The identity transition; for no robot where there are no parameters."""
    robots = len(groups.member) if _width(groups) > 3 else 0
    return np.tile(np.vstack([np.zeros((3, DRIVES)), np.ones((BLOCKS, DRIVES))]), (robots, 1, 1))


def derived_by(
    moves: parameters.Moves, robot: int, blocks: IntArray, noise: FloatArray, numbers: IntArray
) -> list[Derived]:
    """The blocks and then the pose of one robot after a transition, to be appended.

    Of its blocks (BLOCKS,) the first one changes its pose. The process noise (w, w) of pose and blocks is
    diagonal within it. `numbers` (2 + BLOCKS,) are of the pose and the blocks before, and of the next body. A
    block or number of -1: none.
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


_COPY_SPREAD = np.diag(np.square([3e-5, 3e-5, 3e-4]))  # Variance of a copy given its body [m^2, m^2, rad^2]
_PANELS = 4  # Number of panels of a product


def with_derived_shares(shares: FloatArray, derived: tuple[Derived, ...]) -> FloatArray:
    """G (n, 3, k) with the shares of more bodies appended."""
    if not derived:
        return shares
    out = np.concatenate([shares, np.zeros((len(derived), *shares.shape[1:]))])
    for k, one in enumerate(derived):
        others = out[one.others].reshape(3 * one.others.size, shares.shape[2])
        out[len(shares) + k] = one.gain.T @ others
    return out


def renewed(factor: Factor, shares: FloatArray, copied: IntArray) -> FloatArray:
    """G (n, 3, k) of new copies of bodies (m,), which replace the old copies.

    k is 3 m: with fewer combinations, covariances of robots with a single landmark are too small.
    """
    count, size = factor.pattern.front.size, 3 * copied.size
    columns = (3 * copied[:, None] + np.arange(3)).reshape(-1)
    across = np.zeros((3 * count, size))
    across[columns, np.arange(size)] = 1.0
    solve(factor, across)
    before = shares.reshape(3 * count, -1)
    across += before @ before[columns].T
    covariance = across[columns] + np.kron(np.eye(copied.size), _COPY_SPREAD)
    _whiten(across, covariance)
    return across.reshape(count, 3, size)


def updated(
    factor: Factor, shares: FloatArray, measured: parameters.Information
) -> tuple[FloatArray, FloatArray]:
    """G (n, 3, k) after measurements, by that before and the factor of y after; the correction (n, 3)."""
    count, _, size = shares.shape
    before, gradient = shares.reshape(3 * count, size), measured.gradient.reshape(-1)
    right = np.empty((3 * count, size + 1))
    right[:, size] = gradient
    _weigh(measured, before, right)
    weighted = right[:, :size].copy()
    solve(factor, right)
    after, correction = before - right[:, :size], right[:, size]
    if size:
        # I + (T G)^T G after, of which the lower triangle is used: in panels that skip part of the upper one
        product = np.zeros((size, size))
        for panel in np.array_split(np.arange(size), min(_PANELS, size)):
            begin, end = panel[0], panel[-1] + 1
            np.matmul(weighted[:, begin:].T, after[:, begin:end], out=product[begin:, begin:end])
        _whiten(after, np.eye(size) + product)
        correction = correction + after @ (after.T @ gradient)
    return after.reshape(count, 3, size), correction.reshape(count, 3)


def _whiten(columns: FloatArray, matrix: FloatArray) -> None:
    """Multiply columns (n, k) by K^-T, in place, where K K^T is a matrix (k, k) by its lower triangle.

    Uses the inverse of K: the product takes half the time of solving with this many columns. Raises
    LinAlgError if the matrix is not positive definite.
    """
    if matrix.size:
        inverse = np.array(matrix, order="F")
        if not invert_factor(inverse.reshape(-1, order="F"), len(inverse)):
            raise np.linalg.LinAlgError("the covariance of the copies is not positive definite")
        scipy.linalg.blas.dtrmm(1.0, inverse, columns.T, lower=1, overwrite_b=1)


@cached_njit
def _weigh(measured: parameters.Information, shares: FloatArray, out: FloatArray) -> None:
    """Write T G to the first columns of `out` (3 n, k + 1) for G (3 n, k)."""
    size = shares.shape[1]
    out[:, :size] = 0.0
    for k in range(measured.first.size):
        row, column, block = 3 * measured.first[k], 3 * measured.second[k], measured.block[k]
        for i in range(3):
            add_rows(shares[column : column + 3], block[i, 0], block[i, 1], block[i, 2], out[row + i, :size])
            if row != column:
                other = out[column + i, :size]
                add_rows(shares[row : row + 3], block[0, i], block[1, i], block[2, i], other)


@reassociated_njit
def shared(shares: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """Covariances (m, 3, 3) of pairs of bodies (m,) through the copies."""
    out = np.zeros((first.size, 3, 3))
    for k in range(first.size):
        for i in range(3):
            for j in range(3):
                total = 0.0
                for c in range(shares.shape[2]):
                    total += shares[first[k], i, c] * shares[second[k], j, c]
                out[k, i, j] = total
    return out


@cached_njit
def change_shared(
    covariance: FloatArray, pattern: Pattern, place: IntArray, old: FloatArray, new: FloatArray
) -> None:
    """Change the covariances (n, n, 3, 3) of y from old to new copies, by G (n, 3, k), of a pattern's pairs.

    `place` has the numbers of the pattern's bodies in `covariance`.
    """
    for f in range(pattern.pivot_begin.size - 1):
        pivots = place[pattern.pivot[pattern.pivot_begin[f] : pattern.pivot_begin[f + 1]]]
        border = place[pattern.border[pattern.border_begin[f] : pattern.border_begin[f + 1]]]
        bodies = np.concatenate((border, pivots))
        change = np.dot(_rows(old, bodies), _rows(old, pivots).T)
        change -= np.dot(_rows(new, bodies), _rows(new, pivots).T)
        for r in range(bodies.size):
            for c in range(pivots.size):
                for i in range(3):
                    for j in range(3):
                        value = covariance[bodies[r], pivots[c], i, j] + change[3 * r + i, 3 * c + j]
                        covariance[bodies[r], pivots[c], i, j] = value
                        if r < border.size:
                            covariance[pivots[c], bodies[r], j, i] = value


@cached_njit
def _rows(shares: FloatArray, bodies: IntArray) -> FloatArray:
    """The shares (3 m, k) of some bodies (m,)."""
    out = np.empty((3 * bodies.size, shares.shape[2]))
    for r in range(bodies.size):
        out[3 * r : 3 * r + 3] = shares[bodies[r]]
    return out


# The constants below are checked by `make bench-scaling`, which compares with the exact filter.
_COPIES = 64  # Maximum number of bodies that are copied
_COPIED_SHARE = 4  # At most one of this number of bodies is copied
_COPIED_AGAIN = 100
"""Updates after which other bodies are copied: copies become stale, but each change loses correlations."""
_PAIRS_KEPT, _PAIRS_KEPT_WITH_BLOCKS = 3, 2
"""Updates whose pairs count as neighbours, without and with blocks of parameters."""
_FAR_M = 20.0  # Distance from its reference point beyond which the error of a body gets a new reference point
_NOBODY: IntArray = np.zeros(0, dtype=np.int64)


class _Prepared(NamedTuple):
    """The pattern of an update, covariances and shares of copies before it, and the active bodies."""

    pattern: Pattern
    prior: Prior
    shares: FloatArray
    active: IntArray

    def covariance_of(self, first: IntArray, second: IntArray) -> FloatArray:
        """Covariances (k, 3, 3) of pairs of the pattern."""
        places, covariance = self.prior.place, self.prior.covariance
        return covariance[places[first], places[second]] + shared(self.shares, first, second)


class SparseFilter:
    """Errors of bodies; those of bodies that are not neighbours are correlated through others.

    Each body, and each block of a robot's parameters, has three columns.

    Args:
        table: Columns in blocks; each starts independent, with unit variance.
    """

    is_dense = False

    def __init__(self, table: ParameterTable) -> None:
        count = table.filter_size // 3
        self.covariance: FloatArray = np.zeros((0, 0))
        self._marginals = Marginals(parameters.Groups.of(table))
        self._place: FloatArray = np.zeros((count, 2))
        self._number: IntArray = np.full(count, -1)
        self._factor = EMPTY
        self._shares: FloatArray = np.zeros((0, 3, 0))
        self._new: tuple[Derived, ...] = ()
        self._pairs: tuple[IntArray, ...] = ()
        self._ordering: Ordering | None = None
        self._updates = 0
        self._prepared: _Prepared | None = None
        self._workspace = _Workspace(count)

    def copy(self) -> SparseFilter:
        """An independent copy; factors are shared, since they are never written to."""
        other = SparseFilter.__new__(SparseFilter)
        copied = {name: vars(self)[name].copy() for name in ("_marginals", "_place", "_number")}
        vars(other).update(vars(self) | copied | {"_prepared": None})
        return other

    @property
    def marginal(self) -> FloatArray:
        """See `JointFilter`."""
        return self._marginals.current

    @property
    def transition(self) -> FloatArray:
        """See `JointFilter`."""
        return self._marginals.transition

    @property
    def _groups(self) -> parameters.Groups:
        return self._marginals.groups

    def set_prior(self, columns: IntArray, covariance: FloatArray) -> None:
        """Give columns (k,) this covariance (k, k), independent of all others."""
        if columns.size and self._groups.part[columns[0] // 3]:
            blocks, variances = columns // 3, np.diag(covariance)
            for block in np.unique(blocks).tolist():
                here = blocks == block
                self._set_parameter_priors(columns[here], variances[here])
        elif columns.size:
            self.set_body_priors(columns[:1] // 3, covariance[None])

    def _set_parameter_priors(self, columns: IntArray, variances: FloatArray) -> None:
        """Give parameters (k,) of one block these variances; its other parameters do not change."""
        (robot, own), block = self._groups.columns(columns), columns[:1] // 3
        spread, kept = np.ones(3), np.ones(3)
        kept[columns % 3] = 0.0
        if self._number[block[0]] < 0:
            others, gain = _NOBODY, np.zeros((0, 3))
        else:
            self._take_in(robot)
            others, gain, spread = self._number[block], np.diag(kept), np.zeros(3)
        spread[columns % 3] = variances
        self._append(block, [Derived(others, gain, np.diag(spread))])
        self._marginals.set_prior(np.array([robot]), own, np.diag(variances)[None])

    def set_body_priors(self, bodies: IntArray, covariances: FloatArray) -> None:
        """Give bodies (k,) covariances (k, 3, 3), each independent of all others."""
        self._place[bodies] = parameters.centres(covariances)
        own = parameters.carried(self._place[bodies], covariances)
        self._append(bodies, [Derived(_NOBODY, np.zeros((0, 3)), one) for one in own])
        self._marginals.set_prior(bodies, np.arange(3), covariances)

    def _append(self, bodies: IntArray, derived: Sequence[Derived]) -> None:
        self._number[bodies] = self._next_number + np.arange(len(derived))
        self._new += tuple(derived)

    @property
    def _next_number(self) -> int:
        return self._factor.pattern.front.size + len(self._new)

    def add(self, columns: IntArray, covariance: FloatArray) -> None:
        """Add a covariance (k, k) to that of columns (k,)."""
        if columns.size:
            body, own = self._groups.columns(columns)
            self.marginal[body, own[:, None], own] += covariance

    def append_columns(self, table: ParameterTable) -> None:
        """Append the additional columns of a table, without error; their prior is set next."""
        more = table.filter_size // 3 - self._number.size
        self._marginals.append_columns(parameters.Groups.of(table))
        self._place = np.concatenate([self._place, np.zeros((more, 2))])
        self._number = np.concatenate([self._number, np.full(more, -1)])
        self._ordering = None

    def correlate(self, columns: IntArray, others: IntArray, mapping: FloatArray) -> None:
        """Add the errors of other bodies' columns (m,), mapped by (3, m), to those of a body just appended.

        Until the next update its marginal assumes that the other bodies have the same error.
        """
        if others.size == 0:
            return
        body, bodies = int(columns[0]) // 3, others[::3] // 3
        placed, self._new = self._new[-1], self._new[:-1]
        for other in np.unique(bodies).tolist():
            self._take_in(other)
        adjoint = parameters.translation_adjoints(self._place[[body]])[0]
        back = parameters.translation_adjoints(-self._place[bodies])
        shares = adjoint @ mapping.reshape(3, -1, 3).transpose(1, 0, 2) @ back
        alike = np.linalg.cholesky(parameters.carried(self._place[bodies], self.marginal[bodies, :3, :3]))
        common = np.sum(shares @ alike, axis=0)
        gain = shares.transpose(0, 2, 1).reshape(-1, 3)
        self._append(columns[:1] // 3, [Derived(self._number[bodies], gain, placed.spread)])
        more = parameters.carried(-self._place[[body]], (common @ common.T)[None])
        own = self.marginal[[body], :3, :3] + more
        self._marginals.set_prior(np.array([body]), np.arange(3), own)

    def _take_in(self, body: int) -> None:
        """Append a body with the changes of its error since the newest factor, for others to share."""
        noise, moves = self._marginals.since(np.array([body]), self._place)
        if not noise.any() and not moves.any():
            return
        is_robot = body < len(self.transition)
        blocks = self._groups.member[body] if is_robot else np.array([body] + BLOCKS * [-1])
        numbers = np.where(blocks >= 0, self._number[blocks], -1)
        derived = derived_by(moves, int(body), blocks[1:], noise[0], np.append(numbers, self._next_number))
        present = blocks[[*range(1, 1 + BLOCKS), 0]]
        self._append(present[(present >= 0) & (self._number[present] >= 0)], derived)
        self._marginals.settle(np.array([body]))

    def block(self, columns: IntArray) -> FloatArray:
        """Covariance (k, k) of columns (k,) of a body or of one robot's parameters; (0, 0) of none."""
        if columns.size == 0:
            return np.zeros((0, 0))
        body, own = self._groups.columns(columns)
        return np.asarray(self.marginal[body][np.ix_(own, own)])

    def prepare_update(self, columns: IntArray, robots: Robots, cross_covariance: FloatArray) -> None:
        """Write covariances (m, 3, 6) between bodies, see `JointFilter`; undefined where there are none."""
        tied = (columns[:, :2] >= 0).all(axis=1)
        bodies = columns // 3
        prepared = self._prepare(bodies[tied, :2], robots)
        cross_covariance[tied, :, :3] = self._about_map(prepared.covariance_of, *bodies[tied, :2].T)
        seen = (columns[:, 1:] >= 0).all(axis=1)
        cross_covariance[seen, :, 3:] = self._about_map(prepared.covariance_of, *bodies[seen, 1:].T)

    def _prepare(self, pairs: IntArray, robots: Robots) -> _Prepared:
        """Compute the covariances of a pattern that contains pairs (k, 2)."""
        count = robots.active.size
        # landmarks stay at their reference points
        places = np.concatenate([robots.places, self._place[count:]])
        active = np.flatnonzero(np.concatenate([robots.active, self._number[count:] >= 0]))
        bodies = active[self._groups.part[active] == 0]
        self._move_far(bodies, places)
        factor, shares = with_derived(self._factor, self._new), with_derived_shares(self._shares, self._new)
        pattern = self._pattern(pairs, active, places)
        noise, moves = self._marginals.since(bodies, self._place)
        rows = wanted_rows(factor.pattern, pattern, self._number, len(self._new), moves.beside)
        covariance = self._workspace.with_fronts(self._factor, len(self._new))
        write_rows(factor, len(self._new), *rows, covariance)
        self._workspace.holds = None  # since noise is added to it
        others = None
        if self._updates % _COPIED_AGAIN == 0:
            copied = bodies[spread(places[bodies], min(_COPIES, bodies.size // _COPIED_SHARE))]
            others = renewed(factor, shares, self._number[copied])
        if moves.any():
            parameters.move(covariance, pattern, self._number, moves)
            shares = parameters.moved_shares(shares, self._number, moves)
            others = None if others is None else parameters.moved_shares(others, self._number, moves)
        if others is not None:
            change_shared(covariance, pattern, self._number, shares, others)
            shares = others
        self._updates += 1
        for (row, column), of, first, second in self._marginals.within(bodies):  # of bodies and their blocks
            covariance[self._number[first], self._number[second]] += noise[of, row, column]
        prior = Prior(covariance, self._number)
        numbers = self._number[active]
        if not np.array_equal(numbers, np.arange(self._number.size)):  # else all are active, as before
            shares, of_numbers = np.zeros((self._number.size, 3, shares.shape[2])), shares
            shares[active] = of_numbers[numbers]  # by body
        self._prepared = _Prepared(pattern, prior, shares, active)
        return self._prepared

    def _move_far(self, active: IntArray, places: FloatArray) -> None:
        """Move the reference points of bodies that are far from them to their present positions."""
        moved = places[active] - self._place[active]
        far = active[np.hypot(moved[:, 0], moved[:, 1]) > _FAR_M]
        turns = parameters.translation_adjoints(places[far] - self._place[far])
        for body, turn in zip(far[:, None], turns, strict=True):
            self._append(body, [Derived(self._number[body], turn.T.copy(), np.zeros((3, 3)))])
        self._place[far] = places[far]

    def _pattern(self, pairs: IntArray, active: IntArray, places: FloatArray) -> Pattern:
        """A pattern that contains all these pairs (k, 2), by the present order or a new one."""
        here = np.zeros(self._number.size, dtype=bool)
        here[active] = True
        kept = _PAIRS_KEPT_WITH_BLOCKS if self._groups.part.any() else _PAIRS_KEPT
        self._pairs = (*self._pairs[1 - kept :], pairs)
        recent = np.concatenate(self._pairs)
        recent = recent[here[recent].all(axis=1)]
        pairs = np.concatenate([recent, parameters.block_pairs(self._groups, here, recent)])
        bodies = active[self._groups.part[active] == 0]
        situation = Situation(bodies, parameters.active_blocks(self._groups, here), places, pairs)
        self._ordering = ordered(situation, self._ordering)
        return self._ordering.pattern

    def _about_map(
        self, covariance_of: Callable[[IntArray, IntArray], FloatArray], first: IntArray, second: IntArray
    ) -> FloatArray:
        """Covariances (k, 3, 3) of pairs, with errors about the origin of `map` as in the columns."""
        return parameters.carried_pairs(
            -self._place[first], covariance_of(first, second), -self._place[second]
        )

    def update(
        self, columns: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
    ) -> FloatArray:
        """Fuse measurements (m,) whose pairs are prepared, see `JointFilter`; return the correction (n,)."""
        if self._prepared is None:
            raise RuntimeError("call prepare_update before update")
        (pattern, prior, shares, active), self._prepared = self._prepared, None
        measured = parameters.summed(
            parameters.information_of(columns, jacobian, innovation, noise, self._place)
        )
        self._factor = eliminate(pattern, prior, measured)
        self._shares, correction = updated(self._factor, shares, measured)
        count, self._new = self._number.size, ()
        self._number = np.full(count, -1)
        self._number[active] = active
        # Marginals of the newest factor and copies.
        covariance = self._workspace.with_fronts(self._factor)
        bodies = active[self._groups.part[active] == 0]
        for (row, column), of, first, second in self._marginals.within(bodies):
            own = covariance[first, second] + shared(self._shares, first, second)
            own = parameters.carried_pairs(-self._place[first], own, -self._place[second])
            self.marginal[bodies[of], row, column] = own
        self._marginals.settle(bodies)
        moved = np.einsum(
            "nij,nj->ni", parameters.translation_adjoints(-self._place[active]), correction[active]
        )
        out = np.zeros((count, 3))
        out[active] = moved
        return out.reshape(-1)


class _Workspace:
    """Covariances between two updates of some bodies at first, shared by a filter and all its copies."""

    def __init__(self, bodies: int) -> None:
        self._blocks: FloatArray = np.zeros((0, 0, 3, 3))
        self.holds: Factor | None = None  # The factor whose fronts are written there
        self._make(bodies)

    def with_fronts(self, factor: Factor, more: int = 0) -> FloatArray:
        """Array (n, n, 3, 3) with the covariances within all fronts of a factor; other entries are undefined.

        It has space for `more` bodies than the factor has.
        """
        bodies = factor.pattern.front.size + more
        if len(self._blocks) < bodies:
            self._make(bodies)
        if factor is not self.holds:
            write_fronts(factor, self._blocks)
            self.holds = factor
        return self._blocks

    def _make(self, bodies: int) -> None:
        size = bodies + bodies // 8
        self._blocks, self.holds = np.zeros((size, size, 3, 3)), None
        self._blocks.fill(0.0)  # touch the memory now rather than while data arrive
