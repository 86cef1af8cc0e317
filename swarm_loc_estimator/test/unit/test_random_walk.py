"""Robots without odometry that move: their poses walk at random, as fast as their description says."""

import math

import numpy as np
import pytest
from core_geometry import wrapped
from core_messages import SECOND, T0, give_fix

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.error_models import RandomWalk
from swarm_loc_estimator.swarm.swarm import Robot, StartSigma, Swarm, SwarmError
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

WALK = RandomWalk(1e-4, 4e-3)
SWARM = Swarm((Robot("walker", camera=None, stands=True, random_walk=WALK),))
EXACT = Settings(fusion_period_s=0.0)
FIX_SIGMA = np.array([0.02, 0.02, 0.05])
FIXES, FIX_S = 15, 2
HIDDEN = 0.03  # What the estimator adds where few measurements have confirmed a pose [m]


def walked(seed: int) -> tuple[FloatArray, FloatArray]:
    """True poses (FIXES, 3) of a robot that walks, and what fixes say of them."""
    rng = np.random.default_rng(seed)
    poses = np.zeros((FIXES, 3))
    poses[0] = rng.uniform([-1.0, -1.0, -math.pi], [1.0, 1.0, math.pi])
    steps, sigma = 50, np.sqrt([WALK.position, WALK.position, WALK.heading]) * math.sqrt(FIX_S / 50)
    for k in range(1, FIXES):
        x, y, theta = poses[k - 1]
        for forward, left, turn in rng.standard_normal((steps, 3)) * sigma:
            x += math.cos(theta) * forward - math.sin(theta) * left
            y += math.sin(theta) * forward + math.cos(theta) * left
            theta += turn
        poses[k] = x, y, theta
    return poses, poses + FIX_SIGMA * rng.standard_normal(poses.shape)


def test_errors_are_as_large_as_they_are_told() -> None:
    nees = []
    for seed in range(60):
        poses, fixes = walked(seed)
        estimate = in_time(fixes)
        error = wrapped(estimate.poses - poses[-1])[0]
        nees.append(float(error @ np.linalg.solve(estimate.covariances[0], error)))
        assert estimate.status[0] == Status.TRACKED
    assert 2.2 < np.mean(nees) < 4.0  # 3 +- .32


def in_time(fixes: FloatArray) -> Estimate:
    """The estimate at the last of fixes that each arrive when they are taken."""
    estimator = Estimator(SWARM, EXACT)
    for k, fix in enumerate(fixes):
        stamp_ns = T0 + k * FIX_S * SECOND
        give_fix(estimator, 0, stamp_ns, fix, np.diag(FIX_SIGMA**2), stamp_ns)
        estimate = estimator.tick(stamp_ns)
    return estimate


def test_a_pose_grows_less_sure_as_the_walk_says() -> None:
    _, fixes = walked(3)
    estimator = Estimator(SWARM, EXACT)
    for k in range(3):
        give_fix(estimator, 0, T0 + k * SECOND, fixes[0], np.diag(FIX_SIGMA**2), T0 + 2 * SECOND)
    now, later = (estimator.tick(T0 + s * SECOND).covariances[0] for s in (2, 7))
    assert later[2, 2] - now[2, 2] == pytest.approx(5.0 * WALK.heading, rel=1e-6)
    np.testing.assert_allclose(np.diag(later - now)[:2], 5.0 * WALK.position, rtol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_arrival_does_not_matter(seed: int) -> None:
    _, fixes = walked(seed)
    rng = np.random.default_rng(seed)
    end_ns = T0 + 2 * SECOND
    estimates = []
    for order in (np.arange(4), rng.permutation(4), np.arange(4)):
        estimator = Estimator(SWARM, EXACT)
        for k in order.tolist():
            stamp_ns = T0 + k * SECOND // 2
            give_fix(estimator, 0, stamp_ns, fixes[-1], np.diag(FIX_SIGMA**2), end_ns)
            estimator.tick(end_ns)
        estimates.append(estimator.tick(end_ns))
    np.testing.assert_allclose(estimates[0].poses, estimates[1].poses, atol=1e-9)
    np.testing.assert_allclose(estimates[0].covariances, estimates[1].covariances, atol=1e-9)
    assert estimates[0].poses.tobytes() == estimates[2].poses.tobytes()
    assert estimates[0].covariances.tobytes() == estimates[2].covariances.tobytes()


def test_a_start_counts_from_the_first_measurement_on() -> None:
    start = Robot(
        "walker", camera=None, stands=True, random_walk=WALK, start=(0.3, 0.1, 0.5), start_sigma=StartSigma()
    )
    estimator = Estimator(Swarm((start,)), EXACT)
    assert estimator.tick(T0).status[0] == Status.WAITING  # nobody knows since when it walks
    vague = np.diag([1.0, 1.0, 1.0])
    give_fix(estimator, 0, T0 + SECOND, [0.3, 0.1, 0.5], vague, T0 + SECOND)
    estimate = estimator.tick(T0 + SECOND)
    np.testing.assert_allclose(estimate.poses[0], [0.3, 0.1, 0.5], atol=1e-6)
    assert np.sqrt(estimate.covariances[0, 0, 0]) == pytest.approx(math.hypot(0.01, HIDDEN), rel=0.01)


def test_a_robot_of_unsure_heading_is_located_where_such_headings_are_not_lost() -> None:
    sigma, poses = np.array([0.02, 0.02, 0.45]), walked(5)[0]
    found = []
    for limit in (0.3, 1.5):
        settings = Settings(fusion_period_s=0.0, lost_heading_sigma=limit)
        estimator = Estimator(SWARM, settings)
        for k in range(3):
            stamp_ns = T0 + k * SECOND
            give_fix(estimator, 0, stamp_ns, poses[0], np.diag(sigma**2), stamp_ns)
        found.append(estimator.tick(T0 + 2 * SECOND).status[0])
    assert found[0] == Status.WAITING
    assert found[1] != Status.WAITING


def test_a_robot_with_odometry_does_not_walk_at_random() -> None:
    with pytest.raises(SwarmError, match=r"robot 'a' has a random_walk, which must be 0"):
        Swarm((Robot("a", random_walk=WALK),))
