"""Geometry and matrices: SE(2) and inversion."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from core_geometry import planar, slopes_of, wrapped
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.numerics import direction_of, invert_factor
from swarm_loc_estimator.filter.joint_filter import DenseFilter, inverse


def poses(seed: int, *shape: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(-5, 5, (*shape, 2)), rng.uniform(-np.pi, np.pi, (*shape, 1))], axis=-1)


def hat(twist: FloatArray) -> FloatArray:
    x, y, phi = twist
    return np.array([[0, -phi, x], [phi, 0, y], [0, 0, 0]])


def assert_same_pose(a: FloatArray, b: FloatArray, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(wrapped(np.asarray(a) - np.asarray(b)), 0.0, atol=tolerance)


@pytest.mark.parametrize(
    "angle", [-np.pi, np.pi, 3 * np.pi, -3 * np.pi, 0.0, 100.0, -1e4, np.nextafter(np.pi, 0)]
)
def test_wrapped_angles_lie_in_the_half_open_turn_and_point_the_same_way(angle: float) -> None:
    wrapped = float(se2.wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_compose_and_inverse_are_those_of_homogeneous_matrices(seed: int) -> None:
    a, b = poses(seed, 2)
    np.testing.assert_allclose(planar(se2.compose(a, b)), planar(a) @ planar(b), atol=1e-12)
    np.testing.assert_allclose(planar(se2.inverse(a)), np.linalg.inv(planar(a)), atol=1e-12)
    np.testing.assert_allclose(planar(se2.between(a, b)), np.linalg.inv(planar(a)) @ planar(b), atol=1e-12)
    point = np.array([0.7, -2.0])
    np.testing.assert_allclose(se2.transform_points(a, point), (planar(a) @ [*point, 1.0])[:2], atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_rigid_fit_undoes_a_motion_and_errors_that_balance(seed: int) -> None:
    (pose,) = poses(seed, 1)
    points = np.random.default_rng(seed).normal(size=(20, 2))
    assert_same_pose(se2.rigid_fit(points, se2.transform_points(pose, points)), pose)
    square = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    assert_same_pose(se2.rigid_fit(square, se2.transform_points(pose, 1.1 * square)), pose)


@pytest.mark.parametrize("turn", [0.0, 1e-12, 1e-5, 0.99e-4, 1.01e-4, 0.3, -2.0, 3.1])
def test_exp_is_the_matrix_exponential_and_log_undoes_it(turn: float) -> None:
    twist = np.array([0.8, -1.7, turn])
    np.testing.assert_allclose(planar(se2.exp(twist)), expm(hat(twist)), atol=1e-12)
    np.testing.assert_allclose(se2.log(se2.exp(twist)), twist, atol=1e-11)


@pytest.mark.parametrize("seed", range(5))
def test_adjoint_moves_a_twist_through_a_transform(seed: int) -> None:
    (pose,) = poses(seed, 1)
    twist = np.random.default_rng(seed).uniform(-1, 1, 3)
    moved = se2.exp(se2.adjoint(pose) @ twist)
    assert_same_pose(se2.compose(pose, se2.exp(twist)), se2.compose(moved, pose))


def test_everything_works_on_any_leading_shape_as_on_single_poses() -> None:
    a, b = poses(1, 2, 3), poses(2, 2, 3)
    index = (1, 2)
    for function in (se2.compose, se2.between):
        np.testing.assert_array_equal(function(a, b)[index], function(a[index], b[index]))
        np.testing.assert_array_equal(function(a[0, 0], b)[index], function(a[0, 0], b[index]))
    for of_one in (se2.inverse, se2.exp, se2.log, se2.adjoint, se2.error_to_pose_jacobian):
        np.testing.assert_array_equal(of_one(a)[index], of_one(a[index]))
    assert se2.compose(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("seed", range(5))
def test_errors_of_a_pose_follow_from_its_right_invariant_error(seed: int) -> None:
    (pose,) = poses(seed, 1)
    numeric = slopes_of(lambda change: se2.compose(se2.exp(change), pose), 3)
    np.testing.assert_allclose(se2.error_to_pose_jacobian(pose), numeric, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_covariances_go_to_the_error_and_back(seed: int) -> None:
    pose = poses(seed, 4)
    factor = np.random.default_rng(seed).standard_normal((4, 3, 3))
    covariance = factor @ np.swapaxes(factor, 1, 2)
    error = se2.error_covariance(pose, covariance)
    np.testing.assert_allclose(se2.pose_covariance(pose, error), covariance, atol=1e-10)
    sampled = np.random.default_rng(seed).multivariate_normal(np.zeros(3), 1e-6 * error[0], 20_000)
    spread = se2.compose(se2.exp(sampled), pose[0]) - pose[0]
    np.testing.assert_allclose(np.cov(spread.T) * 1e6, covariance[0], atol=0.05 * np.trace(covariance[0]))


def test_directions_are_those_of_the_arc_tangent() -> None:
    angles = np.concatenate([np.linspace(-np.pi, np.pi, 2001), np.arange(-8, 9) * np.pi / 8])
    for length in (1e-9, 1.0, 3e7):
        for x, y in zip(length * np.cos(angles), length * np.sin(angles), strict=True):
            assert direction_of(y, x) == pytest.approx(np.arctan2(y, x), abs=5e-16)
    axes = [(0.0, 0.0), (0.0, -1.0), (-0.0, -1.0), (1.0, 0.0), (-1.0, 0.0)]
    assert [direction_of(y, x) for y, x in axes] == [0.0, np.pi, -np.pi, 0.5 * np.pi, -0.5 * np.pi]


def positive(rng: np.random.Generator, size: int) -> FloatArray:
    factor = rng.standard_normal((size, size))
    matrix: FloatArray = factor @ factor.T / size + 0.1 * np.eye(size)
    return matrix


@given(size=st.sampled_from([1, 2, 3, 59, 80, 81, 161, 300]), seed=st.integers(0, 10**6))
def test_the_inverse_is_lapack_s_and_symmetric(size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-4.0, 4.0, size)  # of positions and of what is not known at all
    scaled = positive(rng, size) * np.outer(scale, scale)
    given = scaled.copy()
    result = inverse(scaled)
    np.testing.assert_array_equal(scaled, given)
    np.testing.assert_array_equal(result, result.T)
    unscaled = result * np.outer(scale, scale)
    np.testing.assert_allclose(unscaled, np.linalg.inv(scaled / np.outer(scale, scale)), atol=1e-9)


@given(size=st.sampled_from([1, 2, 40, 41, 80, 81, 192]), seed=st.integers(0, 10**6))
def test_the_inverse_of_the_factor_is_lapack_s(size: int, seed: int) -> None:
    matrix = positive(np.random.default_rng(seed), size)
    written = matrix.copy()
    assert invert_factor(written.reshape(-1), size)
    expected = np.linalg.inv(np.linalg.cholesky(matrix))
    np.testing.assert_allclose(np.tril(written.T), expected, atol=1e-9)
    assert not invert_factor(-matrix.reshape(-1), size)


@pytest.mark.parametrize("place", [0, 99, 199])
@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_what_is_not_positive_definite_is_refused(place: int, value: float) -> None:
    matrix = np.eye(200)
    matrix[place, place] = value
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        inverse(matrix)


def test_an_update_done_again_from_a_copy_gives_the_same_bytes() -> None:
    rng = np.random.default_rng(1)
    columns, noise = np.array([[0, 1, 2, 3, 4, 5], [3, 4, 5, 6, 7, 8]]), np.array([np.eye(3)] * 2)
    jacobian, innovation = rng.standard_normal((2, 3, 6)), rng.standard_normal((2, 3))
    prior = DenseFilter(9)
    prior.covariance = positive(rng, 9)
    provisional, final, alone = prior.copy(), prior.copy(), DenseFilter(9)
    alone.covariance = prior.covariance.copy()
    provisional.update(columns[:1], jacobian[:1], innovation[:1], noise[:1])
    corrections = [one.update(columns, jacobian, innovation, noise) for one in (final, alone)]
    assert corrections[0].tobytes() == corrections[1].tobytes()
    assert final.covariance.tobytes() == alone.covariance.tobytes()


def test_compiled_code_from_the_cache_finds_lapack(tmp_path: Path) -> None:
    inverting = "import numpy as np\nfrom swarm_loc_estimator.common.numerics import invert_positive\n"
    inverting += "assert invert_positive(np.eye(90).reshape(-1), 90)"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    for _ in ("compiled", "from the cache"):
        subprocess.run([sys.executable, "-c", inverting], env=environment, check=True)
    assert list(tmp_path.rglob("*.nbc"))
