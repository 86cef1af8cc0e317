"""The mapping of the PushBot paper as printed: particles tagged by robot on one shared grid.

Particles are tagged by robot and only those of the robot that sends are moved ("tribes", section IV-C). Where
the paper is silent or its words do not work, this is what is done:

- Weights, count and resampling are not given: the weight of a particle is the map's value where its beam
  ends, once every `_EVERY` readings, and particles are drawn anew when fewer than half of them count.
- "Normalized to have a maximal value of +1" at each measurement divides the whole map and erases it: values
  are capped at +1.
- sigma_1 = 0.1 d and sigma_2 = 0.05 d are standard deviations, the longer one across the beam, which covers
  walls better.
- The nearest local minimum of the visitation map is the next cell, since most of it is a plateau of zeros:
  the nearest cell that is visited least among those half a metre away or further is taken.
- The pose that the map is drawn from is the mean of the robot's particles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import between, compose
from swarm_loc_estimator.mapping.exploration import (
    Goal,
    first_hop,
    goal_by_odometry,
    paths_from,
    planning_grid,
)
from swarm_loc_estimator.mapping.grid import CELL, OccupancyMap, VisitationMap
from swarm_loc_estimator.mapping.scans import LightSightings, Readings
from swarm_loc_estimator.mapping.settings import MapperSettings

_FREE = -0.3
_ACROSS, _ALONG = 0.1, 0.05  # Standard deviations of the ellipse, per distance
_REACH = 2.0  # The ellipse ends after so many of them
_CAP = 1.0


@cached_njit
def draw_beam(values: FloatArray, corner: FloatArray, cell: float, pose: FloatArray, distance: float) -> None:
    """Draw a beam of some length [m] from a pose (3,) into a grid (nx, ny)."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    along, across = _ALONG * distance, _ACROSS * distance
    step, travelled = 0.7 * cell, 0.0
    last_i, last_j = -1, -1
    while travelled < distance - _REACH * along:
        i = math.floor((pose[0] + travelled * cos - corner[0]) / cell)
        j = math.floor((pose[1] + travelled * sin - corner[1]) / cell)
        inside = 0 <= i < values.shape[0] and 0 <= j < values.shape[1]
        if inside and (i != last_i or j != last_j):
            values[i, j] = max(_FREE, values[i, j] + _FREE)
        last_i, last_j = i, j
        travelled += step
    end_x, end_y = pose[0] + distance * cos, pose[1] + distance * sin
    reach = math.ceil(_REACH * across / cell)
    middle_i, middle_j = math.floor((end_x - corner[0]) / cell), math.floor((end_y - corner[1]) / cell)
    for i in range(max(0, middle_i - reach), min(values.shape[0], middle_i + reach + 1)):
        for j in range(max(0, middle_j - reach), min(values.shape[1], middle_j + reach + 1)):
            x, y = corner[0] + (i + 0.5) * cell - end_x, corner[1] + (j + 0.5) * cell - end_y
            ahead, left = (cos * x + sin * y) / along, (-sin * x + cos * y) / across
            square = ahead * ahead + left * left
            if square < _REACH * _REACH:
                values[i, j] = min(_CAP, values[i, j] + math.exp(-0.5 * square))


@cached_njit
def values_at_ends(
    values: FloatArray, corner: FloatArray, cell: float, poses: FloatArray, distance: float
) -> FloatArray:
    """Values (p,) of a grid (nx, ny) where beams of some length [m] from poses (p, 3) end; 0 outside."""
    found = np.zeros(len(poses))
    for k in range(len(poses)):
        i = math.floor((poses[k, 0] + distance * math.cos(poses[k, 2]) - corner[0]) / cell)
        j = math.floor((poses[k, 1] + distance * math.sin(poses[k, 2]) - corner[1]) / cell)
        if 0 <= i < values.shape[0] and 0 <= j < values.shape[1]:
            found[k] = values[i, j]
    return found


_PARTICLES = 200
_EVERY = 25
_FLOOR = 0.05  # Weight of a beam that ends where the map says nothing
_DISTANCE_NOISE, _TURN_NOISE, _HEADING_NOISE = 0.02, math.radians(4.0), math.radians(0.4)
_MIN_PATH = 0.5
_MARGIN_CELLS = 160
_OCCUPIED = 0.3


@dataclass
class _Tribe:
    """Particles of one robot."""

    particles: FloatArray  # (p, 3) poses
    odometry: FloatArray | None = None  # (3,) the newest pose by odometry
    goal: Goal | None = None  # Where to go
    count: int = 0  # How many readings came
    stamp_ns: int = 0  # Of the newest

    @property
    def mean(self) -> FloatArray:
        """(3,) the mean pose."""
        x, y = self.particles[:, :2].mean(axis=0)
        cos, sin = np.cos(self.particles[:, 2]).mean(), np.sin(self.particles[:, 2]).mean()
        return np.array([x, y, math.atan2(sin, cos)])


class ParticleMapper:
    """Tribes of particles on one map.

    Args:
        rng: Moves and draws the particles.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._settings = MapperSettings()
        self._tribes: dict[int, _Tribe] = {}
        self._corner, self._values = np.zeros(2), np.zeros((1, 1))
        self._visits = VisitationMap()

    def join(self, pose: FloatArray, sigma: FloatArray) -> int:
        """Let a robot join at a pose (3,) in map that is known to sigmas (3,); its number."""
        robot = len(self._tribes)
        self._tribes[robot] = _Tribe(pose + sigma * self._rng.standard_normal((_PARTICLES, 3)))
        return robot

    def add_lights(self, robot: int, sightings: LightSightings) -> None:
        """The paper makes no use of them."""

    def add_readings(self, robot: int, readings: Readings) -> None:
        """Take readings (n,) of a robot: move its particles, weigh them now and then, draw."""
        tribe = self._tribes[robot]
        for odometry, inverse in zip(readings.odometry, readings.inverse, strict=True):
            self._move(tribe, odometry)
            tribe.count += 1
            if inverse > 0.0:
                if tribe.count % _EVERY == 0:
                    self._weigh(tribe, 1.0 / inverse)
                self._draw(tribe.mean, 1.0 / inverse)
        tribe.stamp_ns = int(readings.stamp_ns[-1])
        self._visits.add(tribe.mean[None, :2])

    def pose(self, robot: int) -> FloatArray | None:
        """The mean pose (3,) of a robot's particles."""
        return self._tribes[robot].mean

    def goal(self, robot: int) -> Goal | None:
        """Where a robot should go."""
        tribe = self._tribes[robot]
        self._choose_goal(robot, tribe)
        return tribe.goal

    def occupancy(self) -> OccupancyMap:
        """The map; its values are scaled so that what exceeds `_OCCUPIED` counts as occupied."""
        return OccupancyMap(self._corner, CELL, self._values * (0.46 / _OCCUPIED))

    def finish(self) -> None:
        """Nothing is solved anew."""

    def _move(self, tribe: _Tribe, odometry: FloatArray) -> None:
        if tribe.odometry is not None:
            motion = between(tribe.odometry, odometry)
            path, turn = math.hypot(motion[0], motion[1]), abs(float(motion[2]))
            noise = self._rng.standard_normal((_PARTICLES, 2))
            moves = np.tile(motion, (_PARTICLES, 1))
            moves[:, :2] *= 1.0 + _DISTANCE_NOISE * noise[:, :1] / math.sqrt(max(path, 1e-4))
            spread = _TURN_NOISE**2 * turn / (2.0 * math.pi) + _HEADING_NOISE**2 * path
            moves[:, 2] += math.sqrt(spread) * noise[:, 1]
            tribe.particles = compose(tribe.particles, moves)
        tribe.odometry = odometry

    def _weigh(self, tribe: _Tribe, distance: float) -> None:
        values = values_at_ends(self._values, self._corner, CELL, tribe.particles, distance)
        weights = np.maximum(values, 0.0) + _FLOOR
        weights /= weights.sum()
        if 1.0 / np.square(weights).sum() < 0.5 * _PARTICLES:
            places = (np.arange(_PARTICLES) + self._rng.random()) / _PARTICLES
            drawn = np.searchsorted(np.cumsum(weights), places).clip(max=_PARTICLES - 1)
            tribe.particles = tribe.particles[drawn]

    def _draw(self, pose: FloatArray, distance: float) -> None:
        self._make_room(pose[:2])
        draw_beam(self._values, self._corner, CELL, pose, distance)

    def _make_room(self, position: FloatArray) -> None:
        """Enlarge the grid around a robot."""
        place = np.floor((position - self._corner) / CELL).astype(int)
        before = np.maximum(_MARGIN_CELLS - place, 0)
        behind = np.maximum(place + _MARGIN_CELLS - np.array(self._values.shape), 0)
        if before.any() or behind.any():
            before, behind = (np.where(one > 0, one + _MARGIN_CELLS, 0) for one in (before, behind))
            self._values = np.pad(self._values, list(zip(before, behind, strict=True)))
            self._corner = self._corner - before * CELL

    def _choose_goal(self, robot: int, tribe: _Tribe) -> None:
        """Go to the nearest minimum of the visitation map in free space (section IV-D)."""
        pose = tribe.mean
        others = [one.mean[:2] for key, one in self._tribes.items() if key != robot]
        occupancy = OccupancyMap(self._corner, CELL, self._values)
        grid = planning_grid(occupancy, pose[:2], np.array(others).reshape(-1, 2), self._settings)
        here = grid.cell_of(pose[:2])
        length, before = paths_from(grid.passable, *here)
        visits = self._visits.on(occupancy)
        shape = grid.state.shape
        counts = visits[: 2 * shape[0], : 2 * shape[1]].reshape(shape[0], 2, shape[1], 2).sum(axis=(1, 3))
        cost = np.where(np.isfinite(length) & (length * grid.cell > _MIN_PATH), counts * 1e6 + length, np.inf)
        best = np.unravel_index(int(cost.argmin()), shape)
        hop = pose[:2]
        if np.isfinite(cost[best]):
            hop = first_hop(grid, before, here, (int(best[0]), int(best[1])), self._settings.max_hop)
        if tribe.odometry is not None:
            number = tribe.goal.number + 1 if tribe.goal else 1
            there = goal_by_odometry(pose, tribe.odometry, hop, 1.0)
            tribe.goal = Goal(number, hop, there, tribe.stamp_ns, pose)
