"""Shapes of large swarms: where robots live, which landmarks there are, how robots drive."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from swarm_loc_drivers.sim.common.differential_drive import Controller
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

PITCH = 0.5
HOME_RADIUS = 0.08
_SPEED = 0.06
_TURN_SPREAD = 0.6
_TURN_MEMORY_S = 1.0
_HOMING_GAIN = 2.0
_BRIDGE_M = 0.6
_BESIDE_M = 0.3
_REACHED_M = 0.3
ROAMING_SPEED = (0.1, 0.3)
_ROAMING_TURN = 1.5


class Shape(Enum):
    """How a swarm is laid out.

    Robots keep to cells of their own, or wander about all cells and meet ever new neighbours. Landmarks stand
    all around, or there is one at a corner, which only the robot of that corner sees, or whoever passes by.
    """

    BORDER = "border"
    CORNER = "corner"
    WANDER = "wander"
    WANDER_CORNER = "wander_corner"
    CHAIN = "chain"
    CLUSTERS = "clusters"

    @property
    def wanders(self) -> bool:
        """Whether robots leave their cells."""
        return self in {Shape.WANDER, Shape.WANDER_CORNER}

    @property
    def one_sees(self) -> bool:
        """Whether only the first robot sees the landmark."""
        return self in {Shape.CORNER, Shape.CHAIN, Shape.CLUSTERS}

    def homes(self, robots: int) -> FloatArray:
        """Where the robots live (N, 2) [m]."""
        if self is Shape.CHAIN:
            return PITCH * np.column_stack([np.arange(robots), np.zeros(robots)]).astype(float)
        if self is not Shape.CLUSTERS or robots < 3:
            return cells(robots)
        left, right = cells(robots // 2), cells(robots - 1 - robots // 2)
        bridge = np.array([left[:, 0].max() + _BRIDGE_M, PITCH * (round(left[:, 1].max() / PITCH) // 2)])
        return np.concatenate([left, right + np.array([bridge[0] + _BRIDGE_M, 0.0]), bridge[None]])

    def landmarks(self, homes: FloatArray) -> FloatArray:
        """Places of the landmarks (L, 2) [m]: the free cells around homes (N, 2), or one beside the first."""
        if self in {Shape.BORDER, Shape.WANDER}:
            return _border(homes)
        return homes[:1] - [_BESIDE_M, 0.0 if self is Shape.CHAIN else _BESIDE_M]


def cells(robots: int) -> FloatArray:
    """Cells (N, 2) [m], row by row on the squarest grid that holds them."""
    columns = math.ceil(math.sqrt(robots))
    index = np.arange(robots)
    return PITCH * np.column_stack([index % columns, index // columns]).astype(float)


def _border(homes: FloatArray) -> FloatArray:
    taken = {(round(x / PITCH), round(y / PITCH)) for x, y in homes}
    ring = {(i + a, j + b) for i, j in taken for a in (-1, 0, 1) for b in (-1, 0, 1)} - taken
    return PITCH * np.array(sorted(ring), dtype=float)


def stay(rng: np.random.Generator, homes: FloatArray, step_s: float) -> Controller:
    """A controller that turns N robots at random and sends those back that get too far from home (N, 2)."""
    keep = math.exp(-step_s / _TURN_MEMORY_S)
    excite = _TURN_SPREAD * math.sqrt(1.0 - keep * keep)
    turn = _TURN_SPREAD * rng.standard_normal(len(homes))
    speed = np.full(len(homes), _SPEED)

    def control(_step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        nonlocal turn
        turn = keep * turn + excite * rng.standard_normal(len(homes))
        to_home = homes - pose[:, :2]
        away = np.hypot(to_home[:, 0], to_home[:, 1]) > HOME_RADIUS
        bearing = se2.wrap_angle(np.arctan2(to_home[:, 1], to_home[:, 0]) - pose[:, 2])
        return speed, np.where(away, np.clip(_HOMING_GAIN * bearing, -2.0, 2.0), turn)

    return control


def roam(rng: np.random.Generator, homes: FloatArray) -> Controller:
    """A controller that sends N robots to one place after the other among all homes (N, 2)."""
    low, high = homes.min(axis=0), homes.max(axis=0)
    goal = rng.uniform(low, high, homes.shape)
    speed = rng.uniform(*ROAMING_SPEED, len(homes))

    def control(_step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        way = goal - pose[:, :2]
        reached = np.hypot(way[:, 0], way[:, 1]) < _REACHED_M
        goal[reached] = rng.uniform(low, high, (int(reached.sum()), 2))
        bearing = se2.wrap_angle(np.arctan2(way[:, 1], way[:, 0]) - pose[:, 2])
        return speed, np.clip(_HOMING_GAIN * bearing, -_ROAMING_TURN, _ROAMING_TURN)

    return control
