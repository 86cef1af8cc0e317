"""Planar rigid transforms on single numbers, for use inside compiled code; see `se2` for arrays of them."""

from __future__ import annotations

import math

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit


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
def composed(
    ax: float, ay: float, atheta: float, bx: float, by: float, btheta: float
) -> tuple[float, float, float]:
    """The pose b, given in frame a, in the frame that a is given in; heading not wrapped."""
    cos, sin = math.cos(atheta), math.sin(atheta)
    return ax + cos * bx - sin * by, ay + sin * bx + cos * by, atheta + btheta


@cached_njit
def between(
    ax: float, ay: float, atheta: float, bx: float, by: float, btheta: float
) -> tuple[float, float, float]:
    """The pose b seen from the pose a, both given in one frame; heading not wrapped."""
    cos, sin = math.cos(atheta), math.sin(atheta)
    return cos * (bx - ax) + sin * (by - ay), cos * (by - ay) - sin * (bx - ax), btheta - atheta


@cached_njit
def moved_by_twist(
    rho_x: float, rho_y: float, phi: float, x: float, y: float, theta: float
) -> tuple[float, float, float]:
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
