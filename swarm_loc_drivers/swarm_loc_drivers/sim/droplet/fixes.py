"""A tracker above the table: noisy absolute poses of some robots at a fixed rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray


@dataclass(frozen=True)
class Fix:
    """Where a robot was seen.

    Attributes:
        robot: Its index.
        stamp_ns: When.
        pose: (3,) in map, with noise.
    """

    robot: int
    stamp_ns: int
    pose: FloatArray


class Tracker:
    """Sees some robots.

    Args:
        robots: Their indices.
        rate_hz: Of each [1/s].
        sigmas: Of its position [m] and of its heading [rad], one standard deviation.
        seed: Fixes the noise.
    """

    def __init__(
        self, robots: tuple[int, ...], rate_hz: float, sigmas: tuple[float, float], seed: int
    ) -> None:
        self.sigmas = sigmas
        self._robots = robots
        self._period_ns = round(1e9 / rate_hz)
        self._rng = np.random.default_rng([seed, *robots])
        self._due_ns: int | None = None

    def look(self, now_ns: int, poses: FloatArray) -> list[Fix]:
        """What it sees now, if it is time, of robots at poses (N, 3)."""
        if self._due_ns is None:
            self._due_ns = now_ns
        if now_ns < self._due_ns:
            return []
        self._due_ns += self._period_ns
        position, heading = self.sigmas
        scale = np.array([position, position, heading])
        return [
            Fix(robot, now_ns, poses[robot] + scale * self._rng.standard_normal(3)) for robot in self._robots
        ]
