"""The sparse filter: errors of bodies and parameters, a Gaussian on the chordal pattern of recent pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.joint_filter import Robots
from swarm_loc_estimator.filter.sparse import low_rank_correction as copies
from swarm_loc_estimator.filter.sparse.elimination import Prior, eliminate
from swarm_loc_estimator.filter.sparse.factor import (
    EMPTY,
    Derived,
    Factor,
    with_derived,
    write_fronts,
    write_rows,
)
from swarm_loc_estimator.filter.sparse.marginals import Marginals, derived_by
from swarm_loc_estimator.filter.sparse.neighbours import spread
from swarm_loc_estimator.filter.sparse.ordering import Ordering, Situation, ordered
from swarm_loc_estimator.filter.sparse.parameters import (
    Groups,
    active_blocks,
    block_pairs,
    move,
    moved_shares,
)
from swarm_loc_estimator.filter.sparse.symbolic import Pattern, wanted_rows
from swarm_loc_estimator.filter.sparse.translation_adjoint import (
    carried,
    carried_pairs,
    centres,
    information_of,
    summed,
    translation_adjoints,
)
from swarm_loc_estimator.swarm.calibration_states import BLOCKS, ParameterTable

_COPIES = 64
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
        return covariance[places[first], places[second]] + copies.shared(self.shares, first, second)


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
        self._marginals = Marginals(Groups.of(table))
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
    def _groups(self) -> Groups:
        """The blocks of each body."""
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
        self._place[bodies] = centres(covariances)
        own = carried(self._place[bodies], covariances)
        self._append(bodies, [Derived(_NOBODY, np.zeros((0, 3)), one) for one in own])
        self._marginals.set_prior(bodies, np.arange(3), covariances)

    def _append(self, bodies: IntArray, derived: Sequence[Derived]) -> None:
        """Append new bodies (k,)."""
        self._number[bodies] = self._next_number + np.arange(len(derived))
        self._new += tuple(derived)

    @property
    def _next_number(self) -> int:
        """The number of the next body to append."""
        return self._factor.pattern.front.size + len(self._new)

    def add(self, columns: IntArray, covariance: FloatArray) -> None:
        """Add a covariance (k, k) to that of columns (k,)."""
        if columns.size:
            body, own = self._groups.columns(columns)
            self.marginal[body, own[:, None], own] += covariance

    def append_columns(self, table: ParameterTable) -> None:
        """Append the additional columns of a table, without error; their prior is set next."""
        more = table.filter_size // 3 - self._number.size
        self._marginals.append_columns(Groups.of(table))
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
        adjoint, back = (
            translation_adjoints(self._place[[body]])[0],
            translation_adjoints(-self._place[bodies]),
        )
        shares = adjoint @ mapping.reshape(3, -1, 3).transpose(1, 0, 2) @ back
        alike = np.linalg.cholesky(carried(self._place[bodies], self.marginal[bodies, :3, :3]))
        common = np.sum(shares @ alike, axis=0)
        gain = shares.transpose(0, 2, 1).reshape(-1, 3)
        self._append(columns[:1] // 3, [Derived(self._number[bodies], gain, placed.spread)])
        more = carried(-self._place[[body]], (common @ common.T)[None])
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
        covariance: FloatArray = self.marginal[body][np.ix_(own, own)]
        return covariance

    def prepare_update(self, columns: IntArray, robots: Robots, cross_covariance: FloatArray) -> None:
        """Write the covariances between the bodies of measurements (m,), before an update with them.

        Args:
            columns: (m, 3) first columns of observers, targets and observers' cameras; -1: none.
            robots: Positions of all robots.
            cross_covariance: (m, 3, 5) written: of observers with targets, and of targets with cameras;
                undefined where there is none.
        """
        tied = (columns[:, :2] >= 0).all(axis=1)
        bodies = columns // 3
        prepared = self._prepare(bodies[tied, :2], robots)
        cross_covariance[tied, :, :3] = self._about_map(prepared.covariance_of, *bodies[tied, :2].T)
        seen = (columns[:, 1:] >= 0).all(axis=1)
        cross_covariance[seen, :, 3:] = self._about_map(prepared.covariance_of, *bodies[seen, 1:].T)[:, :, :2]

    def _prepare(self, pairs: IntArray, robots: Robots) -> _Prepared:
        """Compute the covariances of a pattern that contains pairs (k, 2)."""
        count = robots.active.size
        # landmarks stay at their reference points
        places = np.concatenate([robots.places, self._place[count:]])
        active = np.flatnonzero(np.concatenate([robots.active, self._number[count:] >= 0]))
        bodies = active[self._groups.part[active] == 0]
        self._move_far(bodies, places)
        factor, shares = with_derived(self._factor, self._new), copies.with_derived(self._shares, self._new)
        pattern = self._pattern(pairs, active, places)
        noise, moves = self._marginals.since(bodies, self._place)
        rows = wanted_rows(factor.pattern, pattern, self._number, len(self._new), moves.beside)
        covariance = self._workspace.with_fronts(self._factor, len(self._new))
        write_rows(factor, len(self._new), *rows, covariance)
        self._workspace.holds = None  # since noise is added to it
        others = None
        if self._updates % _COPIED_AGAIN == 0:
            copied = bodies[spread(places[bodies], min(_COPIES, bodies.size // _COPIED_SHARE))]
            others = copies.renewed(factor, shares, self._number[copied])
        if moves.any():
            move(covariance, pattern, self._number, moves)
            shares = moved_shares(shares, self._number, moves)
            others = None if others is None else moved_shares(others, self._number, moves)
        if others is not None:
            copies.change_shared(covariance, pattern, self._number, shares, others)
            shares = others
        self._updates += 1
        self._add_noise(covariance, bodies, noise)
        prior = Prior(covariance, self._number)
        self._prepared = _Prepared(pattern, prior, self._by_body(shares, active), active)
        return self._prepared

    def _add_noise(self, covariance: FloatArray, bodies: IntArray, noise: FloatArray) -> None:
        """Add the process noise of bodies (k,) and their blocks to covariances by number."""
        for (row, column), of, first, second in self._marginals.within(bodies):
            covariance[self._number[first], self._number[second]] += noise[of, row, column]

    def _by_body(self, shares: FloatArray, active: IntArray) -> FloatArray:
        """Shares of copies (n, 3, r) of all bodies, from those by number."""
        numbers = self._number[active]
        if np.array_equal(numbers, np.arange(self._number.size)):
            return shares  # all bodies are active, with unchanged numbers
        by_body = np.zeros((self._number.size, 3, shares.shape[2]))
        by_body[active] = shares[numbers]
        return by_body

    def _move_far(self, active: IntArray, places: FloatArray) -> None:
        """Move the reference points of bodies that are far from them to their present positions."""
        moved = places[active] - self._place[active]
        far = active[np.hypot(moved[:, 0], moved[:, 1]) > _FAR_M]
        turns = translation_adjoints(places[far] - self._place[far])
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
        pairs = np.concatenate([recent, block_pairs(self._groups, here, recent)])
        bodies = active[self._groups.part[active] == 0]
        situation = Situation(bodies, active_blocks(self._groups, here), places, pairs)
        self._ordering = ordered(situation, self._ordering)
        return self._ordering.pattern

    def _about_map(
        self, covariance_of: Callable[[IntArray, IntArray], FloatArray], first: IntArray, second: IntArray
    ) -> FloatArray:
        """Covariances (k, 3, 3) of pairs, with errors about the origin of `map` as in the columns."""
        return carried_pairs(-self._place[first], covariance_of(first, second), -self._place[second])

    def update(
        self, columns: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
    ) -> FloatArray:
        """Use many measurements with independent errors at once; return the correction (n,) of all columns.

        Their pairs must have been accepted to `prepare_update` before.

        Args:
            columns: (m, c) columns that each depends on, those of the two bodies first.
            jacobian: (m, 3, c) Jacobians; a zero row is a component that was not measured.
            innovation: (m, 3) measured minus predicted.
            noise: (m, 3, 3) covariance of the measurement.
        """
        if self._prepared is None:
            raise RuntimeError("call prepare_update before update")
        (pattern, prior, shares, active), self._prepared = self._prepared, None
        measured = summed(information_of(columns, jacobian, innovation, noise, self._place))
        self._factor = eliminate(pattern, prior, measured)
        self._shares, correction = copies.updated(self._factor, shares, measured)
        count = self._number.size
        self._number = np.full(count, -1)
        self._number[active] = active
        self._new = ()
        self._settle(active)
        moved = np.einsum("nij,nj->ni", translation_adjoints(-self._place[active]), correction[active])
        out = np.zeros((count, 3))
        out[active] = moved
        return out.reshape(-1)

    def _settle(self, active: IntArray) -> None:
        """Compute the marginals of the newest factor and copies."""
        covariance = self._workspace.with_fronts(self._factor)
        bodies = active[self._groups.part[active] == 0]
        for (row, column), of, first, second in self._marginals.within(bodies):
            own = covariance[first, second] + copies.shared(self._shares, first, second)
            own = carried_pairs(-self._place[first], own, -self._place[second])
            self.marginal[bodies[of], row, column] = own
        self._marginals.settle(bodies)


class _Workspace:
    """Covariances between two updates, shared by a filter and all its copies.

    Args:
        bodies: Initial number of bodies.

    Attributes:
        holds: The factor whose fronts are written there.
    """

    def __init__(self, bodies: int) -> None:
        self._blocks: FloatArray = np.zeros((0, 0, 3, 3))
        self.holds: Factor | None = None
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
