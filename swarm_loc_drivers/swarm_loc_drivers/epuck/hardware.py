"""Hardware of e-puck and e-puck2: motors, counters, proximity sensors, camera; measurements."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_drivers.common.odometry import WheelGeometry
from swarm_loc_estimator.common.arrays import FloatArray, IntArray

STEPS_PER_TURN = 1000  # 20 steps of the motor, gear 50:1

PROXIMITY_BEARINGS = tuple(math.radians(-d) for d in (17.0, 46.0, 90.0, 151.0, -151.0, -90.0, -46.0, -17.0))
"""Directions of ps0..ps7 in base_link [rad], positive to the left; the robot numbers them clockwise."""

PROXIMITY_RADIUS_M = 0.035  # Distance of the proximity sensors from the centre of the robot

WIFI_PORT = 1000
WIFI_WIDTH, WIFI_HEIGHT = 160, 120  # Of images in the stream of the WiFi firmware [px]

_COUNTER_SPAN = 1 << 16
_AROUND_IMAGE = 11  # Two speeds before an image, its header of 3 bytes, and two speeds after it


@dataclass(frozen=True)
class EpuckModel:
    """Properties of one generation of robots.

    A timer of `timer_hz` makes a step every whole number of its ticks, so few rates are possible at high
    speeds: an e-puck makes 625 steps/s on a command of 600.
    """

    name: str  # Name in parameters
    max_command: int  # Largest command; larger ones are clamped silently [steps/s]
    timer_hz: int  # Frequency of the timer [1/s]
    answer_buffer: int  # Largest answer in the serial protocol; a longer one overruns the memory [bytes]
    largest_setting: int  # Largest image that the firmware accepts as a setting [bytes of pixels]
    # Zooms of the camera; the firmware silently replaces another one by the last of these
    zooms: tuple[int, ...]

    @property
    def largest_image(self) -> int:
        """Largest image that can be sent, with its header and the speeds around it [bytes of pixels]."""
        return self.answer_buffer - _AROUND_IMAGE

    def rate(self, command: int) -> float:
        """True rate [steps/s] of a commanded speed [steps/s]."""
        speed = min(abs(command), self.max_command)
        if speed == 0:
            return 0.0
        return math.copysign(self.timer_hz / (self.timer_hz // speed), command)

    def wheel_commands(self, geometry: WheelGeometry, speed: float, turn_rate: float) -> tuple[int, int]:
        """Commands [steps/s] for the left and the right wheel, from a speed [m/s] and a turn rate [rad/s]."""
        left, right = geometry.commands_for(speed, turn_rate, self.max_rate)
        return self.command_for(left), self.command_for(right)

    @property
    def max_rate(self) -> float:
        """Fastest rate [steps/s]."""
        return self.rate(self.max_command)

    def command_for(self, rate: float) -> int:
        """Command [steps/s] whose true rate is closest to a wanted finite one [steps/s]."""
        wanted = min(abs(rate), self.max_rate)
        candidates = {0, math.floor(wanted), math.ceil(wanted)}
        if wanted >= 1.0:
            ticks = self.timer_hz / wanted
            candidates |= {math.floor(self.timer_hz / n) for n in (math.floor(ticks), math.ceil(ticks))}
        allowed = {min(command, self.max_command) for command in candidates}
        best = min(allowed, key=lambda command: (abs(self.rate(command) - wanted), command))
        return best if rate >= 0.0 else -best


EPUCK1 = EpuckModel("epuck1", 1000, 10_000, 3456, 3456, tuple(range(1, 9)))
EPUCK2 = EpuckModel("epuck2", 1100, 50_000, 4139, 4136, (1, 2, 4))
EPUCK_MODELS = {model.name: model for model in (EPUCK1, EPUCK2)}


def wheel_geometry(wheel_diameter: float, wheel_separation: float) -> WheelGeometry:
    """The wheels of an e-puck, from their diameter and their separation [m]."""
    return WheelGeometry(math.pi * wheel_diameter / STEPS_PER_TURN, wheel_separation)


def as_counter(steps: int) -> int:
    """Signed 16-bit counter that a robot sends for its steps."""
    return (steps + _COUNTER_SPAN // 2) % _COUNTER_SPAN - _COUNTER_SPAN // 2


def unwrapped_difference(before: int, after: int, expected: float) -> int:
    """Steps between two counters of 16 bits: the possible number closest to the expected one."""
    return round(expected) + as_counter(after - before - round(expected))


_DISTANCE_M = np.array([0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.06])
_RAW = np.array([4095.0, 2133.33, 1465.73, 601.46, 383.84, 234.93, 158.03, 120.0, 104.09])

MIN_RANGE_M = 0.005
MAX_RANGE_M = 0.06
FIELD_OF_VIEW = 0.26  # Opening of a sensor's cone [rad]


def raw_of_distance(distance_m: ArrayLike) -> FloatArray:
    """Raw values (...) of a wall at distances (...) [m]; beyond the table the value of free space."""
    raw: FloatArray = np.interp(np.asarray(distance_m, dtype=float), _DISTANCE_M, _RAW)
    return raw


def range_of_raw(raw: ArrayLike) -> FloatArray:
    """Ranges (...) [m] of raw values (...); as in REP 117 +inf for free space, -inf for too close."""
    raw = np.asarray(raw, dtype=float)
    distance = np.interp(raw, _RAW[::-1], _DISTANCE_M[::-1])
    distance = np.where(raw <= _RAW[-1], np.inf, distance)
    return np.where(distance < MIN_RANGE_M, -np.inf, distance)


Image = NDArray[np.uint8]


def decode_rgb565(data: bytes, width: int, height: int) -> Image:
    """Decode RGB565, high byte first, to an image (height, width, 3) RGB with the full range of 8 bits."""
    pixels = np.frombuffer(data, ">u2").reshape(height, width)
    red, green, blue = pixels >> 11, (pixels >> 5) & 0x3F, pixels & 0x1F
    channels = [(red << 3) | (red >> 2), (green << 2) | (green >> 4), (blue << 3) | (blue >> 2)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def encode_rgb565(image: Image) -> bytes:
    """Encode an image (height, width, 3) RGB as RGB565 bytes."""
    red, green, blue = np.moveaxis(image.astype(np.uint16), -1, 0)
    pixels: NDArray[np.uint16] = ((red >> 3) << 11) | ((green >> 2) << 5) | (blue >> 3)
    return pixels.astype(">u2").tobytes()


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
    proximity: IntArray  # (8,) raw values of ps0..ps7


@dataclass(frozen=True)
class CameraImage:
    """An image of the robot's camera."""

    stamp_ns: int  # Best estimate of the exposure time [ns]
    pixels: Image  # (height, width, 3) RGB
