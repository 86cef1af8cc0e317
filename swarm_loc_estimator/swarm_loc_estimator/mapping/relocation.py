"""Where a robot is whose odometry has restarted: the one place in the map that fits all it has seen since.

Robots turn and drive on while nobody hears them, so nothing before the restart tells their pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import distance_transform_edt

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import between, compose, transform_points
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.scans import ScanStop

# The constants are checked by `make bench-pushbot`, part restart: both halls, 20 instants each.
_WALL_SIGMA, _UNKNOWN = 0.08, 0.3
"""Standard deviation of points from walls [m], and the score of a point where the map is unknown."""
_FARTHEST, _POINTS = 2.0, 120  # Maximum distance of points that are used [m], and their number
_STEP, _TURN_STEP = 0.1, math.radians(3.0)  # Of the places that are tried [m], [rad]
_MIN_SCORE, _MAX_OTHER = 0.8, 0.9  # Minimum score, and maximum score of another place relative to it
_PLACES, _NEW_PLACE = 3, 0.1  # Number of newest stops that are matched together, and their least distance [m]
_SHIFT, RATES = np.array([0.5, math.radians(15.0)]), np.array([0.3, 3.0])
"""How far a robot is moved by hands [m, rad], and how fast it moves by itself [m/s, rad/s]."""
_AT_WALL, _MIN_KNOWN = 0.15, 40
"""Distance of points on walls [m]; minimum number of points where the map is known."""
_SHARES = np.linspace(1.0, 0.1, 19)  # Shares of the way to a wall, before which no other one may be
_APART = np.array([0.4, math.radians(20.0)])
"""Distance [m] and turn [rad] from which a place is another one."""


@dataclass
class Search:
    """What a robot has seen since its odometry restarted, in the frame of its first stop since then."""

    near: FloatArray  # (3,) its pose in map before
    pause_s: float  # How long it was not heard
    parts: list[FloatArray] = field(default_factory=list)  # Points (n, 2) on walls, of its newest places [m]
    arrival: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,) at its newest stop
    departure: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,) from its newest stop
    left: FloatArray | None = None  # (3,) by odometry then
    first: int = -1  # Its first stop in the graph since it was found
    is_entered: bool = False  # Whether its scan there is in the graph
    checks: int = 0  # Number of stops since then that agree with those of others

    def add(self, stop: ScanStop, ratio: float) -> None:
        """Add the readings of a stop; true turns are `ratio` times those by odometry."""
        if self.left is not None:
            x, y, turn = between(self.left, stop.arrival)
            length, course = math.hypot(x, y), ratio * math.atan2(y, x)
            motion = [length * math.cos(course), length * math.sin(course), ratio * turn]
            self.arrival = compose(self.departure, motion)
            self.parts = self.parts[1 - _PLACES :] if length > _NEW_PLACE else self.parts[:-1]
        self.left = stop.arrival if stop.reach else stop.departure
        turned = 0.0 if stop.reach else ratio * float(stop.turn[-1])
        self.departure = self.arrival + np.array([0.0, 0.0, turned])
        self.parts.append(transform_points(self.arrival, _wall_points(stop, ratio)))

    def place(self, occupancy: OccupancyMap) -> FloatArray | None:
        """The pose (3,) of its newest stop, if all points fit one place in a map that it may have reached."""
        points = np.concatenate(self.parts)
        points = points[:: max(1, len(points) // _POINTS)]
        if len(points) < _POINTS // 4 or not occupancy.occupied.any():
            return None
        # score of a point in each cell, with a margin as wide as points reach [cells]
        cell = occupancy.cell
        walls = cell * distance_transform_edt(~occupancy.occupied)
        score = np.exp(-0.5 * (walls / _WALL_SIGMA) ** 2)
        score = np.where(occupancy.free, score, np.maximum(score, _UNKNOWN))
        margin = math.ceil(np.hypot(*points.T).max() / cell) + 1
        score = np.pad(score, margin, constant_values=_UNKNOWN)
        # the best place that it may have reached unheard, and the best other one
        step = max(1, round(_STEP / cell))
        cells = np.argwhere(occupancy.free[::step, ::step]) * step + margin
        begin = np.array([*((self.near[:2] - occupancy.corner) / cell + margin - 0.5), self.near[2]])
        limits = _SHIFT + RATES * self.pause_s, _APART
        scaled = np.array(limits) / [cell, 1.0]
        found, other = np.full((2, 4), np.nan)
        for one in (found, other):
            one[:] = _best_place(score, points / cell, cells, np.array([begin, found[:3]]), scaled)
        if found[3] < _MIN_SCORE or other[3] > _MAX_OTHER * found[3]:
            return None
        where = (found[:2] - margin + 0.5) * cell + occupancy.corner
        return compose(np.array([*where, found[2]]), self.arrival)


def agreement(occupancy: OccupancyMap, stop: ScanStop, state: FloatArray) -> float:
    """Share of the walls seen from a stop with a state (4,) in the graph that fit a map; NaN if unknown.

    A wall does not fit if it is not one of the map, or if one of the map is before it.
    """
    points = _wall_points(stop, state[3])
    way = np.hypot(*points.T)
    walls = distance_transform_edt(~occupancy.occupied) * occupancy.cell < _AT_WALL
    known = fits = np.zeros(len(points), dtype=bool)
    for share in _SHARES:
        cells = occupancy.index(transform_points(state[:3], share * points))
        inside = ((cells >= 0) & (cells < walls.shape)).all(axis=1)
        i, j = np.where(inside[:, None], cells, 0).T
        if share == 1.0:
            known, fits = inside & (occupancy.log_odds[i, j] != 0.0), walls[i, j]
        else:
            fits &= ~(inside & occupancy.occupied[i, j] & ((1.0 - share) * way > 2.0 * _AT_WALL))
    return float(fits[known].mean()) if known.sum() >= _MIN_KNOWN else math.nan


def _wall_points(stop: ScanStop, ratio: float) -> FloatArray:
    """Points (n, 2) on walls that a stop sees, in the frame of the robot on arrival [m]."""
    seen = stop.inverse > 1.0 / _FARTHEST
    angle = (stop.bearing + ratio * stop.turn)[seen]
    return np.stack([np.cos(angle), np.sin(angle)], -1) / stop.inverse[seen, None]


@cached_njit
def _best_place(
    field: FloatArray,
    points: FloatArray,
    cells: IntArray,
    poses: FloatArray,
    limits: FloatArray,
) -> tuple[float, float, float, float]:
    """The cell (i, j), heading and score at which points (n, 2) [cells] fit a field best.

    Only places as near to the first pose as the first of the limits [cells, rad] are tried, without those as
    near to the second pose as the second ones.
    """
    count = len(points)
    best = (0.0, 0.0, 0.0, 0.0)
    offsets = np.zeros((count, 2), dtype=np.int64)
    for k in range(round(2.0 * math.pi / _TURN_STEP)):
        heading = k * _TURN_STEP
        turned = np.abs((heading - poses[:, 2] + math.pi) % (2.0 * math.pi) - math.pi)
        if turned[0] > limits[0, 1]:
            continue
        cos, sin = math.cos(heading), math.sin(heading)
        for n in range(count):
            offsets[n, 0] = round(cos * points[n, 0] - sin * points[n, 1])
            offsets[n, 1] = round(sin * points[n, 0] + cos * points[n, 1])
        for i, j in cells:
            if math.hypot(i - poses[0, 0], j - poses[0, 1]) > limits[0, 0]:
                continue
            if turned[1] < limits[1, 1] and math.hypot(i - poses[1, 0], j - poses[1, 1]) < limits[1, 0]:
                continue
            total, least = 0.0, best[3] * count
            for n in range(count):
                total += field[i + offsets[n, 0], j + offsets[n, 1]]
                if total + (count - 1 - n) < least:  # the rest cannot make up for it
                    break
            if total > least:
                best = (float(i), float(j), heading, total / count)
    return best
