"""Laws of what a pair of robots tells again: it counts once, until the robots have turned."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.core.description.estimated_parameters import ParameterTable
from swarm_loc_estimator.core.description.swarm import Robot
from swarm_loc_estimator.core.filter.correlated_noise import inflate_noise, record_constraint, record_pair
from swarm_loc_estimator.core.filter.measurement_model import (
    MEASUREMENT_DTYPE,
    Kind,
    MeasurementArray,
    MeasurementColumns,
)
from swarm_loc_estimator.core.filter.state import SwarmState
from swarm_loc_estimator.numerics.arrays import FloatArray

VARIANCES = np.array([1e-4, 2e-3, 5e-3])
VALUE = (0.15, 0.4, -2.0)
UNKNOWN = 1e6 * VARIANCES


class Exchange(NamedTuple):
    """What robot 0 has heard."""

    systematic_share: float
    value: tuple[float, float, float] = VALUE
    transmitter: int = 1
    stamp_ns: int = 0
    size: float = 1.0  # of its variances

    def row(self) -> MeasurementArray:
        """As the filter gets it."""
        one = np.zeros(1, dtype=MEASUREMENT_DTYPE)
        one["stamp_ns"], one["target"], one["kind"], one["has_heading"] = (
            self.stamp_ns,
            self.transmitter,
            Kind.POLAR,
            1,
        )
        one["value"], one["systematic_share"], one["covariance"] = (
            self.value,
            self.systematic_share,
            np.diag(VARIANCES * self.size),
        )
        return one


def pairs(places: int = 4) -> SwarmState:
    return SwarmState(ParameterTable.of([Robot(name) for name in "abcd"]), places)


def believed(value: tuple[float, float, float]) -> FloatArray:
    """Poses (2, 3) in map of an observer and of a target that it has at so much."""
    distance, bearing, heading = value
    x, y, theta = 0.3, -0.2, 0.7
    along = theta + bearing
    target = (x + distance * np.cos(along), y + distance * np.sin(along), theta + heading)
    return np.array([(x, y, theta), target])


def noise_of(
    state: SwarmState, exchange: Exchange, predicted: FloatArray, at: tuple[float, float, float] | None = None
) -> FloatArray:
    """The variances (3,) to use it with where the pair is believed to be, by default as it was measured."""
    noise, pose = np.diag(VARIANCES * exchange.size), believed(at or exchange.value)
    inflate_noise(MeasurementColumns.of(exchange.row()), 0, state.arrays(), pose, predicted, noise)
    variances: FloatArray = np.diag(noise).copy()
    return variances


def used(
    state: SwarmState, exchange: Exchange, predicted: FloatArray, at: tuple[float, float, float] | None = None
) -> FloatArray:
    """Use it; returns the variances (3,) left."""
    noise = noise_of(state, exchange, predicted, at)
    left: FloatArray = predicted * noise / (predicted + noise)
    columns = MeasurementColumns.of(exchange.row())
    pose = believed(at or exchange.value)
    record_pair(columns, 0, state.arrays(), pose, predicted.copy(), np.diag(noise))
    return left


@given(systematic_share=st.floats(0.0, 1.0), count=st.integers(1, 30))
def test_exchanges_of_robots_that_stand_count_once_but_for_their_noise(
    systematic_share: float, count: int
) -> None:
    state, left = pairs(), UNKNOWN
    for _ in range(count):
        left = used(state, Exchange(systematic_share), left)
    np.testing.assert_allclose(
        left, VARIANCES * (systematic_share + (1.0 - systematic_share) / count), rtol=1e-3
    )


@given(
    exchanges=st.lists(st.tuples(st.floats(0.01, 1.0), st.floats(0.2, 5.0)), min_size=2, max_size=20),
    seed=st.integers(0, 10**6),
)
def test_robots_that_stand_are_never_surer_than_the_least_error_that_comes_again(
    exchanges: list[tuple[float, float]], seed: int
) -> None:
    """However unlike exchanges are; and however values scatter, that is no turn of the robots."""
    rng = np.random.default_rng(seed)
    state, left = pairs(), UNKNOWN
    for share, size in exchanges:
        bearing, heading = rng.uniform(-3.0, 3.0, 2).tolist()
        left = used(state, Exchange(share, (VALUE[0], bearing, heading), size=size), left, at=VALUE)
    assert (left >= (1.0 - 1e-5) * min(share * size for share, size in exchanges) * VARIANCES).all()


def test_an_exchange_that_seems_better_does_not_take_what_came_again_before_for_less() -> None:
    """The mean still contains the errors of those before it, by their weight."""
    state, left = pairs(), UNKNOWN
    for _ in range(9):
        left = used(state, Exchange(0.8), left)
    before = left.copy()
    left = used(state, Exchange(0.8, size=0.5), left)
    better = 0.8 * (0.5**0.5 * 0.2 + 0.8) ** 2  # a tenth and somewhat more of the mean is the new one
    assert (left > better * VARIANCES).all()
    assert (left < before).all()


@given(systematic_share=st.floats(0.0, 1.0), turn=st.floats(0.0, 3.0), more=st.floats(1.0, 4.0))
def test_what_is_told_again_never_counts_more_than_the_first_time(
    systematic_share: float, turn: float, more: float
) -> None:
    state = pairs()
    left = used(state, Exchange(systematic_share), UNKNOWN)
    distance, bearing, heading = VALUE
    again = noise_of(state, Exchange(systematic_share, (distance, bearing + turn, heading)), more * left)
    assert (again >= VARIANCES * (1.0 - 1e-9)).all()
    assert (again <= noise_of(state, Exchange(systematic_share), more * left) * (1.0 + 1e-9)).all()


@pytest.mark.parametrize(
    ("receiver_turns", "transmitter_turns", "new"),
    [(1.5, 0.0, [False, True, False]), (0.0, 1.5, [False, False, False]), (1.5, 1.5, [True, True, True])],
)
def test_robots_that_have_turned_tell_something_new(
    receiver_turns: float, transmitter_turns: float, new: list[bool]
) -> None:
    """A bearing errs by the gains of sensors, range and heading by those of emitters besides."""
    state = pairs()
    left = used(state, Exchange(0.9), UNKNOWN)
    distance, bearing, heading = VALUE
    turned = (distance, bearing - receiver_turns, heading - receiver_turns + transmitter_turns)
    noise = noise_of(state, Exchange(0.9, turned), left)
    np.testing.assert_array_equal(noise < 1.1 * VARIANCES, new)


def test_what_others_tell_makes_room_for_what_a_pair_tells_again() -> None:
    state = pairs()
    left = used(state, Exchange(1.0), UNKNOWN)
    lowered = noise_of(state, Exchange(1.0), 0.1 * left)
    moved = used(state, Exchange(1.0), 0.1 * left)
    again = noise_of(state, Exchange(1.0), moved + left)
    assert (lowered > 1e6 * VARIANCES).all()
    assert (again < 2.0 * VARIANCES).all()


def test_a_pair_is_forgotten_when_either_robot_is_lost_or_others_take_its_place() -> None:
    for lost in (0, 1):
        state = pairs()
        left = used(state, Exchange(1.0), UNKNOWN)
        state.lose(lost)
        np.testing.assert_allclose(noise_of(state, Exchange(1.0), left), VARIANCES)
    state = pairs(places=2)
    for transmitter, stamp_ns in ((1, 1), (2, 2), (3, 3)):
        left = used(state, Exchange(1.0, transmitter=transmitter, stamp_ns=stamp_ns), UNKNOWN)
    known = [(noise_of(state, Exchange(1.0, transmitter=k), left) > VARIANCES).all() for k in (1, 2, 3)]
    assert known == [False, True, True]


def test_what_has_located_a_robot_counts_as_told() -> None:
    state = pairs()
    record_constraint(MeasurementColumns.of(Exchange(1.0).row()), 0, state.arrays())
    assert (noise_of(state, Exchange(1.0), VARIANCES) > 1e6 * VARIANCES).all()
    np.testing.assert_allclose(noise_of(state, Exchange(0.0), VARIANCES), VARIANCES)
