"""What is told of a mapper's fixes: together they make as sure as the mapper is, never surer."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.mapping.exploration import Goal
from swarm_loc_estimator.mapping.mapper_feed import FixCovariances, pose_covariance
from swarm_loc_estimator.swarm.swarm import OdometryModel

ELEMENTS = st.floats(-0.3, 0.3)
STOP = np.diag([0.01, 0.02, 0.01]) ** 2
STILL = OdometryModel(wheel_noise=0.0)
"""Tells all there is, but for three millimetres."""
USUAL = OdometryModel(wheel_separation=0.085, wheel_noise=1e-6, distance_noise=3e-4, turn_noise=2e-5)


def goal(number: int, x: float = 0.0, y: float = 0.0) -> Goal:
    return Goal(number, np.array([x + 1.0, y]), np.zeros(2), number, np.array([x, y, 0.3]))


def fused(known: FloatArray, told: FloatArray) -> FloatArray:
    return np.linalg.inv(np.linalg.inv(known) + np.linalg.inv(told))


def test_the_first_fix_is_told_as_the_mapper_knows_it() -> None:
    told = FixCovariances(USUAL).next_covariance(goal(1), STOP)
    np.testing.assert_allclose(told, pose_covariance(STOP))


def test_a_fix_that_adds_nothing_hardly_counts() -> None:
    fixes = FixCovariances(STILL)
    before = fixes.next_covariance(goal(1), STOP)
    again = fixes.next_covariance(goal(2), STOP)
    assert (np.diag(again) > 5.0 * np.diag(before)).all()
    for number in range(3, 10):  # whoever fuses them all is hardly surer than by the first alone
        before = fused(before, fixes.next_covariance(goal(number), STOP))
    assert (np.diag(before) > 0.6 * np.diag(pose_covariance(STOP))).all()


def test_a_fix_counts_the_more_the_coarser_the_odometry_is() -> None:
    """Whoever has forgotten the heading while the robot looked around is told it again."""
    told = []
    for noise in (1e-6, 2e-4, 2e-2):
        fixes = FixCovariances(OdometryModel(wheel_separation=0.085, wheel_noise=noise))
        fixes.next_covariance(goal(1), STOP)
        told.append(fixes.next_covariance(goal(2, 0.5), STOP)[2, 2])
    now = pose_covariance(STOP)[2, 2]
    assert told[0] > told[1] > told[2] > now
    assert told[2] < 1.05 * now


def test_a_closed_loop_counts_in_full() -> None:
    fixes = FixCovariances(USUAL)
    fixes.next_covariance(goal(1), 400.0 * STOP)
    closed = fixes.next_covariance(goal(2, 0.5), STOP)
    np.testing.assert_allclose(np.diag(closed), np.diag(pose_covariance(STOP)), rtol=0.2)


def test_after_odometry_has_begun_anew_a_fix_counts_in_full() -> None:
    fixes = FixCovariances(STILL)
    fixes.next_covariance(goal(1), STOP)
    fixes.next_covariance(goal(2), STOP)
    np.testing.assert_allclose(fixes.next_covariance(goal(1), STOP), pose_covariance(STOP))


@given(arrays(float, (3, 3), elements=ELEMENTS), arrays(float, (3, 3), elements=ELEMENTS), st.floats(-2, 2))
def test_what_is_told_is_a_covariance_and_never_less_than_the_mapper_has(
    first: FloatArray, second: FloatArray, x: float
) -> None:
    fixes = FixCovariances(USUAL)
    fixes.next_covariance(goal(1), first @ first.T)
    told = fixes.next_covariance(goal(2, x), second @ second.T)
    now = pose_covariance(second @ second.T)
    assert (told == told.T).all()
    scale = np.abs(told).max()
    assert np.linalg.eigvalsh(told - now).min() > -1e-9 * scale
    assert np.linalg.eigvalsh(told).min() > 0.0
