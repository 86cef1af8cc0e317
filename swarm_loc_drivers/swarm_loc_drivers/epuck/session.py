"""Images and measurements that the serial and the WiFi session of an e-puck share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.common.session import Session
from swarm_loc_drivers.epuck.hardware import Image

Speeds = Callable[[], tuple[int, int]]
"""Commands for the left and the right wheel [steps/s]; called just before they are sent."""


@dataclass(frozen=True)
class CameraSettings:
    """Images to request."""

    width: int  # [px]
    height: int  # [px]
    zoom: int  # Camera pixels per pixel
    period_s: float  # Between two images over a serial port [s]


@dataclass(frozen=True)
class Reading:
    """Sensor values."""

    stamp_ns: int  # Acquisition [ns]
    doubt_ns: int  # Uncertainty of the stamp in both directions [ns]
    left_counter: int  # Steps of the left wheel, 16 bits, wrapping
    right_counter: int  # Steps of the right wheel, 16 bits, wrapping
    proximity: NDArray[np.int64]  # (8,) raw values of ps0..ps7


@dataclass(frozen=True)
class CameraImage:
    """An image of the robot's camera."""

    stamp_ns: int  # Best estimate of the exposure time [ns]
    pixels: Image  # (height, width, 3) RGB


class EpuckSession(Session, Protocol):
    """A conversation with one e-puck."""

    found: list[Reading | CameraImage]  # Measurements; the reader empties the list
    is_idle: bool  # Whether no answer is pending: the next step sends a request

    def step(self, data: bytes, now_ns: int, steady_s: float) -> bytes:
        """See `TalkSession.step`."""
