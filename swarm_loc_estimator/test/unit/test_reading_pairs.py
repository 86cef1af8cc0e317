"""Distances and odometry that come one before the other, late, twice, or wrong."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.mapping.mapper_feed import MAX_GAP_NS, MAX_WAITING, ReadingPairer

STEP_NS = 50_000_000


def pairer_with_odometry(count: int) -> ReadingPairer:
    pairer = ReadingPairer()
    for k in range(count):
        pairer.add_odometry(k * STEP_NS, np.array([0.1 * k, 0.0, 0.0]))
    return pairer


def test_poses_are_those_of_the_distances_instants() -> None:
    pairer = pairer_with_odometry(3)
    for stamp_ns, distance in ((0, 2.0), (STEP_NS // 2, math.nan), (2 * STEP_NS, 1.0)):
        pairer.add_distance(stamp_ns, distance, 0.04 if distance == 2.0 else 0.01)
    found = pairer.ready()
    assert found is not None
    assert np.allclose(found.odometry[:, 0], [0.0, 0.05, 0.2])
    assert found.inverse.tolist() == [0.5, 0.0, 1.0]
    assert found.sigma == pytest.approx(0.01)
    assert pairer.ready() is None


@given(order=st.permutations(range(12)))
def test_it_does_not_matter_which_comes_first(order: list[int]) -> None:
    """Six of each kind, each kind in its own order."""
    pairer, stamps, counts = ReadingPairer(), [], [0, 0]
    for one in order:
        kind = one % 2
        stamp_ns = counts[kind] * STEP_NS
        counts[kind] += 1
        if kind:
            pairer.add_distance(stamp_ns, 1.0, 0.01)
        else:
            pairer.add_odometry(stamp_ns, np.array([stamp_ns * 1e-9, 0.0, 0.0]))
        found = pairer.ready()
        if found is not None:
            stamps += found.stamp_ns.tolist()
            assert np.allclose(found.odometry[:, 0], found.stamp_ns * 1e-9)
    assert stamps == [k * STEP_NS for k in range(6)]


def test_what_cannot_be_used_is_counted() -> None:
    pairer = pairer_with_odometry(2)
    pairer.add_odometry(0, np.zeros(3))
    pairer.add_odometry(5 * STEP_NS, np.array([math.nan, 0.0, 0.0]))
    pairer.add_distance(-1, 1.0, 0.01)
    pairer.add_distance(-2, 1.0, 0.01)
    pairer.add_distance(1, math.inf, 0.01)
    pairer.add_distance(2, 1.0, math.nan)
    assert pairer.ready() is None
    assert dict(pairer.drops) == {
        "odometry_too_old": 1,
        "odometry_not_finite": 1,
        "laser_too_old": 1,
        "laser_bad_value": 2,
        "laser_without_odometry": 1,
    }


def test_odometry_is_not_guessed_over_gaps_and_nothing_waits_for_ever() -> None:
    pairer = pairer_with_odometry(1)
    pairer.add_distance(1, 1.0, 0.01)
    pairer.add_odometry(2 * MAX_GAP_NS, np.zeros(3))
    assert pairer.ready() is None
    for k in range(MAX_WAITING + 10):
        pairer.add_distance(3 * MAX_GAP_NS + k, 1.0, 0.01)
    assert pairer.drops["laser_without_odometry"] == 11


def test_beams_that_met_nothing_count_before_anything_was_seen() -> None:
    pairer = pairer_with_odometry(2)
    pairer.add_distance(0, math.nan, math.nan)
    found = pairer.ready()
    assert found is not None
    assert found.inverse.tolist() == [0.0]
    assert math.isnan(found.sigma)
    assert not pairer.drops


def test_a_dim_spot_is_no_measure_of_the_others() -> None:
    pairer = pairer_with_odometry(50)
    for k in range(40):
        pairer.add_distance(k * STEP_NS, 2.0, 0.5 if k in (0, 20, 39) else 0.04)
    found = pairer.ready()
    assert found is not None
    assert found.sigma == pytest.approx(0.01)
