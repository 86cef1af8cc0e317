"""A robot without a world around it: an exact differential drive whose every step and pose is known."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.epuck.hardware import wheel_geometry

GEOMETRY = wheel_geometry(wheel_diameter=0.041, wheel_separation=0.053)
_CAMERA_PERIOD_NS = 66_000_000
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
        self._steps = (float(steps[0]), float(steps[1]))
        self._rates = (0.0, 0.0)
        self._pose = (0.0, 0.0, 0.0)
        self.frame: tuple[NDArray[np.uint8], int | None] | None = None

    def _drive(self) -> None:
        """Catch up with the clock; one that has jumped back takes no way."""
        now_ns = self._clock()
        elapsed_s = max(0, now_ns - self._since_ns) * 1e-9
        self._since_ns = now_ns
        left, right = (rate * elapsed_s for rate in self._rates)
        if not (left or right):
            return
        self._steps = self._steps[0] + left, self._steps[1] + right
        path = 0.5 * (left + right) * GEOMETRY.metres_per_step
        turn = (right - left) * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation
        x, y, theta = self._pose
        chord = path * (math.sin(0.5 * turn) / (0.5 * turn) if turn else 1.0)
        x, y = x + chord * math.cos(theta + 0.5 * turn), y + chord * math.sin(theta + 0.5 * turn)
        self._pose = x, y, (theta + turn + math.pi) % (2.0 * math.pi) - math.pi

    def set_wheel_speeds(self, left: float, right: float) -> None:
        """See `EpuckBody`."""
        self._drive()
        self._rates = (left, right)

    def wheel_steps(self) -> tuple[int, int]:
        """See `EpuckBody`."""
        self._drive()
        left, right = self._steps
        return math.floor(left + 1e-6), math.floor(right + 1e-6)  # what the sum of many products may lack

    def proximity(self) -> NDArray[np.int64]:
        """Always the same."""
        return PROXIMITY

    def image(self) -> tuple[NDArray[np.uint8], int] | None:
        """What the test has set; without an exposure's stamp a camera takes it again and again."""
        if self.frame is None:
            return None
        pixels, stamp_ns = self.frame
        return pixels, self.now_ns // _CAMERA_PERIOD_NS * _CAMERA_PERIOD_NS if stamp_ns is None else stamp_ns

    @property
    def now_ns(self) -> int:
        """The time [ns]."""
        return self._clock()

    @property
    def rates(self) -> tuple[float, float]:
        """How the wheels turn [steps/s]."""
        return self._rates

    @property
    def pose(self) -> NDArray[np.float64]:
        """Where it is (3,)."""
        self._drive()
        return np.array(self._pose)
