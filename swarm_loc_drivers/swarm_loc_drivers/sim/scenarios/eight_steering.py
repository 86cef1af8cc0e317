"""Path following along the eight for single robots, by poses that come when they come."""

from __future__ import annotations

import numpy as np

from swarm_loc_drivers.common.velocity_command import Velocity
from swarm_loc_drivers.sim.scenarios.eight import HALF_WIDTH, follow
from swarm_loc_drivers.sim.scenarios.lemniscate import Lemniscate
from swarm_loc_estimator.common.arrays import FloatArray


class EightSteering:
    """Keeps each robot at its place on the eight, which moves on at constant speed.

    Args:
        robots: How many; robot i begins i-th of as many equal parts along the eight.
        speed: [m/s].
    """

    def __init__(self, robots: int, speed: float) -> None:
        path = Lemniscate(HALF_WIDTH)
        offsets = np.arange(robots) * path.length / robots
        self._control = [follow(path, offset[None], speed, 1e-9) for offset in offsets]
        self._begin_ns: int | None = None

    def command(self, robot: int, stamp_ns: int, pose: FloatArray) -> Velocity:
        """What a robot should do now.

        Args:
            robot: Its index.
            stamp_ns: When it was at `pose`; the first one of all robots is when the eight begins.
            pose: (3,) in map.
        """
        if self._begin_ns is None or stamp_ns < self._begin_ns:
            self._begin_ns = stamp_ns
        speed, turn_rate = self._control[robot](stamp_ns - self._begin_ns, pose[None])
        return float(speed[0]), 0.0, float(turn_rate[0])
