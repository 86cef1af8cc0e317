"""Floor plans: halls as walls in the plane, with places where robots start, and distances in them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.parameters import UserError

Rectangle = tuple[float, float, float, float]
"""Left, lower, right and upper edge [m]."""
Point = tuple[float, float]


class FloorPlanError(UserError):
    """There is no such floor plan; the message is one sentence."""


@dataclass(frozen=True)
class FloorPlan:
    """A hall seen from above.

    Attributes:
        name: Of the plan.
        walls: (S, 4) segments x0, y0, x1, y1 [m].
        starts: (R, 2) where the first robots may start [m].
    """

    name: str
    walls: FloatArray
    starts: FloatArray


def outline(free: Sequence[Rectangle], solid: Sequence[Rectangle]) -> FloatArray:
    """The walls (S, 4) around free rectangles without the solid ones."""
    xs = _edges([one[k] for one in (*free, *solid) for k in (0, 2)])
    ys = _edges([one[k] for one in (*free, *solid) for k in (1, 3)])
    x, y = np.meshgrid(0.5 * (xs[1:] + xs[:-1]), 0.5 * (ys[1:] + ys[:-1]), indexing="ij")
    inside = _within(x, y, free) & ~_within(x, y, solid)
    walls = [(xs[i + 1], ys[j], xs[i + 1], ys[j + 1]) for i, j in np.argwhere(inside[1:] != inside[:-1])]
    walls += [
        (xs[i], ys[j + 1], xs[i + 1], ys[j + 1]) for i, j in np.argwhere(inside[:, 1:] != inside[:, :-1])
    ]
    return np.array(walls)


def polygon(corners: Sequence[Point]) -> FloatArray:
    """The walls (S, 4) of a closed polygon."""
    points = np.array(corners, dtype=float)
    return np.hstack([points, np.roll(points, -1, axis=0)])


def _edges(values: Sequence[float]) -> FloatArray:
    """Distinct coordinates in order, with one beyond each end."""
    inner = np.unique(values)
    return np.concatenate([[inner[0] - 1.0], inner, [inner[-1] + 1.0]])


def _within(x: FloatArray, y: FloatArray, rectangles: Sequence[Rectangle]) -> BoolArray:
    """Whether points lie in any of the rectangles."""
    inside = np.zeros(x.shape, dtype=bool)
    for left, low, right, high in rectangles:
        inside |= (left < x) & (x < right) & (low < y) & (y < high)
    return inside


def _load() -> dict[str, FloorPlan]:
    """The plans of `floor_plans.json`: free rectangles without solid ones, polygons, rectangular columns."""
    plans = {}
    data = Path(__file__).with_name("floor_plans.json").read_text(encoding="utf-8")
    for name, plan in json.loads(data).items():
        walls = [outline(plan["free"], plan["solid"])] if "free" in plan else []
        walls += [polygon(corners) for corners in plan.get("polygons", ())]
        walls += [outline([column], []) for column in plan.get("columns", ())]
        plans[name] = FloorPlan(name, np.vstack(walls), np.array(plan["starts"]))
    return plans


FLOOR_PLANS = _load()


def floor_plan(name: str) -> FloorPlan:
    """The floor plan of a name.

    Raises:
        FloorPlanError: There is none.
    """
    if name not in FLOOR_PLANS:
        raise FloorPlanError(f"There is no floor plan '{name}'; there are {', '.join(FLOOR_PLANS)}.")
    return FLOOR_PLANS[name]


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
