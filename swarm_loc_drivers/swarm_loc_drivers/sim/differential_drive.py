"""Differential-drive motion model: true wheels slip at random, odometry reports the commanded motion.

The wheels follow Siegwart and Nourbakhsh: a wheel commanded to roll ds rolls ds plus noise of
variance `wheel_noise` * abs(ds), independently of the other wheel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

Controller = Callable[[int, FloatArray], tuple[FloatArray, FloatArray]]
"""(step index, true poses (N, 3)) -> commanded speed (N,) [m/s] and turn rate (N,) [rad/s]."""


@dataclass(frozen=True)
class Drive:
    """A differential drive and its imperfections."""

    wheel_separation: float | FloatArray  # [m], of all robots or of each (N,)
    wheel_noise: float  # Variance of a wheel's path per metre rolled [m]
    turn_slip: float = 0.0  # Share of every commanded turn that is lost, in [0, 1)


class LastingNoise:
    """Unit noise of some shape that is correlated over several steps [s].

    White noise would move a wheel abruptly at every step, visibly so in an exposure of 8 ms. Real wheels
    slip over millimetres, and a robot has inertia. So the noise is a moving average over `time_s`. The
    variance of sums over longer times equals that of white noise except for a third of `time_s`, so
    `wheel_noise` keeps its meaning.
    """

    def __init__(
        self, rng: np.random.Generator, shape: tuple[int, ...], step_s: float, time_s: float
    ) -> None:
        self._rng = rng
        self._draws = rng.standard_normal((max(1, round(time_s / step_s)), *shape))
        self._oldest = 0

    def next(self) -> FloatArray:
        """The noise of the next step."""
        self._draws[self._oldest] = self._rng.standard_normal(self._draws.shape[1:])
        self._oldest = (self._oldest + 1) % len(self._draws)
        mean: FloatArray = self._draws.mean(axis=0)
        return mean


def wheel_paths(
    speed: FloatArray, turn_rate: FloatArray, separation: float | FloatArray, step_s: float
) -> FloatArray:
    """Paths (..., 2) [m] of the right and left wheel in one step."""
    half_turn = 0.5 * separation * turn_rate
    return np.stack([speed + half_turn, speed - half_turn], axis=-1) * step_s


def twist_of(wheels: FloatArray, separation: float | FloatArray) -> FloatArray:
    """The twist (..., 3) of one step in the robot's own frame, from its wheels' paths (..., 2) [m]."""
    right, left = wheels[..., 0], wheels[..., 1]
    return np.stack([0.5 * (right + left), np.zeros_like(right), (right - left) / separation], axis=-1)


def roll(
    poses: FloatArray,
    speed: FloatArray,
    turn_rate: FloatArray,
    model: Drive,
    step_s: float,
    noise: FloatArray,
) -> FloatArray:
    """The poses of robots after one step.

    Args:
        poses: (N, 3) before the step, in map.
        speed: Commanded (N,) [m/s].
        turn_rate: Commanded (N,) [rad/s].
        model: Their drive and its imperfections.
        step_s: [s].
        noise: (N, 2) of the right and left wheel, of variance `model.wheel_noise` [m^0.5].
    """
    rolled = wheel_paths(speed, (1.0 - model.turn_slip) * turn_rate, model.wheel_separation, step_s)
    rolled += noise * np.sqrt(np.abs(rolled))
    return se2.compose(poses, se2.exp(twist_of(rolled, model.wheel_separation)))


def integrate(twists: FloatArray) -> FloatArray:
    """Odometry (T + 1, N, 3) from zero, by the mean heading of each step, e-puck paper eq. (1)."""
    heading = np.concatenate([np.zeros((1, *twists.shape[1:-1])), np.cumsum(twists[..., 2], axis=0)])
    middle = heading[:-1] + 0.5 * twists[..., 2]
    steps = twists[..., :1] * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    position = np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])
    return np.concatenate([position, se2.wrap_angle(heading)[..., None]], axis=-1)
