"""Compilation of the inner loops, and the plane's geometry on single numbers for use inside them.

The estimator's hot paths touch a handful of numbers a hundred thousand times, where calls of array
functions cost ten to fifty times the arithmetic. Compiled code is cached beside the source.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile a function on its first call; calls among compiled functions cost nothing."""
    result: Function = numba.njit(cache=True, error_model="numpy")(function)
    return result


@compiled
def wrap(angle: float) -> float:
    """An angle [rad] in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@compiled
def composed(
    ax: float, ay: float, atheta: float, bx: float, by: float, btheta: float
) -> tuple[float, float, float]:
    """The pose b, given in frame a, in the frame that a is given in; heading not wrapped."""
    cos, sin = math.cos(atheta), math.sin(atheta)
    return ax + cos * bx - sin * by, ay + sin * bx + cos * by, atheta + btheta


@compiled
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
