"""Robots without odometry that move: their poses walk at random, as fast as their description says."""

import math
from dataclasses import replace

import numpy as np
import pytest
from core_geometry import wrapped
from core_messages import SECOND, T0, give_fix
from ir_swarm import DROPLET, Event, Place, exchange, messages

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.offline.metrics import is_misleading, nees
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.error_models import OdometryModel, RandomWalk
from swarm_loc_estimator.swarm.ir_board import RobotIr
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


def test_a_robot_of_unsure_heading_is_located_and_its_heading_told_as_unknown() -> None:
    """Its heading carries it nowhere, so that its position is as good without."""
    sigma, poses = np.array([0.02, 0.02, 0.8]), walked(5)[0]
    for limit, is_known in ((0.3, False), (1.5, True)):
        settings = Settings(fusion_period_s=0.0, lost_heading_sigma=limit)
        estimator = Estimator(SWARM, settings)
        for k in range(4):  # three locate it, the next one confirms
            stamp_ns = T0 + k * SECOND
            give_fix(estimator, 0, stamp_ns, poses[0], np.diag(sigma**2), stamp_ns)
            estimate = estimator.tick(stamp_ns)
        assert estimate.status[0] == Status.TRACKED
        assert estimate.heading_known[0] == is_known


def test_a_heading_is_forgotten_up_to_any_in_a_turn_while_the_position_is_kept() -> None:
    estimator, sigma = Estimator(Swarm((replace(SWARM.robots[0], random_walk=RandomWalk(1e-6, 0.5)),))), []
    for k in range(40):
        stamp_ns = T0 + k * SECOND
        if k < 5 or k == 35:
            give_fix(estimator, 0, stamp_ns, [0.3, 0.1, 0.5], np.diag(FIX_SIGMA**2), stamp_ns)
        estimate = estimator.tick(stamp_ns)
        assert k < 3 or estimate.status[0] == Status.TRACKED
        sigma.append(math.sqrt(estimate.covariances[0, 2, 2]))
        assert estimate.heading_known[0] == (sigma[-1] <= 0.3)
        assert k < 3 or (np.linalg.eigvalsh(estimate.covariances[0]) > 0.0).all()
    assert not estimator.losses
    assert sigma[34] == pytest.approx(math.pi / math.sqrt(3.0))
    assert sigma[35] < 0.3


def test_a_robot_with_odometry_does_not_walk_at_random() -> None:
    with pytest.raises(SwarmError, match=r"robot 'a' has a random_walk, which must be 0"):
        Swarm((Robot("a", random_walk=WALK),))


WALKING = RandomWalk(1e-5, 0.06)  # Of Droplets that turn by more than a radian between two of their exchanges


@pytest.mark.parametrize("seed", [5, 11, 12])
def test_robots_that_turn_unseen_are_located_by_each_other_and_mislead_nobody(seed: int) -> None:
    """All read each other, one is fixed from outside. Where errors lie on arcs, no ellipse may hide it."""
    rng, robots, squared, told, seconds = np.random.default_rng(seed), 6, list[float](), 0, 150
    swarm = Swarm(
        tuple(
            Robot(
                f"r{k}", camera=None, stands=True, random_walk=WALKING, ir=RobotIr(k + 1, DROPLET, "droplet")
            )
            for k in range(robots)
        )
    )
    places = 0.12 * np.array([(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1)])
    poses, estimator = np.column_stack([places, rng.uniform(-math.pi, math.pi, robots)]), Estimator(swarm)
    for second in range(seconds):
        poses = poses + rng.standard_normal((robots, 3)) * np.sqrt([1e-5, 1e-5, WALKING.heading])
        stamp_ns = T0 + second * SECOND
        events: list[Event] = [Place(0, stamp_ns, poses[0])]
        if second % 6 == 0:
            events += exchange(rng, wrapped(poses), int(rng.integers(robots)), stamp_ns)
        estimator.receive(messages(events, [stamp_ns] * len(events)))
        estimate = estimator.tick(stamp_ns)
        tracked = estimate.status == Status.TRACKED
        error, covariance = wrapped(estimate.poses - poses)[tracked], estimate.covariances[tracked]
        assert not is_misleading(error, covariance).any()
        squared += nees(error[:, :2], covariance[:, :2, :2]).tolist()
        told += int(tracked.sum()) if second >= 75 else 0
    assert told > 0.7 * 75 * robots
    assert np.mean(squared) < 3.0


def test_a_heading_forgotten_for_minutes_is_relearned_in_a_few_exchanges() -> None:
    rng, walk = np.random.default_rng(2), RandomWalk(1e-7, 0.1)
    seer = Robot("seer", camera=None, stands=True, start=(0.0, 0.0, 0.3), ir=RobotIr(1, DROPLET, "droplet"))
    turner = replace(seer, name="turner", start=None, random_walk=walk, ir=RobotIr(2, DROPLET, "droplet"))
    estimator, poses = Estimator(Swarm((seer, turner))), np.array([[0.0, 0.0, 0.3], [0.1, 0.05, 1.0]])
    for second in (*range(8), 600, 601, 602, 603):
        stamp_ns = T0 + second * SECOND
        poses[1, 2] = 1.0 if second < 600 else -1.4
        lights = [one for one in exchange(rng, poses, 1, stamp_ns) if one.robot == 0]
        estimator.receive(messages(lights, [stamp_ns] * len(lights)))
        estimate = estimator.tick(stamp_ns)
    assert estimate.status[1] == Status.TRACKED
    assert math.sqrt(estimate.covariances[1, 2, 2]) < 0.8
    assert abs(wrapped(estimate.poses - poses)[1, 2]) < 0.3


def test_a_robot_that_turns_on_the_spot_keeps_its_place_until_it_drives() -> None:
    """Odometry that turns badly: its heading is soon unknown, but not where it stands."""
    model = OdometryModel(wheel_noise=1e-6, turn_noise=0.05)
    robot = Robot(
        "r", odometry=model, camera=None, start=(0.5, 0.2, 0.0), start_sigma=StartSigma(0.01, 0.01, 0.02)
    )
    estimator, told = Estimator(Swarm((robot,))), []
    for k in range(120):
        stamp_ns = T0 + k * SECOND // 10
        pose = (0.0, 0.0, 0.15 * k) if k < 100 else (0.03 * (k - 100), 0.0, 15.0)
        rows = np.array([0]), np.array([stamp_ns]), np.array([pose]), np.array([stamp_ns])
        estimator.receive(Batch.of(stamp_ns, stamp_ns, odometry=OdometryRows.without_twist(*rows)))
        if k % 5 == 0 and k < 100:
            fix = [0.5, 0.2, math.nan]
            give_fix(estimator, 0, stamp_ns, fix, np.diag(FIX_SIGMA**2), stamp_ns)
        estimate = estimator.tick(stamp_ns)
        told.append((int(estimate.status[0]), bool(estimate.heading_known[0])))
    assert not estimator.losses
    assert told[10] == (Status.TRACKED, True)
    assert told[99] == (Status.TRACKED, False)
    assert told[-1] == (Status.UNCERTAIN, False)
