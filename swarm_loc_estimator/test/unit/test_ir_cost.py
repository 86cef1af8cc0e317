"""The likelihood's cost is the sum over readings, each by itself, however it is computed."""

import math
from dataclasses import replace

import numpy as np
import pytest
from ir_world import droplet, pair_of, random_poses, readings_of

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import expected_with_slopes
from swarm_loc_estimator.infrared.cost import (
    MEASURED,
    MISSING,
    SATURATED,
    CostWorkspace,
    Pair,
    cost_of,
    new_cost_workspace,
    reading_cost,
)
from swarm_loc_estimator.swarm.ir_board import IrModel, load_ir_platform

PLATFORMS = {
    "blocked": droplet(),
    "never blocked": replace(droplet(), blocked_share=0.0),
    "relative": replace(droplet(), relative_noise=0.1),
    "systematic": replace(droplet(), relative_noise=0.05, curve_sigma=0.1),
    "bright": load_ir_platform("droplet_2016"),
}


def one_by_one(
    model: IrModel, pair: Pair, bright: FloatArray, slopes: FloatArray
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Cost, gradient (3,), Hessian (3, 3), tally (3,), systematic information (3, 3), by reading."""
    total, gradient, tally = 0.0, np.zeros(3), np.array([0.0, -3.0, 0.0])
    hessian, systematic = np.zeros((2, 3, 3))
    for f in np.flatnonzero(pair.kinds != MISSING):
        cost, pull, weight, sure, share, square = reading_cost(
            model.errors, pair.kinds[f], pair.cut[f], pair.stable[f], bright[f]
        )
        both = np.outer(slopes[f], slopes[f])
        total += cost
        gradient += pull * slopes[f]
        hessian += weight * both
        systematic += share * weight * both
        tally += [2.0 * cost * sure, sure and pair.kinds[f] == MEASURED, square]
    return total, gradient, hessian, tally, systematic


def costs_at(model: IrModel, pair: Pair, pose: FloatArray) -> tuple[float, CostWorkspace]:
    """By `cost_of`."""
    work = new_cost_workspace(model.amplitudes.shape[0], model.angles.size, False)
    return cost_of(model, pair, pose, work, work.gradients[0], work.hessians[0]), work


@pytest.mark.parametrize("name", PLATFORMS)
@pytest.mark.parametrize("away", [0.0, 0.3])
def test_the_cost_is_the_sum_over_readings(name: str, away: float) -> None:
    """Near the pose, and where many readings are outliers; with saturated, missing and blocked ones."""
    platform, rng = PLATFORMS[name], np.random.default_rng(5)
    model, gains = platform.model, rng.uniform(0.9, 1.1, (2, 6))
    for pose in random_poses(20, 5, low=0.06, high=0.2):
        readings = readings_of(platform, pose[None], 5)[0]
        readings[rng.random(readings.shape) < 0.1] = 0.0
        readings[rng.random(readings.shape) < 0.1] = math.nan
        pair = pair_of(model, readings, 0.6 * float(np.nanmax(readings)), gains)
        assert {MISSING, MEASURED, SATURATED} == set(pair.kinds.tolist())
        at = pose + away * np.array([0.03, 1.0, -1.0])
        bright, slopes = expected_with_slopes(platform, at)
        factor = np.outer(*gains)
        wanted = one_by_one(
            model, pair, (factor * bright[0]).ravel(), (factor[..., None] * slopes[0]).reshape(-1, 3)
        )
        cost, work = costs_at(model, pair, at)
        hessian = np.tril(work.hessians[0]) + np.tril(work.hessians[0], -1).T
        found = (cost, work.gradients[0], hessian, work.tally, work.systematic)
        for one, other in zip(map(np.asarray, found), map(np.asarray, wanted), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9 * max(float(np.abs(other).max()), 1.0))


def test_what_a_dead_element_reads_does_not_count() -> None:
    model, pose = droplet().model, random_poses(1, 6, low=0.1)[0]
    readings = readings_of(droplet(), pose[None], 6)[0]
    gains = np.ones((2, 6))
    gains[0, 2], gains[1, 4] = math.nan, math.nan
    missing = readings.copy()
    missing[:, 2], missing[:, :, 4] = math.nan, math.nan
    dead, _ = costs_at(model, pair_of(model, readings, 255.0, gains), pose)
    without, _ = costs_at(model, pair_of(model, missing, 255.0), pose)
    assert dead == without
