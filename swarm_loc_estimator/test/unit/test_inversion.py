"""Inverses of large matrices against LAPACK's, and the memory of the last one."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.numerics import invert_factor
from swarm_loc_estimator.filter.joint_filter import DenseFilter, inverse


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
