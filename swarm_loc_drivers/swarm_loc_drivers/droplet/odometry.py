"""Dead reckoning of a Droplet by its commands alone, with the covariance of its gait.

A Droplet walks by vibrating; the effect of a step depends on the robot and the floor. So the uncertainty is a
share of the path, and a command that may have been lost makes its whole motion uncertain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarm_loc_drivers.common.odometry import OdometryState, carried_on
from swarm_loc_drivers.droplet.hardware import Gait
from swarm_loc_estimator.common.arrays import FloatArray

_NS = 1e9
_ALL_OR_NONE = 1.0 / 3.0  # Mean square of 1 - s for a true share s that is uniform in [0, 1]


@dataclass(frozen=True)
class MotionNoise:
    """Noise of commanded motion."""

    walk_noise: float  # Variance along and across of a walk per metre [m^2/m]
    veer_noise: float  # Variance of the heading per metre walked [rad^2/m]
    turn_noise: float  # Variance of a turn per radian [rad^2/rad]


@dataclass(frozen=True)
class _Move:
    """A command in execution."""

    gait: Gait
    steps: float
    begin_ns: int

    @property
    def end_ns(self) -> int:
        return self.begin_ns + round(self.steps * self.gait.step_s * _NS)


class CommandedMotion:
    """Integrates commands to a pose, with the noise of the motion."""

    def __init__(self, noise: MotionNoise) -> None:
        self._noise = noise
        self._pose = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._now_ns: int | None = None
        self._move: _Move | None = None
        self._doubted: tuple[FloatArray, float] | None = None  # start of an uncertain motion, variance

    def moving(self, stamp_ns: int) -> bool:
        """Whether the robot moves at a time [ns], as estimated."""
        return self._move is not None and stamp_ns < self._move.end_ns

    def begin(self, stamp_ns: int, gait: Gait, steps: int, doubt: float = 0.0) -> None:
        """Begin a motion of some steps, unless the robot is moving; `doubt`: probability that it was lost."""
        self._advance(stamp_ns)
        if not self.moving(stamp_ns):
            self._settle()
            self._move = _Move(gait, steps, stamp_ns)
            self._doubted = (self._pose, doubt)

    def stop(self, stamp_ns: int, doubt: float = 0.0) -> None:
        """Stop the motion; `doubt`: probability that the command was lost and the robot completes it."""
        move = self._move
        self._advance(stamp_ns)
        self._settle()
        if move is not None:
            left = min(max(0.0, (move.end_ns - stamp_ns) / (_NS * move.gait.step_s)), move.steps)
            rest = self._way(move.gait, left)
            self._covariance = self._covariance + doubt * np.outer(rest, rest)
        self._move = None

    def lose(self, stamp_ns: int) -> None:
        """From now on it is unknown whether the robot continues its motion."""
        self._advance(stamp_ns)
        self._settle()
        self._doubted = (self._pose, _ALL_OR_NONE)

    def state(self, stamp_ns: int) -> OdometryState:
        """The estimate at a time [ns]."""
        self._advance(stamp_ns)
        twist, noise = np.zeros(3), np.zeros((3, 3))
        if self._move is not None:
            gait = self._move.gait
            twist = np.array(gait.velocity)
            noise = np.diag(self._body_noise(gait, 1.0)) / gait.step_s**2
        return OdometryState(stamp_ns, self._pose, self._whole_covariance(), twist, noise)

    def _settle(self) -> None:
        """Add the variance of an uncertain motion for good."""
        self._covariance = self._whole_covariance()
        self._doubted = None

    def _whole_covariance(self) -> FloatArray:
        """Covariance including that of an uncertain motion."""
        if self._doubted is None:
            return self._covariance
        since, share = self._doubted
        way = self._pose - since
        way[2] = (way[2] + math.pi) % (2.0 * math.pi) - math.pi
        return self._covariance + share * np.outer(way, way)

    def _advance(self, stamp_ns: int) -> None:
        """Advance to a time; after a jump back the robot stands and continues from there."""
        before_ns, self._now_ns = self._now_ns, stamp_ns
        if before_ns is None or stamp_ns < before_ns:
            self._move = None
        if self._move is None or before_ns is None:
            return
        begin_ns, end_ns = max(before_ns, self._move.begin_ns), min(stamp_ns, self._move.end_ns)
        if end_ns > begin_ns:
            self._step(self._move.gait, (end_ns - begin_ns) / (_NS * self._move.gait.step_s))
        if stamp_ns >= self._move.end_ns:
            self._move = None

    def _step(self, gait: Gait, steps: float) -> None:
        """Advance by steps."""
        way = self._way(gait, steps)
        dx, dy, _ = way
        self._covariance = carried_on(self._covariance, dx, dy)
        walk, _, heading = self._body_noise(gait, steps)
        # a heading error that grows along the path displaces the robot sideways by half of it on average
        effect, spread = np.array([-0.5 * dy, 0.5 * dx, 1.0]), np.array([-dy, dx, 0.0])
        self._covariance += np.diag([walk, walk, 0.0])
        self._covariance += heading * (np.outer(effect, effect) + np.outer(spread, spread) / 12.0)
        self._pose = self._pose + way
        self._pose[2] = (self._pose[2] + math.pi) % (2.0 * math.pi) - math.pi

    def _body_noise(self, gait: Gait, steps: float) -> FloatArray:
        """Variances (3,) of steps: along, across, heading."""
        path, turn = steps * math.hypot(gait.forward, gait.left), steps * abs(gait.turn)
        walk, heading = self._noise.walk_noise * path, self._noise.veer_noise * path
        return np.array([walk, walk, heading + self._noise.turn_noise * turn])

    def _way(self, gait: Gait, steps: float) -> FloatArray:
        """Motion (3,) of steps in the odometry's frame; the turn is not wrapped."""
        cos, sin = math.cos(self._pose[2]), math.sin(self._pose[2])
        dx, dy = cos * gait.forward - sin * gait.left, sin * gait.forward + cos * gait.left
        return steps * np.array([dx, dy, gait.turn])
