"""The simulated infrared: what sensors read, who hears whom, and what gets lost."""

from dataclasses import replace

import numpy as np
import pytest
from droplet_rig import IDEAL, LINK, QUIET, SECOND, TRIANGLE, world_of

from swarm_loc_drivers.droplet.hardware import EXCHANGE_NS, FULL_POWER, message_ns
from swarm_loc_drivers.sim.droplet.infrared import ExchangeReadings, InfraredCommand, InfraredSettings
from swarm_loc_drivers.sim.droplet.world import NEAR_POWER, STEP_NS, DropletErrors, DropletWorld
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import expected_brightness


def with_link(**changes: float) -> DropletErrors:
    return replace(IDEAL, infrared=replace(LINK, **changes))


def run(world: DropletWorld, duration_ns: int) -> None:
    for _ in range(-(-duration_ns // STEP_NS)):
        world.step()


def exchange(world: DropletWorld, emitter: int = 0, power: int = FULL_POWER) -> dict[int, FloatArray]:
    """Robot -> what it read (n, n), emitters by sensors."""
    world.infrared.emit(emitter, power, world.poses)
    run(world, EXCHANGE_NS)
    found: dict[int, FloatArray] = {}
    for robot, heard in enumerate(world.infrared.heard):
        for one in heard:
            if isinstance(one, ExchangeReadings):
                found[robot] = one.readings.astype(float)
        heard.clear()
    return found


def model(world: DropletWorld, receiver: int, emitter: int) -> FloatArray:
    """What a board reads (modes, n, n) without noise, sensors by emitters."""
    seen = se2.between(world.poses[receiver], world.poses[emitter])
    pose = [np.hypot(seen[0], seen[1]), np.arctan2(seen[1], seen[0]), seen[2]]
    readings: FloatArray = expected_brightness(QUIET, pose)[0]
    return readings


@pytest.mark.parametrize(("power", "mode"), [(FULL_POWER, 0), (NEAR_POWER, 1)])
def test_sensors_read_what_the_board_makes_of_the_poses(power: int, mode: int) -> None:
    world = world_of()
    found = exchange(world, power=power)
    assert set(found) == {1, 2}
    for robot, readings in found.items():
        exact = np.clip(np.rint(model(world, robot, 0)[mode].T), 0.0, 255.0)
        assert (readings == exact).all()


def test_power_in_between_shines_in_between() -> None:
    world = world_of(np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.5]]))
    totals = [exchange(world, power=power)[1].sum() for power in (0, NEAR_POWER, 150, FULL_POWER)]
    assert totals[0] == 0.0
    assert totals == sorted(totals)


def test_elements_differ_by_their_gains() -> None:
    world = world_of(np.array([[0.0, 0.0, 0.0], [0.18, 0.0, 0.5]]), replace(IDEAL, gain_sigma=0.1))
    bright = model(world, 1, 0)[0].T
    shares = exchange(world)[1] / np.where(bright > 8.0, bright, np.nan)
    gains = world.gains[1, 0][:, None] * world.gains[0, 1][None]
    shown = ~np.isnan(shares)
    assert np.abs(shares - gains)[shown].max() < 0.07
    assert np.abs(shares - 1.0)[shown].max() > 0.08


def test_counts_end_where_the_converter_does_and_ambient_light_is_taken_off() -> None:
    start = np.array([[0.0, 0.0, 0.0], [0.07, 0.0, 0.5]])
    world = world_of(start, with_link(ambient=8.0), noise=1.0)
    run(world, 6 * SECOND)
    readings = exchange(world)[1]
    assert 247 <= readings.max() <= 255
    assert (readings == 255).sum() < (readings > 245).sum()
    dim = model(world, 1, 0)[0].T < 0.5
    assert np.abs(readings[dim]).max() <= 6
    assert abs(readings[dim].mean()) < 2.0


def test_a_robot_in_between_casts_a_shadow() -> None:
    line = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.5]])
    free = exchange(world_of(line))[1]
    next_to_it = np.vstack([line, [0.1, 0.03, 0.0]])
    partly = exchange(world_of(next_to_it))[1]
    hidden = partly == 0.0
    assert hidden[free > 5.0].any()
    assert (partly[~hidden] == free[~hidden]).all()
    between = np.vstack([line, [0.1, 0.0, 0.0]])
    assert set(exchange(world_of(between))) == {2}


def test_messages_reach_so_far() -> None:
    world = world_of(np.array([[0.0, 0.0, 0.0], [0.0, 0.29, 0.0], [0.31, 0.0, 0.0]]))
    world.infrared.send(0, "get_id", 0, world.poses)
    run(world, message_ns(6))
    assert [len(heard) for heard in world.infrared.heard] == [0, 1, 0]


def test_messages_are_for_one_or_for_all() -> None:
    world = world_of()
    world.infrared.send(0, "get_id", int(world.ids[2]), world.poses)
    run(world, message_ns(6))
    assert [len(heard) for heard in world.infrared.heard] == [0, 0, 1]
    (heard,) = world.infrared.heard[2]
    assert isinstance(heard, InfraredCommand)
    assert heard.line == "get_id"


def test_as_many_get_lost_as_described() -> None:
    share, count = 0.2, 500
    world = world_of(errors=with_link(loss=share))
    for _ in range(count):
        world.infrared.send(0, "x", 0, world.poses)
        run(world, message_ns(1))
    heard = sum(len(one) for one in world.infrared.heard)
    expected_count, sigma = 2 * count * (1.0 - share), np.sqrt(2 * count * share * (1.0 - share))
    assert abs(heard - expected_count) < 5.0 * sigma


def test_who_speaks_at_the_same_time_is_not_understood() -> None:
    world = world_of()
    world.infrared.send(0, "get_id", 0, world.poses)
    run(world, STEP_NS)
    world.infrared.send(1, "get_id", 0, world.poses)
    run(world, SECOND)
    assert not any(world.infrared.heard)
    assert world.infrared.counts["collided"] == 4


def test_who_measures_hears_nothing_else() -> None:
    far = np.vstack([TRIANGLE[:2], [0.35, 0.02, 0.0]])  # hears the second, and not the first
    world = world_of(far)
    world.infrared.emit(0, FULL_POWER, world.poses)
    run(world, EXCHANGE_NS // 2)
    world.infrared.send(2, "get_id", 0, world.poses)
    run(world, EXCHANGE_NS)
    assert [type(one) for one in world.infrared.heard[1]] == [ExchangeReadings]


def test_who_measured_when_a_message_began_does_not_understand_it() -> None:
    far = np.vstack([TRIANGLE[:2], [0.35, 0.02, 0.0]])  # hears the second, and not the first
    world = world_of(far)
    world.infrared.emit(0, FULL_POWER, world.poses)
    run(world, EXCHANGE_NS - 2 * STEP_NS)
    world.infrared.send(2, "get_id", 0, world.poses)
    run(world, 2 * STEP_NS)
    assert not world.infrared.status(0)
    run(world, message_ns(6))
    assert [type(one) for one in world.infrared.heard[1]] == [ExchangeReadings]
    assert world.infrared.counts["exchanges"] == 1
    world.infrared.send(2, "get_id", 0, world.poses)
    run(world, message_ns(6))
    assert [type(one) for one in world.infrared.heard[1]] == [ExchangeReadings, InfraredCommand]


def test_light_of_two_at_once_adds_up() -> None:
    row = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.4, 0.0, 0.0]])
    alone = exchange(world_of(row), power=FULL_POWER)[1]
    world = world_of(row)
    world.infrared.emit(0, FULL_POWER, world.poses)
    run(world, 30_000_000)
    world.infrared.emit(2, FULL_POWER, world.poses)
    run(world, EXCHANGE_NS)
    (both,) = (one.readings for one in world.infrared.heard[1] if isinstance(one, ExchangeReadings))
    assert (both >= alone).all()
    assert both.sum() > 1.2 * alone.sum()


def test_the_same_seed_gives_the_same_readings() -> None:
    errors = replace(IDEAL, gain_sigma=0.1, infrared=InfraredSettings(0.3, 0.05, 6.0, 0.1))
    first, again, other = (exchange(world_of(errors=errors, seed=seed, noise=1.0)) for seed in (4, 4, 5))
    assert all((first[robot] == again[robot]).all() for robot in first)
    assert any((first[robot] != other.get(robot)).any() for robot in first)
