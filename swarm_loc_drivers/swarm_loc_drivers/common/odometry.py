"""Odometry of a robot at an instant, and dead reckoning of a differential drive."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray


@dataclass(frozen=True)
class OdometryState:
    """Odometry at an instant."""

    stamp_ns: int  # Acquisition [ns]
    pose: FloatArray  # (3,) x [m], y [m], theta [rad] of base_link in odom
    covariance: FloatArray  # (3, 3) of the pose
    twist: FloatArray  # (3,) forward [m/s], to the left [m/s], turn rate [rad/s] since the state before
    twist_covariance: FloatArray  # (3, 3)


def carried_on(covariance: FloatArray, dx: float, dy: float) -> FloatArray:
    """Covariance (3, 3) of a pose after a translation (dx, dy), which a heading error turns sideways."""
    transition = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    carried: FloatArray = transition @ covariance @ transition.T
    return carried


_STEP_VARIANCE = 1.0 / 12.0  # Variance of the truncation error of a counter [steps^2]
_FORWARD_TURN = np.ix_((0, 2), (0, 2))


@dataclass(frozen=True)
class WheelGeometry:
    """The two driven wheels of a robot."""

    metres_per_step: float  # Path of a wheel per step of its counter [m]
    wheel_separation: float  # [m]

    def commands_for(
        self, speed: float, turn_rate: float, limit: float, period_s: float = 1.0
    ) -> tuple[float, float]:
        """Commands for the left and the right wheel [steps per period], not rounded, of finite velocities.

        Beyond the largest command both wheels slow down by the same factor, which keeps the curve.
        """
        half_turn, unit = 0.5 * self.wheel_separation * turn_rate, self.metres_per_step / period_s
        left, right = (speed - half_turn) / unit, (speed + half_turn) / unit
        slower = min(1.0, limit / max(abs(left), abs(right), 1.0))
        return slower * left, slower * right


class DeadReckoning:
    """Integrates the paths of two wheels to a pose with its covariance, starting at zero.

    `wheel_noise` is the variance of each wheel's path per metre it rolls [m^2/m].
    """

    def __init__(self, geometry: WheelGeometry, wheel_noise: float) -> None:
        self._separation = geometry.wheel_separation
        self._wheel_noise = wheel_noise
        self._step = geometry.metres_per_step
        self._pose = (0.0, 0.0, 0.0)
        self._covariance = np.zeros((3, 3))

    def advance(self, left: float, right: float) -> None:
        """Move along the arc of the wheels' paths [m]; the noise acts at the middle of the arc."""
        x, y, theta = self._pose
        turn = (right - left) / self._separation
        half = 0.5 * turn
        chord = 0.5 * (left + right) * (math.sin(half) / half if half else 1.0)
        forward = np.array([math.cos(theta + half), math.sin(theta + half)])
        dx, dy = (chord * forward).tolist()
        self._pose = (x + dx, y + dy, (theta + turn + math.pi) % (2.0 * math.pi) - math.pi)
        self._covariance = carried_on(self._covariance, dx, dy)
        effect = np.array([[forward[0], -0.5 * dy], [forward[1], 0.5 * dx], [0.0, 1.0]])
        self._covariance += effect @ self._twist_noise(abs(left), abs(right), self._wheel_noise) @ effect.T

    def forget_motion(self, reach: float) -> None:
        """The motion is unknown; each wheel rolled at most `reach` [m]."""
        turned = min(2.0 * reach / self._separation, math.pi)
        self._covariance += np.diag([reach**2, reach**2, turned**2]) / 3.0

    def state(self, stamp_ns: int, left: float, right: float, elapsed_s: float) -> OdometryState:
        """The current state; `left` and `right` are the wheels' last paths [m], made in `elapsed_s`."""
        cut_off = _STEP_VARIANCE * self._step**2
        (along, _), (_, turned) = self._twist_noise(1.0, 1.0, cut_off).tolist()
        covariance = self._covariance + np.diag([along, along, turned])
        twist, twist_noise = np.zeros(3), np.zeros((3, 3))
        if elapsed_s > 0.0:
            turned_rad = (right - left) / self._separation
            twist = np.array([0.5 * (left + right), 0.0, turned_rad]) / elapsed_s
            noise = self._twist_noise(abs(left), abs(right), self._wheel_noise)
            twist_noise[_FORWARD_TURN] = (noise + self._twist_noise(2.0, 2.0, cut_off)) / elapsed_s**2
        return OdometryState(stamp_ns, np.array(self._pose), covariance, twist, twist_noise)

    def _twist_noise(self, left: float, right: float, scale: float) -> FloatArray:
        """Covariance (2, 2) of path and turn when the wheels' paths have the variances scale * left, right.

        covar(ds_r, ds_l) = diag(k |ds_r|, k |ds_l|) of Siegwart and Nourbakhsh, as the estimator has it.
        """
        both = 0.5 * (right - left) / self._separation
        return scale * np.array([[0.25 * (left + right), both], [both, (left + right) / self._separation**2]])
