"""Hardware interface between an emulated firmware and a simulated world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

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


class Command(NamedTuple):
    """A line that came by infrared.

    Attributes:
        line: What to do.
        end_ns: When its last byte came.
    """

    line: str
    end_ns: int


class Measured(NamedTuple):
    """An exchange in which this robot measured.

    Attributes:
        emitter: Id of the robot that emitted.
        readings: (n, n) emitters by sensors, baseline taken off [count].
        end_ns: When the exchange was over.
    """

    emitter: int
    readings: NDArray[np.int64]
    end_ns: int


class DropletBody(Protocol):
    """Motors, infrared and clock of one Droplet; called by the thread that serves the firmware's bytes."""

    @property
    def robot_id(self) -> int:
        """What its chip was made with, never 0."""

    @property
    def trims(self) -> Sequence[Sequence[int]]:
        """Calibration in its memory: per direction the trims of the three motors, see `protocols.droplet`."""

    @property
    def lengths(self) -> Sequence[int]:
        """Likewise path [mm] or turn [deg] per 1000 steps of each direction."""

    def move(self, direction: int | None) -> None:
        """Run the motors of a direction until the next call; None: stand."""

    def infrared_status(self) -> int:
        """Bits: 1 a message is coming in, 2 one is going out, 4 and 8 an exchange is going on."""

    def send(self, line: str, target: int) -> None:
        """Send a command to another robot; target 0: to all."""

    def emit(self, power: int) -> None:
        """Call all robots around, and light the emitters one after the other at a power of 0 to 256."""

    def heard(self) -> Sequence[Command | Measured]:
        """What has come by infrared since the last call."""

    def deaf_until_ns(self) -> int:
        """The firmware does nothing else before this time: an exchange needs it whole [ns]."""

    @property
    def now_ns(self) -> int:
        """The world's time [ns]."""


class Blinking(NamedTuple):
    """A light that is lit in the first part of each period; a period of 0: it is dark.

    Attributes:
        period_us: [us].
        lit_us: [us].
    """

    period_us: int = 0
    lit_us: int = 0


class PushbotBody(Protocol):
    """Motors, wheel encoders, lights and clock of one PushBot; called by the thread that steps the world."""

    def set_duties(self, left: float, right: float) -> None:
        """Drive the motors by shares of the battery's voltage in [-1, 1]; 0 brakes, and it lasts."""

    def wheel_ticks(self) -> tuple[int, int]:
        """Return the quadrature counts of the wheels since power-on, left and right."""

    def set_lights(self, laser: Blinking, rear: Blinking, front: Blinking) -> None:
        """Let laser pointer and LEDs blink until the next call."""

    @property
    def now_ns(self) -> int:
        """The world's time [ns]."""
