"""A robot without a world around it: an exact differential drive whose every step and pose is known."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.core.wheels import WheelGeometry
from swarm_loc_estimator.core import se2

GEOMETRY = WheelGeometry(wheel_diameter=0.041, wheel_separation=0.053)
PROXIMITY = np.array([150, 110, 60, 60, 60, 60, 110, 2000])


class DrivenBody:
    """An `EpuckBody` that follows its wheels without slip.

    Args:
        clock: Tells the time [ns].
        steps: Done since power-on, left and right.
    """

    def __init__(self, clock: Callable[[], int], steps: tuple[int, int] = (0, 0)) -> None:
        self._clock = clock
        self._since_ns = clock()
        self._steps = np.array(steps, dtype=float)
        self._rates = np.zeros(2)
        self._pose = np.zeros(3)
        self.frame: tuple[NDArray[np.uint8], int] | None = None

    def _drive(self) -> None:
        """Catch up with the clock; one that has jumped back takes no way."""
        now_ns = self._clock()
        steps = self._rates * max(0, now_ns - self._since_ns) * 1e-9
        left, right = steps * GEOMETRY.metres_per_step
        twist = [0.5 * (left + right), 0.0, (right - left) / GEOMETRY.wheel_separation]
        self._pose = se2.compose(self._pose, se2.exp(twist))
        self._steps += steps
        self._since_ns = now_ns

    def set_wheel_speeds(self, left: float, right: float) -> None:
        """See `EpuckBody`."""
        self._drive()
        self._rates = np.array([left, right])

    def wheel_steps(self) -> tuple[int, int]:
        """See `EpuckBody`."""
        self._drive()
        left, right = self._steps + 1e-6  # what the sum of many products may lack
        return math.floor(left), math.floor(right)

    def proximity(self) -> NDArray[np.int64]:
        """Always the same."""
        return PROXIMITY

    def image(self) -> tuple[NDArray[np.uint8], int] | None:
        """What the test has set."""
        return self.frame

    @property
    def now_ns(self) -> int:
        """The time [ns]."""
        return self._clock()

    @property
    def rates(self) -> tuple[float, float]:
        """How the wheels turn [steps/s]."""
        left, right = self._rates
        return float(left), float(right)

    @property
    def pose(self) -> NDArray[np.float64]:
        """Where it is (3,)."""
        self._drive()
        return self._pose
