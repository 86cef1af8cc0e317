"""What the two ways of talking to an e-puck have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Speeds = Callable[[], tuple[int, int]]
"""Tells what the wheels are to do, left and right [steps/s]; called when it is about to be sent."""


@dataclass(frozen=True)
class Reading:
    """Sensor values.

    Attributes:
        stamp_ns: Acquisition [ns].
        left_counter: Steps of the left wheel, 16 bits, wrapping.
        right_counter: Likewise of the right wheel.
        proximity: (8,) raw values of ps0..ps7.
    """

    stamp_ns: int
    left_counter: int
    right_counter: int
    proximity: NDArray[np.int64]


@dataclass(frozen=True)
class Photo:
    """A picture of the robot's camera.

    Attributes:
        stamp_ns: Exposure, as well as it can be known [ns].
        pixels: (height, width, 3) RGB.
    """

    stamp_ns: int
    pixels: NDArray[np.uint8]


class Session(Protocol):
    """A conversation with one robot over one link. All of it may raise LinkError or SessionError."""

    def begin(self) -> None:
        """Bring the robot to a known state; it stands afterwards."""

    def exchange(self, speeds: Speeds) -> list[Reading | Photo]:
        """Tell the wheels what to do and take what the robot has measured; lasts a moment."""

    def end(self) -> None:
        """Stop the robot, and return when it is known to have heard."""
