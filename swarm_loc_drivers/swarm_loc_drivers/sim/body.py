"""What robot firmware finds on its robot: the seam between an emulated firmware and a simulated world."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class EpuckBody(Protocol):
    """Motors, step counters, proximity sensors, camera and clock of one e-puck.

    All of it is called by the thread that serves the emulated firmware's bytes.
    """

    def set_wheel_speeds(self, left: float, right: float) -> None:
        """Turn the wheels at these rates [steps/s] until the next call: the motors have no watchdog.

        The firmware has clamped and quantised the rates already, so they need not be whole numbers.
        """

    def wheel_steps(self) -> tuple[int, int]:
        """Return the whole steps done since power-on, left and right: open loop, blind to slip, unbounded."""

    def proximity(self) -> NDArray[np.int64]:
        """Return eight raw values in [0, 4095], ps0..ps7 clockwise from the front; close things give more."""

    def image(self) -> tuple[NDArray[np.uint8], int] | None:
        """Return the newest exposed frame and its exposure stamp [ns]; None before the first.

        The frame is (height, width) grey or (height, width, 3) RGB, of any size.
        """

    @property
    def now_ns(self) -> int:
        """The world's time [ns]."""
