"""What event cameras see in a hall: the own laser's spot, LEDs of other robots, corners that pass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from swarm_loc_drivers.sim.common.body import Blinking
from swarm_loc_drivers.sim.pushbot import optics
from swarm_loc_drivers.sim.pushbot.event_camera import CameraEvents, CameraNoise, EventCamera, Spot
from swarm_loc_drivers.sim.pushbot.ray_casting import is_visible, ray_distance
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.jit import cached_njit

BODY_RADIUS_M = 0.07
_MAX_SPOT_M = 5.0
"""Beyond it no pixel notices the laser."""
_BEFORE_WALL = 1e-3
"""A corner is part of walls: what is to be seen of it lies this share of the way before it."""
_CONTRAST = 0.6
"""Share of the pixels along an upright edge that notice it."""

Lights = tuple[Blinking, Blinking, Blinking]
"""Laser, rear and front LED of a robot."""


class HallSight:
    """The event cameras of robots in a hall.

    Args:
        walls: (S, 4) of the hall [m].
        built: How the robots were put together.
        noise: Of their cameras.
        rng: Source of all that is random.
    """

    def __init__(
        self,
        walls: FloatArray,
        built: Sequence[optics.LaserOptics],
        noise: CameraNoise,
        rng: np.random.Generator,
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
        """What a robot's camera sees while all go from poses (N, 3) to others.

        Args:
            robot: Its index.
            before: (N, 3) at the begin, in map.
            after: (N, 3) at the end.
            span_us: Begin and end [us].
            lights: Of all robots.
        """
        spots = self._laser_spot(robot, before, after, lights[robot][0])
        for other in range(len(after)):
            if other != robot:
                spots += self._led_spots((robot, other), before, after, lights[other])
        return self._cameras[robot].look(*span_us, spots, self._edges(before[robot], after[robot]))

    def distance(self, robot: int, poses: FloatArray) -> float:
        """From a robot's camera to what its laser hits when all stand at `poses` (N, 3) [m]."""
        x, y = optics.camera_place(poses[robot])
        others = np.delete(poses[:, :2], robot, axis=0)
        return float(ray_distance(self._walls, others, BODY_RADIUS_M, x, y, poses[robot, 2]))

    def _laser_spot(self, robot: int, before: FloatArray, after: FloatArray, laser: Blinking) -> list[Spot]:
        begin, end = self.distance(robot, before), self.distance(robot, after)
        if not laser.period_us or max(begin, end) > _MAX_SPOT_M or min(begin, end) <= 0.0:
            return []
        spot = self._optics[robot].spot
        return [Spot(spot(begin), spot(end), optics.spot_brightness(end), laser)]

    def _led_spots(
        self, pair: tuple[int, int], before: FloatArray, after: FloatArray, lights: Lights
    ) -> list[Spot]:
        """The LEDs of another robot, unless a wall is between: who looks, and at whom."""
        robot, other = pair
        spots = []
        x, y = optics.camera_place(after[robot])
        for blinking, front in zip(lights[1:], (False, True), strict=True):
            if not blinking.period_us:
                continue
            begin = optics.led_pixel(before[robot], before[other], front=front)
            end = optics.led_pixel(after[robot], after[other], front=front)
            place = optics.led_place(after[other], front=front)
            if begin and end and is_visible(self._walls, x, y, *place):
                spots.append(Spot(begin[:2], end[:2], optics.led_brightness(end[2]), blinking))
        return spots

    def _edges(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """Corners of walls as upright edges (E, 3) in the image, at the begin and the end of a step."""
        columns = []
        shown = _visible(self._walls, np.array(optics.camera_place(after)), self._corners)
        corners = self._corners[shown]
        for pose in (before, after):
            x, y = corners.T - np.array(optics.camera_place(pose))[:, None]
            ahead = x * np.cos(pose[2]) + y * np.sin(pose[2])
            left = y * np.cos(pose[2]) - x * np.sin(pose[2])
            with np.errstate(divide="ignore", invalid="ignore"):
                columns.append(
                    np.where(ahead > 0.05, optics.CENTRE_PX - optics.FOCAL_PX * left / ahead, np.nan)
                )
        edges = np.column_stack([*columns, self._contrast[shown]])
        near = (np.abs(edges[:, :2] - optics.CENTRE_PX) < 2.0 * optics.CENTRE_PX).all(axis=1)
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
