"""Odometry that never changes is contradicted by poses that keep moving, and by nothing else."""

import numpy as np
import pytest
from core_messages import SECOND, T0

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.timeline.estimate import ConstantOdometry, Estimate, Status

SIGMA = 0.01
TENTH = SECOND // 10


def contradicted(
    poses: FloatArray, *, constant: BoolArray | bool = True, sigma: FloatArray | float = SIGMA
) -> list[bool]:
    """Whether a robot with poses (T, 3), ten a second, and their sigmas (T,) is contradicted at each."""
    odometry, found = ConstantOdometry(1), []
    stands = np.broadcast_to(constant, len(poses))
    for k, (pose, one) in enumerate(zip(poses, np.broadcast_to(sigma, len(poses)), strict=True)):
        covariance = np.diag([one**2, one**2, 0.01])[None]
        status = np.array([Status.WAITING if np.isnan(pose[0]) else Status.TRACKED], np.uint8)
        now_ns = T0 + k * TENTH
        estimate = Estimate(now_ns, pose[None], covariance, pose[None], status, np.zeros(1), status > 0)
        odometry.add(stands[k : k + 1], estimate)
        found.append(bool(odometry.contradicted(now_ns)[0]))
    return found


def drive(speed: float, seconds: float) -> FloatArray:
    """Poses (T, 3) along a line."""
    return np.outer(0.1 * speed * np.arange(round(10 * seconds)), [1.0, 0.0, 0.0])


def test_a_robot_that_moves_is_found_unless_its_odometry_does() -> None:
    found = contradicted(drive(0.1, 10.0))
    assert 1.5 <= 0.1 * found.index(True) <= 2.0, "after three moves of five centimetres"
    assert all(found[found.index(True) :])
    assert not any(contradicted(drive(0.1, 10.0), constant=False))


@pytest.mark.parametrize("seed", range(20))
def test_a_pose_that_becomes_surer_is_no_move(seed: int) -> None:
    """The mean of all measurements of a robot that stands."""
    count = np.arange(1, 601)
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (600, 3))
    means = np.cumsum(noise, axis=0) / count[:, None]
    assert not any(contradicted(means, sigma=1.0 / np.sqrt(count)))


def test_moves_must_be_clear() -> None:
    found = contradicted(drive(0.1, 30.0), sigma=0.1)
    assert 12.0 <= 0.1 * found.index(True) <= 14.0, "three moves of three standard deviations"


@pytest.mark.parametrize("moves", [1, 2])
def test_a_robot_that_was_carried_or_started_wrong_is_believed_to_stand(moves: int) -> None:
    places = np.repeat(np.outer(np.arange(moves + 1), [1.0, 0.5, 0.2]), 50, axis=0)
    assert not any(contradicted(places))


def test_a_robot_that_was_lost_in_between_has_not_moved_by_that() -> None:
    places = np.repeat(np.outer(np.arange(6.0), [1.0, 0.5, 0.2]), 20, axis=0)
    places[::20] = np.nan
    assert not any(contradicted(places))


def test_it_is_forgotten_a_while_after_the_last_moves() -> None:
    found = contradicted(np.concatenate([drive(0.1, 2.0), np.tile([0.2, 0.0, 0.0], (400, 1))]))
    assert found[20 + 250]
    assert not found[20 + 310]


def test_a_robot_that_was_carried_and_then_drives_is_no_longer_accused() -> None:
    found = contradicted(drive(0.1, 10.0), constant=np.arange(100) < 50)
    assert found[49]
    assert not any(found[50:])


def test_poses_that_were_set_are_no_moves() -> None:
    odometry = ConstantOdometry(1)
    for k in range(6):
        odometry.forget(0)
        for now_ns in (T0 + k * SECOND, T0 + k * SECOND + TENTH):
            pose = np.full((1, 3), float(k))
            status = np.array([Status.TRACKED], np.uint8)
            odometry.add(
                np.ones(1, bool),
                Estimate(now_ns, pose, 1e-6 * np.eye(3)[None], pose, status, pose[:, 0], status > 0),
            )
            assert not odometry.contradicted(now_ns).any()
