"""Readings that saturate below the platform's full scale: true ones are at least so bright.

A Droplet cuts at 255 counts and then takes the ambient light off: what saturates reads 240 to 255.
"""

from dataclasses import replace

import numpy as np
import pytest
from ir_world import droplet, nees, pair_of, pose_errors, random_poses, readings_of
from scipy.integrate import quad
from scipy.optimize import minimize

from bench.droplet.cramer_rao import information
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.cost import SATURATED, cost_of, new_cost_workspace
from swarm_loc_estimator.infrared.gains import Exchanges, estimate_gains
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.search import IrOutcome, ReadingsError
from swarm_loc_estimator.swarm.ir_board import PairGains

LIMIT = 240.0
ALIKE = MaximumLikelihood(droplet())
NEVER_BLOCKED = replace(droplet(), blocked_share=0.0)


def cut_readings(poses: FloatArray, seed: int) -> FloatArray:
    """Readings (k, modes, n, n) of sensors that saturate at 255 less an ambient light of up to 15 counts."""
    ambient = np.random.default_rng([seed, 1]).uniform(0.0, 255.0 - LIMIT, (len(poses), 1, 6, 1))
    bright = readings_of(replace(droplet(), saturation=1e9), poses, seed)
    return np.asarray(np.minimum(bright, 255.0 - ambient))


def limits(readings: FloatArray, limit: float = LIMIT) -> FloatArray:
    """Of all powers."""
    return np.full(readings.shape[:2], limit)


def surprise(pose: FloatArray, readings: FloatArray) -> float:
    """Minus the logarithm of the readings' likelihood, tails of the normal distribution integrated."""
    total = 0.0
    for one, bright in zip(
        readings.ravel(), expected_brightness(NEVER_BLOCKED, pose[None]).ravel(), strict=True
    ):
        if one < LIMIT:
            total += 0.5 * (one - bright) ** 2
        else:
            begin = max(LIMIT, bright - 12.0)
            tail, _ = quad(lambda x, b=bright: np.exp(-0.5 * (x - b) ** 2), begin, max(LIMIT, bright) + 12.0)
            total -= np.log(tail / np.sqrt(2.0 * np.pi))
    return float(total)


@pytest.mark.parametrize("seed", range(3))
def test_the_cost_is_that_of_the_likelihood_with_tails_integrated(seed: int) -> None:
    """Also where saturated readings are expected below the limit."""
    pose = random_poses(1, seed, low=0.1, high=0.13)
    readings = cut_readings(pose, seed)[0]
    pair, work = pair_of(NEVER_BLOCKED.model, readings, LIMIT), new_cost_workspace(2, 6, False)
    assert (pair.kinds == SATURATED).any()
    rng = np.random.default_rng(seed)
    for scale in (0.0, 0.003, 0.01, 0.03):
        at = pose[0] + scale * np.array([0.1, 1.0, 1.0]) * rng.standard_normal(3)
        cost = cost_of(NEVER_BLOCKED.model, pair, at, work, work.gradients[0], work.hessians[0])
        assert cost == pytest.approx(surprise(at, readings), rel=1e-6, abs=1e-4)


def test_the_solution_is_where_the_likelihood_with_tails_integrated_is_largest() -> None:
    """And elsewhere than where saturated readings are dropped, or taken at their word."""
    poses = random_poses(6, 30, low=0.1, high=0.13)
    readings = cut_readings(poses, 30)
    solutions = MaximumLikelihood(NEVER_BLOCKED).solve(readings, None, limits(readings))
    for pose, one, covariance in zip(solutions.poses, readings, solutions.covariances, strict=True):
        scale = np.sqrt(np.diag(covariance))
        best = minimize(
            lambda x, p=pose, s=scale, r=one: surprise(p + s * x, r),
            0.3 * np.ones(3),
            method="Nelder-Mead",
            options={"xatol": 1e-3, "fatol": 1e-6},
        )
        np.testing.assert_allclose(best.x, 0.0, atol=0.05)


@pytest.mark.parametrize("centimetres", [7, 10, 13, 16])
def test_errors_are_those_of_the_bound_and_honest(centimetres: int) -> None:
    poses = random_poses(1500, centimetres, low=0.01 * centimetres, high=0.01 * centimetres)
    readings = cut_readings(poses, centimetres)
    solutions = ALIKE.solve(readings, None, limits(readings))
    assert np.all(solutions.outcomes == IrOutcome.FOUND)
    errors = pose_errors(solutions.poses, poses)
    ends_there = replace(droplet(), saturation=LIMIT)
    bound = np.mean(np.diagonal(np.linalg.inv(information(ends_there, poses)), axis1=1, axis2=2), axis=0)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0) / bound) < 1.1)
    squares = nees(errors, solutions.covariances)
    assert 2.5 < np.mean(squares) < 4.0
    assert 2.0 < np.median(squares) < 2.7  # 2.37 in theory
    assert np.mean(solutions.misfits) == pytest.approx(1.0, abs=0.03)
    normed = errors / np.sqrt(np.diagonal(solutions.covariances, axis1=1, axis2=2))
    assert np.all(np.abs(np.mean(normed, axis=0)) < 4.5 / np.sqrt(len(poses)))


def test_that_a_reading_is_saturated_tells_something() -> None:
    poses = random_poses(1500, 31, low=0.12, high=0.16)
    readings = cut_readings(poses, 31)
    censored = ALIKE.solve(readings, None, limits(readings))
    dropped = ALIKE.solve(np.where(readings >= LIMIT, np.nan, readings))
    assert np.all(censored.outcomes == IrOutcome.FOUND)
    found = dropped.outcomes == IrOutcome.FOUND
    for axis in range(3):
        variances = [solutions.covariances[found, axis, axis] for solutions in (censored, dropped)]
        assert np.mean(variances[0]) < 0.95 * np.mean(variances[1])
        errors = [pose_errors(solutions.poses, poses)[found, axis] for solutions in (censored, dropped)]
        assert np.mean(errors[0] ** 2) < np.mean(errors[1] ** 2)


def test_every_pair_and_power_has_its_own_saturation() -> None:
    poses = random_poses(20, 32, low=0.07, high=0.12)
    readings = readings_of(droplet(), poses, 32)
    saturation = np.random.default_rng(32).uniform([150.0, 50.0], [255.0, 100.0], (20, 2))
    together = ALIKE.solve(readings, None, saturation)
    for k in range(len(poses)):
        alone = ALIKE.solve(readings[k : k + 1], None, saturation[k : k + 1])
        np.testing.assert_array_equal(alone.poses[0], together.poses[k])
    swapped = ALIKE.solve(readings, None, saturation[:, ::-1])
    assert np.mean(swapped.poses[:, 0] == together.poses[:, 0]) < 0.2


def test_gains_are_not_sought_from_saturated_readings() -> None:
    count, rng = 200, np.random.default_rng(34)
    factors = np.exp(0.1 * rng.standard_normal((2, 2, 6)))
    receiver, poses = rng.integers(0, 2, count), random_poses(count, 34, low=0.08, high=0.2)
    pairs = PairGains(factors[0, receiver], factors[1, 1 - receiver], np.zeros((count, 4)))
    readings = np.minimum(readings_of(droplet(), poses, 34, pairs), 150.0)
    errors = []
    for limit in (150.0, 255.0):
        fit = estimate_gains(
            droplet(0.1), 2, Exchanges(receiver, 1 - receiver, readings, limits(readings, limit), poses)
        )
        found = np.array([[gains.sensor for gains in fit.gains], [gains.emitter for gains in fit.gains]])
        logs = np.log(found / factors)
        errors.append(np.std(logs - logs.mean(axis=-1, keepdims=True)))
    assert errors[0] < 0.01
    assert errors[1] > 3.0 * errors[0]


def test_a_limit_far_below_the_platforms_is_as_good_as_a_platform_that_ends_there() -> None:
    """Although the table where searches start ends at the platform's."""
    poses = random_poses(1000, 35, low=0.08, high=0.2)
    readings = np.minimum(readings_of(droplet(), poses, 35), 120.0)
    told = ALIKE.solve(readings, None, limits(readings, 120.0))
    made_so = MaximumLikelihood(replace(droplet(), saturation=120.0)).solve(readings)
    assert np.mean(told.outcomes == IrOutcome.FOUND) > 0.99
    sigmas = np.sqrt(np.diagonal(made_so.covariances, axis1=1, axis2=2))
    apart = np.abs(pose_errors(told.poses, made_so.poses)) / sigmas
    assert np.mean(apart.max(axis=1) < 0.1) > 0.98


def test_saturation_of_another_shape_is_refused() -> None:
    with pytest.raises(ReadingsError, match=r"saturation has the shape \(2, 3\) but must have \(2, 2\)\."):
        ALIKE.solve(np.zeros((2, 2, 6, 6)), None, np.zeros((2, 3)))
