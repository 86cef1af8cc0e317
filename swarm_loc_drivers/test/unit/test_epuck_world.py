"""The world of e-pucks: wheels against truth, what cameras take when, and that all of it repeats itself."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.scenarios.eight_run import EightSettings, describe
from swarm_loc_drivers.epuck.hardware import raw_of_distance, wheel_geometry
from swarm_loc_drivers.sim.epuck.world import (
    STEP_NS,
    EpuckWorld,
    EpuckWorldSettings,
    Exposure,
    SimulatedEpuck,
)
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena
from swarm_loc_drivers.sim.scenarios.eight import ARENA
from swarm_loc_drivers.sim.worlds import W0, W2, ErrorModel, WorldError
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_vision.markers.families import family_named

WHEELS = wheel_geometry(wheel_diameter=0.041, wheel_separation=0.053)
IDEAL = replace(W0, wheel_noise=0.0)
CAMERA = CameraModel(width=320, height=240)
START = np.array([[0.0, 0.0, 0.3], [0.3, 0.05, 2.0], [-0.4, 0.3, -1.0]])


def world_of(
    errors: ErrorModel = IDEAL,
    seed: int = 1,
    start: FloatArray = START,
    camera: CameraModel = CAMERA,
    rate: float = 7.5,
    swarm: Swarm | None = None,
) -> EpuckWorld:
    arena = Arena(ARENA, family_named("artoolkit_bch_thin"))
    settings = EpuckWorldSettings(seed, errors, arena, camera, WHEELS, rate, 1_000_000_000_000)
    return EpuckWorld(swarm or describe(EightSettings(robots=len(start)), start), settings)


def run(world: EpuckWorld, duration_s: float) -> list[Exposure]:
    return [taken for _ in range(round(duration_s * 1e9) // STEP_NS) for taken in world.step()]


@pytest.mark.parametrize(("left", "right"), [(400.0, 400.0), (300.0, 520.0), (-200.0, 200.0), (0.0, 0.0)])
def test_ideal_wheels_drive_the_arc_that_their_counters_tell(left: float, right: float) -> None:
    world = world_of()
    body = SimulatedEpuck(world, 0)
    body.set_wheel_speeds(left, right)
    run(world, 4.0)
    assert body.wheel_steps() == pytest.approx((4.0 * left, 4.0 * right), abs=1.0)
    paths = math.pi * 0.041 / 1000.0 * np.array([4.0 * left, 4.0 * right])
    turn, path = (paths[1] - paths[0]) / 0.053, 0.5 * paths.sum()
    chord = path if turn == 0.0 else 2.0 * path / turn * math.sin(0.5 * turn)
    direction = 0.3 + 0.5 * turn
    expected = [chord * math.cos(direction), chord * math.sin(direction)]
    np.testing.assert_allclose(world.poses[0, :2], expected, atol=1e-9)
    assert math.remainder(world.poses[0, 2] - 0.3 - turn, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(world.poses[1:], START[1:])


@pytest.mark.parametrize("shown", ["faces", "landmarks", "nothing"])
def test_swarms_with_markers_on_robots_alone_in_the_room_alone_or_nowhere_are_simulated(shown: str) -> None:
    swarm = describe(EightSettings(robots=len(START)), START)
    swarm = replace(swarm, landmarks=swarm.landmarks if shown == "landmarks" else ())
    robots = tuple(replace(one, faces=one.faces if shown == "faces" else ()) for one in swarm.robots)
    world = world_of(W2, swarm=replace(swarm, robots=robots))
    taken = run(world, 0.5)
    assert {one.robot for one in taken} == {0, 1, 2}
    assert all(world.image(one).std() > 0.0 for one in taken[-3:])


def test_counters_are_blind_to_slip_and_noise() -> None:
    turns = []
    for seed in range(40):
        world = world_of(W2, seed)
        body = SimulatedEpuck(world, 0)
        body.set_wheel_speeds(-206.0, 206.0)
        run(world, 2.0)
        assert body.wheel_steps() == pytest.approx((-412, 412), abs=1)
        turns.append(math.remainder(world.poses[0, 2] - 0.3, 2.0 * math.pi))
    rolled = math.pi * 0.041 / 1000.0 * 412.0
    assert np.mean(turns) == pytest.approx(0.95 * 2.0 * rolled / 0.053, abs=0.02)
    spread = math.sqrt(2.0 * W2.wheel_noise * 0.95 * rolled) / 0.053
    assert np.std(turns) == pytest.approx(spread, rel=0.4)


def test_slipping_wheels_do_not_shake_the_camera_within_an_exposure() -> None:
    world = world_of(replace(W2, turn_slip=0.0))
    world.rates[:] = 466.0
    headings = [world.poses[:, 2]]
    for _ in range(400):
        world.step()
        headings.append(world.poses[:, 2])
    turns = np.diff(headings, axis=0)
    jumps = np.diff(turns, axis=0)
    # white noise would change the turn twice as much as it turns, in variance
    assert 0.1 < np.var(jumps) / np.var(turns) < 0.4


def test_every_camera_takes_pictures_at_its_rate_and_stamps_them_as_the_world_errs() -> None:
    for world, early_s in ((world_of(), 0.0), (world_of(W2), 0.133)):
        taken = run(world, 6.0)
        for robot in range(3):
            own = [one for one in taken if one.robot == robot]
            assert [one.number for one in own] == list(range(len(own)))
            stamps = [one.stamp_ns for one in own]
            assert set(np.diff(stamps)) == {round(1e9 / 7.5)}
            assert len(own) >= 6.0 * 7.5 - 3
            early = np.array([one.stamp_ns - one.middle_ns for one in own]) * 1e-9
            assert (early >= 0.0).all()
            assert early.max() <= early_s
            assert np.ptp(early) > 0.7 * early_s or early_s == 0.0
        assert len({one.stamp_ns for one in taken}) == len(taken)  # each at its own phase


def test_a_picture_is_there_once_its_shutter_has_closed_and_not_before() -> None:
    world = world_of()
    body = SimulatedEpuck(world, 0)
    assert body.image() is None
    while not (taken := [one for one in world.step() if one.robot == 0]):
        pass
    assert world.now_ns - STEP_NS < taken[0].middle_ns + 4_000_000 <= world.now_ns
    image = body.image()
    assert image is not None
    assert image[1] == taken[0].stamp_ns
    assert image[0].shape == (240, 320)
    np.testing.assert_array_equal(image[0], world.image(taken[0]))


def test_a_picture_shows_where_the_robot_was_when_it_was_taken() -> None:
    """The robot turns; the image equals that of a robot that stands where this one was at the middle."""
    short = replace(CAMERA, exposure_s=1e-5)
    world = world_of(camera=short)
    world.rates[0] = -60.0, 60.0
    taken = [one for one in run(world, 0.6) if one.robot == 0][-1]
    rate = 2.0 * 60.0 * math.pi * 0.041 / 1000.0 / 0.053
    there = START.copy()
    there[0, 2] += rate * (taken.middle_ns - 1_000_000_000_000) * 1e-9
    still = world_of(start=there, camera=short)
    same = [one for one in run(still, 0.6) if one.robot == 0][-1]
    difference = world.image(taken).astype(int) - still.image(same).astype(int)
    assert np.abs(difference).max() <= 2
    later = world_of(start=there + np.array([0.0, 0.0, 0.02]), camera=short)
    run(later, 0.6)
    assert np.abs(world.image(taken).astype(int) - later.image(same)).max() > 40


@pytest.mark.parametrize(("rate", "exposure_s"), [(2.0, 0.133), (2.0, 1e-5), (60.0, 0.133), (60.0, 0.008)])
def test_the_newest_picture_can_be_drawn_until_the_next_one_is_taken(rate: float, exposure_s: float) -> None:
    world = world_of(W2, camera=replace(CAMERA, width=32, height=24, exposure_s=exposure_s), rate=rate)
    run(world, 0.8)
    for _ in range(5 * round(1e9 / rate) // STEP_NS):
        newest = list(world.newest)
        world.step()
        for exposure in newest:
            assert exposure is not None
            if world.newest[exposure.robot] is not exposure:
                assert world.image(exposure).shape == (24, 32)


def test_the_same_seed_and_commands_give_the_same_world_whoever_looks() -> None:
    watched, alone, other = world_of(W2, 5), world_of(W2, 5), world_of(W2, 6)
    for world in (watched, alone, other):
        world.rates[:] = [[300.0, 380.0], [350.0, 300.0], [100.0, 150.0]]
    images = [watched.image(one) for one in run(watched, 0.5)]
    watched.proximity(0)
    taken = run(alone, 0.5)
    run(other, 0.5)
    np.testing.assert_array_equal(watched.poses, alone.poses)
    np.testing.assert_array_equal(images[-1], alone.image(taken[-1]))
    assert np.abs(watched.poses - other.poses).max() > 1e-5


def test_proximity_rises_before_walls_and_robots() -> None:
    before_wall = np.array([[1.2 - 0.035 - 0.02, 0.0, math.radians(17.0)], [0.0, 0.0, 0.0], [0.0, 0.4, 0.0]])
    world = world_of(start=before_wall)
    free = raw_of_distance(1.0)
    wall = world.proximity(0)
    assert wall[0] == pytest.approx(raw_of_distance(0.02), abs=30)  # ps0 looks 17 degrees to the right
    assert (np.abs(wall[2:6] - free) < 30).all()
    pair = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0], [0.5, 0.5, 0.0]])
    left = world_of(start=pair).proximity(0)
    assert left[5] == pytest.approx(raw_of_distance(0.1 - 2 * 0.035), abs=40)  # ps5 looks to the left
    assert np.abs(left[2] - free) < 30


@pytest.mark.parametrize(
    ("change", "said"),
    [({"start": None}, "'epuck1' has no start pose"), ({"camera": None}, "'epuck1' has no camera")],
)
def test_a_swarm_that_cannot_be_simulated_is_refused_in_one_sentence(
    change: dict[str, None], said: str
) -> None:
    swarm = describe(EightSettings(robots=2), START[:2])
    lacking = Swarm((replace(swarm.robots[0], **change), swarm.robots[1]), swarm.landmarks)  # type: ignore[arg-type]
    with pytest.raises(WorldError, match=said):
        world_of(swarm=lacking)
