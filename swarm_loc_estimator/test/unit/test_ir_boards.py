"""Infrared boards: what is fitted to recordings, which elements are dead, which readings are usable."""

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from core_geometry import slopes_of
from hypothesis import given
from hypothesis import strategies as st
from ir_world import random_poses

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.infrared.brightness import curve_at, expected_brightness
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.mapping.mapper_feed import MAX_GAP_NS, MAX_WAITING, ReadingPairer
from swarm_loc_estimator.offline.calibration.infrared.board import (
    BoardReadings,
    _Problem,
    errors_of,
    fit_board,
    turned,
    without_dead,
)
from swarm_loc_estimator.offline.calibration.infrared.elements import (
    ElementVerdicts,
    ReadingLimits,
    contradictions,
    find_dead_elements,
    find_reading_limits,
)
from swarm_loc_estimator.swarm.ir_board import IrPlatform, PairGains, load_ir_platform

PLATFORM = load_ir_platform("droplet_2016")
ROBOTS = 4
YAW = np.radians([0.0, 4.0, -3.0, 2.0])
FACTORS = np.array([1.2, 0.8, 1.1, 0.9, 1.25, 0.85])


def recorded(count: int, seed: int) -> BoardReadings:
    """Robot 0 reads the others, which turn and whose truth is off by `YAW`; a few readings are blocked."""
    rng = np.random.default_rng(seed)
    transmitter = rng.integers(1, ROBOTS, count)
    receiver = np.zeros(count, dtype=np.int64)
    told = random_poses(count, seed, low=0.05, high=0.2)
    true = turned(told, YAW[receiver], YAW[transmitter])
    gains = PairGains(np.tile(FACTORS, (count, 1)), np.ones((count, 6)), np.zeros((count, 4)))
    light = expected_brightness(PLATFORM, true, gains)[:, 0]
    light = np.where(rng.uniform(size=light.shape) < 0.05, 0.0, light)
    light = light * np.exp(0.1 * rng.standard_normal(light.shape)) + 15.0 * rng.standard_normal(light.shape)
    readings = np.minimum(light, PLATFORM.saturation)
    return BoardReadings(receiver, transmitter, readings, told, np.arange(count, dtype=np.int64))


def values(curve: FloatArray) -> FloatArray:
    """Relative to straight ahead."""
    relative: FloatArray = curve / curve[0]
    return relative


def test_slopes_are_those_of_differences() -> None:
    problem = _Problem(replace(PLATFORM, curve_sigma=0.2), recorded(120, 1), ROBOTS)
    rng = np.random.default_rng(1)
    at = problem.first_unknowns()
    at = at + 0.03 * rng.standard_normal(at.size)
    differences = slopes_of(lambda change: problem.residuals(at + change), at.size)
    np.testing.assert_allclose(problem.slopes(at), differences, atol=5e-3)


@pytest.mark.parametrize("seed", [2, 3])
def test_curves_yaw_and_gains_are_found_again(seed: int) -> None:
    model = fit_board(load_ir_platform("droplet_2016"), recorded(500, seed), ROBOTS)
    angles = np.radians([20.0, 40.0, 50.0, 60.0])
    for name in ("sensor", "emitter"):
        found, true = (
            np.array([curve_at(getattr(one, name).table(), a)[0] for a in (0.0, *angles)])
            for one in (model.platform, PLATFORM)
        )
        np.testing.assert_allclose(values(found), values(true), rtol=0.15)
    np.testing.assert_allclose(np.degrees(model.truth_yaw), np.degrees(YAW), atol=1.5)
    np.testing.assert_allclose(values(model.sensor_gains[0]), values(FACTORS), rtol=0.1)
    assert 10.0 < model.platform.noise < 20.0


def dark_sensor(data: BoardReadings, sensor: int, seed: int) -> BoardReadings:
    """The same, of one sensor of robot 0 nothing but noise."""
    readings = data.readings.copy()
    readings[:, sensor] = 15.0 * np.random.default_rng(seed).standard_normal(readings[:, sensor].shape)
    return data._replace(readings=readings)


@pytest.mark.parametrize("seed", [4, 5])
def test_a_dead_sensor_is_found_and_left_out_though_the_curves_to_begin_with_are_wrong(seed: int) -> None:
    paper, data = load_ir_platform("droplet"), dark_sensor(recorded(300, seed), 2, seed)
    narrow = replace(PLATFORM, sensor=paper.sensor, emitter=paper.emitter)
    elements, alive = without_dead(fit_board(narrow, data, ROBOTS).platform, data, ROBOTS)
    assert np.argwhere(elements.dead).tolist() == [[0, 0, 2]]
    assert np.isnan(alive.readings[:, 2]).all()
    assert np.isfinite(alive.readings[:, [0, 1, 3, 4, 5]]).all()
    assert not without_dead(PLATFORM, recorded(300, seed), ROBOTS)[0].dead.any()


@pytest.mark.parametrize("seed", [6, 7])
def test_sensors_that_nobody_faced_are_not_called_dead(seed: int) -> None:
    """All robots are ahead of the receiver; its sensors 2 and 3 look back."""
    data = recorded(600, seed)
    ahead = select(data, np.abs(data.poses[:, 1]) < 1.2)
    brightest = np.quantile(ahead.readings.max(axis=2), 0.95, axis=0)
    assert brightest[[2, 3]].max() < 0.2 * np.median(brightest)
    elements, _ = without_dead(fit_board(PLATFORM, ahead, ROBOTS).platform, ahead, ROBOTS)
    assert not elements.dead.any()


def with_stray_light(data: BoardReadings, share: float, seed: int) -> BoardReadings:
    """The same with light by way of bodies and floor, a share of the brightest reading of each exchange."""
    brightest = data.readings.max(axis=(1, 2), keepdims=True)
    light = share * brightest * np.random.default_rng(seed).standard_normal(data.readings.shape)
    return data._replace(readings=np.minimum(data.readings + light, PLATFORM.saturation))


@pytest.mark.parametrize("seed", [8, 9])
def test_a_board_that_knows_of_stray_light_is_less_overconfident(seed: int) -> None:
    data = with_stray_light(recorded(400, seed), 0.06, seed)
    model = fit_board(PLATFORM, data, ROBOTS)
    nees = {
        stray: errors_of(replace(model, platform=replace(model.platform, stray_noise=stray)), data).nees
        for stray in (0.0, 0.06)
    }
    assert np.mean(nees[0.06]) < 0.6 * np.mean(nees[0.0])


TRIO, N = 3, 6
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
    """Robots with the platform's noise, of which all that lasts is the same while they stand."""
    rng = np.random.default_rng(seed)
    stretches = -(-course.count // course.stay)
    poses = random_poses(stretches, seed, course.nearest, course.farthest)
    stretch = np.repeat(np.arange(stretches), course.stay)[: course.count]
    first = rng.integers(0, TRIO, stretches)
    receiver = first[stretch]
    transmitter = ((first + rng.integers(1, TRIO, stretches)) % TRIO)[stretch]
    moved = poses[stretch] + course.walk * rng.standard_normal((course.count, 3)) * [1.0, 10.0, 10.0]
    factors = np.exp(platform.element_sigma * rng.standard_normal((2, TRIO, N)))
    gains = PairGains(factors[0, receiver], factors[1, transmitter], np.zeros((course.count, 4)))
    lasting = np.exp(platform.curve_sigma * rng.standard_normal((stretches, N, N)))
    lasting *= rng.uniform(size=lasting.shape) > platform.blocked_share
    light = expected_brightness(platform, moved, gains)[:, 0] * lasting[stretch]
    light *= 1.0 + platform.relative_noise * rng.standard_normal(light.shape)
    light += platform.noise * rng.standard_normal(light.shape)
    limit = np.broadcast_to(platform.saturation if saturation is None else saturation, (TRIO, N))
    readings = np.rint(np.minimum(light, limit[receiver][..., None]))[:, None]
    unknown = np.full((course.count, 3), np.nan)
    return Exchanges(
        receiver, transmitter, readings, np.full((course.count, 1), platform.saturation), unknown
    )


def limits_of(
    platform: IrPlatform, course: Course, seed: int, saturation: FloatArray | float | None = None
) -> ReadingLimits:
    return find_reading_limits(platform, TRIO, exchanged(platform, course, seed, saturation))


@pytest.mark.parametrize("seed", range(5))
def test_sensors_that_saturate_are_found_each_at_its_own_count(seed: int) -> None:
    """Every other one saturates at a lower count."""
    true = np.where(np.arange(TRIO * N).reshape(TRIO, N) % 2, 255.0, 180.0)
    found = limits_of(board("droplet"), Course(stay=1), seed, true).saturation
    np.testing.assert_allclose(found, true, rtol=0.005)


@pytest.mark.parametrize("seed", range(3))
def test_sensors_of_real_boards_are_found_where_enough_geometries_saturate_them(seed: int) -> None:
    course = Course(1500, stay=1, nearest=0.044)
    exchanges = exchanged(board("droplet_2016"), course, seed)
    found = find_reading_limits(board("droplet_2016"), TRIO, exchanges).saturation
    exchange, sensor, _ = np.nonzero(exchanges.readings[:, 0] >= board("droplet_2016").saturation)
    often = np.zeros((TRIO, N), dtype=np.bool_)
    for robot, i in np.ndindex(TRIO, N):
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
    ratio = find_reading_limits(platform, TRIO, exchanges).noise / platform.noise
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
    found = find_reading_limits(board("droplet"), TRIO, exchanges)
    assert np.isnan(found.saturation[:, 2]).all()
    assert np.isnan(found.relative_noise[:, 2]).all()
    others = np.delete(found.noise, 2, axis=1)
    assert np.abs(others - np.hypot(1.0, ROUNDED)).max() < 0.12
    assert np.isnan(dark) or np.abs(found.noise[:, 2] - np.sqrt(2.0)).max() < 0.15


@pytest.mark.parametrize("seed", [1, 2])
def test_a_board_that_is_as_described_is_not_contradicted(seed: int) -> None:
    for name in ("droplet", "droplet_2016"):
        exchanges = exchanged(board(name), Course(1500), seed)
        limits = find_reading_limits(board(name), TRIO, exchanges)
        assert contradictions(board(name), exchanges, limits, ("a", "b", "c")) == []


def test_what_contradicts_the_description_is_said_in_a_sentence_each() -> None:
    described = replace(board("droplet"), dark_level=0.4)
    truly = replace(described, noise=4.0, relative_noise=0.12)
    true = np.full((TRIO, N), NEVER)
    true[1] = 150.0
    exchanges = exchanged(truly, Course(3000, stay=3, nearest=0.12), 8, true)
    limits = find_reading_limits(described, TRIO, exchanges)
    saturation, noise, relative = contradictions(described, exchanges, limits, ("a", "b", "c"))
    assert saturation == (
        "Sensors saturate lower than board and matrices say: b [0, 1, 2, 3, 4, 5] at 150 of 255 counts."
    )
    assert noise.startswith("Where robots stand, dark readings scatter by 4")
    assert noise.endswith(" counts, but noise of the board is 1.")
    assert relative.startswith("Where robots stand, bright readings scatter by 1")
    assert relative.endswith(" % besides, but relative_noise and curve_sigma of the board are 0 % together.")


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


Faults = dict[tuple[int, int, int], float]
"""The share of its light that an element still gives, by side, robot and number."""


def exchanged_with(count: int, seed: int, faults: Faults, poses: FloatArray | None = None) -> Exchanges:
    """Robots that stand elsewhere at every exchange; readings are blocked as often as the board says.

    In every tenth exchange a whole sensor is dark, as behind a third robot.
    """
    rng = np.random.default_rng(seed)
    receiver = rng.integers(0, TRIO, count)
    transmitter = (receiver + rng.integers(1, TRIO, count)) % TRIO
    poses = random_poses(count, seed, 0.05, 0.2) if poses is None else poses
    factors = np.exp(PLATFORM.element_sigma * rng.standard_normal((2, TRIO, N)))
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
    exchanges = exchanged_with(count, seed, drawn(seed))
    return exchanges, find_dead_elements(PLATFORM, TRIO, exchanges)


@pytest.mark.parametrize("seed", range(5))
def test_dead_and_shaded_elements_are_found_and_no_others(seed: int) -> None:
    faults, (_, verdicts) = drawn(seed), found(400, seed)
    assert set(zip(*(side.tolist() for side in np.nonzero(verdicts.dead)), strict=True)) == set(faults)
    few = find_dead_elements(PLATFORM, TRIO, exchanged_with(60, seed, faults))
    assert verdicts.undecided.sum() < few.undecided.sum()


@pytest.mark.parametrize("seed", range(10, 15))
def test_where_all_work_none_is_named(seed: int) -> None:
    verdicts = find_dead_elements(PLATFORM, TRIO, exchanged_with(400, seed, {}))
    assert not verdicts.dead.any()
    assert verdicts.works.mean() > 0.5


def test_few_exchanges_decide_nothing() -> None:
    verdicts = find_dead_elements(PLATFORM, TRIO, exchanged_with(6, 1, drawn(1)))
    assert verdicts.undecided.all()


@pytest.mark.parametrize("seed", [1, 2])
def test_one_geometry_says_little_however_often_it_was_measured(seed: int) -> None:
    """Something that stands between two robots darkens the same sensor every time."""
    facing = np.tile([0.1, PLATFORM.angles[0], 0.0], (100, 1))
    exchanges = exchanged_with(100, seed, {}, facing)
    exchanges.readings[:, :, 0] = PLATFORM.noise * np.random.default_rng(seed).standard_normal((100, 1, N))
    assert not find_dead_elements(PLATFORM, TRIO, exchanges).dead.any()


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
    two = find_dead_elements(PLATFORM, TRIO, other)
    np.testing.assert_array_equal(one.dead, two.dead[:, places])
    np.testing.assert_array_equal(one.works, two.works[:, places])
