"""What the event cameras of PushBots in a hall see: the own laser's spot, LEDs of others, corners that pass.

Base_link is on the floor between the wheels; the camera looks along its x. The laser pointer is parallel to
the camera's axis, below it and a little aside, so the spot lies at p_inf + f b / d, a hyperbola in the
distance d.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swarm_loc_drivers.sim.pushbot.event_camera import Blinking, CameraEvents, CameraNoise, EventCamera, Spot
from swarm_loc_drivers.sim.pushbot.floor_plan import is_visible, ray_distance
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit

FOCAL_PX = 90.0  # 3.6 mm over pixels of 40 um: 70.8 degrees
CENTRE_PX = 63.5
CAMERA_X_M = 0.04  # The camera before base_link
_LED_X_M = 0.04
_LED_ABOVE_CAMERA_M = 0.03
_BASE_ROW_M, _BASE_COLUMN_M = 0.07, 0.02  # From the laser pointer to the camera
_LED_FIELD = math.radians(80.0)
_HALF_FIELD = math.radians(37.0)
_SPOT_BRIGHTNESS, _LED_BRIGHTNESS = 12.0, 20.0  # At a metre, over that of the surroundings
_MAX_BRIGHTNESS = 60.0
_LASER_PERIODS_US = (2430, 2330, 2230, 2130, 1880, 1820, 1760, 1700, 2500, 1640)
_LED_PERIODS_US = (1000, 900, 1100, 800, 1200, 1300, 700, 1400, 1500, 1600)
"""Each robot of a hall has its own; trackers tell apart LEDs whose periods differ by a tenth of a ms."""
MAX_ROBOTS = len(_LED_PERIODS_US)  # Of one hall


@dataclass(frozen=True)
class LaserOptics:
    """The laser and camera of one robot as assembled."""

    row: tuple[float, float]  # p_inf [px] and f b [px m] of the spot's row
    column: tuple[float, float]  # The same of its column
    sensor: int  # Seed of what the pixels of its event camera are like

    def spot(self, distance: float) -> tuple[float, float]:
        """Column and row [px] of the spot on what is so far from the camera [m]."""
        return self.column[0] + self.column[1] / distance, self.row[0] + self.row[1] / distance


def assembled(rng: np.random.Generator) -> LaserOptics:
    """Draw the optics of one assembled robot."""
    shift_row, shift_column, turn_row, turn_column = rng.standard_normal(4)
    return LaserOptics(
        (CENTRE_PX + 0.5 + 1.5 * shift_row, FOCAL_PX * _BASE_ROW_M * (1.0 + 0.03 * turn_row)),
        (CENTRE_PX + 1.0 * shift_column, FOCAL_PX * _BASE_COLUMN_M * (1.0 + 0.1 * turn_column)),
        int(rng.spawn(1)[0].integers(1 << 32)),
    )


def assembled_robots(seed: int, count: int) -> list[LaserOptics]:
    """The optics of all robots of a world, by its seed."""
    rng = np.random.default_rng(seed)
    return [assembled(rng) for _ in range(count)]


def laser_hz(robot: int) -> float:
    """Frequency of the laser of a robot of a hall, by its index [Hz]."""
    return round(1e6 / _LASER_PERIODS_US[robot], 3)


def led_hz(robot: int) -> float:
    """Frequency of the LEDs of a robot of a hall, by its index [Hz]."""
    return round(1e6 / _LED_PERIODS_US[robot], 3)


def lights_of(robot: int) -> tuple[Blinking, Blinking, Blinking]:
    """Laser, rear and front LED of a robot of a hall."""
    laser, led = _LASER_PERIODS_US[robot], _LED_PERIODS_US[robot]
    return Blinking(laser, laser // 2), Blinking(led, led // 2), Blinking(led, led // 2)


def spot_brightness(distance: float) -> float:
    """Brightness of the laser spot over its surroundings."""
    return min(_SPOT_BRIGHTNESS / distance**2, _MAX_BRIGHTNESS)


def camera_place(pose: FloatArray) -> tuple[float, float]:
    """Where the camera of a robot at `pose` (3,) is in the plane [m]."""
    return pose[0] + CAMERA_X_M * math.cos(pose[2]), pose[1] + CAMERA_X_M * math.sin(pose[2])


def led_place(pose: FloatArray, *, front: bool) -> tuple[float, float]:
    """Where an LED of a robot at `pose` (3,) is in the plane [m]."""
    x = _LED_X_M if front else -_LED_X_M
    return pose[0] + x * math.cos(pose[2]), pose[1] + x * math.sin(pose[2])


def led_pixel(observer: FloatArray, pose: FloatArray, *, front: bool) -> tuple[float, float, float] | None:
    """Column, row [px] and distance [m] of an LED of a robot at `pose`; None if not seen, walls aside."""
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


BODY_RADIUS_M = 0.07
_MAX_SPOT_M = 5.0  # The laser is invisible beyond this distance
_BEFORE_WALL = 1e-3  # Corners are on walls: visibility is tested nearer to the camera by this share
_CONTRAST = 0.6  # Share of the pixels along an upright edge that notice it

Lights = tuple[Blinking, Blinking, Blinking]  # Laser, rear and front LED of a robot


class HallSight:
    """The event cameras of robots in a hall with walls (S, 4) [m]."""

    def __init__(
        self, walls: FloatArray, built: Sequence[LaserOptics], noise: CameraNoise, rng: np.random.Generator
    ) -> None:
        self._walls = walls
        self._optics = built
        robots = zip(rng.spawn(len(built)), built, strict=True)
        self._cameras = [EventCamera(noise, own, one.sensor) for own, one in robots]
        self._corners = _corners(walls)
        self._contrast = rng.choice([-_CONTRAST, _CONTRAST], len(self._corners))

    def look(
        self,
        robot: int,
        before: FloatArray,
        after: FloatArray,
        span_us: tuple[int, int],
        lights: Sequence[Lights],
    ) -> CameraEvents:
        """The events of a robot's camera during a step between two times [us].

        Poses (N, 3) of all robots before and after it are in map; lights are those of all robots.
        """
        spots = self._laser_spot(robot, before, after, lights[robot][0])
        for other in range(len(after)):
            if other != robot:
                spots += self._led_spots((robot, other), before, after, lights[other])
        return self._cameras[robot].look(*span_us, spots, self._edges(before[robot], after[robot]))

    def distance(self, robot: int, poses: FloatArray) -> float:
        """From a robot's camera to what its laser hits when all stand at `poses` (N, 3) [m]."""
        x, y = camera_place(poses[robot])
        others = np.delete(poses[:, :2], robot, axis=0)
        return float(ray_distance(self._walls, others, BODY_RADIUS_M, x, y, poses[robot, 2]))

    def _laser_spot(self, robot: int, before: FloatArray, after: FloatArray, laser: Blinking) -> list[Spot]:
        begin, end = self.distance(robot, before), self.distance(robot, after)
        if not laser.period_us or max(begin, end) > _MAX_SPOT_M or min(begin, end) <= 0.0:
            return []
        spot = self._optics[robot].spot
        return [Spot(spot(begin), spot(end), spot_brightness(end), laser)]

    def _led_spots(
        self, pair: tuple[int, int], before: FloatArray, after: FloatArray, lights: Lights
    ) -> list[Spot]:
        """The LEDs of another robot, unless a wall is between: who looks, and at whom."""
        robot, other = pair
        spots = []
        x, y = camera_place(after[robot])
        for blinking, front in zip(lights[1:], (False, True), strict=True):
            if not blinking.period_us:
                continue
            begin = led_pixel(before[robot], before[other], front=front)
            end = led_pixel(after[robot], after[other], front=front)
            place = led_place(after[other], front=front)
            if begin and end and is_visible(self._walls, x, y, *place):
                brightness = min(_LED_BRIGHTNESS / end[2] ** 2, _MAX_BRIGHTNESS)
                spots.append(Spot(begin[:2], end[:2], brightness, blinking))
        return spots

    def _edges(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """Corners of walls as upright edges (E, 3) in the image, at the begin and the end of a step."""
        columns = []
        shown = _visible(self._walls, np.array(camera_place(after)), self._corners)
        corners = self._corners[shown]
        for pose in (before, after):
            x, y = corners.T - np.array(camera_place(pose))[:, None]
            ahead = x * np.cos(pose[2]) + y * np.sin(pose[2])
            left = y * np.cos(pose[2]) - x * np.sin(pose[2])
            with np.errstate(divide="ignore", invalid="ignore"):
                columns.append(np.where(ahead > 0.05, CENTRE_PX - FOCAL_PX * left / ahead, np.nan))
        edges = np.column_stack([*columns, self._contrast[shown]])
        near = (np.abs(edges[:, :2] - CENTRE_PX) < 2.0 * CENTRE_PX).all(axis=1)
        chosen: FloatArray = edges[near]
        return chosen


def _corners(walls: FloatArray) -> FloatArray:
    """Points (n, 2) where walls (S, 4) end or change their direction: walls may consist of several pieces."""
    points, where = np.unique(walls.reshape(-1, 2), axis=0, return_inverse=True)
    twice = np.repeat(2.0 * np.arctan2(walls[:, 3] - walls[:, 1], walls[:, 2] - walls[:, 0]), 2)
    sums = np.zeros((len(points), 3))
    np.add.at(sums, where.ravel(), np.column_stack([np.cos(twice), np.sin(twice), np.ones(len(twice))]))
    is_straight = (sums[:, 2] > 1.0) & (np.hypot(sums[:, 0], sums[:, 1]) > sums[:, 2] - 1e-6)
    corners: FloatArray = points[~is_straight]
    return corners


@cached_njit
def _visible(walls: FloatArray, place: FloatArray, corners: FloatArray) -> BoolArray:
    """Which corners (n, 2) no wall hides from a place (2,)."""
    visible = np.zeros(len(corners), dtype=np.bool_)
    for k in range(len(corners)):
        x = corners[k, 0] + _BEFORE_WALL * (place[0] - corners[k, 0])
        y = corners[k, 1] + _BEFORE_WALL * (place[1] - corners[k, 1])
        visible[k] = is_visible(walls, place[0], place[1], x, y)
    return visible
