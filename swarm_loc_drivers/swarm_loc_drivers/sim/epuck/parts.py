"""Parts of a simulated e-puck: the body that its firmware drives, motors, camera, sensors, pending images."""

from __future__ import annotations

import math
from collections import deque
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.epuck.hardware import (
    FIELD_OF_VIEW,
    PROXIMITY_BEARINGS,
    PROXIMITY_RADIUS_M,
    EpuckModel,
    Image,
    as_counter,
    raw_of_distance,
)
from swarm_loc_drivers.epuck.wifi_session import SENSORS_DTYPE
from swarm_loc_estimator.common.arrays import FloatArray, IntArray


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

    def proximity(self) -> IntArray:
        """Return eight raw values in [0, 4095], ps0..ps7 clockwise from the front; close things give more."""

    def image(self) -> tuple[NDArray[np.uint8], int] | None:
        """Return the newest exposed frame and its exposure stamp [ns]; None before the first.

        The frame is (height, width) grey or (height, width, 3) RGB, of any size.
        """

    @property
    def now_ns(self) -> int:
        """The world's time [ns]."""


CAMERA_WIDTH, CAMERA_HEIGHT = 640, 480

_GRAVITY = 768  # One g in raw accelerations of an e-puck2
_AMBIENT = 3600
_TOF_MM = 2000
_BATTERY = 3200
_TEMPERATURE = 25
_SELECTOR = 3
_MICROPHONE = 40


class Motors:
    """The stepper motors: clamped and quantised speeds, counters of steps."""

    def __init__(self, body: EpuckBody, model: EpuckModel) -> None:
        self._body = body
        self._model = model
        self.commanded = (0, 0)  # The speeds as they were commanded, left and right [steps/s]

    def set_speeds(self, left: int, right: int) -> None:
        """Turn the wheels [steps/s]; the firmware keeps speeds in 16 bits."""
        self.commanded = (as_counter(left), as_counter(right))
        self._body.set_wheel_speeds(*map(self._model.rate, self.commanded))

    def counters(self) -> tuple[int, int]:
        """The counters as they are sent, 16 bits."""
        left, right = self._body.wheel_steps()
        return as_counter(left), as_counter(right)


def camera_image(body: EpuckBody, width: int, height: int, zoom: int) -> Image:
    """The newest frame (height, width, 3) RGB as the camera delivers it, black before the first.

    The middle width * zoom x height * zoom of the camera's 640x480 is delivered, one pixel for zoom x zoom.
    """
    newest = body.image()
    if newest is None:
        return np.zeros((height, width, 3), np.uint8)
    frame = newest[0] if newest[0].ndim == 3 else np.repeat(newest[0][:, :, None], 3, axis=2)
    rows, columns = frame.shape[:2]
    part_rows = max(1, min(rows, round(rows * height * zoom / CAMERA_HEIGHT)))
    part_columns = max(1, min(columns, round(columns * width * zoom / CAMERA_WIDTH)))
    top, left = (rows - part_rows) // 2, (columns - part_columns) // 2
    part = frame[top : top + part_rows, left : left + part_columns]
    small: Image = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    return small


def sensor_values(body: EpuckBody, motors: Motors) -> NDArray[np.void]:
    """The sensor values () of SENSORS_DTYPE of a robot that stands level in a quiet room."""
    values = np.zeros((), SENSORS_DTYPE)
    values["acceleration"] = (0, 0, _GRAVITY)
    values["acceleration_polar"] = (_GRAVITY, 0.0, 0.0)
    values["temperature"] = _TEMPERATURE
    values["proximity"] = body.proximity()
    values["ambient"] = _AMBIENT
    values["tof"] = _TOF_MM
    values["microphones"] = _MICROPHONE
    values["left_counter"], values["right_counter"] = motors.counters()
    values["battery"] = _BATTERY
    values["selector"] = _SELECTOR
    return values


_LARGEST = 4095
_NOISE = 6.0
_RAYS = np.array([-0.5, 0.0, 0.5]) * FIELD_OF_VIEW  # A sensor reports the nearest of what these rays meet


def proximity_values(
    poses: FloatArray, robot: int, arena: tuple[float, float], rng: np.random.Generator
) -> IntArray:
    """Raw values (8,) of one of the robots at poses (N, 3) in map; the arena lies around map's origin [m]."""
    x, y, heading = poses[robot]
    outwards = heading + np.array(PROXIMITY_BEARINGS)
    origins = np.array([x, y]) + PROXIMITY_RADIUS_M * np.column_stack([np.cos(outwards), np.sin(outwards)])
    angles = outwards[:, None] + _RAYS
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    others = np.delete(poses[:, :2], robot, axis=0)
    distance = np.minimum(_to_walls(origins, rays, arena), _to_discs(origins, rays, others)).min(axis=1)
    raw = raw_of_distance(distance) + _NOISE * rng.standard_normal(len(distance))
    return np.clip(np.rint(raw), 0, _LARGEST).astype(np.int64)


def _to_walls(origins: FloatArray, rays: FloatArray, arena: tuple[float, float]) -> FloatArray:
    """Along rays (S, R, 2) from origins (S, 2) to the walls (S, R) [m]; 0 from outside of them."""
    half = 0.5 * np.array(arena)
    with np.errstate(divide="ignore"):
        along = (half - np.sign(rays) * origins[:, None]) / np.abs(rays)
    nearest: FloatArray = np.maximum(along.min(axis=-1), 0.0)
    return nearest


def _to_discs(origins: FloatArray, rays: FloatArray, centres: FloatArray) -> FloatArray:
    """Along rays (S, R, 2) to robots at (M, 2) (S, R) [m]; infinite where they meet none."""
    if not len(centres):
        return np.full(rays.shape[:2], math.inf)
    to_centre = centres - origins[:, None, None]
    along = (to_centre * rays[:, :, None]).sum(axis=-1)
    off_ray = (to_centre**2).sum(axis=-1) - along**2
    depth = np.sqrt(np.maximum(PROXIMITY_RADIUS_M**2 - off_ray, 0.0))
    met = (off_ray < PROXIMITY_RADIUS_M**2) & (along > 0.0)
    nearest: FloatArray = np.where(met, np.maximum(along - depth, 0.0), math.inf).min(axis=-1)
    return nearest


class Unanswered:
    """Images that wait for their detections, so that simulated time can wait for them, too.

    An image may get `within_s` old without an answer [s]; 0: any age.
    """

    def __init__(self, within_s: float) -> None:
        self._within_ns = round(1e9 * within_s)
        self._asked: deque[tuple[int, int, int]] = deque()

    def ask(self, robot: int, stamp_ns: int, now_ns: int) -> None:
        """A robot's image with this stamp is shown now."""
        if self._within_ns:
            self._asked.append((robot, stamp_ns, now_ns))

    def answer(self, robot: int, stamp_ns: int) -> None:
        """A robot's image has become detections; older ones of it will not any more."""
        self._asked = deque(one for one in self._asked if one[0] != robot or one[1] > stamp_ns)

    def give_up(self) -> int:
        """Wait for the oldest image no longer; whose it was."""
        return self._asked.popleft()[0]

    def is_late(self, now_ns: int) -> bool:
        """Whether an image has waited too long."""
        return bool(self._asked) and now_ns >= self._asked[0][2] + self._within_ns
