"""What the sparse filter sums of many measurements, carries from place to place, and orders ahead."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.core.filter.sparse import ordering
from swarm_loc_estimator.core.filter.sparse.levers import Information, carried_pairs, levers, summed
from swarm_loc_estimator.core.filter.sparse.ordering import Situation, ordered
from swarm_loc_estimator.numerics.arrays import FloatArray

COUNT = 60


def grid() -> FloatArray:
    index = np.arange(COUNT)
    return 0.5 * np.column_stack([index % 8, index // 8]).astype(float)


def situation(pairs: list[tuple[int, int]]) -> Situation:
    blocks = np.zeros(0, dtype=np.int64)
    return Situation(np.arange(COUNT), blocks, grid(), np.array(pairs, dtype=np.int64).reshape(-1, 2))


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
            assert one.near is other.near
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
    for a, b in now.near:
        if robot in (a, b):
            assert np.linalg.norm(here.places[a] - here.places[b]) < 2.0
    assert now.near_updates <= ordering._NEAR_AGAIN + ordering._ORDERED_AGAIN


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
    expected = levers(places) @ across @ levers(others).transpose(0, 2, 1)
    np.testing.assert_allclose(carried_pairs(places, across, others), expected, atol=1e-9)
