"""The covariance's updates against textbook formulas, and their symmetry and definiteness under strain."""

import numpy as np
import pytest
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.numerics import cholesky3, solve3
from swarm_loc_estimator.filter.joint_filter import DenseFilter, update_one


def covariance(rng: np.random.Generator, size: int) -> FloatArray:
    factor = rng.standard_normal((size, size))
    positive: FloatArray = factor @ factor.T + 0.1 * np.eye(size)
    return positive


def full(columns: NDArray[np.int64], jacobian: FloatArray, size: int) -> FloatArray:
    """H (3, size); a column named twice counts twice."""
    h = np.zeros((3, size))
    for c, column in enumerate(columns):
        h[:, column] += jacobian[:, c]
    return h


def kalman(p: FloatArray, h: FloatArray, y: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariance and correction by eqs. (11)-(14) as they stand in textbooks."""
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
    rest = np.eye(p.shape[0]) - gain @ h
    return rest @ p @ rest.T + gain @ r @ gain.T, gain @ y


def problem(
    seed: int, size: int = 9
) -> tuple[FloatArray, NDArray[np.int64], FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    columns = np.concatenate([rng.permutation(size)[:5], [0]]).astype(np.int64)
    return (
        covariance(rng, size),
        columns,
        rng.standard_normal((3, 6)),
        rng.standard_normal(3),
        covariance(rng, 3),
    )


@pytest.mark.parametrize("measured", [2, 3])
@pytest.mark.parametrize("seed", range(8))
def test_one_measurement_is_used_as_in_the_textbook(seed: int, measured: int) -> None:
    """A component that is not measured changes nothing."""
    p, columns, jacobian, y, r = problem(seed)
    jacobian[measured:], y[measured:] = 0.0, 0.0
    r[measured:], r[:, measured:] = np.eye(3)[measured:], np.eye(3)[:, measured:]
    h = full(columns, jacobian, 9)[:measured]
    expected, correction = kalman(p, h, y[:measured], r[:measured, :measured])
    np.testing.assert_allclose(update_one(p, columns, jacobian, y, r), correction, atol=1e-10)
    np.testing.assert_allclose(p, expected, atol=1e-10)


@pytest.mark.parametrize("seed", range(8))
def test_many_measurements_at_once_are_those_one_after_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size, m = 12, 30
    columns = np.array([rng.permutation(size)[:6] for _ in range(m)], dtype=np.int64)
    columns[0, 3] = columns[0, 0]
    jacobian, value = rng.standard_normal((m, 3, 6)), rng.standard_normal((m, 3))
    jacobian[::3, 2] = 0.0  # not measured
    noise = np.array([covariance(rng, 3) for _ in range(m)])
    noise[::3, 2, :] = noise[::3, :, 2] = [0.0, 0.0, 1.0]
    together = DenseFilter(size)
    together.covariance = covariance(rng, size)
    p, mean = together.covariance.copy(), np.zeros(size)
    for k in range(m):
        y = value[k] - full(columns[k], jacobian[k], size) @ mean
        y[2] *= k % 3 != 0
        mean += update_one(p, columns[k], jacobian[k], y, noise[k])
    value[::3, 2] = 0.0
    np.testing.assert_allclose(together.update(columns, jacobian, value, noise), mean, atol=1e-9)
    np.testing.assert_allclose(together.covariance, p, atol=1e-9)


def assert_sound(p: FloatArray) -> None:
    np.testing.assert_array_equal(p, p.T)
    scale = np.sqrt(np.diag(p))
    assert (scale > 0.0).all()
    assert np.linalg.eigvalsh(p / np.outer(scale, scale)).min() > -1e-9


@pytest.mark.parametrize("seed", range(2))
def test_a_hundred_thousand_updates_leave_it_symmetric_and_positive_definite(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p = covariance(rng, 9)
    r = np.diag([4e-4, 1e-4, 1e-2])
    jacobians = rng.standard_normal((50, 3, 6))
    columns = np.array([[0, 1, 2, 3, 4, 5], [3, 4, 5, 6, 7, 8], [6, 7, 8, 0, 1, 2]])
    noise = 1e-7 * np.eye(9)
    for k in range(100_000):
        update_one(p, columns[k % 3], jacobians[k % 50], np.zeros(3), r)
        p += noise
    assert_sound(p)
    assert np.linalg.eigvalsh(p).min() > 1e-8


@pytest.mark.parametrize("prior", [1e-10, 1.0, 1e6])
@pytest.mark.parametrize("noise", [1e-8, 1e-4, 1e8])
def test_extreme_ratios_of_variances_keep_it_sound(prior: float, noise: float) -> None:
    rng = np.random.default_rng(0)
    p = prior * covariance(rng, 6)
    for _ in range(200):
        jacobian = rng.standard_normal((3, 6))
        correction = update_one(p, np.arange(6), jacobian, rng.standard_normal(3), noise * np.eye(3))
        assert np.isfinite(correction).all()
    assert_sound(p)


def test_placing_makes_columns_independent() -> None:
    rng = np.random.default_rng(0)
    dense = DenseFilter(9)
    dense.covariance = covariance(rng, 9)
    before = dense.copy().covariance
    block = covariance(rng, 3)
    dense.set_prior(np.arange(3, 6), block)
    np.testing.assert_array_equal(dense.covariance[3:6, 3:6], block)
    assert not dense.covariance[3:6, :3].any()
    assert not dense.covariance[6:, 3:6].any()
    np.testing.assert_array_equal(dense.covariance[:3, 6:], before[:3, 6:])


def test_the_small_cholesky_solves() -> None:
    rng = np.random.default_rng(0)
    matrix, right, out = covariance(rng, 3), rng.standard_normal(3), np.empty(3)
    factor = cholesky3(matrix)
    np.testing.assert_allclose(factor, np.linalg.cholesky(matrix), atol=1e-12)
    solve3(factor, right, out)
    np.testing.assert_allclose(out, np.linalg.solve(matrix, right), atol=1e-12)
