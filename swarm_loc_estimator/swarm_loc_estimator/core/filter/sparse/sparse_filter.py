"""The sparse filter: errors of bodies on a chordal pattern, which follows who sees whom."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.core.filter.joint_filter import Robots
from swarm_loc_estimator.core.filter.sparse import copies
from swarm_loc_estimator.core.filter.sparse.elimination import Prior, ProjectionMemory, eliminate
from swarm_loc_estimator.core.filter.sparse.factor import (
    EMPTY,
    Derived,
    Factor,
    with_derived,
    write_fronts,
    write_rows,
)
from swarm_loc_estimator.core.filter.sparse.levers import (
    carried,
    carried_pairs,
    centres,
    information_of,
    levers,
    summed,
)
from swarm_loc_estimator.core.filter.sparse.neighbours import spread
from swarm_loc_estimator.core.filter.sparse.ordering import Ordering, Situation, ordered
from swarm_loc_estimator.core.filter.sparse.symbolic import Pattern, wanted_rows
from swarm_loc_estimator.numerics.arrays import FloatArray, IntArray

_COPIES = 64
_COPIED_SHARE = 4
"""One of so many bodies is copied, at most."""
_COPIED_AGAIN = 25
"""Updates after which other bodies are copied."""
_PAIRS_KEPT = 3
"""Pairs of so many updates count as neighbours."""
_FAR_M = 20.0
"""A body so far from where its error is held about is held about another place."""


class _Prepared(NamedTuple):
    """What an update needs: the pattern, covariances and shares of copies before it, who is active.

    And the factor from which the covariances follow but for what is added; None: not from one alone.
    """

    pattern: Pattern
    prior: Prior
    shares: FloatArray
    active: IntArray
    origin: Factor | None


class SparseFilter:
    """Errors of bodies, of which those of bodies that are not neighbours are known through others.

    Args:
        size: Number of columns, three for each body; each starts with unit variance, independent.
    """

    calibrates = False
    sequential = False

    def __init__(self, size: int) -> None:
        count = size // 3
        self.covariance: FloatArray = np.zeros((0, 0))
        self.marginal: FloatArray = np.tile(np.eye(3), (count, 1, 1))
        self._settled = self.marginal.copy()
        self._place: FloatArray = np.zeros((count, 2))
        self._number: IntArray = np.full(count, -1)
        self._factor = EMPTY
        self._shares: FloatArray = np.zeros((0, 3, 0))
        self._new: tuple[Derived, ...] = ()
        self._pairs: tuple[IntArray, ...] = ()
        self._ordering: Ordering | None = None
        self._updates = 0
        self._prepared: _Prepared | None = None
        self._room = _Room(count)
        self._projections = ProjectionMemory()

    def copy(self) -> SparseFilter:
        """An independent copy; factors are shared, since they are never written to."""
        other = SparseFilter.__new__(SparseFilter)
        copied = {name: vars(self)[name].copy() for name in ("marginal", "_settled", "_place", "_number")}
        vars(other).update(vars(self) | copied | {"_prepared": None})
        return other

    def place(self, columns: IntArray, covariance: FloatArray) -> None:
        """Give a body's columns (3,) this covariance (3, 3), independent of the rest, whatever was known."""
        if columns.size:
            self.place_bodies(columns[:1] // 3, covariance[None])

    def place_bodies(self, bodies: IntArray, covariances: FloatArray) -> None:
        """Likewise the columns of bodies (k,), each with a covariance (k, 3, 3) of its own."""
        self._place[bodies] = centres(covariances)
        own = carried(self._place[bodies], covariances)
        nobody, nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        self._append(bodies, [Derived(nobody, nothing, one) for one in own])
        self.marginal[bodies] = self._settled[bodies] = covariances

    def _append(self, bodies: IntArray, derived: Sequence[Derived]) -> None:
        """Let bodies (k,) be new ones."""
        self._number[bodies] = self._factor.pattern.front.size + len(self._new) + np.arange(len(derived))
        self._new += tuple(derived)

    def add(self, columns: IntArray, covariance: FloatArray) -> None:
        """Add a covariance (3, 3) to that of a body's columns (3,): its error is larger than was known."""
        if columns.size:
            body = int(columns[0]) // 3
            if self._number[body] < 0:
                self.place(columns, covariance)
            else:
                self.marginal[body] += covariance

    def grow(self, count: int) -> None:
        """Append columns without error, three for each body."""
        bodies = count // 3
        self.marginal = np.concatenate([self.marginal, np.zeros((bodies, 3, 3))])
        self._settled = np.concatenate([self._settled, np.zeros((bodies, 3, 3))])
        self._place = np.concatenate([self._place, np.zeros((bodies, 2))])
        self._number = np.concatenate([self._number, np.full(bodies, -1)])
        self._ordering = None

    def relate(self, columns: IntArray, others: IntArray, mapping: FloatArray) -> None:
        """Add the errors of other bodies' columns (m,), mapped by (3, m), to those of a body just placed.

        Until the next update its marginal is that of others which err alike.
        """
        if others.size == 0:
            return
        body, bodies = int(columns[0]) // 3, others[::3] // 3
        placed, self._new = self._new[-1], self._new[:-1]
        self._take_in_noise(bodies)
        lever, back = levers(self._place[[body]])[0], levers(-self._place[bodies])
        shares = lever @ mapping.reshape(3, -1, 3).transpose(1, 0, 2) @ back
        alike = np.linalg.cholesky(carried(self._place[bodies], self.marginal[bodies]))
        common = np.sum(shares @ alike, axis=0)
        gain = shares.transpose(0, 2, 1).reshape(-1, 3)
        self._append(columns[:1] // 3, [Derived(self._number[bodies], gain, placed.spread)])
        self.marginal[body] += carried(-self._place[[body]], (common @ common.T)[None])[0]
        self._settled[body] = self.marginal[body]

    def _take_in_noise(self, bodies: IntArray) -> None:
        """Take what bodies have erred by since the newest factor into their errors, so others share it."""
        added = carried(self._place[bodies], self.marginal[bodies] - self._settled[bodies])
        for body, noise in zip(bodies[:, None], added, strict=True):
            if noise.any():
                self._append(body, [Derived(self._number[body], np.eye(3), noise)])
                self._settled[body] = self.marginal[body]

    def block(self, columns: IntArray) -> FloatArray:
        """Covariance (3, 3) of a body's columns (3,); (0, 0) of none."""
        if columns.size == 0:
            return np.zeros((0, 0))
        covariance: FloatArray = self.marginal[int(columns[0]) // 3].copy()
        return covariance

    def relate_pairs(self, columns: IntArray, robots: Robots) -> FloatArray:
        """Cross-covariances (m, 3, 3) of pairs of bodies before an update with measurements (m,) of them."""
        tied = (columns >= 0).all(axis=1)
        pairs = columns[tied] // 3
        prepared = self._prepare(pairs, robots)
        out = np.zeros((len(columns), 3, 3))
        first, second = pairs.T
        places, covariance = prepared.prior.place, prepared.prior.covariance
        across = covariance[places[first], places[second]] + copies.shared(prepared.shares, first, second)
        out[tied] = carried_pairs(-self._place[first], across, -self._place[second])
        return out

    def _prepare(self, pairs: IntArray, robots: Robots) -> _Prepared:
        """Have the covariances of all pairs of a pattern that pairs (k, 2) fit into."""
        count = robots.active.size
        places = np.concatenate(
            [robots.places, self._place[count:]]
        )  # landmarks stand where they were placed
        active = np.flatnonzero(np.concatenate([robots.active, self._number[count:] >= 0]))
        self._move_far(active, places)
        factor, shares = with_derived(self._factor, self._new), copies.with_derived(self._shares, self._new)
        pattern = self._pattern(pairs, active, places)
        rows = wanted_rows(factor.pattern, pattern, self._number, len(self._new))
        covariance = self._room.with_fronts(self._factor, len(self._new))
        write_rows(factor, len(self._new), rows, covariance)
        self._room.holds = None  # since noise is added to it
        origin: Factor | None = factor
        if self._updates % _COPIED_AGAIN == 0:
            copied = active[spread(places[active], min(_COPIES, active.size // _COPIED_SHARE))]
            others = copies.renewed(factor, shares, self._number[copied])
            copies.change_shared(covariance, pattern, self._number, (shares, others))
            shares, origin = others, None
        self._updates += 1
        numbers, added = self._number[active], np.zeros_like(self.marginal)
        added[active] = carried(self._place[active], self.marginal[active] - self._settled[active])
        covariance[numbers, numbers] += added[active]
        by_body = shares
        if not np.array_equal(
            numbers, np.arange(self._number.size)
        ):  # not all are there, as they were before
            by_body = np.zeros((self._number.size, 3, shares.shape[2]))
            by_body[active] = shares[numbers]
        prior = Prior(covariance, self._number, added)
        self._prepared = _Prepared(pattern, prior, by_body, active, origin)
        return self._prepared

    def _move_far(self, active: IntArray, places: FloatArray) -> None:
        """Hold the errors of bodies that have gone far about where they are now."""
        moved = places[active] - self._place[active]
        far = active[np.hypot(moved[:, 0], moved[:, 1]) > _FAR_M]
        turns = levers(places[far] - self._place[far])
        for body, turn in zip(far[:, None], turns, strict=True):
            self._append(body, [Derived(self._number[body], turn.T.copy(), np.zeros((3, 3)))])
        self._place[far] = places[far]

    def _pattern(self, pairs: IntArray, active: IntArray, places: FloatArray) -> Pattern:
        """A pattern in which all these pairs (k, 2) lie, in the order in use or a new one."""
        here = np.zeros(self._number.size, dtype=bool)
        here[active] = True
        self._pairs = (*self._pairs[1 - _PAIRS_KEPT :], pairs)
        recent = np.concatenate(self._pairs)
        situation = Situation(active, places, recent[here[recent].all(axis=1)])
        self._ordering = ordered(situation, self._ordering)
        return self._ordering.pattern

    def update(
        self, columns: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
    ) -> FloatArray:
        """Use many measurements with independent errors at once; return the correction (n,) of all columns.

        Their pairs must have been among those of `relate_pairs`, which comes before each update.

        Args:
            columns: (m, c) what each depends on, the two bodies' first.
            jacobian: (m, 3, c) its Jacobian; a zero row is a component that was not measured.
            innovation: (m, 3) measured minus predicted.
            noise: (m, 3, 3) covariance of the measurement.
        """
        if self._prepared is None:
            raise RuntimeError("the pairs of an update are related first")
        (pattern, prior, shares, active, origin), self._prepared = self._prepared, None
        measured = summed(information_of(columns, jacobian, innovation, noise, self._place))
        self._factor = eliminate(pattern, prior, measured, self._projections, origin)
        self._shares, correction = copies.updated(self._factor, shares, measured)
        count = self._number.size
        self._number = np.full(count, -1)
        self._number[active] = active
        self._new = ()
        self._settle(active)
        moved = np.einsum("nij,nj->ni", levers(-self._place[active]), correction[active])
        out = np.zeros((count, 3))
        out[active] = moved
        return out.reshape(-1)

    def _settle(self, active: IntArray) -> None:
        """Have the marginals of the newest factor and copies."""
        covariance = self._room.with_fronts(self._factor)
        own = covariance[active, active] + copies.shared(self._shares, active, active)
        self.marginal[active] = carried(-self._place[active], own)
        self._settled[active] = self.marginal[active]


class _Room:
    """Where covariances are written between two factors, for a filter and all its copies.

    Args:
        bodies: How many there are at first.

    Attributes:
        holds: The factor of whose fronts all covariances stand there.
    """

    def __init__(self, bodies: int) -> None:
        self._blocks: FloatArray = np.zeros((0, 0, 3, 3))
        self.holds: Factor | None = None
        self._make(bodies)

    def with_fronts(self, factor: Factor, more: int = 0) -> FloatArray:
        """Room (n, n, 3, 3) with the covariances within all fronts of a factor; others do not matter.

        There is room for `more` bodies than the factor has.
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
        self._blocks.fill(0.0)  # so that the system finds the memory now, and not when data are there
