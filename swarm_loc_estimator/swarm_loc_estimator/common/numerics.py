"""Small numerics inside compiled code: planar transforms of single numbers, matrices of three rows, LAPACK.

`se2` has transforms of arrays. LAPACK and BLAS work in place on parts of matrices: SciPy's Python functions
copy every part that is not contiguous. These are the same routines, by its Cython interface; matrices are in
Fortran order, given by all their numbers and the offset of a part.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import cast

import llvmlite.binding
import numpy as np
from numba import types
from numba.extending import get_cython_function_address
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit

Pose = tuple[float, float, float]  # x [m], y [m], heading [rad]


@cached_njit
def wrap(angle: float) -> float:
    """An angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@cached_njit
def direction_of(y: float, x: float) -> float:
    """The angle [rad] in [-pi, pi] of a vector as `math.atan2` has it, to 5e-16, without a branch.

    So loops over many are vectorized. The rational approximation is that of the Cephes library.
    """
    width, height = abs(x), abs(y)
    large, small = max(width, height, 1e-300), min(width, height)
    turned = small > 0.41421356237309503 * large
    t = (small - large if turned else small) / (small + large if turned else large)
    z = t * t
    above = -8.750608600031904122785e-1 * z - 1.615753718733365076637e1
    above = (above * z - 7.500855792314704667340e1) * z - 1.228866684490136173410e2
    above = above * z - 6.485021904942025371773e1
    below = (z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2
    below = (below * z + 4.328810604912902668951e2) * z + 4.853903996359136964868e2
    below = below * z + 1.945506571482613964425e2
    angle = t + t * z * above / below
    angle = angle + (0.25 * math.pi if turned else 0.0)
    angle = 0.5 * math.pi - angle if height > width else angle
    angle = math.pi - angle if x < 0.0 else angle
    return math.copysign(angle, y)


@cached_njit
def composed(ax: float, ay: float, atheta: float, bx: float, by: float, btheta: float) -> Pose:
    """The pose b, given in frame a, in the frame that a is given in; heading not wrapped."""
    cos, sin = math.cos(atheta), math.sin(atheta)
    return ax + cos * bx - sin * by, ay + sin * bx + cos * by, atheta + btheta


@cached_njit
def between(ax: float, ay: float, atheta: float, bx: float, by: float, btheta: float) -> Pose:
    """The pose b seen from the pose a, both given in one frame; heading not wrapped."""
    cos, sin = math.cos(atheta), math.sin(atheta)
    return cos * (bx - ax) + sin * (by - ay), cos * (by - ay) - sin * (bx - ax), btheta - atheta


@cached_njit
def moved_by_twist(rho_x: float, rho_y: float, phi: float, x: float, y: float, theta: float) -> Pose:
    """exp(twist) composed with a pose, heading wrapped."""
    if abs(phi) < 1e-4:
        a, b = 1.0 - phi * phi / 6.0, 0.5 * phi
    else:
        a, b = math.sin(phi) / phi, (1.0 - math.cos(phi)) / phi
    ex, ey, etheta = composed(a * rho_x - b * rho_y, b * rho_x + a * rho_y, phi, x, y, theta)
    return ex, ey, wrap(etheta)


@cached_njit
def adjoint_of(transform: FloatArray) -> tuple[tuple[float, ...], ...]:
    """Ad(T) of a transform (3,), see `se2.adjoint`."""
    cos, sin = math.cos(transform[2]), math.sin(transform[2])
    return (cos, -sin, transform[1]), (sin, cos, -transform[0]), (0.0, 0.0, 1.0)


@cached_njit
def carry(transform: FloatArray, matrix: FloatArray, out: FloatArray) -> None:
    """Write Ad(T) M Ad(T)^T (3, 3), of a transform (3,) and the covariance M (3, 3) of an error after it."""
    adjoint = adjoint_of(transform)
    for i in range(3):
        a, b, c = adjoint[i]
        x = a * matrix[0, 0] + b * matrix[1, 0] + c * matrix[2, 0]
        y = a * matrix[0, 1] + b * matrix[1, 1] + c * matrix[2, 1]
        z = a * matrix[0, 2] + b * matrix[1, 2] + c * matrix[2, 2]
        for j in range(3):
            out[i, j] = x * adjoint[j][0] + y * adjoint[j][1] + z * adjoint[j][2]


@cached_njit
def assign(target: FloatArray, source: FloatArray) -> None:
    """Copy a vector; each slice assignment would cost seconds of compilation."""
    for i in range(target.size):
        target[i] = source[i]


@cached_njit
def assign_matrix(target: FloatArray, source: FloatArray) -> None:
    """Copy a matrix."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@cached_njit
def add_scaled(target: FloatArray, source: FloatArray, factor: float) -> None:
    """Add `factor` times a matrix."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] += factor * source[i, j]


@inlined_njit
def factor_numbers(matrix: FloatArray) -> tuple[float, float, float, float, float, float]:
    """The rows of the lower Cholesky factor of a positive definite matrix (3, 3), one after the other."""
    a = math.sqrt(matrix[0, 0])
    b = matrix[1, 0] / a
    c = math.sqrt(matrix[1, 1] - b * b)
    d = matrix[2, 0] / a
    e = (matrix[2, 1] - d * b) / c
    return a, b, c, d, e, math.sqrt(matrix[2, 2] - d * d - e * e)


@cached_njit
def cholesky3(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor (3, 3) of a positive definite matrix (3, 3)."""
    factor = np.zeros((3, 3))
    factor[0, 0], factor[1, 0], factor[1, 1], factor[2, 0], factor[2, 1], factor[2, 2] = factor_numbers(
        matrix
    )
    return factor


@cached_njit
def solve3(factor: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Write the solution (3,) of L L^T x = right for a lower factor L (3, 3)."""
    a = right[0] / factor[0, 0]
    b = (right[1] - factor[1, 0] * a) / factor[1, 1]
    c = (right[2] - factor[2, 0] * a - factor[2, 1] * b) / factor[2, 2]
    c = c / factor[2, 2]
    b = (b - factor[2, 1] * c) / factor[1, 1]
    out[0] = (a - factor[1, 0] * b - factor[2, 0] * c) / factor[0, 0]
    out[1], out[2] = b, c


def _external(library: str, name: str, arguments: int) -> Callable[..., None]:
    """A routine, by a symbol that compiled code finds also when it comes from the cache."""
    symbol = f"swarm_loc_{name}"
    llvmlite.binding.add_symbol(symbol, get_cython_function_address(f"scipy.linalg.cython_{library}", name))
    routine = types.ExternalFunction(symbol, types.void(*[types.voidptr] * arguments))
    return cast("Callable[..., None]", routine)


_dpotrf, _dtrtri = _external("lapack", "dpotrf", 5), _external("lapack", "dtrtri", 6)
_dlauum = _external("lapack", "dlauum", 5)
_dtrmm, _dsyrk = _external("blas", "dtrmm", 11), _external("blas", "dsyrk", 10)

_LOWER = _LEFT = np.frombuffer(b"L", dtype=np.uint8)
_RIGHT, _TRANSPOSED, _PLAIN = (np.frombuffer(letter, dtype=np.uint8) for letter in (b"R", b"T", b"N"))
_PLUS, _MINUS = np.array([1.0]), np.array([-1.0])
_LEAF = 40  # Maximum number of rows that are passed to LAPACK, which is slow with larger triangles
_WHOLE, _FIRST, _LAST = 0, 1, 2  # Steps of a plan: a small part; what follows from its upper and lower half


def invert_positive(numbers: FloatArray, size: int) -> bool:
    """Invert a symmetric positive definite matrix (size * size,), column by column, in place.

    Only its lower triangle is used. Returns whether it is positive definite; else its content is undefined.
    """
    return _invert(numbers, size, _plan(size))


def invert_factor(numbers: FloatArray, size: int) -> bool:
    """Replace a positive definite matrix (size, size) by the inverse of its Cholesky factor.

    Only its lower triangle is read and written; for arguments and result see `invert_positive`.
    """
    return _invert_factor(numbers, size, _plan(size))


@cache
def _plan(size: int) -> IntArray:
    """The steps (s, 3) that invert the factor of a matrix: which, the first row, number of rows."""
    return np.array(_steps(0, size), dtype=np.int64).reshape(-1, 3)


def _steps(begin: int, rows: int) -> list[tuple[int, int, int]]:
    if rows <= _LEAF:
        return [(_WHOLE, begin, rows)]
    half = rows // 2
    upper, lower = _steps(begin, half), _steps(begin + half, rows - half)
    return [*upper, (_FIRST, begin, rows), *lower, (_LAST, begin, rows)]


@cached_njit
def _invert(numbers: FloatArray, size: int, plan: IntArray) -> bool:
    if not _invert_factor(numbers, size, plan):
        return False
    sizes = np.empty(2, dtype=np.int32)
    sizes[0] = size
    _dlauum(_LOWER.ctypes, sizes.ctypes, numbers.ctypes, sizes.ctypes, sizes[1:].ctypes)
    return True


@cached_njit
def _invert_factor(numbers: FloatArray, size: int, plan: IntArray) -> bool:
    """Invert the factor in steps; not by recursion, which numba's cache does not support."""
    sizes = np.empty(3, dtype=np.int32)
    for k in range(plan.shape[0]):
        step, begin, rows = plan[k, 0], plan[k, 1] * (size + 1), plan[k, 2]
        if step == _WHOLE:
            if not _invert_part(numbers, begin, rows, size, sizes):
                return False
        else:
            _join_halves(numbers, begin, rows, size, sizes, step == _FIRST)
    return True


@cached_njit
def _invert_part(numbers: FloatArray, begin: int, rows: int, size: int, sizes: NDArray[np.int32]) -> bool:
    """Replace a small part on the diagonal by the inverse of its factor; return whether it has one."""
    sizes[0], sizes[1], sizes[2] = rows, size, 0
    part, n, stride, info = numbers[begin:].ctypes, sizes.ctypes, sizes[1:].ctypes, sizes[2:].ctypes
    _dpotrf(_LOWER.ctypes, n, part, stride, info)
    for i in range(rows):  # LAPACK may let NaN pass
        if sizes[2] != 0 or not np.isfinite(numbers[begin + i * (size + 1)]):
            return False
    _dtrtri(_LOWER.ctypes, _PLAIN.ctypes, n, part, stride, info)
    return True


@cached_njit
def _join_halves(
    numbers: FloatArray, begin: int, rows: int, size: int, sizes: NDArray[np.int32], is_first: bool
) -> None:
    """Go on from half of a part on the diagonal; products take nearly all of the time, LAPACK would solve.

    [A .; B D] has the factor [L 0; M N] with M = B L^-T and N N^T = D - M M^T, and that the inverse
    [L^-1 0; -N^-1 M L^-1 N^-1].
    """
    half = rows // 2
    last = begin + half * (size + 1)
    sizes[0], sizes[1], sizes[2] = rows - half, half, size
    m, n, stride = sizes.ctypes, sizes[1:].ctypes, sizes[2:].ctypes
    upper, lower, below = numbers[begin:].ctypes, numbers[last:].ctypes, numbers[begin + half :].ctypes
    right, left, is_lower = _RIGHT.ctypes, _LEFT.ctypes, _LOWER.ctypes
    plain, transposed, plus, minus = _PLAIN.ctypes, _TRANSPOSED.ctypes, _PLUS.ctypes, _MINUS.ctypes
    if is_first:
        _dtrmm(right, is_lower, transposed, plain, m, n, plus, upper, stride, below, stride)
        _dsyrk(is_lower, plain, m, n, minus, below, stride, plus, lower, stride)
    else:
        _dtrmm(left, is_lower, plain, plain, m, n, minus, lower, stride, below, stride)
        _dtrmm(right, is_lower, plain, plain, m, n, plus, upper, stride, below, stride)
