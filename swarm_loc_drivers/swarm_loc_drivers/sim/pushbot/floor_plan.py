"""Floor plans: halls as walls in the plane, with places where robots start, and distances in them.

See doc/floor_plans.md for the files.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from swarm_loc_estimator import load_map
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.codec import WHOLE_FILE, Tree, TreeChecks
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.yaml_tree import read_tree

Rectangle = tuple[float, float, float, float]  # Left, lower, right and upper edge [m]
_SUFFIXES = (".yaml", ".yml", ".json")
_KEYS = ("about", "free", "solid", "polygons", "columns", "segments", "starts")
_MAX_WALLS, _MAX_RECTANGLES = 2000, 200  # Each step of a world compares every corner with every wall


class FloorPlanError(UserError):
    """A floor plan that cannot be used; the message is one sentence."""


@dataclass(frozen=True)
class FloorPlan:
    """A hall seen from above."""

    name: str  # Of the plan
    walls: FloatArray  # (S, 4) segments x0, y0, x1, y1 [m]
    starts: FloatArray  # (R, 2) where the first robots may start [m]


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


def polygon(corners: Sequence[tuple[float, ...]]) -> FloatArray:
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


def floor_plan(plan: str) -> FloorPlan:
    """A floor plan by its name in `FLOOR_PLANS`, or from a YAML or JSON file.

    A file has either walls with the keys of `floor_plans.json`, or a map of ROS's map_server. Raises
    UserError if there is no such plan, or the file cannot be used.
    """
    if plan in FLOOR_PLANS:
        return FLOOR_PLANS[plan]
    path = Path(plan)
    if path.suffix not in _SUFFIXES:
        raise FloorPlanError(
            f"There is no floor plan '{plan}': it must be one of {', '.join(FLOOR_PLANS)},"
            f" or the path of a file with the ending {' or '.join(_SUFFIXES)}."
        )
    tree = read_tree(path)
    is_map = isinstance(tree, dict) and "image" in tree
    return _plan_of_map(path) if is_map else _plan_of(plan, tree, TreeChecks(path, FloorPlanError))


def _plan_of(name: str, tree: Tree, checks: TreeChecks) -> FloorPlan:
    """A floor plan from its description; raises FloorPlanError if the description cannot be used."""
    about = checks.mapping(tree, WHOLE_FILE, _KEYS)

    def rows(tree: Tree, key: str, width: int) -> list[tuple[float, ...]]:
        """A list of rows of numbers."""
        table = [checks.list_of_numbers(row, f"{key}[{k}]") for k, row in enumerate(checks.items(tree, key))]
        for k, row in enumerate(table):
            if len(row) != width:
                raise checks.error(f"{key}[{k}]", list(row), f"must have {width} numbers")
        return table

    def rectangles(key: str) -> list[Rectangle]:
        found = [(row[0], row[1], row[2], row[3]) for row in rows(about.get(key, []), key, 4)]
        for k, (left, low, right, high) in enumerate(found):
            if not (left < right and low < high):
                raise checks.error(f"{key}[{k}]", list(found[k]), "must be [left, lower, right, upper]")
        if len(found) > _MAX_RECTANGLES:
            raise checks.said(f"{key} has {len(found)} rectangles but may have {_MAX_RECTANGLES}")
        return found

    free, solid = rectangles("free"), rectangles("solid")
    walls = [np.array(rows(about.get("segments", []), "segments", 4)).reshape(-1, 4)]
    walls += [outline(free, solid)] if free else []
    for k, corners in enumerate(checks.items(about.get("polygons", []), "polygons")):
        walls.append(polygon(rows(corners, f"polygons[{k}]", 2)))
    walls += [outline([column], []) for column in rectangles("columns")]
    starts = np.array(rows(about.get("starts", []), "starts", 2)).reshape(-1, 2)
    return _checked(FloorPlan(name, np.vstack(walls), starts), checks)


def _plan_of_map(path: Path) -> FloorPlan:
    """The walls around the occupied cells of a map; where its image ends is a wall, too.

    Raises UserError if the map cannot be used.
    """
    grid = load_map(path)
    # lines (S, 4) between solid and free cells of the grid (nx, ny), in cells; all around it is solid
    padded = np.pad(grid.occupied, 1, constant_values=True)
    x, low, high = _runs(padded[1:] != padded[:-1]).T
    y, left, right = _runs((padded[:, 1:] != padded[:, :-1]).T).T
    upright = np.column_stack([x, low - 1, x, high - 1])
    level = np.column_stack([left - 1, y, right - 1, y])
    walls = grid.cell * np.vstack([upright, level]).astype(float) + np.tile(grid.corner, 2)
    return _checked(FloorPlan(str(path), walls, np.zeros((0, 2))), TreeChecks(path, FloorPlanError))


def _checked(plan: FloorPlan, checks: TreeChecks) -> FloorPlan:
    """A plan without walls of no length; raises FloorPlanError if it has no walls, or too many."""
    lengths = np.hypot(*(plan.walls[:, 2:] - plan.walls[:, :2]).T)
    walls = plan.walls[lengths > 0.0]
    if not 0 < len(walls) <= _MAX_WALLS:
        raise checks.said(f"the plan has {len(walls)} walls but must have 1 to {_MAX_WALLS}")
    return replace(plan, walls=walls)


def _runs(rows: BoolArray) -> IntArray:
    """Row, begin and end (R, 3) of the runs of True in each row (n, m)."""
    flips = np.diff(np.pad(rows, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, begin = np.nonzero(flips > 0)
    return np.column_stack([row, begin, np.nonzero(flips < 0)[1]])


def _load() -> dict[str, FloorPlan]:
    path = Path(__file__).with_name("floor_plans.json")
    checks = TreeChecks(path, FloorPlanError)
    plans = json.loads(path.read_text(encoding="utf-8"))
    return {name: _plan_of(name, plan, checks) for name, plan in plans.items()}


FLOOR_PLANS = _load()


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
def is_blocked(walls: FloatArray, radii: FloatArray, poses: FloatArray, robot: int) -> bool:
    """Whether the body of one of the robots at poses (N, 3) touches a wall (S, 4) or another robot."""
    x, y = poses[robot, 0], poses[robot, 1]
    for k in range(len(poses)):
        away = math.hypot(x - poses[k, 0], y - poses[k, 1])
        if k != robot and away < radii[robot] + radii[k]:
            return True
    return bool(clearance(walls, np.empty((0, 2)), 0.0, x, y) < radii[robot])


@cached_njit
def kept_clear(walls: FloatArray, radii: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """The poses (N, 3) `after` a step, in which robots that would hit something have only turned."""
    for robot in range(len(after)):
        if is_blocked(walls, radii, after, robot):
            after[robot, :2] = before[robot, :2]
    return after


@cached_njit
def is_visible(walls: FloatArray, ax: float, ay: float, bx: float, by: float) -> bool:
    """Whether no wall (S, 4) stands between two points."""
    distance = math.hypot(bx - ax, by - ay)
    return wall_distance(walls, ax, ay, math.atan2(by - ay, bx - ax)) > distance
