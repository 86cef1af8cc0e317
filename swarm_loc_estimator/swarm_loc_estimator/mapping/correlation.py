"""Correlative matching: where points of walls fit others best, whatever the shape of the walls.

Points that are known make a field of cells, 1 on a point and falling off around it. A pose scores the mean
of the field at the points seen from it. The best one within a window is found by branch and bound over
blocks of cells (E. Olson, Real-time correlative scan matching, ICRA 2009; W. Hess et al., Real-time loop
closure in 2D LIDAR SLAM, ICRA 2016), and its covariance follows from how the score falls off around it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit

_CELL, _LEVELS = 0.05, 6  # Side of a cell [m], and number of sizes of blocks: 1 to 32 cells
_SPREAD, _SPREAD_CELLS = 0.08, 4  # Standard deviation of points of a wall [m], and up to where they count
_PARTS = 4  # Parts of a cell along each side in which points are drawn alike
_SEARCH_POINTS, _SHAPE_POINTS = 160, 80  # Number of points in searches and in covariances
_INDEPENDENT = 90.0  # Points that count as independent, since neighbours share their errors
_MAX_PENALTY, _DISTINCT = 4.0, 30.0
"""Loss of a pose that the prediction excludes, in log likelihood, and what that is of a score."""
_SHAPE_CELLS, _SHAPE_TURNS, _SHAPE_TURN = 8, 5, 0.005
"""Lattice for covariances: cells and turns to each side, and step of the turns [rad]."""
_RIDGE = 0.1  # Standard deviation on the lattice from which a direction is unknown [m]
_UNKNOWN = 10.0  # Standard deviation of such a direction [m]
_LEAST_VARIANCE = np.array([0.01, 0.01, 0.002]) ** 2  # [m, m, rad]
_ON_CELLS = 0.8  # Share of its score that the best pose has at least on the cells of the search
_STEPS = 8  # Number of Gauss-Newton steps to a place between cells
_APART_TURN = math.radians(12.0)  # Turn from which a pose is another place
_APART = 0.5  # Distance from which it is one [m]
_MAX_BETWEEN, _NEIGHBOUR = 2.0, 0.5  # Greatest distance of neighbouring ends on a wall, and of any others [m]
_ON_LINE = 0.2  # How far a third one may be from their line, over the distance of their beams


class PointField(NamedTuple):
    """How well points fit places."""

    corner: FloatArray  # (2,) of the first cell [m]
    #: (levels, nx, ny) greatest value, 0 to 255, of the 2^level x 2^level cells from each one on
    levels: NDArray[np.uint8]


class PoseWindow(NamedTuple):
    """Poses that are searched, around a predicted one."""

    reach: float  # Greatest offset along x and y [m]
    turn: float  # Greatest turn [rad]
    sigma: float  # Standard deviation of the predicted position [m]; infinite: all places are alike
    turn_sigma: float  # and of its heading [rad]


class BestPose(NamedTuple):
    """The best pose in a window."""

    pose: FloatArray  # (3,)
    covariance: FloatArray  # (3, 3)
    score: float  # Mean value of the field, 0 to 1
    rival: float  # The score of another place that has been looked for; 0: clearly less


@cached_njit
def thin(points: FloatArray, apart: float) -> FloatArray:
    """Points (m, 2) of those (n, 2) in order of a sweep, each at least `apart` from the one before [m]."""
    kept = np.zeros(len(points), dtype=np.bool_)
    x, y = math.inf, math.inf
    for k in range(len(points)):
        if math.hypot(points[k, 0] - x, points[k, 1] - y) >= apart or k == 0:
            x, y = points[k]
            kept[k] = True
    thinned: FloatArray = points[kept]
    return thinned


def outline(ends: FloatArray, met: BoolArray, apart: float) -> FloatArray:
    """Points (m, 2) along the walls that beams (n, 2) of a sweep have met, `apart` from each other [m].

    Where beams graze a wall, their ends are far apart, and at the same places in the frame of the robot
    wherever it is along the wall. So the wall between two of them is drawn where a third one lies on their
    line, and one that has no other near it is left out.
    """
    # ways from each end to the next one, and whether it lies on the same wall, or near by
    way, (x, y) = np.diff(ends, axis=0), ends.T
    length, far = np.hypot(*way.T), np.hypot(x, y)
    beside = np.abs(x[:-1] * way[:, 1] - y[:-1] * way[:, 0]) / np.maximum(far[:-1], far[1:]).clip(1e-9)
    bend = np.abs(way[:-1, 0] * way[1:, 1] - way[:-1, 1] * way[1:, 0])
    bend[~(met[:-2] & met[1:-1] & met[2:])] = np.inf
    bend = np.minimum(np.append(np.inf, bend), np.append(bend, np.inf))
    both = met[:-1] & met[1:] & (length < _MAX_BETWEEN)
    is_wall = both & (bend < _ON_LINE * beside * length)
    is_near = is_wall | (both & (length < _NEIGHBOUR))
    # ends, and points on the ways along walls
    kept = met & (np.append(is_near, False) | np.append(False, is_near))
    count = np.append(np.where(is_wall, length / apart, 1.0).astype(int).clip(1), 1)
    begin = np.repeat(np.arange(len(ends)), count)
    share = (np.arange(len(begin)) - np.repeat(np.cumsum(count) - count, count)) / count[begin]
    points = ends[begin] + share[:, None] * np.append(way, np.zeros((1, 2)), axis=0)[begin]
    along: FloatArray = thin(points[kept[begin]], apart)
    return along


@cached_njit
def gather(points: FloatArray, first: IntArray, counts: IntArray, poses: FloatArray) -> FloatArray:
    """Points (m, 2) at poses (n, 3): of each the `counts` ones of all (p, 2) from `first` on."""
    moved = np.zeros((counts.sum(), 2))
    at = 0
    for k in range(len(poses)):
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        for i in range(first[k], first[k] + counts[k]):
            moved[at, 0] = poses[k, 0] + cos * points[i, 0] - sin * points[i, 1]
            moved[at, 1] = poses[k, 1] + sin * points[i, 0] + cos * points[i, 1]
            at += 1
    return moved


def field_of(points: FloatArray) -> PointField:
    """The field of points (n, 2), at least one [m]."""
    pad = (_SPREAD_CELLS + 1 + (1 << (_LEVELS - 1))) * _CELL  # blocks may begin before the first cell
    corner = np.floor((points.min(axis=0) - pad) / _CELL) * _CELL
    high = points.max(axis=0) + (_SPREAD_CELLS + 2) * _CELL
    nx, ny = np.ceil((high - corner) / _CELL).astype(int)
    levels = np.empty((_LEVELS, int(nx), int(ny)), dtype=np.uint8)
    levels[0] = _draw((points - corner) / _CELL, int(nx), int(ny))
    for level in range(1, _LEVELS):
        step, below, here = 1 << (level - 1), levels[level - 1], levels[level]
        here[:] = below
        np.maximum(below[:-step], below[step:], out=here[:-step])
        wide = here.copy()
        np.maximum(wide[:, :-step], wide[:, step:], out=here[:, :-step])
    return PointField(corner, levels)


@cached_njit
def _draw(cells: FloatArray, nx: int, ny: int) -> NDArray[np.uint8]:
    """The finest level of a field of points (n, 2) [cells]."""
    first = np.zeros((nx, ny), dtype=np.uint8)
    # each part of a cell has its own pattern, and is drawn once
    width = 2 * _SPREAD_CELLS + 1
    patterns = np.zeros((_PARTS * _PARTS, width, width), dtype=np.uint8)
    scale = -0.5 * (_CELL / _SPREAD) ** 2
    for part in range(_PARTS * _PARTS):
        u, v = (part // _PARTS + 0.5) / _PARTS, (part % _PARTS + 0.5) / _PARTS
        for a in range(width):
            for b in range(width):
                square = (a - _SPREAD_CELLS + 0.5 - u) ** 2 + (b - _SPREAD_CELLS + 0.5 - v) ** 2
                patterns[part, a, b] = np.uint8(255.0 * math.exp(scale * square))
    drawn = np.zeros((nx, ny), dtype=np.uint16)
    for k in range(len(cells)):
        i, j = math.floor(cells[k, 0]), math.floor(cells[k, 1])
        part = int((cells[k, 0] - i) * _PARTS) * _PARTS + int((cells[k, 1] - j) * _PARTS)
        if drawn[i, j] >> part & 1:
            continue
        drawn[i, j] |= 1 << part
        for a in range(width):
            row = first[i - _SPREAD_CELLS + a]
            for b in range(width):
                row[j - _SPREAD_CELLS + b] = max(row[j - _SPREAD_CELLS + b], patterns[part, a, b])
    return first


def match(
    field: PointField,
    points: FloatArray,
    pose: FloatArray,
    window: PoseWindow,
    rival: float = 0.0,
    least: float = 0.0,
) -> BestPose:
    """Find where points (n, 2) in the frame of a robot fit best around a predicted pose (3,).

    Args:
        field: Of points that are known.
        points: At least one [m].
        pose: (3,) predicted.
        window: What is searched.
        rival: Share of the best score from which another place is looked for; 0: it is not.
        least: A score below which no pose is of use: the predicted one is returned with a score of 0.
    """
    far = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 85.0))
    cells = points / _CELL
    centre = np.array([*((pose[:2] - field.corner) / _CELL), pose[2]])
    step = 1.5 * _CELL / max(far, 1.0)
    reach = math.ceil(window.reach / _CELL)
    turns = math.ceil(window.turn / step)
    sigmas = np.array([window.sigma / _CELL, window.turn_sigma])
    nothing = np.full(3, np.nan)
    rotated = _rotated(_some(cells, _SEARCH_POINTS), centre, turns, step)
    floor = _ON_CELLS * least
    best, place = _search(field.levels, rotated, reach, turns, step, sigmas, floor, nothing)
    if least and best <= floor:
        return BestPose(pose, np.eye(3), 0.0, 0.0)
    other = 0.0
    if rival:
        other, _ = _search(field.levels, rotated, reach, turns, step, sigmas, rival * best, place)
        other = other if other > rival * best else 0.0
    found, score = _climb(field.levels[0], cells, centre + place)
    covariance = _shape(field.levels[0], _some(cells, _SHAPE_POINTS), found)
    found[:2] = found[:2] * _CELL + field.corner
    return BestPose(found, covariance, score, other)


def _some(points: FloatArray, most: int) -> FloatArray:
    """At most so many of points (n, 2), evenly."""
    return np.ascontiguousarray(points[:: -(-len(points) // most)])


@cached_njit
def score_at(field: PointField, points: FloatArray, pose: FloatArray) -> float:
    """Mean value of the field, 0 to 1, at points (n, 2) in the frame of a robot at a pose (3,)."""
    cos, sin, total = math.cos(pose[2]), math.sin(pose[2]), 0.0
    first = field.levels[0]
    for k in range(len(points)):
        x = pose[0] + cos * points[k, 0] - sin * points[k, 1]
        y = pose[1] + sin * points[k, 0] + cos * points[k, 1]
        i, j = math.floor((x - field.corner[0]) / _CELL), math.floor((y - field.corner[1]) / _CELL)
        if 0 <= i < first.shape[0] and 0 <= j < first.shape[1]:
            total += first[i, j]
    return total / 255.0 / max(1, len(points))


@cached_njit
def _rotated(cells: FloatArray, centre: FloatArray, turns: int, step: float) -> NDArray[np.int32]:
    """Cells (2 turns + 1, n, 2) of points (n, 2) [cells] seen from a pose (3,), at each turn."""
    rotated = np.zeros((2 * turns + 1, len(cells), 2), dtype=np.int32)
    for a in range(2 * turns + 1):
        heading = centre[2] + (a - turns) * step
        cos, sin = math.cos(heading), math.sin(heading)
        for k in range(len(cells)):
            rotated[a, k, 0] = math.floor(centre[0] + cos * cells[k, 0] - sin * cells[k, 1])
            rotated[a, k, 1] = math.floor(centre[1] + sin * cells[k, 0] + cos * cells[k, 1])
    return rotated


@cached_njit
def _total(level: NDArray[np.uint8], cells: NDArray[np.int32], i: int, j: int) -> float:
    """Mean value, 0 to 1, of points in cells (n, 2) moved by i and j."""
    total = 0
    nx, ny = level.shape
    for k in range(len(cells)):
        a, b = cells[k, 0] + i, cells[k, 1] + j
        if 0 <= a < nx and 0 <= b < ny:
            total += level[a, b]
    return total / (255.0 * len(cells))


@cached_njit
def _penalty(i: int, j: int, width: int, turn: float, sigmas: FloatArray) -> float:
    """Least loss of score by the prediction of the offsets in a block of cells."""
    x = max(0, i, -(i + width - 1))
    y = max(0, j, -(j + width - 1))
    loss = 0.5 * ((x * x + y * y) / sigmas[0] ** 2 + (turn / sigmas[1]) ** 2)
    return float(min(loss, _MAX_PENALTY) / _DISTINCT)


@cached_njit
def _is_near(i: int, j: int, width: int, turn: float, place: FloatArray) -> bool:
    """Whether all offsets in a block of cells are about the same place as an offset (3,)."""
    if math.isnan(place[0]) or abs(turn - place[2]) > _APART_TURN:
        return False
    x = max(abs(i - place[0]), abs(i + width - 1 - place[0]))
    y = max(abs(j - place[1]), abs(j + width - 1 - place[1]))
    return math.hypot(x, y) * _CELL < _APART


@cached_njit
def _search(
    levels: NDArray[np.uint8],
    rotated: NDArray[np.int32],
    reach: int,
    turns: int,
    step: float,
    sigmas: FloatArray,
    floor: float,
    avoid: FloatArray,
) -> tuple[float, FloatArray]:
    """The best offset (3,) [cells, rad] and its score, if above a floor; any that is not near another one."""
    top = _LEVELS - 1
    width = 1 << top
    blocks = (2 * reach) // width + 1
    count = (2 * turns + 1) * blocks * blocks
    bounds = np.zeros(count)
    for a in range(2 * turns + 1):
        turn = (a - turns) * step
        for b in range(blocks * blocks):
            i, j = (b // blocks) * width - reach, (b % blocks) * width - reach
            bound = _total(levels[top], rotated[a], i, j) - _penalty(i, j, width, turn, sigmas)
            bounds[a * blocks * blocks + b] = -1.0 if _is_near(i, j, width, turn, avoid) else bound
    best, place = floor, np.zeros(3)
    # blocks that are left, those of the best bound last
    stack = np.zeros((4 * _LEVELS + 4, 3), dtype=np.int64)
    stack_bound = np.zeros(4 * _LEVELS + 4)
    child = np.zeros(4)
    for one in np.argsort(-bounds):
        if bounds[one] <= best:
            break
        a, b = one // (blocks * blocks), one % (blocks * blocks)
        turn = (a - turns) * step
        stack[0, 0], stack[0, 1] = top, (b // blocks) * width - reach
        stack[0, 2] = (b % blocks) * width - reach
        stack_bound[0] = bounds[one]
        size = 1
        while size:
            size -= 1
            level, i, j = stack[size]
            bound = stack_bound[size]
            if bound <= best:
                continue
            if level == 0:
                best = bound
                place[0], place[1], place[2] = i, j, turn
                if not math.isnan(avoid[0]):
                    return best, place  # one rival is enough
                continue
            half = 1 << (level - 1)
            for c in range(4):
                x, y = i + (c // 2) * half, j + (c % 2) * half
                child[c] = -1.0
                if not _is_near(x, y, half, turn, avoid):
                    child[c] = _total(levels[level - 1], rotated[a], x, y)
                    child[c] -= _penalty(x, y, half, turn, sigmas)
            for c in np.argsort(child):
                if child[c] > best:
                    stack[size, 0], stack[size, 1] = level - 1, i + (c // 2) * half
                    stack[size, 2] = j + (c % 2) * half
                    stack_bound[size] = child[c]
                    size += 1
    return best, place


@cached_njit
def _climb(first: NDArray[np.uint8], cells: FloatArray, start: FloatArray) -> tuple[FloatArray, float]:
    """The pose (3,) [cells, rad] near another at which the field, interpolated, is greatest, and its mean."""
    pose: FloatArray = start.copy()
    best, score = start.copy(), -1.0
    nx, ny = first.shape
    for _ in range(_STEPS):
        H, g, total = np.zeros((3, 3)), np.zeros(3), 0.0
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        for k in range(len(cells)):
            dx = cos * cells[k, 0] - sin * cells[k, 1]
            dy = sin * cells[k, 0] + cos * cells[k, 1]
            x, y = pose[0] + dx - 0.5, pose[1] + dy - 0.5
            i, j = math.floor(x), math.floor(y)
            if not (0 <= i < nx - 1 and 0 <= j < ny - 1):
                continue
            u, v = x - i, y - j
            f00, f01 = first[i, j] / 255.0, first[i, j + 1] / 255.0
            f10, f11 = first[i + 1, j] / 255.0, first[i + 1, j + 1] / 255.0
            value = (1 - u) * ((1 - v) * f00 + v * f01) + u * ((1 - v) * f10 + v * f11)
            gx = (1 - v) * (f10 - f00) + v * (f11 - f01)
            gy = (1 - u) * (f01 - f00) + u * (f11 - f10)
            total += value
            gt = -gx * dy + gy * dx
            row = (gx, gy, gt)
            for a in range(3):
                g[a] += row[a] * (1.0 - value)
                for b in range(3):
                    H[a, b] += row[a] * row[b]
        if total / len(cells) > score:
            score = total / len(cells)
            best[:] = pose
        size = 1e-3 * (H[0, 0] + H[1, 1]) + 1e-9
        H[0, 0] += size
        H[1, 1] += size
        H[2, 2] += 1e-3 * H[2, 2] + 1e-9
        change = np.linalg.solve(H, g)
        length = math.hypot(change[0], change[1])
        scale = min(1.0, 1.0 / max(length, 1e-9), 0.01 / max(abs(change[2]), 1e-9))
        pose += scale * change
    return best, score


@cached_njit
def _shape(first: NDArray[np.uint8], cells: FloatArray, pose: FloatArray) -> FloatArray:
    """Covariance (3, 3) [m, rad] of a pose (3,) [cells, rad] from how the score falls off around it."""
    n, m = 2 * _SHAPE_CELLS + 1, 2 * _SHAPE_TURNS + 1
    scores = np.zeros((m, n, n))
    rotated = _rotated(cells, pose, _SHAPE_TURNS, _SHAPE_TURN)
    for a in range(m):
        for b in range(n):
            for c in range(n):
                scores[a, b, c] = _total(first, rotated[a], b - _SHAPE_CELLS, c - _SHAPE_CELLS)
    best = scores.max()
    weight, mean, square = 0.0, np.zeros(3), np.zeros((3, 3))
    off = np.zeros(3)
    for a in range(m):
        for b in range(n):
            for c in range(n):
                share = math.exp(_INDEPENDENT * (scores[a, b, c] - best))
                off[0], off[1] = (b - _SHAPE_CELLS) * _CELL, (c - _SHAPE_CELLS) * _CELL
                off[2] = (a - _SHAPE_TURNS) * _SHAPE_TURN
                weight += share
                mean += share * off
                square += share * np.outer(off, off)
    mean /= weight
    covariance: FloatArray = square / weight - np.outer(mean, mean)
    for a in range(3):
        covariance[a, a] += _LEAST_VARIANCE[a]
    # where the score hardly falls off within the lattice, it says nothing
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    half = math.hypot(0.5 * (xx - yy), xy)
    for sign in (1.0, -1.0):
        variance = 0.5 * (xx + yy) + sign * half
        if variance > _RIDGE**2:
            angle = 0.5 * math.atan2(2.0 * xy, xx - yy) + (0.0 if sign > 0.0 else 0.5 * math.pi)
            direction = np.array([math.cos(angle), math.sin(angle), 0.0])
            covariance += _UNKNOWN**2 * np.outer(direction, direction)
    return covariance
