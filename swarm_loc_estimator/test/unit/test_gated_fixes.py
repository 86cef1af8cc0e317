"""A robot is where absolute fixes put it, whatever others say that were located by way of it."""

import numpy as np
import pytest
from core_geometry import wrapped
from core_messages import SECOND, T0, give_fix
from ir_swarm import DROPLET, Event, Place, exchange, messages

from swarm_loc_estimator.filter.measurements import NOBODY, Measurements
from swarm_loc_estimator.filter.sources import LossLimits, assess, count_gated, is_contradicted, share_of
from swarm_loc_estimator.filter.state import SwarmState
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import RandomWalk
from swarm_loc_estimator.swarm.ir_board import RobotIr
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.estimate import Contradicted
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

ROOT, NEIGHBOUR = 0, 1
LIMITS = LossLimits(1.0, 0.3, 12, 10.0)
WALKER = Swarm((Robot("root", camera=None, stands=True, random_walk=RandomWalk(1e-6, 1e-4)),))
WALKING = RandomWalk(5e-6, 3e-2)
IRS = [RobotIr(k + 1, DROPLET, "droplet") for k in range(5)]
RING = 0.5 * np.pi * np.arange(-1, 4)
NOISE = np.diag(np.square([0.002, 0.002, 0.02]))
HERE, THERE = np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.0, 1.3])


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


def test_a_robot_that_was_carried_away_is_not_told_as_tracked_until_it_is_found() -> None:
    estimator = Estimator(WALKER, Settings())
    told, named = [], []
    for second in range(18):
        stamp_ns = T0 + second * SECOND
        true = HERE if second < 10 else THERE
        give_fix(estimator, 0, stamp_ns, true, NOISE, stamp_ns)
        estimate = estimator.tick(stamp_ns)
        right = bool(np.hypot(*(estimate.poses[0] - true)[:2]) < 0.05)
        told.append((estimate.status[0] == Status.TRACKED, right))
        named.append(bool(estimator.contradictions(stamp_ns)))
    assert all(right for tracked, right in told if tracked)
    assert told[9] == told[17] == (True, True)
    assert named[10]
    assert {one.kind for one in estimator.contradictions(T0 + 17 * SECOND)} <= {Contradicted.DESCRIPTION}


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
