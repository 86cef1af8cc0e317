"""Swarms without a map: poses relative to the best connected robot, and their move to `map` as a whole."""

from dataclasses import replace

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import SECOND, T0, Event, give_fix
from core_run import on_time, play, ticks
from core_world import Plan, World, simulate

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.state import InitialPose, SwarmState
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.swarm import Robot
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

AFTER_S = 2.0
SETTINGS = Settings(origin_after_s=AFTER_S)
BLIND = Plan(robots=4, duration_s=14.0, arena=0.6, start_known=(False,), reach=3.0)
LANDMARK_IDS = 1000
FIX = np.diag([0.01**2, 0.01**2, 0.02**2])


def without_landmarks(world: World, until_s: float = np.inf) -> World:
    """The world in which no landmark is seen before an instant."""
    events = []
    for event in world.events:
        seen = event.detections
        if seen.size and event.stamp_ns < T0 + until_s * 1e9:
            seen = seen[seen["id"] < LANDMARK_IDS]
        if event.pose is not None or seen.size:
            events.append(replace(event, detections=seen))
    return replace(world, events=tuple(events))


def end_of(world: World) -> int:
    return int(world.stamp_ns[-1])


def run(estimator: Estimator, world: World, until_s: float | None = None) -> Estimate:
    end_ns = end_of(world) if until_s is None else T0 + round(until_s * 1e9)
    events = [(at_ns, event) for at_ns, event in on_time(world) if at_ns <= end_ns]
    return play(estimator, events, ticks(T0 + SECOND // 10, end_ns))[-1]


def relative_to_first(poses: FloatArray, truth: FloatArray) -> FloatArray:
    """Errors (N, 3) of poses (N, 3) moved such that the first robot has its true pose."""
    motion = se2.compose(truth[0], se2.inverse(poses[0]))
    return wrapped(se2.compose(motion, poses) - truth)


@pytest.mark.parametrize("seed", range(3))
def test_robots_are_located_relative_to_one_of_them(seed: int) -> None:
    world = without_landmarks(simulate(BLIND, seed))
    estimator = Estimator(world.swarm, SETTINGS)
    early = run(estimator, world, AFTER_S)
    assert np.isnan(early.poses).all()
    assert estimator.origin == ""
    estimator = Estimator(world.swarm, SETTINGS)
    last = run(estimator, world)
    assert estimator.origin in {robot.name for robot in world.swarm.robots}
    assert (last.status == Status.TRACKED).all()
    error = relative_to_first(last.poses, world.at(end_of(world)))
    assert np.abs(error[:, :2]).max() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_the_swarm_moves_to_the_map_as_a_whole_when_landmarks_come(seed: int) -> None:
    world = without_landmarks(simulate(BLIND, seed), until_s=8.0)
    estimator = Estimator(world.swarm, SETTINGS)
    run(estimator, world, 7.9)
    assert estimator.origin != ""
    estimator = Estimator(world.swarm, SETTINGS)
    estimates = play(estimator, on_time(world), ticks(T0 + SECOND // 10, end_of(world)))
    assert (estimator.origin, estimator.frame_moves) == ("", 1)
    last = estimates[-1]
    assert (last.status == Status.TRACKED).all()
    errors = wrapped(last.poses - world.at(end_of(world)))
    assert nees(errors, last.covariances).max() < 25.0
    assert np.abs(errors[:, :2]).max() < 0.1


@pytest.mark.parametrize("tracked", [True, False])
def test_one_fix_with_heading_moves_them_too(tracked: bool) -> None:
    """Or two, of a robot that nobody has located: the others wait for sightings then."""
    world = without_landmarks(simulate(BLIND, 1))
    robot, at_s = 2, 8.0
    if not tracked:  # nobody sees it, and it sees nobody
        world = replace(world, events=tuple(_unseen(event, robot) for event in world.events))
    estimator = Estimator(world.swarm, SETTINGS)
    run(estimator, world, at_s)
    before = estimator.tick(T0 + round(at_s * 1e9))
    assert np.isfinite(before.poses[robot]).all() == tracked
    for k in range(12):
        at_ns = T0 + round((at_s + 0.2 * k) * 1e9)
        for _, event in on_time(world):
            if at_ns - SECOND // 5 < event.stamp_ns <= at_ns:
                event.give(estimator, at_ns)
        give_fix(estimator, robot, at_ns, world.at(at_ns)[robot], FIX, at_ns)
        last = estimator.tick(at_ns)
    assert (estimator.origin, estimator.frame_moves) == ("", 1)
    located = np.asarray(np.isfinite(last.poses).all(axis=1))
    assert located.all() if tracked else located[robot]
    errors = wrapped(last.poses - world.at(at_ns))
    assert nees(errors[located], last.covariances[located]).max() < 25.0


def test_a_local_frame_ends_when_all_its_robots_are_forgotten() -> None:
    world = without_landmarks(simulate(BLIND, 0))
    estimator, at_ns = Estimator(world.swarm, SETTINGS), T0 + 8 * SECOND
    run(estimator, world, 8.0)
    assert estimator.origin
    for robot in range(4):
        estimator.forget(robot, at_ns)
    estimator.tick(at_ns)
    assert estimator.origin == ""
    kept = estimator.counters["constraints kept"]
    give_fix(estimator, 1, at_ns + SECOND // 10, np.array([0.1, 0.2, 0.3]), FIX, at_ns + SECOND // 5)
    estimator.tick(at_ns + SECOND // 5)
    assert estimator.counters["constraints kept"] == kept + 1


def _unseen(event: Event, robot: int) -> Event:
    seen = event.detections
    return replace(event, detections=seen[:0] if event.robot == robot else seen[seen["id"] // 10 != robot])


def test_starts_landmarks_and_a_time_of_zero_keep_the_swarm_in_the_map() -> None:
    world = without_landmarks(simulate(BLIND, 0))
    started = simulate(replace(BLIND, start_known=(True, False, False, False)), 0)
    for swarm, settings, events in (
        (world.swarm, Settings(origin_after_s=0.0), world),
        (started.swarm, SETTINGS, without_landmarks(started)),
        (world.swarm, SETTINGS, simulate(BLIND, 0)),
    ):
        estimator = Estimator(swarm, settings)
        run(estimator, events)
        assert (estimator.origin, estimator.frame_moves) == ("", 0)


def test_a_move_has_the_covariance_of_sampled_errors() -> None:
    """A frame of three robots with correlated errors, of which the second gets a pose in `map`."""
    rng = np.random.default_rng(0)
    state = SwarmState(ParameterTable.of([Robot(f"r{i}") for i in range(4)]))
    for robot in range(3):
        state.initialize(robot, InitialPose(rng.normal(0.0, 1.0, 3), np.eye(3)), Preintegrated.begin(T0))
    root = 1e-3 * rng.standard_normal((9, 9))
    state.filter.covariance[:9, :9] = root @ root.T
    transforms, joint = state.transform[:3].copy(), state.filter.covariance[:9, :9].copy()
    pose, own = np.array([3.0, -1.0, 2.0]), np.diag([1e-4, 4e-4, 1e-5])
    state.move(1, InitialPose(pose, own))
    count = 20_000
    twists = rng.multivariate_normal(np.zeros(9), joint, count).reshape(count, 3, 3)
    new = rng.multivariate_normal(np.zeros(3), own, count)
    true = se2.compose(se2.exp(twists), transforms)
    fixed = se2.compose(se2.exp(new), pose)
    moved = se2.compose(se2.compose(fixed, se2.inverse(true[:, 1]))[:, None], true)
    errors = se2.log(se2.compose(moved, se2.inverse(state.transform[:3])))
    expected = np.cov(errors.reshape(count, 9).T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(state.filter.covariance[:9, :9] / scale, expected / scale, atol=0.05)
    np.testing.assert_array_equal(state.filter.covariance[9:12, :9], 0.0)
