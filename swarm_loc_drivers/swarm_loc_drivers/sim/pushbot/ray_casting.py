"""Distances in a floor plan: to the first wall or robot along a ray, and to the nearest one."""

from __future__ import annotations

import math

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit

_PARALLEL = 1e-12


@cached_njit
def wall_distance(walls: FloatArray, x: float, y: float, angle: float) -> float:
    """Distance [m] from a point to the first of walls (S, 4) along an angle [rad]; infinite without any."""
    cos, sin = math.cos(angle), math.sin(angle)
    nearest = math.inf
    for k in range(len(walls)):
        along_x, along_y = walls[k, 2] - walls[k, 0], walls[k, 3] - walls[k, 1]
        across = cos * along_y - sin * along_x
        if abs(across) < _PARALLEL:
            continue
        to_x, to_y = walls[k, 0] - x, walls[k, 1] - y
        distance = (to_x * along_y - to_y * along_x) / across
        share = (to_x * sin - to_y * cos) / across
        if 0.0 < distance < nearest and -1e-9 <= share <= 1.0 + 1e-9:
            nearest = distance
    return nearest


@cached_njit
def disc_distance(discs: FloatArray, radius: float, x: float, y: float, angle: float) -> float:
    """Distance [m] to the first of discs with centres (D, 2) along an angle; infinite without any."""
    cos, sin = math.cos(angle), math.sin(angle)
    nearest = math.inf
    for k in range(len(discs)):
        to_x, to_y = discs[k, 0] - x, discs[k, 1] - y
        along = to_x * cos + to_y * sin
        half_square = radius * radius - (to_x * to_x + to_y * to_y - along * along)
        if along > 0.0 and half_square > 0.0:
            nearest = min(nearest, max(0.0, along - math.sqrt(half_square)))
    return nearest


@cached_njit
def ray_distance(
    walls: FloatArray, discs: FloatArray, radius: float, x: float, y: float, angle: float
) -> float:
    """Distance [m] to the first wall (S, 4) or robot, a disc with its centre among (D, 2), along a ray."""
    return min(wall_distance(walls, x, y, angle), disc_distance(discs, radius, x, y, angle))


@cached_njit
def clearance(walls: FloatArray, discs: FloatArray, radius: float, x: float, y: float) -> float:
    """Distance [m] from a point to the nearest wall (S, 4) or rim of a disc with its centre among (D, 2)."""
    nearest = math.inf
    for k in range(len(walls)):
        along_x, along_y = walls[k, 2] - walls[k, 0], walls[k, 3] - walls[k, 1]
        to_x, to_y = x - walls[k, 0], y - walls[k, 1]
        share = (to_x * along_x + to_y * along_y) / (along_x * along_x + along_y * along_y)
        share = min(1.0, max(0.0, share))
        nearest = min(nearest, math.hypot(to_x - share * along_x, to_y - share * along_y))
    for k in range(len(discs)):
        nearest = min(nearest, math.hypot(x - discs[k, 0], y - discs[k, 1]) - radius)
    return nearest


@cached_njit
def is_visible(walls: FloatArray, ax: float, ay: float, bx: float, by: float) -> bool:
    """Whether no wall (S, 4) stands between two points."""
    distance = math.hypot(bx - ax, by - ay)
    return wall_distance(walls, ax, ay, math.atan2(by - ay, bx - ax)) > distance
