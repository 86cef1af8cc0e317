"""Dead and shaded elements from exchanges alone: found, not named falsely, undecided where little is read."""

import functools

import numpy as np
import pytest
from ir_world import random_poses

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.offline.calibration.infrared.elements import ElementVerdicts, find_dead_elements
from swarm_loc_estimator.swarm.ir_board import PairGains, load_ir_platform

PLATFORM = load_ir_platform("droplet_2016")
ROBOTS, N = 3, 6
Faults = dict[tuple[int, int, int], float]
"""The share of its light that an element still gives, by side, robot and number."""


def exchanged(count: int, seed: int, faults: Faults, poses: FloatArray | None = None) -> Exchanges:
    """Robots that stand elsewhere at every exchange; readings are blocked as often as the board says.

    In every tenth exchange a whole sensor is dark, as behind a third robot.
    """
    rng = np.random.default_rng(seed)
    receiver = rng.integers(0, ROBOTS, count)
    transmitter = (receiver + rng.integers(1, ROBOTS, count)) % ROBOTS
    poses = random_poses(count, seed, 0.05, 0.2) if poses is None else poses
    factors = np.exp(PLATFORM.element_sigma * rng.standard_normal((2, ROBOTS, N)))
    for place, share in faults.items():
        factors[place] *= share
    gains = PairGains(factors[0, receiver], factors[1, transmitter], np.zeros((count, 4)))
    light = expected_brightness(PLATFORM, poses, gains)[:, 0]
    light[rng.uniform(size=light.shape) < PLATFORM.blocked_share] = 0.0
    light[np.flatnonzero(rng.uniform(size=count) < 0.1), rng.integers(0, N)] = 0.0
    light *= np.exp(PLATFORM.curve_sigma * rng.standard_normal(light.shape))
    light += PLATFORM.noise * rng.standard_normal(light.shape)
    readings = np.minimum(light, PLATFORM.saturation)[:, None]
    unknown = np.full((count, 3), np.nan)
    return Exchanges(receiver, transmitter, readings, np.full((count, 1), PLATFORM.saturation), unknown)


def drawn(seed: int) -> Faults:
    """A dead sensor, a dead emitter and a shaded one, on different robots."""
    rng = np.random.default_rng([seed, 7])
    elements = rng.integers(0, N, 3).tolist()
    return {(0, 0, elements[0]): 0.0, (1, 1, elements[1]): 0.0, (1, 2, elements[2]): 0.15}


@functools.cache
def found(count: int, seed: int) -> tuple[Exchanges, ElementVerdicts]:
    """Exchanges of robots with drawn faults, and what is found."""
    exchanges = exchanged(count, seed, drawn(seed))
    return exchanges, find_dead_elements(PLATFORM, ROBOTS, exchanges)


@pytest.mark.parametrize("seed", range(5))
def test_dead_and_shaded_elements_are_found_and_no_others(seed: int) -> None:
    faults, (_, verdicts) = drawn(seed), found(400, seed)
    assert set(zip(*(side.tolist() for side in np.nonzero(verdicts.dead)), strict=True)) == set(faults)
    few = find_dead_elements(PLATFORM, ROBOTS, exchanged(60, seed, faults))
    assert verdicts.undecided.sum() < few.undecided.sum()


@pytest.mark.parametrize("seed", range(10, 15))
def test_where_all_work_none_is_named(seed: int) -> None:
    verdicts = find_dead_elements(PLATFORM, ROBOTS, exchanged(400, seed, {}))
    assert not verdicts.dead.any()
    assert verdicts.works.mean() > 0.5


def test_few_exchanges_decide_nothing() -> None:
    verdicts = find_dead_elements(PLATFORM, ROBOTS, exchanged(6, 1, drawn(1)))
    assert verdicts.undecided.all()


@pytest.mark.parametrize("seed", [1, 2])
def test_one_geometry_says_little_however_often_it_was_measured(seed: int) -> None:
    """Something that stands between two robots darkens the same sensor every time."""
    facing = np.tile([0.1, PLATFORM.angles[0], 0.0], (100, 1))
    exchanges = exchanged(100, seed, {}, facing)
    exchanges.readings[:, :, 0] = PLATFORM.noise * np.random.default_rng(seed).standard_normal((100, 1, N))
    assert not find_dead_elements(PLATFORM, ROBOTS, exchanges).dead.any()


def test_readings_of_dead_elements_are_left_out() -> None:
    exchanges, verdicts = found(400, 0)
    left = np.isfinite(verdicts.without(exchanges).readings[:, 0])
    for k in range(len(left)):
        alive = [~verdicts.dead[side, robot[k]] for side, robot in enumerate(exchanges[:2])]
        np.testing.assert_array_equal(left[k], np.outer(*alive))


@pytest.mark.parametrize("order", [(1, 0, 2), (1, 2, 0)])
def test_the_order_of_robots_does_not_matter(order: tuple[int, ...]) -> None:
    """All orders of three follow from an exchange of two and a cycle."""
    (exchanges, one), places = found(120, 3), np.array(order)
    other = exchanges._replace(receiver=places[exchanges.receiver], transmitter=places[exchanges.transmitter])
    two = find_dead_elements(PLATFORM, ROBOTS, other)
    np.testing.assert_array_equal(one.dead, two.dead[:, places])
    np.testing.assert_array_equal(one.works, two.works[:, places])
