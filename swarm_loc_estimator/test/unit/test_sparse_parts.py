"""What the sparse filter sums of many measurements, carries from place to place, and orders ahead."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter.sparse import ordering
from swarm_loc_estimator.filter.sparse.factor import Factor, new_factor, solve, write_fronts, write_rows
from swarm_loc_estimator.filter.sparse.ordering import (
    Order,
    Pattern,
    Situation,
    adjacency,
    dissect,
    ordered,
    pattern_of,
    wanted_rows,
)
from swarm_loc_estimator.filter.sparse.parameters import (
    Groups,
    Information,
    active_blocks,
    carried_pairs,
    summed,
    translation_adjoints,
)

COUNT = 60


def grid() -> FloatArray:
    index = np.arange(COUNT)
    return 0.5 * np.column_stack([index % 8, index // 8]).astype(float)


def situation(pairs: list[tuple[int, int]]) -> Situation:
    no_blocks = Order(np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64))
    return Situation(np.arange(COUNT), no_blocks, grid(), np.array(pairs, dtype=np.int64).reshape(-1, 2))


PAIR = st.tuples(st.integers(0, COUNT - 1), st.integers(0, COUNT - 1))


@given(st.lists(st.lists(PAIR, max_size=6), min_size=12, max_size=12), st.lists(PAIR, max_size=6))
def test_the_next_order_does_not_depend_on_what_is_measured_then(
    earlier: list[list[tuple[int, int]]], late: list[tuple[int, int]]
) -> None:
    before = None
    for pairs in earlier:
        now = situation(pairs)
        one, other = ordered(now, before), ordered(situation(pairs + late), before)
        if before is not None and before.updates >= ordering._ORDERED_AGAIN:
            assert one.order is other.order
            assert one.near.pairs is other.near.pairs
        for a, b in pairs + late:  # whatever the order is, all pairs lie in the pattern
            assert in_pattern(other, a, b)
        before = one


def in_pattern(one: ordering.Ordering, a: int, b: int) -> bool:
    pattern = one.pattern
    f, g = sorted((int(pattern.front[a]), int(pattern.front[b])))
    later = a if pattern.front[a] == g else b
    return f == g or later in pattern.border[pattern.border_begin[f] : pattern.border_begin[f + 1]]


@pytest.mark.parametrize("grown", [0.0, math.inf])
def test_who_is_near_whom_is_found_out_again_however_soon_orders_are_replaced(
    monkeypatch: pytest.MonkeyPatch, grown: float
) -> None:
    monkeypatch.setattr(ordering, "_GROWN", grown)
    robot, now = 0, None
    for update in range(3 * ordering._NEAR_AGAIN):
        here = situation([])
        here.places[robot] = (3.6, 0.1 + 0.05 * min(update, ordering._NEAR_AGAIN))
        now = ordered(here, now)
    assert now is not None
    for a, b in now.near.pairs:
        if robot in (a, b):
            assert np.linalg.norm(here.places[a] - here.places[b]) < 2.0
    assert now.near.updates <= ordering._NEAR_AGAIN + ordering._ORDERED_AGAIN


@given(st.integers(0, 10**6), st.integers(0, 40))
def test_blocks_of_the_same_bodies_are_summed(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, 6, (2, count))
    one = Information(first, second, rng.standard_normal((count, 3, 3)), rng.standard_normal((6, 3)))
    result, total, expected = summed(one), np.zeros((6, 6, 3, 3)), np.zeros((6, 6, 3, 3))
    np.add.at(expected, (first, second), one.block)
    total[result.first, result.second] = result.block
    np.testing.assert_allclose(total, expected, atol=1e-12)
    assert len(set(zip(result.first.tolist(), result.second.tolist(), strict=True))) == result.first.size
    assert np.all(np.diff(result.first) >= 0)
    np.testing.assert_array_equal(result.gradient, one.gradient)


@given(st.integers(0, 10**6))
def test_covariances_are_carried_by_the_levers_of_their_bodies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places, others, across = (
        rng.normal(0.0, 9.0, (5, 2)),
        rng.normal(0.0, 9.0, (5, 2)),
        rng.normal(0, 1, (5, 3, 3)),
    )
    expected = translation_adjoints(places) @ across @ translation_adjoints(others).transpose(0, 2, 1)
    np.testing.assert_allclose(carried_pairs(places, across, others), expected, atol=1e-9)


def test_blocks_of_a_robot_are_eliminated_together() -> None:
    member = np.array([[0, 4, 5], [1, -1, 6], [2, -1, -1], [3, 7, 8]])
    groups = Groups(member, np.zeros(9, dtype=np.int64), np.zeros(9, dtype=np.int64))
    active = np.ones(9, dtype=bool)
    active[7] = False
    blocks = active_blocks(groups, active)
    assert blocks.body.tolist() == [4, 5, 6, 8]
    assert blocks.begin.tolist() == [0, 2, 3, 4]


def random_pattern(rng: np.random.Generator) -> Pattern:
    """That of pairs of bodies near each other, some bodies having been eliminated before all others."""
    places, first = rng.uniform(0.0, 1.0, (COUNT, 2)), rng.permutation(COUNT)[:8]
    near = np.argsort(np.linalg.norm(places[:, None] - places, axis=2), axis=1)[:, 1:4]
    pairs = np.column_stack([np.repeat(np.arange(COUNT), 3), near.reshape(-1)])
    graph = adjacency(COUNT, pairs)
    rest = dissect(np.setdiff1d(np.arange(COUNT), first), places, graph)
    begin = np.concatenate([[0, 2, 3, 5, 6, 7], 8 + rest.begin])
    return pattern_of(Order(np.concatenate([first, rest.body]), begin), graph)


def random_factor(rng: np.random.Generator, pattern: Pattern) -> tuple[Factor, FloatArray]:
    """A factor, and the covariance (3 n, 3 n) that it says."""
    factor, size = new_factor(pattern), 3 * COUNT
    depends, own = np.eye(size), np.zeros((size, size))
    for f in range(pattern.fronts):
        pivots = columns_of(pattern.pivot[pattern.pivot_begin[f] : pattern.pivot_begin[f + 1]])
        border = columns_of(pattern.border[pattern.border_begin[f] : pattern.border_begin[f + 1]])
        gain, root = rng.normal(0.0, 0.1, (border.size, pivots.size)), rng.normal(0.0, 1.0, 2 * [pivots.size])
        spread = root @ root.T + np.eye(pivots.size)
        factor.gain[factor.gain_begin[f] : factor.gain_begin[f + 1]] = gain.reshape(-1)
        factor.spread[factor.spread_begin[f] : factor.spread_begin[f + 1]] = spread.reshape(-1)
        depends[np.ix_(pivots, border)] = -gain.T
        own[np.ix_(pivots, pivots)] = spread
    inverse = np.linalg.inv(depends)
    return factor, inverse @ own @ inverse.T


def columns_of(bodies: IntArray) -> IntArray:
    columns: IntArray = (3 * bodies[:, None] + np.arange(3)).reshape(-1)
    return columns


@pytest.mark.parametrize("seed", range(8))
def test_a_factor_says_all_covariances_that_a_new_pattern_wants(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factor, exact = random_factor(rng, random_pattern(rng))
    solved = np.eye(3 * COUNT)
    solve(factor, solved)
    np.testing.assert_allclose(solved, exact, atol=1e-10)

    new, place = random_pattern(rng), rng.permutation(COUNT)
    beside = np.where(rng.random(COUNT) < 0.3, rng.integers(0, COUNT, COUNT), -1)
    covariance = np.full((COUNT, COUNT, 3, 3), np.nan)
    write_fronts(factor, covariance)
    write_rows(factor, 0, *wanted_rows(factor.pattern, new, place, 0, beside), covariance)
    for f in range(new.fronts):
        pivots = new.pivot[new.pivot_begin[f] : new.pivot_begin[f + 1]]
        border = new.border[new.border_begin[f] : new.border_begin[f + 1]]
        for a in pivots.tolist():
            moved = beside[a] >= 0
            of_a = place[[a, *([beside[a]] if moved else [])]]
            for b in [*pivots.tolist(), *border.tolist()]:
                of_b = place[[b, *([beside[b]] if beside[b] >= 0 else [])]] if b != a else of_a
                found = covariance[np.ix_(of_a, of_b)].transpose(0, 2, 1, 3).reshape(3 * of_a.size, -1)
                wanted = exact[np.ix_(columns_of(of_a), columns_of(of_b))]
                np.testing.assert_allclose(found, wanted, atol=1e-10)
