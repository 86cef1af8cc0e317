"""Boards whose readings may be blocked or too bright: poses are honest, and none is read into noise."""

import numpy as np
import pytest
from ir_world import nees, pair_of, pose_errors, random_poses, readings_of

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import add_spread, new_start_workspace
from swarm_loc_estimator.infrared.cost import cost_of, new_cost_workspace
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.search import IrOutcome
from swarm_loc_estimator.swarm.ir_board import load_ir_platform

BOARD = load_ir_platform("droplet_2016")
ESTIMATOR = MaximumLikelihood(BOARD)
_CHI_SQUARE_99 = 11.345


def with_faults(poses: FloatArray, seed: int) -> FloatArray:
    """Readings (k, 1, 6, 6) of which now and then a whole emitter is dark, or one reading too bright."""
    rng = np.random.default_rng(seed)
    readings = readings_of(BOARD, poses, seed)
    readings *= np.exp(BOARD.relative * rng.standard_normal(readings.shape))
    for k in np.flatnonzero(rng.random(len(poses)) < 0.5).tolist():
        readings[k, 0, :, rng.integers(6)] = BOARD.noise * rng.standard_normal(6)
    bright = rng.random(readings.shape) < 0.01
    readings[bright] += rng.exponential(5.0 * BOARD.noise, readings.shape)[bright]
    return np.minimum(readings, BOARD.saturation)


@pytest.mark.parametrize(
    ("seed", "low", "high", "beyond"),
    [(1, 0.06, 0.18, 0.03), (2, 0.06, 0.18, 0.03), (3, 0.06, 0.18, 0.03), (5, 0.2, 0.3, 0.05)],
)
def test_dark_emitters_and_light_from_elsewhere_do_not_mislead(
    seed: int, low: float, high: float, beyond: float
) -> None:
    """Of faint robots bearing or heading is often another one, and covariances say so."""
    poses = random_poses(600, seed, low=low, high=high)
    solutions = ESTIMATOR.solve(with_faults(poses, seed))
    found = solutions.outcomes == IrOutcome.FOUND
    errors = pose_errors(solutions.poses[found], poses[found])
    assert np.mean(nees(errors, solutions.covariances[found]) > _CHI_SQUARE_99) < beyond
    if high < 0.2:
        assert np.mean(found) > 0.85
        assert np.all(np.median(np.abs(errors), axis=0) < [0.01, np.radians(5.0), np.radians(10.0)])


def test_covariances_say_of_the_same_direction_at_another_range() -> None:
    table = ESTIMATOR._models.table
    work = new_start_workspace(table)
    work.costs[:] = 100.0
    work.costs[3 * table.angles.size + 5, [2, 10]] = 0.0
    pose, covariance = np.array([table.ranges[10], table.angles[3], table.angles[5]]), np.zeros((3, 3))
    add_spread(table, work, pose, covariance)
    near, far = table.ranges[2], table.ranges[10]
    weight = near**2 / (near**2 + far**2)
    assert covariance[0, 0] == pytest.approx(weight * (far - near) ** 2, rel=1e-5)
    np.testing.assert_allclose(covariance[1:, 1:], 0.0, atol=1e-12)


def test_noise_alone_is_no_robot() -> None:
    noise = BOARD.noise * np.random.default_rng(4).standard_normal((500, 1, 6, 6))
    outcomes = ESTIMATOR.solve(noise).outcomes
    assert np.mean(outcomes == IrOutcome.FOUND) < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_the_costs_gradient_is_its_slope_also_of_outliers(seed: int) -> None:
    pose = random_poses(1, seed, low=0.08, high=0.16)
    readings = np.roll(with_faults(pose, seed)[0], 1, axis=1)  # most are outliers now
    model = BOARD.model
    pair, work = pair_of(model, readings, 1e9), new_cost_workspace(1, 6, False)

    def cost_at(at: FloatArray) -> tuple[float, FloatArray]:
        cost = cost_of(model, pair, at, work, work.gradients[0], work.hessians[0])
        return cost, work.gradients[0].copy()

    _, gradient = cost_at(pose[0])
    for p in range(3):
        step = np.zeros(3)
        step[p] = 1e-7
        slope = (cost_at(pose[0] + step)[0] - cost_at(pose[0] - step)[0]) / 2e-7
        assert gradient[p] == pytest.approx(slope, rel=1e-3, abs=0.05)
