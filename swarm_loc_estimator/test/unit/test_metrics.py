"""Error tables against cases worked out by hand, and their statistics against known noise."""

import math

import numpy as np
import pytest

from swarm_loc_estimator.common.trajectory import Trajectory, TrajectoryError, interpolate
from swarm_loc_estimator.offline import metrics
from swarm_loc_estimator.offline.metrics import MetricsError

SECOND = 1_000_000_000


def track(*rows: tuple[float, float, float, float]) -> Trajectory:
    """Rows of time [s], x, y, theta."""
    table = np.array(rows, float).reshape(-1, 4)
    return Trajectory((table[:, 0] * SECOND).round().astype(np.int64), table[:, 1:])


def test_interpolation_follows_the_arc_and_the_shorter_turn() -> None:
    quarter = track((0, 1, 0, math.pi / 2), (1, 0, 1, math.pi))
    poses, valid = interpolate(quarter, np.array([SECOND // 2]), SECOND)
    assert valid.all()
    np.testing.assert_allclose(poses[0], [math.sqrt(0.5), math.sqrt(0.5), 0.75 * math.pi], atol=1e-12)
    across = track((0, 0, 0, 3.1), (1, 0, 0, -3.1))
    poses, _ = interpolate(across, np.array([SECOND // 2]), SECOND)
    assert abs(poses[0, 2]) == pytest.approx(math.pi)


def test_no_extrapolation_and_no_long_gaps() -> None:
    known = track((1, 0, 0, 0), (2, 1, 0, 0), (4, 3, 0, 0))
    query = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 4.5])
    poses, valid = interpolate(known, (query * SECOND).astype(np.int64), SECOND)
    assert valid.tolist() == [False, True, True, True, False, True, False]
    np.testing.assert_allclose(poses[valid][:, 0], [0.0, 0.5, 1.0, 3.0])
    assert np.isnan(poses[~valid]).all()


def test_doubled_truth_stamps_do_no_harm() -> None:
    known = track((1, 0, 0, 0), (1, 0, 0, 0), (2, 1, 0, 0))
    poses, valid = interpolate(known, np.array([1.0, 1.5]).astype(np.int64) * SECOND, SECOND)
    assert valid.all()
    assert np.isfinite(poses).all()


def test_errors_by_hand() -> None:
    truth = track((0, 0, 0, 0), (1, 1, 0, 0), (2, 2, 0, 0))
    estimate = track((0.5, 0.5, 0.3, 0.1), (1.5, 1.9, 0.3, -0.2), (9, 0, 0, 0))
    covariance = np.broadcast_to(np.diag([0.01, 0.09, 0.04]), (3, 3, 3))
    errors = metrics.compare(estimate, covariance, truth, SECOND)
    np.testing.assert_allclose(errors.error, [[0, 0.3, 0.1], [0.4, 0.3, -0.2]], atol=1e-12)
    np.testing.assert_allclose(errors.position, [0.3, 0.5])
    np.testing.assert_allclose(errors.sigma, [[0.1, 0.3, 0.2]] * 2)
    np.testing.assert_allclose(errors.nees, [1.25, 18.0])
    row = metrics.summarise(errors)
    assert row.count == 2
    assert row.position_rmse == pytest.approx(math.sqrt(0.17))
    assert (row.position_mean, row.position_median, row.position_max) == pytest.approx((0.4, 0.4, 0.5))
    assert row.position_p95 == pytest.approx(0.49)
    assert row.heading_rmse == pytest.approx(math.sqrt(0.025))
    assert row.nees == pytest.approx(9.625)


def test_heading_error_is_wrapped() -> None:
    errors = metrics.compare(track((0, 0, 0, 3.1)), None, track((0, 0, 0, -3.1)))
    assert errors.error[0, 2] == pytest.approx(6.2 - 2 * math.pi)
    assert np.isnan(errors.nees).all()
    assert math.isnan(metrics.summarise(errors).nees)


def test_lone_truth_meets_the_interpolated_estimate() -> None:
    estimate = track(*[(0.1 * k, 0.1 * k, 0, 0) for k in range(100)])
    covariance = np.arange(1.0, 101.0)[:, None, None] * np.eye(3)
    truth = track((2.06, 2.0, 0, 0), (5.0, 5.0, 0, 0), (20.0, 0, 0, 0))
    errors = metrics.compare(estimate, covariance, truth)
    np.testing.assert_allclose(errors.error[:, 0], [0.06, 0.0], atol=1e-9)
    np.testing.assert_allclose(errors.sigma[:, 0] ** 2, [22.0, 51.0])  # that of the nearest estimate


def test_what_is_not_positive_definite_or_finite_is_not_hidden() -> None:
    error = np.ones((3, 3))
    covariance = np.stack([np.eye(3), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)])
    values = metrics.nees(error, covariance)
    assert values[0] == pytest.approx(3.0)
    assert math.isinf(values[1])
    assert math.isnan(values[2])
    estimate = track((0, 0, 0, 0), (1, np.nan, 0, 0))
    assert len(metrics.compare(estimate, None, track((0, 0, 0, 0), (1, 0, 0, 0)), SECOND).error) == 1


def test_nothing_in_common() -> None:
    empty = Trajectory(np.empty(0, np.int64), np.empty((0, 3)))
    for estimate, truth in ((empty, track((0, 0, 0, 0))), (track((0, 0, 0, 0)), empty), (empty, empty)):
        row = metrics.summarise(metrics.compare(estimate, None, truth))
        assert row.count == 0
        assert math.isnan(row.position_rmse)
    assert metrics.summarise(metrics.pool([])).count == 0


def test_consistent_noise_has_nees_three_and_pools() -> None:
    rng = np.random.default_rng(7)
    count = 4000
    root = np.array([[0.1, 0, 0], [0.05, 0.2, 0], [0.02, -0.03, 0.1]])
    covariance = np.broadcast_to(root @ root.T, (count, 3, 3))
    truth = Trajectory(np.arange(count) * 10_000_000, rng.uniform(-3, 3, (count, 3)))
    estimate = Trajectory(truth.stamp_ns, truth.pose + rng.normal(size=(count, 3)) @ root.T)
    errors = metrics.compare(estimate, covariance, truth)
    both = metrics.summarise(metrics.pool([errors, errors]))
    assert both.count == 2 * count
    assert both.nees == pytest.approx(3.0, abs=0.15)
    assert both.position_rmse == pytest.approx(math.sqrt(np.trace((root @ root.T)[:2, :2])), rel=0.03)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(TrajectoryError, match="do not fit poses"):
        Trajectory(np.zeros(2, np.int64), np.zeros((3, 3)))
    with pytest.raises(TrajectoryError, match="go back in time"):
        track((1, 0, 0, 0), (0, 0, 0, 0))
    with pytest.raises(MetricsError, match="do not fit 1 poses"):
        metrics.compare(track((0, 0, 0, 0)), np.zeros((2, 3, 3)), track((0, 0, 0, 0)))
