"""Where a PushBot's event camera sees its own laser spot and the LEDs of others.

Base_link is on the floor between the wheels; the camera looks along its x. The laser pointer is parallel to
the camera's axis, below it and a little aside, so the spot lies at p_inf + f b / d, a hyperbola in the
distance d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarm_loc_drivers.sim.common.body import Blinking
from swarm_loc_estimator.common.arrays import FloatArray

FOCAL_PX = 90.0
"""3.6 mm over pixels of 40 um: 70.8 degrees."""
CENTRE_PX = 63.5
CAMERA_X_M = 0.04
"""The camera before base_link."""
_LED_X_M = 0.04
_LED_ABOVE_CAMERA_M = 0.03
_BASE_ROW_M, _BASE_COLUMN_M = 0.07, 0.02
"""From the laser pointer to the camera."""
_LED_FIELD = math.radians(80.0)
_HALF_FIELD = math.radians(37.0)
_SPOT_BRIGHTNESS, _LED_BRIGHTNESS = 12.0, 20.0
"""At a metre, over that of the surroundings."""
_MAX_BRIGHTNESS = 60.0
_LASER_PERIODS_US = (2430, 2330, 2230, 2130, 1880, 1820, 1760, 1700, 2500, 1640)
_LED_PERIODS_US = (1000, 900, 1100, 800, 1200, 1300, 700, 1400, 1500, 1600)
"""Each robot of a hall has its own; trackers tell apart LEDs whose periods differ by a tenth of a ms."""
MAX_ROBOTS = len(_LED_PERIODS_US)
"""Of one hall."""


@dataclass(frozen=True)
class LaserOptics:
    """How one robot was put together.

    Attributes:
        row: p_inf [px] and f b [px m] of the spot's row.
        column: Likewise of its column.
        sensor: Seed of what the pixels of its event camera are like.
    """

    row: tuple[float, float]
    column: tuple[float, float]
    sensor: int

    def spot(self, distance: float) -> tuple[float, float]:
        """Column and row [px] of the spot on what is so far from the camera [m]."""
        return self.column[0] + self.column[1] / distance, self.row[0] + self.row[1] / distance


def assembled(rng: np.random.Generator) -> LaserOptics:
    """One robot as it came from assembly."""
    shift_row, shift_column, turn_row, turn_column = rng.standard_normal(4)
    return LaserOptics(
        (CENTRE_PX + 0.5 + 1.5 * shift_row, FOCAL_PX * _BASE_ROW_M * (1.0 + 0.03 * turn_row)),
        (CENTRE_PX + 1.0 * shift_column, FOCAL_PX * _BASE_COLUMN_M * (1.0 + 0.1 * turn_column)),
        int(rng.spawn(1)[0].integers(1 << 32)),
    )


def assembled_robots(seed: int, count: int) -> list[LaserOptics]:
    """The robots of a world of a seed as they came from assembly."""
    rng = np.random.default_rng(seed)
    return [assembled(rng) for _ in range(count)]


def laser_hz(robot: int) -> float:
    """At which the laser of a robot of a hall blinks, by its index [Hz]."""
    return round(1e6 / _LASER_PERIODS_US[robot], 3)


def led_hz(robot: int) -> float:
    """Likewise its LEDs [Hz]."""
    return round(1e6 / _LED_PERIODS_US[robot], 3)


def lights_of(robot: int) -> tuple[Blinking, Blinking, Blinking]:
    """Laser, rear and front LED of a robot of a hall, as it is told to let them blink."""
    laser, led = _LASER_PERIODS_US[robot], _LED_PERIODS_US[robot]
    return Blinking(laser, laser // 2), Blinking(led, led // 2), Blinking(led, led // 2)


def spot_brightness(distance: float) -> float:
    """Brightness of the laser spot over its surroundings."""
    return min(_SPOT_BRIGHTNESS / distance**2, _MAX_BRIGHTNESS)


def led_brightness(distance: float) -> float:
    """Likewise of an LED."""
    return min(_LED_BRIGHTNESS / distance**2, _MAX_BRIGHTNESS)


def camera_place(pose: FloatArray) -> tuple[float, float]:
    """Where the camera of a robot at `pose` (3,) is in the plane [m]."""
    return pose[0] + CAMERA_X_M * math.cos(pose[2]), pose[1] + CAMERA_X_M * math.sin(pose[2])


def led_place(pose: FloatArray, *, front: bool) -> tuple[float, float]:
    """Where an LED of a robot at `pose` (3,) is in the plane [m]."""
    x = _LED_X_M if front else -_LED_X_M
    return pose[0] + x * math.cos(pose[2]), pose[1] + x * math.sin(pose[2])


def led_pixel(observer: FloatArray, pose: FloatArray, *, front: bool) -> tuple[float, float, float] | None:
    """Column, row [px] and distance [m] of an LED; None where it cannot be seen, walls aside.

    Args:
        observer: (3,) pose of the robot that looks.
        pose: (3,) of the robot with the LED.
        front: Which LED.
    """
    (cx, cy), (x, y) = camera_place(observer), led_place(pose, front=front)
    way = math.atan2(y - cy, x - cx)
    bearing = math.remainder(way - observer[2], 2.0 * math.pi)
    faces = pose[2] + (0.0 if front else math.pi)
    away = math.remainder(way + math.pi - faces, 2.0 * math.pi)
    distance = math.hypot(x - cx, y - cy)
    if abs(bearing) > _HALF_FIELD or abs(away) > _LED_FIELD or distance < 0.02:
        return None
    depth = distance * math.cos(bearing)
    row = CENTRE_PX - FOCAL_PX * _LED_ABOVE_CAMERA_M / depth
    return CENTRE_PX - FOCAL_PX * math.tan(bearing), row, distance
