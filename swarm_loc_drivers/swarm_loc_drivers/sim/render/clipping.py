"""Clip surfaces by the view of a camera: near plane and four planes beside it."""

from __future__ import annotations

import math

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit

_NEAR = 0.004  # [m] in front of the camera; what is nearer is cut off
CORNERS = 12  # a quadrangle cut by five planes has at most nine


@cached_njit
def _inside(plane: int, reach: float, point: FloatArray) -> float:
    """How far a point lies inside one of the five planes around what is drawn; negative outside."""
    x, y, z = float(point[0]), float(point[1]), float(point[2])
    if plane == 0:
        return z - _NEAR
    if plane == 1:
        return reach * z - x
    if plane == 2:
        return reach * z + x
    if plane == 3:
        return reach * z - y
    return reach * z + y


@cached_njit
def _blend(target: FloatArray, here: FloatArray, there: FloatArray, share: float) -> None:
    """Write the point (3,) that lies `share` of the way from `here` to `there`."""
    for axis in range(3):
        target[axis] = here[axis] + share * (there[axis] - here[axis])


@cached_njit
def cut(polygon: FloatArray, count: int, spare: FloatArray, reach: float) -> int:
    """Cut a convex polygon, its first `count` rows, by the five planes; its new number of corners."""
    for plane in range(5):
        outside = 0
        for i in range(count):
            if _inside(plane, reach, polygon[i]) < 0.0:
                outside += 1
        if outside == 0:
            continue
        if outside == count:
            return 0
        kept = 0
        for i in range(count):
            here, there = polygon[i], polygon[(i + 1) % count]
            a, b = _inside(plane, reach, here), _inside(plane, reach, there)
            if a >= 0.0:
                _blend(spare[kept], here, here, 0.0)
                kept += 1
            if (a >= 0.0) != (b >= 0.0):
                _blend(spare[kept], here, there, a / (a - b))
                kept += 1
        count = kept
        for i in range(count):
            _blend(polygon[i], spare[i], spare[i], 0.0)
    return count


@cached_njit
def move(rotation: FloatArray, shift: FloatArray, point: FloatArray, moved: FloatArray) -> None:
    """Rotate and shift a point (3,) into `moved`."""
    for axis in range(3):
        moved[axis] = shift[axis]
        for k in range(3):
            moved[axis] += rotation[axis, k] * point[k]


@cached_njit
def ball_in_view(centre: FloatArray, radius: float, reach: float) -> bool:
    """Whether a ball touches what is drawn, in the optical frame."""
    slack = radius * math.sqrt(1.0 + reach * reach)
    for plane in range(5):  # noqa: SIM110 - the compiler knows no generators
        if _inside(plane, reach, centre) < -slack:
            return False
    return True
