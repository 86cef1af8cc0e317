"""Floor plans: halls as walls in the plane, with places where robots start, and distances in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

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

    def wall_points(self, spacing: float) -> FloatArray:
        """Points (P, 2) [m] in the middle of equal pieces of the walls, at most `spacing` long."""
        pieces = []
        for x0, y0, x1, y1 in self.walls:
            count = max(1, int(np.ceil(np.hypot(x1 - x0, y1 - y0) / spacing)))
            share = ((np.arange(count) + 0.5) / count)[:, None]
            pieces.append(np.array([x0, y0]) + share * np.array([x1 - x0, y1 - y0]))
        return np.concatenate(pieces)


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


def _corridor() -> FloorPlan:
    """The hallway of the PushBot paper, 12.0 x 3.3 m, with door niches and furniture."""
    niches: list[Rectangle] = [
        (2, -0.12, 2.9, 0),
        (7, -0.12, 7.9, 0),
        (4.5, 3.3, 5.4, 3.42),
        (9.5, 3.3, 10.4, 3.42),
    ]
    furniture: list[Rectangle] = [
        (5.5, 0, 6.3, 0.35),
        (0, 2.6, 0.4, 3.3),
        (11.6, 0.6, 12, 1.8),
        (2.2, 2.9, 3.0, 3.3),
        (8.6, 1.2, 9.0, 1.7),
    ]
    starts = [(1.5, 1.5), (1.5, 0.7), (1.2, 2.2), (2.3, 1.1), (2.4, 2.0)]
    starts += [(3.2, 0.7), (3.2, 1.5), (3.3, 2.3), (4.1, 0.9), (4.1, 1.9)]
    return FloorPlan("corridor", outline([(0, 0, 12, 3.3), *niches], furniture), np.array(starts))


def _office() -> FloorPlan:
    """A hallway between four rooms."""
    rooms: list[Rectangle] = [
        (0, 3.2, 9, 4.7),
        (0, 0, 4.4, 3.1),
        (4.5, 0, 9, 3.1),
        (0, 4.8, 3.9, 8),
        (4.0, 4.8, 9, 8),
    ]
    doors: list[Rectangle] = [
        (3.0, 3.1, 3.9, 3.2),
        (5.2, 3.1, 6.1, 3.2),
        (1.0, 4.7, 1.9, 4.8),
        (7.0, 4.7, 7.9, 4.8),
    ]
    furniture: list[Rectangle] = [
        (0, 0, 0.6, 1.4),
        (1.9, 0, 3.1, 0.5),
        (8.3, 0.8, 9, 2.2),
        (6.2, 1.2, 7.0, 1.7),
        (0, 7.4, 1.6, 8),
        (3.3, 6, 3.9, 7),
        (6.3, 6.3, 7.2, 6.9),
        (8.5, 5.2, 9, 6.2),
        (4.6, 4.35, 5.4, 4.7),
    ]
    starts = [(1.6, 3.8), (2.4, 4.2), (2.5, 3.6), (0.8, 4.2), (0.8, 3.6)]
    return FloorPlan("office", outline([*rooms, *doors], furniture), np.array(starts))


def _ring() -> FloorPlan:
    """A corridor around a block, which closes a loop of 26 m."""
    solid: list[Rectangle] = [
        (1.5, 1.5, 6.5, 6.5),
        (3.2, 0, 4.0, 0.3),
        (7.75, 2.5, 8, 3.4),
        (4.6, 7.6, 5.2, 8),
        (0, 4.8, 0.25, 5.7),
        (6.5, 5.0, 6.7, 5.4),
        (1.3, 2.6, 1.5, 3.2),
    ]
    starts = [(0.75, 0.75), (1.5, 0.8), (0.8, 1.6), (2.2, 0.7), (0.7, 2.3)]
    return FloorPlan("ring", outline([(0, 0, 8, 8)], solid), np.array(starts))


def _bend() -> FloorPlan:
    """Two legs of a corridor that meet at 60 degrees, with slanted walls and a pillar of five sides."""
    hall = polygon(
        [
            (0, 0),
            (7.0, 0),
            (10.0, 5.196),
            (8.1, 6.293),
            (5.7, 2.136),
            (4.9, 2.0),
            (4.6, 2.4),
            (0.5, 2.4),
            (0, 1.9),
        ]
    )
    pillar = polygon([(6.2, 0.7), (6.6, 0.6), (6.8, 0.95), (6.55, 1.25), (6.2, 1.1)])
    cabinet = polygon([(2.0, 0), (2.0, 0.4), (2.9, 0.4), (2.9, 0)])
    starts = [(1.0, 1.2), (1.6, 0.7), (1.7, 1.7), (2.5, 1.2), (0.7, 0.5)]
    return FloorPlan("bend", np.vstack([hall, pillar, cabinet]), np.array(starts))


def _atrium() -> FloorPlan:
    """An eight-sided hall of 7 m with four columns and an alcove."""
    lower = [(2.0, 0), (5.0, 0), (7.0, 2.0), (7.0, 3.0), (8.0, 3.0), (8.0, 4.2)]
    upper = [(7.0, 4.2), (7.0, 5.0), (5.0, 7.0), (2.0, 7.0), (0, 5.0), (0, 2.0)]
    hall = polygon([*lower, *upper])
    columns = [
        outline([(x, y, x + 0.5, y + 0.4)], []) for x, y in [(1.9, 2.1), (4.7, 1.9), (2.1, 4.6), (4.5, 4.8)]
    ]
    starts = [(3.5, 1.0), (2.7, 0.7), (4.3, 0.8), (3.2, 1.8), (4.0, 1.7)]
    return FloorPlan("atrium", np.vstack([hall, *columns]), np.array(starts))


def _tee() -> FloorPlan:
    """Three arms of different widths, one of them with a door to a small room."""
    free: list[Rectangle] = [(0, 0, 9, 1.8), (4.0, 1.8, 5.6, 7.0), (5.7, 3.6, 8.6, 6.6), (5.6, 4.6, 5.7, 5.5)]
    solid: list[Rectangle] = [
        (1.2, 1.4, 2.0, 1.8),
        (6.8, 0, 7.5, 0.4),
        (4.0, 4.0, 4.3, 4.8),
        (7.4, 3.6, 8.6, 4.2),
    ]
    starts = [(1.0, 0.8), (0.6, 1.2), (1.6, 0.5), (2.3, 1.0), (3.0, 0.7)]
    return FloorPlan("tee", outline(free, solid), np.array(starts))


FLOOR_PLANS: dict[str, Callable[[], FloorPlan]] = {
    "corridor": _corridor,
    "office": _office,
    "ring": _ring,
    "bend": _bend,
    "atrium": _atrium,
    "tee": _tee,
}


def floor_plan(name: str) -> FloorPlan:
    """The floor plan of a name.

    Raises:
        FloorPlanError: There is none.
    """
    if name not in FLOOR_PLANS:
        raise FloorPlanError(f"There is no floor plan '{name}'; there are {', '.join(FLOOR_PLANS)}.")
    return FLOOR_PLANS[name]()


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
