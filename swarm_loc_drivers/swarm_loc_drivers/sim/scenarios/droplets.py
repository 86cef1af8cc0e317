"""A swarm of Droplets on a table that take turns to emit, half of them wandering.

Robots, consoles and conversations are those of the live graph (see `droplet/world.py`). A tracker above
the table sees two robots, all others are to be located by infrared alone.
"""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_drivers.sim.scenarios.eight import rounded
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

PITCH = 0.13
_JITTER = 0.02
_WANDER_RADIUS = 0.03
_ARRIVED, _TURNED = 0.004, 0.1
_PATIENCE_NS = 30_000_000_000
_FAST, _FAST_TURN = 0.02, 0.5  # Faster than any Droplet: the direction counts


def starts(seed: int, robots: int) -> FloatArray:
    """(N, 3) where the robots begin: near the places of a grid, looking anywhere."""
    rng = np.random.default_rng([seed, robots])
    columns = math.ceil(math.sqrt(1.25 * robots))
    places = np.stack(np.divmod(np.arange(robots), columns), axis=-1)[:, ::-1] * PITCH
    places = places - places.mean(axis=0) + rng.uniform(-_JITTER, _JITTER, places.shape)
    headings = rng.uniform(-math.pi, math.pi, robots)
    return np.array([rounded(pose) for pose in np.column_stack([places, headings])])


class Wander:
    """Steers each robot to places around its home (N, 3) in map, one after the other, with turns in between.

    Only those that are `walking` (N,) wander; the others stand. The seed fixes the places.
    """

    def __init__(self, homes: FloatArray, walking: FloatArray, seed: int) -> None:
        self._homes, self._walking, self._seed = homes, walking, seed
        self._leg = np.full(len(homes), -1)
        self._since_ns = np.zeros(len(homes), dtype=np.int64)

    def command(self, robot: int, stamp_ns: int, pose: FloatArray) -> tuple[float, float, float]:
        """The velocity of a robot: forward [m/s], to the left [m/s], turning to the left [rad/s].

        At `stamp_ns` it was at the pose (3,) in map.
        """
        if not self._walking[robot]:
            return 0.0, 0.0, 0.0
        if not 0 <= stamp_ns - self._since_ns[robot] <= _PATIENCE_NS:
            self._next_leg(robot, stamp_ns)
        velocity = self._toward(robot, pose)
        if not any(velocity):
            self._next_leg(robot, stamp_ns)
        return velocity

    def _next_leg(self, robot: int, stamp_ns: int) -> None:
        self._leg[robot] += 1
        self._since_ns[robot] = stamp_ns

    def _toward(self, robot: int, pose: FloatArray) -> tuple[float, float, float]:
        """The velocity to the end of the leg; still when it is reached."""
        leg = int(self._leg[robot])
        rng = np.random.default_rng([self._seed, robot, leg // 2])
        radius, angle, aside = rng.uniform((0.0, -math.pi, -1.0), (_WANDER_RADIUS, math.pi, 1.0))
        if leg % 2:
            left = float(se2.wrap_angle(self._homes[robot, 2] + aside - pose[2]))
            return 0.0, 0.0, math.copysign(_FAST_TURN, left) if abs(left) > _TURNED else 0.0
        there = self._homes[robot, :2] + radius * np.array([math.cos(angle), math.sin(angle)])
        seen = se2.between(pose, [*there, 0.0])
        distance = math.hypot(seen[0], seen[1])
        if distance <= _ARRIVED:
            return 0.0, 0.0, 0.0
        return _FAST * seen[0] / distance, _FAST * seen[1] / distance, 0.0
