"""The scale of the process noise follows what the odometry does, and stays where the description is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from core_geometry import nees, wrapped
from core_messages import T0
from core_run import on_time, play, ticks
from core_world import ODOMETRY, Plan, World, simulate

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.state import LOG_SCALES
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings

PLAN = Plan(3, 40.0, speed=0.2, landmarks=6)


def described(world: World, share: float) -> World:
    """The world whose description has only a share of the true noise of the wheels."""
    odometry = replace(ODOMETRY, wheel_noise=share * ODOMETRY.wheel_noise)
    robots = tuple(replace(robot, odometry=odometry) for robot in world.swarm.robots)
    return replace(world, swarm=replace(world.swarm, robots=robots))


def run(world: World, settings: Settings) -> tuple[FloatArray, FloatArray]:
    """NEES (T, N), and the scales of the process noise (N,) at the end."""
    estimator = Estimator(world.swarm, settings)
    estimates = play(estimator, on_time(world), ticks(T0, int(world.stamp_ns[-1]), 1.0))
    error = np.array([estimate.poses - world.at(estimate.stamp_ns) for estimate in estimates])
    covariance = np.array([estimate.covariances for estimate in estimates])
    return nees(wrapped(error), covariance), estimator._timeline._ahead.integrity.motion_scale


@pytest.mark.parametrize("batch_from", [5, 1000])
def test_noise_that_is_described_too_small_is_scaled_up(batch_from: int) -> None:
    settings = Settings(policy=Policy(large_from=1, batch_from=batch_from))
    scales, late = [], []
    for seed in range(4):
        squared, scale = run(described(simulate(PLAN, 300 + seed), 0.02), settings)
        scales.append(scale)
        late.append(np.nanmean(squared[20:]))
    assert np.median(scales) > 8.0  # of 50
    assert np.max(scales) <= np.exp(LOG_SCALES[-1])
    assert np.mean(late) < 6.0


def test_noise_that_is_described_rightly_keeps_its_scale() -> None:
    scales = np.concatenate([run(simulate(PLAN, 300 + seed), Settings())[1] for seed in range(4)])
    assert np.median(scales) < 1.5
    assert scales.max() < 4.0
    assert scales.min() >= 1.0


def test_a_robot_that_stands_learns_nothing() -> None:
    _, scale = run(simulate(replace(PLAN, duration_s=10.0, standing=(0, 1, 2)), 1), Settings())
    np.testing.assert_array_equal(scale, 1.0)
