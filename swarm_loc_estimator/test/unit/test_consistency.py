"""Errors are as large as the covariances say, and vanish where there is no noise."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import POSE, POSE_TWO, POSITION, T0
from core_run import SPARSE, TOGETHER, on_time, play, ticks
from core_world import MOUNT, ODOMETRY, Plan, World, simulate
from scipy.stats import chi2

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

SEEDS = range(6)

world_of = lru_cache(maxsize=len(SEEDS))(simulate)
"""For tests that let several estimators run over one world, and change nothing in it."""


def errors(world: World, settings: Settings, period_s: float) -> tuple[FloatArray, FloatArray]:
    """Errors (T, N, 3) and covariances (T, N, 3, 3) of a run, every `period_s`."""
    end_ns = int(world.stamp_ns[-1])
    estimates = play(Estimator(world.swarm, settings), on_time(world), ticks(T0, end_ns, period_s))
    error = np.array([estimate.poses - world.at(estimate.stamp_ns) for estimate in estimates])
    return wrapped(error), np.array([estimate.covariances for estimate in estimates])


def batched(batch_from: int) -> Settings:
    """Settings that fuse so many measurements of a period and more together."""
    return Settings(policy=Policy(large_from=1, batch_from=batch_from))


def assert_chi_square(squared: Sequence[FloatArray]) -> None:
    """The mean of normalised errors, an array (N,) of each run, is what three degrees of freedom give."""
    samples = np.concatenate(squared)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 3 * samples.size) / samples.size
    assert low < samples.mean() < high


@pytest.mark.parametrize(("settings", "robots"), [(Settings(), 1), (Settings(), 5), (SPARSE, 12)])
@pytest.mark.parametrize(
    ("content", "flips"), [(POSE, 0.0), (POSITION, 0.0), (POSE_TWO, 0.2)], ids=["pose", "range", "two"]
)
def test_the_normalised_error_is_chi_square_distributed(
    content: int, flips: float, settings: Settings, robots: int
) -> None:
    """Poses of one run are correlated over time: as many samples count as there are runs and robots."""
    squared = []
    for seed in SEEDS:
        world = simulate(Plan(robots, 8.0, content=content, flips=flips, landmarks=6), 100 + seed)
        error, covariance = errors(world, settings, 1.0)
        squared.append(nees(error, covariance)[2:].mean(axis=0))
    assert_chi_square(squared)


def assert_estimated(worlds: Sequence[World], trusting: Callable[[World], Swarm], settings: Settings) -> None:
    """What is wrong with worlds is estimated: errors are as the filter says, and less than of who trusts."""
    squared, own, others = [], [], []
    for world in worlds:
        error, covariance = errors(world, settings, 1.0)
        squared.append(nees(error, covariance)[5:].mean(axis=0))
        own.append(np.square(error[5:, :, :2]).mean())
        error, _ = errors(replace(world, swarm=trusting(world)), settings, 1.0)
        others.append(np.square(error[5:, :, :2]).mean())
    assert_chi_square(squared)
    assert np.mean(own) < 0.7 * np.nanmean(others)  # not a number where it got lost


@pytest.mark.parametrize(
    ("content", "robots", "settings"),
    [
        *((POSE, 1, settings) for settings in (batched(5), batched(1000))),
        *((POSITION, 3, settings) for settings in (batched(5), batched(1000), SPARSE)),
        (POSE, 3, SPARSE),
    ],
)
def test_errors_that_last_are_estimated_and_the_error_stays_chi_square_distributed(
    content: int, robots: int, settings: Settings
) -> None:
    plan = Plan(robots, 20.0, content=content, lasting=1.0, speed=0.15)

    def trusting(world: World) -> Swarm:
        trusted = (replace(robot, odometry=ODOMETRY, camera=MOUNT) for robot in world.swarm.robots)
        return replace(world.swarm, robots=tuple(trusted))

    assert_estimated([world_of(plan, 200 + seed) for seed in SEEDS], trusting, settings)


@pytest.mark.parametrize(
    ("settings", "robots", "duration_s"), [(batched(5), 1, 30.0), (batched(1000), 1, 30.0), (SPARSE, 3, 20.0)]
)
@pytest.mark.parametrize("content", [POSE, POSITION])
def test_landmarks_badly_surveyed_are_estimated_and_the_error_stays_chi_square_distributed(
    content: int, settings: Settings, robots: int, duration_s: float
) -> None:
    plan = Plan(robots, duration_s, content=content, survey=1.0, speed=0.15)

    def trusting(world: World) -> Swarm:
        trusted = (replace(mark, position_sigma=0.0, yaw_sigma=0.0) for mark in world.swarm.landmarks)
        return replace(world.swarm, landmarks=tuple(trusted))

    assert_estimated([world_of(plan, 300 + seed) for seed in SEEDS], trusting, settings)


@pytest.mark.parametrize("fusion_period_s", [0.0, 0.2])
@pytest.mark.parametrize("content", [POSE, POSITION])
def test_without_noise_the_error_vanishes(content: int, fusion_period_s: float) -> None:
    world = simulate(Plan(2, 10.0, content=content, noise=0.0), 7)
    wrong = [
        replace(robot, start=(robot.start[0] + 0.03, robot.start[1] - 0.03, robot.start[2] + 0.05))
        for robot in world.swarm.robots
        if robot.start
    ]
    world = replace(world, swarm=replace(world.swarm, robots=tuple(wrong)))
    error, _ = errors(world, replace(batched(3), fusion_period_s=fusion_period_s), 0.5)
    assert np.abs(error[0]).max() > 0.02
    assert np.abs(error[-1]).max() < 0.006


def rmse(speed: float, settings: Settings, period_s: float = 0.25, stored_s: float = 0.0) -> float:
    """Root mean square of the distances from the truth, looked at every `period_s` [m].

    Sightings have the stamps of the closest of the states that are stored every `stored_s`, 0: their own.
    """
    squared, stored_ns = [], round(stored_s * 1e9)
    for seed in SEEDS:
        plan = Plan(2, 8.0, speed=speed, turn_rate=1.0, standing=(0, 1) if speed == 0.0 else ())
        world = world_of(plan, seed)
        if stored_ns:
            closest = (
                one
                if one.pose
                else replace(one, stamp_ns=(one.stamp_ns + stored_ns // 2) // stored_ns * stored_ns)
                for one in world.events
            )
            world = replace(world, events=tuple(sorted(closest, key=lambda one: one.stamp_ns)))
        error, _ = errors(world, settings, period_s)
        squared.append(np.square(error[4:, :, :2]).sum(axis=-1))
    return float(np.sqrt(np.mean(squared)))


def test_the_closest_stored_state_is_as_good_for_robots_that_stand_and_worse_for_fast_ones() -> None:
    """What the e-puck paper does (V-B), sightings at the closest stored state, against exact times."""
    standing, fast = (
        [rmse(speed, Settings(fusion_period_s=0.0), 0.4, stored_s) for stored_s in (0.4, 0.0)]
        for speed in (0.0, 0.3)
    )
    assert standing[0] == pytest.approx(standing[1], rel=0.02)
    assert not fast[0] <= 1.5 * fast[1]  # not a number where one got lost


def test_fusing_together_costs_little_accuracy() -> None:
    together, exact = replace(batched(3), fusion_period_s=0.2), Settings(fusion_period_s=0.0)
    assert rmse(0.1, together) < 1.1 * rmse(0.1, exact)


@pytest.mark.parametrize("settings", [TOGETHER, SPARSE], ids=["batch", "sparse"])
def test_fusing_together_makes_no_robot_surer_than_its_measurements_in_order(settings: Settings) -> None:
    """Process noise between a measurement and the end of its period counts. Starts are confirmed earlier."""
    ratios = []
    for seed in SEEDS:
        world = world_of(Plan(2, 8.0, landmarks=5), seed)
        _, together = errors(world, settings, 0.1)
        _, exact = errors(world, Settings(fusion_period_s=0.0), 0.1)
        ratios.append(np.diagonal(together, axis1=2, axis2=3) / np.diagonal(exact, axis1=2, axis2=3))
    assert np.median(ratios, axis=1).min() > 0.95


def test_neighbours_help_where_landmarks_are_few() -> None:
    plan = Plan(5, 12.0, landmarks=1)
    with_all, without = [], []
    for seed in SEEDS:
        world = simulate(plan, seed)
        error, _ = errors(world, Settings(), 0.5)
        with_all.append(np.square(error[8:, :, :2]).sum(axis=-1).mean())
        for event in world.events:
            event.detections["id"][event.detections["id"] < 1000] = 99
        error, _ = errors(world, Settings(), 0.5)
        without.append(np.square(error[8:, :, :2]).sum(axis=-1).mean())
    assert np.sqrt(np.mean(with_all)) < 0.8 * np.sqrt(np.mean(without))
