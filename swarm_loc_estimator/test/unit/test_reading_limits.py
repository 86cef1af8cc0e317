"""Saturation and noise from exchanges alone: found as they are, never where there is none to be found."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from ir_world import random_poses

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.offline.calibration.infrared.elements import (
    ReadingLimits,
    contradictions,
    find_reading_limits,
)
from swarm_loc_estimator.swarm.ir_board import IrPlatform, PairGains, load_ir_platform

ROBOTS, N = 3, 6
NEVER = 1e8  # A saturation that nothing reaches [count]
ROUNDED = 1.0 / np.sqrt(12.0)  # Noise of whole counts [count]


def board(name: str) -> IrPlatform:
    """At full power alone."""
    platform = load_ir_platform(name)
    return replace(platform, amplitudes=platform.amplitudes[:1])


@dataclass(frozen=True)
class Course:
    """What happens."""

    count: int = 400  # How many exchanges
    stay: int = 4  # So many in a row in each geometry of a pair
    nearest: float = 0.05  # Least range [m]
    farthest: float = 0.2  # Largest range [m]
    walk: float = 0.0  # How far robots move between exchanges of one geometry, one standard deviation [m]


def exchanged(
    platform: IrPlatform, course: Course, seed: int, saturation: FloatArray | float | None = None
) -> Exchanges:
    """Robots with the platform's noise, of which all that lasts is the same while they stand.

    Args:
        platform: With the noise, and the saturation unless it is given.
        course: What happens.
        seed: Fixes all chance.
        saturation: (ROBOTS, N) or one of all sensors [count].
    """
    rng = np.random.default_rng(seed)
    stretches = -(-course.count // course.stay)
    poses = random_poses(stretches, seed, course.nearest, course.farthest)
    stretch = np.repeat(np.arange(stretches), course.stay)[: course.count]
    first = rng.integers(0, ROBOTS, stretches)
    receiver = first[stretch]
    transmitter = ((first + rng.integers(1, ROBOTS, stretches)) % ROBOTS)[stretch]
    moved = poses[stretch] + course.walk * rng.standard_normal((course.count, 3)) * [1.0, 10.0, 10.0]
    factors = np.exp(platform.element_sigma * rng.standard_normal((2, ROBOTS, N)))
    gains = PairGains(factors[0, receiver], factors[1, transmitter], np.zeros((course.count, 4)))
    lasting = np.exp(platform.curve_sigma * rng.standard_normal((stretches, N, N)))
    lasting *= rng.uniform(size=lasting.shape) > platform.blocked_share
    light = expected_brightness(platform, moved, gains)[:, 0] * lasting[stretch]
    light *= 1.0 + platform.relative_noise * rng.standard_normal(light.shape)
    light += platform.noise * rng.standard_normal(light.shape)
    limit = np.broadcast_to(platform.saturation if saturation is None else saturation, (ROBOTS, N))
    readings = np.rint(np.minimum(light, limit[receiver][..., None]))[:, None]
    unknown = np.full((course.count, 3), np.nan)
    return Exchanges(
        receiver, transmitter, readings, np.full((course.count, 1), platform.saturation), unknown
    )


def limits_of(
    platform: IrPlatform, course: Course, seed: int, saturation: FloatArray | float | None = None
) -> ReadingLimits:
    return find_reading_limits(platform, ROBOTS, exchanged(platform, course, seed, saturation))


@pytest.mark.parametrize("seed", range(5))
def test_sensors_that_saturate_are_found_each_at_its_own_count(seed: int) -> None:
    """Every other one saturates at a lower count."""
    true = np.where(np.arange(ROBOTS * N).reshape(ROBOTS, N) % 2, 255.0, 180.0)
    found = limits_of(board("droplet"), Course(stay=1), seed, true).saturation
    np.testing.assert_allclose(found, true, rtol=0.005)


@pytest.mark.parametrize("seed", range(3))
def test_sensors_of_real_boards_are_found_where_enough_geometries_saturate_them(seed: int) -> None:
    course = Course(1500, stay=1, nearest=0.044)
    exchanges = exchanged(board("droplet_2016"), course, seed)
    found = find_reading_limits(board("droplet_2016"), ROBOTS, exchanges).saturation
    exchange, sensor, _ = np.nonzero(exchanges.readings[:, 0] >= board("droplet_2016").saturation)
    often = np.zeros((ROBOTS, N), dtype=np.bool_)
    for robot, i in np.ndindex(ROBOTS, N):
        rows = np.unique(exchange[(exchanges.receiver[exchange] == robot) & (sensor == i)])
        emitters = exchanges.readings[rows, 0, i].argmax(axis=1) + N * exchanges.transmitter[rows]
        often[robot, i] = rows.size >= 5 and np.unique(emitters).size >= 3
    assert often.sum() >= 2
    np.testing.assert_allclose(found[often], board("droplet_2016").saturation, rtol=0.01)


@pytest.mark.parametrize("name", ["droplet", "droplet_2016"])
@pytest.mark.parametrize("seed", range(20, 30))
def test_no_sensor_is_said_to_saturate_that_does_not(name: str, seed: int) -> None:
    """Also where robots stand, all at one range, or bright readings are as frequent as may be."""
    for course in (Course(stay=1), Course(stay=10), Course(stay=1, nearest=0.1, farthest=0.1)):
        assert np.isnan(limits_of(board(name), course, seed, NEVER).saturation).all()


@pytest.mark.parametrize("name", ["droplet", "droplet_2016"])
@pytest.mark.parametrize("relative", [0.0, 0.05, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_noise_of_every_sensor_is_found_while_robots_stand(name: str, relative: float, seed: int) -> None:
    platform = replace(board(name), relative_noise=relative)
    found = limits_of(platform, Course(1500), seed)
    ratio = found.noise / np.hypot(platform.noise, ROUNDED)
    assert np.abs(ratio - 1.0).max() < 0.12
    assert abs(ratio.mean() - 1.0) < 0.02
    assert np.nanmedian(found.relative_noise) == pytest.approx(relative, abs=0.012)


@pytest.mark.parametrize("name", ["droplet", "droplet_2016"])
def test_steps_of_a_millimetre_are_hardly_taken_for_noise(name: str) -> None:
    found = limits_of(board(name), Course(1500, walk=0.001), 4)
    ratio = found.noise / np.hypot(board(name).noise, ROUNDED)
    assert np.abs(ratio - 1.0).max() < 0.12
    assert np.nanmedian(found.relative_noise) < 0.075


@pytest.mark.parametrize("name", ["droplet", "droplet_2016"])
def test_robots_that_are_elsewhere_each_time_tell_no_noise(name: str) -> None:
    found = limits_of(board(name), Course(1500, stay=1), 5)
    assert np.isnan(found.noise).all()
    assert np.isnan(found.relative_noise).all()


def test_readings_that_fail_now_and_then_are_no_noise() -> None:
    """As on real boards: in one exchange of ten a reading is lost, in one there is light from elsewhere."""
    platform, rng = board("droplet_2016"), np.random.default_rng(6)
    exchanges = exchanged(platform, Course(1500), 6)
    chance = rng.uniform(size=exchanges.readings.shape)
    exchanges.readings[chance < 1 / 360] = 0.0
    exchanges.readings[chance > 359 / 360] += 300.0
    ratio = find_reading_limits(platform, ROBOTS, exchanges).noise / platform.noise
    assert np.abs(ratio - 1.0).max() < 0.25


def test_few_exchanges_tell_nothing() -> None:
    found = limits_of(board("droplet"), Course(12), 7)
    for part in (found.saturation, found.noise, found.relative_noise):
        assert np.isnan(part).all()


@pytest.mark.parametrize("dark", [np.nan, -40.0])
def test_a_sensor_that_never_sees_light_says_nothing_wrong(dark: float) -> None:
    """It reads nothing, or less than is read in the dark."""
    exchanges = exchanged(board("droplet"), Course(1500), 9)
    exchanges.readings[:, :, 2] = dark + np.random.default_rng(9).integers(-2, 3, (1500, 1, N))
    found = find_reading_limits(board("droplet"), ROBOTS, exchanges)
    assert np.isnan(found.saturation[:, 2]).all()
    assert np.isnan(found.relative_noise[:, 2]).all()
    others = np.delete(found.noise, 2, axis=1)
    assert np.abs(others - np.hypot(1.0, ROUNDED)).max() < 0.12
    assert np.isnan(dark) or np.abs(found.noise[:, 2] - np.sqrt(2.0)).max() < 0.15


@pytest.mark.parametrize("seed", [1, 2])
def test_a_board_that_is_as_described_is_not_contradicted(seed: int) -> None:
    for name in ("droplet", "droplet_2016"):
        exchanges = exchanged(board(name), Course(1500), seed)
        limits = find_reading_limits(board(name), ROBOTS, exchanges)
        assert contradictions(board(name), exchanges, limits, ("a", "b", "c")) == []


def test_what_contradicts_the_description_is_said_in_a_sentence_each() -> None:
    described = replace(board("droplet"), dark_level=0.4)
    truly = replace(described, noise=4.0, relative_noise=0.12)
    true = np.full((ROBOTS, N), NEVER)
    true[1] = 150.0
    exchanges = exchanged(truly, Course(3000, stay=3, nearest=0.12), 8, true)
    limits = find_reading_limits(described, ROBOTS, exchanges)
    saturation, noise, relative = contradictions(described, exchanges, limits, ("a", "b", "c"))
    assert saturation == (
        "Sensors saturate lower than board and matrices say: b [0, 1, 2, 3, 4, 5] at 150 of 255 counts."
    )
    assert noise.startswith("Where robots stand, dark readings scatter by 4")
    assert noise.endswith(" counts, but noise of the board is 1.")
    assert relative.startswith("Where robots stand, bright readings scatter by 1")
    assert relative.endswith(" % besides, but relative_noise and curve_sigma of the board are 0 % together.")
