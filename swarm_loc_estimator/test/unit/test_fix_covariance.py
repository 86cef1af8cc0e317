"""Fixes of a mapper: what is wrong with its map is wrong with all of them; a single one locates a robot."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from core_messages import SECOND, T0, give_fix
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from bench.shared.bags import copy_part, first_log_ns
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.correlated_noise import inflate_fix
from swarm_loc_estimator.mapping.mapper_feed import fix_covariance
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.error_models import FixModel, RandomWalk
from swarm_loc_estimator.swarm.swarm import Robot, StartSigma, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimate import Estimate
from swarm_loc_estimator.timeline.estimator import Estimator, Status

BAGS = Path(__file__).parents[3] / "bags"
ELEMENTS = st.floats(-0.3, 0.3)
NOISE = np.diag(np.square([0.05, 0.03, 0.02]))
POSE = np.array([1.0, -2.0, 0.5])


def updated(
    share: float, before: FloatArray, noise: FloatArray, value: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pose and covariance after a fix with an innovation `value` (3,), from a pose of zeros."""
    own = noise.copy()
    inflate_fix(np.full(3, share), before, own)
    gain = before @ np.linalg.inv(before + own)
    return gain @ value, before - gain @ before


def covariances() -> st.SearchStrategy[FloatArray]:
    return arrays(float, (3, 3), elements=ELEMENTS).map(lambda root: root @ root.T + 1e-3 * np.eye(3))


@given(covariances(), covariances(), arrays(float, 3, elements=ELEMENTS))
def test_without_a_systematic_share_a_fix_is_fused_as_usual(
    before: FloatArray, noise: FloatArray, value: FloatArray
) -> None:
    pose, after = updated(0.0, before, noise, value)
    gain = before @ np.linalg.inv(before + noise)
    np.testing.assert_allclose(pose, gain @ value, atol=1e-6)
    np.testing.assert_allclose(after, before - gain @ before, atol=1e-6)


@given(covariances(), covariances(), arrays(float, 3, elements=ELEMENTS), st.floats(0.05, 1.0))
def test_no_fix_makes_a_pose_surer_than_its_systematic_error(
    before: FloatArray, noise: FloatArray, value: FloatArray, share: float
) -> None:
    _, after = updated(share, before, noise, value)
    inverse = np.linalg.inv(np.linalg.cholesky(noise))
    ratio, axes = np.linalg.eigh(inverse @ before @ inverse.T)
    left = np.diag(axes.T @ inverse @ after @ inverse.T @ axes)
    assert (left > 0.999 * np.minimum(ratio, share)).all()
    assert (left < 1.001 * ratio).all()


def test_a_surer_fix_gives_its_covariance_and_another_is_ignored() -> None:
    value = np.array([0.3, -0.2, 0.1])
    pose, after = updated(1.0, 100.0 * NOISE, NOISE, value)
    np.testing.assert_allclose(pose, 0.99 * value, rtol=1e-6)
    np.testing.assert_allclose(after, NOISE, rtol=1e-6)
    pose, after = updated(1.0, 0.5 * NOISE, NOISE, value)
    np.testing.assert_allclose(pose, 0.0, atol=1e-6)
    np.testing.assert_allclose(after, 0.5 * NOISE, rtol=1e-6)


def walker(**about: object) -> Swarm:
    robot = Robot("walker", camera=None, stands=True, random_walk=RandomWalk(1e-9, 1e-9))
    return Swarm((replace(robot, **about),))  # type: ignore[arg-type]


def after_fixes(swarm: Swarm, poses: list[FloatArray]) -> list[Estimate]:
    """The estimate after each of the fixes of a robot, one a second."""
    estimator, found = Estimator(swarm), []
    for second, pose in enumerate(poses):
        stamp_ns = T0 + second * SECOND
        give_fix(estimator, 0, stamp_ns, pose, NOISE, stamp_ns)
        found.append(estimator.tick(stamp_ns))
    return found


def test_fixes_that_share_their_errors_make_no_surer_than_one() -> None:
    first, *_, last = after_fixes(walker(fix=FixModel(1.0)), [POSE] * 40)
    assert first.status[0] == Status.TRACKED
    np.testing.assert_allclose(last.covariances[0], NOISE, rtol=5e-3)  # and the floor
    independent = after_fixes(walker(), [POSE] * 40)
    assert independent[0].status[0] != Status.TRACKED
    assert np.trace(independent[-1].covariances[0]) < 0.1 * np.trace(NOISE)


@pytest.mark.parametrize("off", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.5)])
def test_a_start_that_a_fix_contradicts_gives_way_to_it(off: tuple[float, float, float]) -> None:
    start = tuple((POSE + np.array(off)).tolist())
    swarm = walker(fix=FixModel(1.0), start=start, start_sigma=StartSigma(0.01, 0.01, 0.01))
    (only,) = after_fixes(swarm, [POSE])
    np.testing.assert_allclose(only.poses[0], POSE, atol=1e-6)


def test_a_robot_that_was_carried_away_is_found_by_the_third_fix() -> None:
    elsewhere = POSE + np.array([2.0, 1.0, 1.0])
    found = after_fixes(walker(fix=FixModel(1.0)), [POSE] * 20 + [elsewhere] * 3)
    assert [one.status[0] == Status.TRACKED for one in found[-4:]] == [True, False, False, True]
    np.testing.assert_allclose(found[-1].poses[0], elsewhere, atol=1e-6)


@pytest.mark.parametrize("bag", ["pushbot_one", "pushbots_two"])
@pytest.mark.parametrize("late_s", [0.0, 15.0, 60.0, 150.0])
def test_whenever_the_estimator_starts_the_first_fix_of_a_mapper_locates_a_robot(
    bag: str, late_s: float, tmp_path: Path
) -> None:
    copy_part(BAGS / bag, tmp_path / "late", 1e9, late_s)
    result = replay(tmp_path / "late", load_swarm(BAGS / bag / "swarm.yaml"))
    for index, robot in enumerate(result.swarm.robots):
        first_ns = first_log_ns(tmp_path / "late", f"{robot.name}/fix")
        tracked = result.status[:, index] == Status.TRACKED
        assert tracked[result.stamp_ns > first_ns + 3 * SECOND].mean() > 0.9 - 0.1 * (late_s == 0.0)
        if late_s:
            assert tracked[np.searchsorted(result.stamp_ns, first_ns + 3 * SECOND)]
        errors = result.select(result.stamp_ns > first_ns + SECOND).summaries[robot.name]
        assert errors.nees < 5.0
        assert errors.position_rmse < 0.25


@pytest.mark.parametrize("sigma", [0.1, 0.5, 1.0, 2.0])
def test_a_fix_with_a_poor_heading_says_where_the_robot_may_be(sigma: float) -> None:
    """Positions lie on an arc about where the heading was last known; the graph knows the tangent only."""
    way, turns = np.array([4.0, -3.0]), sigma * np.random.default_rng(3).standard_normal(2000)
    lever = np.array([3.0, 4.0, 1.0])
    covariance = fix_covariance(sigma**2 * np.outer(lever, lever) + np.diag([0.02, 0.02, 0.01]) ** 2)
    x, y = np.cos(turns) - 1.0, np.sin(turns)
    off = np.column_stack([x * way[0] - y * way[1], y * way[0] + x * way[1]])
    squared = np.einsum("ki,ij,kj->k", off, np.linalg.inv(covariance[:2, :2]), off)
    assert squared.mean() < 2.5
    assert (squared > 25.0).mean() <= 0.001


def test_the_covariance_of_a_fix_is_that_of_the_mapper_and_never_smaller() -> None:
    stop = np.diag([0.01, 0.02, 0.01]) ** 2
    assert np.linalg.eigvalsh(fix_covariance(stop) - stop).min() > 0.0
