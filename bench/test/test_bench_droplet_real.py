"""A recording of real Droplets is held against the camera only while that saw a robot stand."""

import numpy as np
import pytest

from bench.droplet.real.graph import outcome_of, standing
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Status

SECOND = 10**9
TRUTH = Trajectory(
    np.array([0, 10, 20, 60], dtype=np.int64) * SECOND,
    np.array([(0.1, 0.2, 3.1), (0.1, 0.2, -3.1), (0.2, 0.2, -3.1), (0.2, 0.2, -3.1)]),
)
"""It stands, across the cut of angles, moves, and is then not seen for long."""


def run(error_m: float) -> ReplayResult:
    """A robot that is believed to be so far off, surer than a millimetre, and one that is not located."""
    stamp_ns = np.arange(0, 70, dtype=np.int64) * SECOND
    pose, covariance = np.full((70, 2, 3), np.nan), np.full((70, 2, 3, 3), np.nan)
    pose[:, 0] = (0.1 + error_m, 0.2, 3.1)
    covariance[:, 0] = np.diag([1e-6, 1e-6, 1e-2])
    told = np.tile(np.array([Status.TRACKED, Status.WAITING], dtype=np.uint8), (70, 1))
    swarm = Swarm((Robot("seen"), Robot("unseen")))
    known = (told == Status.TRACKED) & (stamp_ns < 9 * SECOND)[:, None]
    return ReplayResult("", swarm, stamp_ns, pose, covariance, told, {"seen": TRUTH}, heading_known=known)


def test_a_robot_stands_where_two_sightings_agree_that_follow_each_other_soon() -> None:
    stamp_ns = np.array([0, 5, 10, 15, 20, 40, 60, 65], dtype=np.int64) * SECOND
    _, known = standing(TRUTH, stamp_ns)
    np.testing.assert_array_equal(known, [True, True, True, False, False, False, True, False])


def test_a_sure_pose_told_as_tracked_beside_the_truth_misleads_and_is_in_no_other_instant() -> None:
    outcome = outcome_of(run(0.03), {"seen": 0.0}, {"seen", "unseen"})
    assert outcome.score.misleading.sum() == 12  # the seconds 0 to 10, and 60
    assert outcome.located_share == pytest.approx(0.5)
    np.testing.assert_allclose(outcome.position_cm[:11], 3.0)
    assert not outcome_of(run(0.0), {"seen": 0.0}, {"seen"}).score.misleading[:11].any()


def test_a_heading_is_held_against_the_truth_turned_by_how_the_fiducial_sits() -> None:
    found = outcome_of(run(0.0), {"seen": 0.1}, {"seen"})
    np.testing.assert_allclose(found.heading_deg[0], np.degrees(0.1), rtol=1e-6)
    assert found.figures["heading_known_share"] == pytest.approx(9 / 12)
    assert found.figures["tracked_share"] == pytest.approx(0.5)
