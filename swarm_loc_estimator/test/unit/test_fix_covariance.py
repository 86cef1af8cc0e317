"""Absolute fixes: their covariances, gates, and those that are suspended."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from core_geometry import wrapped
from core_messages import SECOND, T0, give_fix
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ir_swarm import DROPLET, Event, Place, exchange, messages

from bench.shared.bags import copy_part, first_log_ns
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.filter.correlated_noise import inflate_fix
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.sources import (
    LossLimits,
    assess,
    count_gated,
    fixes_of,
    is_contradicted,
    share_of,
)
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.mapping.mapper_feed import fix_covariance
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import FixModel, RandomWalk
from swarm_loc_estimator.swarm.ir_board import RobotIr
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, StartSigma, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimate import Contradicted, Estimate
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

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


def walker(**about: object) -> Swarm:
    robot = Robot("walker", camera=None, stands=True, random_walk=RandomWalk(1e-9, 1e-9))
    return Swarm((replace(robot, **about),))  # type: ignore[arg-type]


def after_fixes(estimator: Estimator, poses: list[FloatArray], first: int = 0) -> list[Estimate]:
    found = []
    for second, pose in enumerate(poses, first):
        stamp_ns = T0 + second * SECOND
        give_fix(estimator, 0, stamp_ns, pose, NOISE, stamp_ns)
        found.append(estimator.tick(stamp_ns))
    return found


def test_fixes_that_share_their_errors_make_no_surer_than_one() -> None:
    first, *_, last = after_fixes(Estimator(walker(fix=FixModel(1.0))), [POSE] * 40)
    assert first.status[0] == Status.TRACKED
    np.testing.assert_allclose(last.covariances[0], NOISE, rtol=5e-3)  # and the floor
    independent = after_fixes(Estimator(walker()), [POSE] * 40)
    assert independent[0].status[0] != Status.TRACKED
    assert np.trace(independent[-1].covariances[0]) < 0.1 * np.trace(NOISE)


@pytest.mark.parametrize("off", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.5)])
def test_a_start_that_a_fix_contradicts_gives_way_to_it(off: tuple[float, float, float]) -> None:
    start = tuple((POSE + np.array(off)).tolist())
    swarm = walker(fix=FixModel(1.0), start=start, start_sigma=StartSigma(0.01, 0.01, 0.01))
    (only,) = after_fixes(Estimator(swarm), [POSE])
    np.testing.assert_allclose(only.poses[0], POSE, atol=1e-6)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_robot_that_was_carried_away_is_named_at_once_and_found_by_the_third_fix(share: float) -> None:
    elsewhere = POSE + np.array([2.0, 1.0, 1.0])
    estimator, poses = Estimator(walker(fix=FixModel(share))), [POSE] * 20 + [elsewhere] * 8
    found = after_fixes(estimator, poses[:21])
    assert estimator.contradictions(T0 + 20 * SECOND)
    found += after_fixes(estimator, poses[21:], 21)
    tracked = [one.status[0] == Status.TRACKED for one in found]
    assert tracked[19:23] == [True, False, False, share > 0.0]
    assert tracked[-1]
    for one, true in zip(found, poses, strict=True):
        assert one.status[0] != Status.TRACKED or np.hypot(*(one.poses[0] - true)[:2]) < 0.05
    np.testing.assert_allclose(found[-1].poses[0], elsewhere, atol=1e-6)
    assert {one.kind for one in estimator.contradictions(T0 + 27 * SECOND)} <= {Contradicted.DESCRIPTION}


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


ROOT, NEIGHBOUR = 0, 1
LIMITS = LossLimits(1.0, 0.3, 12, 10.0)
WALKING = RandomWalk(5e-6, 3e-2)
IRS = [RobotIr(k + 1, DROPLET, "droplet") for k in range(5)]
RING = 0.5 * np.pi * np.arange(-1, 4)


def looked(state: SwarmState, second: int, observer: int, passed: bool) -> int:
    """Assess a fix of the root, or what another robot measures of it; returns who is lost."""
    one = Measurements.empty(1)
    one.stamp_ns[:], one.observer[:], one.target[:] = T0 + second * SECOND, observer, ROOT
    return assessed(state, one, passed=passed)


def assessed(state: SwarmState, one: Measurements, *, passed: bool) -> int:
    """Assess a measurement that passes its gate or is far beyond it; returns who is lost."""
    belief, one.gate[:] = state.arrays(), 18.0
    share = share_of(one, 0, belief)
    assess(one, 0, belief, LIMITS.max_fault_score, 0.0 if passed else 100.0, (0.0, 0.0), share, False)
    return count_gated(one, 0, belief, passed, share, LIMITS)[0]


def new_state() -> SwarmState:
    return SwarmState(ParameterTable.of([Robot("root"), Robot("neighbour")], [Landmark(1)]))


def test_what_others_say_does_not_outweigh_fixes() -> None:
    """They were located by the root, so they agree with it wherever it is."""
    state = new_state()
    lost = []
    for second in range(3):
        assert looked(state, second, NEIGHBOUR, passed=True) == -1
        lost.append(looked(state, second, NOBODY, passed=False))
        assert is_contradicted(state.arrays(), ROOT)
    assert lost == [-1, -1, ROOT]


def test_one_fix_that_is_wrong_is_forgiven_with_the_next_good_one() -> None:
    state = new_state()
    for second in range(100):
        assert looked(state, second, NOBODY, passed=second % 20 != 1) == -1
        assert is_contradicted(state.arrays(), ROOT) == (second % 20 == 1)
    for _ in range(5):  # of one instant, as of several trackers
        assert looked(state, 130, NOBODY, passed=False) == -1


def test_a_fix_that_is_wrong_is_forgiven_with_a_landmark_in_its_place() -> None:
    state = new_state()
    assert looked(state, 0, NOBODY, passed=False) == -1
    assert is_contradicted(state.arrays(), ROOT)
    one = Measurements.empty(1)
    one.stamp_ns[:], one.observer[:], one.target[:] = T0 + SECOND, ROOT, NOBODY
    one.landmark[:] = 0
    assert assessed(state, one, passed=True) == -1
    assert not is_contradicted(state.arrays(), ROOT)


@pytest.mark.parametrize("seed", range(3))
def test_a_fiducial_read_turned_for_half_a_minute_moves_no_neighbour(seed: int) -> None:
    """One robot reads all others and alone has fixes; for a spell their headings are turned by a half."""
    rng = np.random.default_rng(seed)
    swarm = Swarm(
        tuple(
            Robot(f"droplet{k}", camera=None, stands=True, random_walk=WALKING, ir=IRS[k]) for k in range(5)
        )
    )
    poses = np.column_stack([0.13 * np.cos(RING), 0.13 * np.sin(RING), rng.uniform(-np.pi, np.pi, 5)])
    poses[ROOT] = 0.0
    estimator, errors = Estimator(swarm, Settings(lost_heading_sigma=1.5, fix_window_s=60.0)), list[float]()
    for second in range(100):
        stamp_ns = T0 + second * SECOND
        turned = np.array([0.0, 0.0, np.pi if 45 <= second < 75 else 0.0])
        lit = 1 + second % (3 if second < 45 else 4)  # the last one is not heard before
        lights = exchange(rng, poses, lit, stamp_ns)
        events: list[Event] = [
            Place(ROOT, stamp_ns, poses[ROOT] + turned),
            *(one for one in lights if one.robot == ROOT),
        ]
        estimator.receive(messages(events, [stamp_ns] * len(events)))
        estimate = estimator.tick(stamp_ns)
        tracked = estimate.status == Status.TRACKED
        error = wrapped(estimate.poses - poses)
        errors += np.hypot(error[:, 0], error[:, 1])[tracked].tolist()
        if tracked[ROOT]:
            assert abs(error[ROOT, 2]) < 0.5
    assert tracked.all()
    assert max(errors) < 0.02


PERIOD_NS, LIMIT = 100_000_000, 10.0


@pytest.mark.parametrize("sees_landmark", [False, True])
def test_a_robot_alone_with_its_fixes_errs_by_the_same_until_they_are_used(sees_landmark: bool) -> None:
    state = SwarmState(ParameterTable.of([Robot("robot")], [Landmark(1)]))
    belief = state.arrays()
    fixes, scores = fixes_of(belief, 0), list[float]()
    belief.sources.score[fixes] = 2.0 * LIMIT
    for tick in range(100):
        one = Measurements.empty(1)
        one.stamp_ns[:], one.model[:], one.gate[:] = tick * PERIOD_NS, CARTESIAN, 20.0
        if sees_landmark:
            one.observer[:], one.target[:], one.landmark[:] = 0, NOBODY, 0
            assess(one, 0, belief, LIMIT, 0.0, (0.0, 0.0), 1.0, False)
        one.observer[:], one.target[:], one.landmark[:] = NOBODY, 0, NOBODY
        assess(one, 0, belief, LIMIT, 0.89, (0.8, 0.5), 1.0, False)  # an error of less than a sigma
        scores.append(float(belief.sources.score[fixes]))
    # from there on, fixes that are not used locate the robot anew
    assert (min(scores) < 1.5 * LIMIT) != sees_landmark
