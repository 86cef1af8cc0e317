"""Delays of lidars: which lag agrees with odometry, what none tells, and poses by all of them."""

from collections.abc import Callable

import numpy as np
import pytest
from core_geometry import nees, wrapped

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import compose, exp
from swarm_loc_estimator.mapping.messages import DelayBelief, at_odometry, described_delay, learned_delay

PERIOD_S, COVARIANCE = 0.2, np.diag([0.01, 0.01, 0.005]) ** 2
START = np.array([2.0, -1.0, 2.5])
Path = Callable[[FloatArray], FloatArray]


def weaving(time_s: FloatArray) -> FloatArray:
    """Poses (n, 3) by odometry of a robot that looks to the left and to the right and back."""
    return np.stack([0.1 * np.sin(time_s), 0.0 * time_s, 0.6 * np.sin(1.5 * time_s)], axis=-1)


def straight(time_s: FloatArray) -> FloatArray:
    """Those of a robot that drives on."""
    return np.multiply.outer(time_s, [0.3, 0.0, 0.0])


def circling(time_s: FloatArray) -> FloatArray:
    """Those of one that drives a circle."""
    return exp(np.multiply.outer(time_s, [0.3, 0.0, 0.8]))


def after(
    belief: DelayBelief, path: Path, late_s: float, seed: int, begin_s: float = 5.0, until_s: float = 15.0
) -> DelayBelief:
    """The belief after scans that are `late_s` older than their stamps, on a path."""
    rng = np.random.default_rng(seed)
    for time_s in np.arange(begin_s, until_s, PERIOD_S).tolist():
        true = compose(START, path(np.array([time_s - late_s]))[0])
        seen = true + np.sqrt(0.3) * np.sqrt(np.diag(COVARIANCE)) * rng.standard_normal(3)
        belief = learned_delay(belief, round(1e9 * time_s), seen, COVARIANCE, path(time_s - belief.lag_s))
    return belief


@pytest.mark.parametrize("late_s", [0.0, 0.1, 0.237, 0.4])
def test_a_robot_that_turns_to_and_fro_tells_the_delay(late_s: float) -> None:
    for seed in range(5):
        belief = after(described_delay(0.0), weaving, late_s, seed)
        assert belief.mean_s == pytest.approx(late_s, abs=0.02)
        assert belief.sigma_s < 0.02
        assert belief.is_refuted == (late_s > 0.06)


@pytest.mark.parametrize("path", [straight, circling])
def test_steady_motion_tells_nothing_and_poses_are_right_within_that(path: Path) -> None:
    now = np.array([14.8])
    for seed in range(5):
        belief = after(described_delay(0.0), path, 0.3, seed)
        assert not belief.is_refuted
        pose, covariance = at_odometry(belief, path(now)[0])
        error = wrapped(pose - compose(START, path(now)[0]))
        assert np.hypot(*error[:2]) > 0.05  # as of 0.3 s
        assert nees(error[None], (covariance + COVARIANCE)[None])[0] < 16.0


def test_a_lidar_that_begins_to_lag_is_found_and_so_is_its_recovery() -> None:
    for seed in range(5):
        belief = after(described_delay(0.0), weaving, 0.0, seed)
        for late_s, begin_s in ((0.25, 15.0), (0.0, 25.0)):
            belief = after(belief, weaving, late_s, seed, begin_s, begin_s + 5.0)
            assert belief.mean_s == pytest.approx(late_s, abs=0.03)
            assert belief.is_refuted == (late_s > 0.0)


def test_the_pose_is_that_of_the_delay() -> None:
    belief = after(described_delay(0.0), weaving, 0.4, 3)
    pose, covariance = at_odometry(belief, weaving(np.array([14.8]))[0])
    assert pose == pytest.approx(compose(START, weaving(np.array([14.8]))[0]), abs=0.03)
    assert np.sqrt(np.diag(covariance)).max() < 0.02


def test_scans_of_one_stamp_and_after_a_gap_are_not_compared() -> None:
    belief = after(described_delay(0.0), weaving, 0.0, 1)
    there, track = np.array([9.0, 9.0, 0.0]), belief.track
    for stamp_ns in (belief.stamp_ns, belief.stamp_ns + 2_000_000_000):
        assert (learned_delay(belief, stamp_ns, there, COVARIANCE, track).chance == belief.chance).all()
