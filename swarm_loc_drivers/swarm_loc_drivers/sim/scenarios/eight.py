"""Five e-pucks driving the paper's eight among twenty wall markers.

The geometry fits the text of "Vision-based Localization for a Swarm of Ground Mini-Robots": a lemniscate of
half-width 0.60 m in an arena of 2.4 m by 1.6 m with a marker every 0.4 m of wall; five faces per robot,
cameras at 7.5 Hz.

The eight with rendered images in place of sightings, and the ground control on its floor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ellipk, ellipkinc

from swarm_loc_drivers.common.robot_driver import Velocity
from swarm_loc_drivers.sim.differential_drive import Controller
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.ground_control import FloorMarker, Ground
from swarm_loc_vision.markers.families import family_named

_TABLE_SIZE = 20001


class Lemniscate:
    """x = a cos t / (1 + sin^2 t), y = x sin t, by the length travelled from its right end; a is in m."""

    def __init__(self, half_width: float) -> None:
        self.half_width = half_width
        self.length = 4.0 * half_width * float(ellipk(-1.0))  # Once around [m]
        self._parameter = np.linspace(0.0, 2.0 * np.pi, _TABLE_SIZE)
        self._travelled = half_width * ellipkinc(self._parameter, -1.0)

    def at(self, travelled: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pose (..., 3) and curvature (...) [1/m], positive to the left, at lengths `travelled` (...) [m]."""
        t = np.interp(np.mod(travelled, self.length), self._travelled, self._parameter)
        sin, cos = np.sin(t), np.cos(t)
        scale = 1.0 / (1.0 + sin * sin)
        x, y = self.half_width * cos * scale, self.half_width * sin * cos * scale
        dx = -sin * (3.0 - sin * sin)  # direction of travel, up to a positive factor
        dy = 1.0 - 3.0 * sin * sin
        curvature = 3.0 * cos * np.sqrt(scale) / self.half_width
        return np.stack([x, y, np.arctan2(dy, dx)], axis=-1), curvature


HALF_WIDTH = 0.60
ARENA = (2.4, 1.6)
CAMERA_RATE_HZ = 7.5

_ACROSS_GAIN = 25.0
_HEADING_GAIN = 10.0
_CATCH_UP_GAIN = 0.5


def eight_starts(robots: int) -> FloatArray:
    """Poses (N, 3) on the eight at which its robots begin."""
    return Lemniscate(HALF_WIDTH).at(_offsets(robots))[0]


def _offsets(robots: int) -> FloatArray:
    """Lengths (N,) along the eight at which its robots begin [m]."""
    return np.asarray(np.arange(robots) * Lemniscate(HALF_WIDTH).length / robots)


def rounded(pose: Sequence[float] | FloatArray) -> tuple[float, float, float]:
    """A pose x, y, theta as people write it down, to the micrometre."""
    x, y, theta = (round(float(value), 6) for value in pose)
    return x, y, theta


def follow(path: Lemniscate, offset: FloatArray, speed: float, step_s: float) -> Controller:
    """Keeps N robots on the path, robot i at length `offset[i]` [m] plus speed [m/s] times time."""

    def control(step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        target, curvature = path.at(offset + speed * step * step_s)
        error = se2.between(pose, target)
        forward = speed + _CATCH_UP_GAIN * error[:, 0]
        return forward, speed * (curvature + _ACROSS_GAIN * error[:, 1] + _HEADING_GAIN * error[:, 2])

    return control


class EightSteering:
    """Keeps each robot at its place on the eight, which moves on at constant speed [m/s].

    Robot i begins i-th of as many equal parts along the eight as there are robots.
    """

    def __init__(self, robots: int, speed: float) -> None:
        path = Lemniscate(HALF_WIDTH)
        self._control = [follow(path, offset[None], speed, 1e-9) for offset in _offsets(robots)]
        self._begin_ns: int | None = None

    def command(self, robot: int, stamp_ns: int, pose: FloatArray) -> Velocity:
        """The velocity of a robot now, from the pose (3,) in map that it had at a stamp.

        The first stamp of all robots is when the eight begins.
        """
        if self._begin_ns is None or stamp_ns < self._begin_ns:
            self._begin_ns = stamp_ns
        speed, turn_rate = self._control[robot](stamp_ns - self._begin_ns, pose[None])
        return float(speed[0]), 0.0, float(turn_rate[0])


FAMILY = "artoolkit_bch_thin"


_SIZE, _FROM_WALL = 0.12, 0.15


def eight_floor() -> Ground:
    """Six markers along the longer walls; their ids are the last ones of the family."""
    family = family_named(FAMILY)
    x, y = 0.5 * ARENA[0] - _FROM_WALL, 0.5 * ARENA[1] - _FROM_WALL
    places = [(a * x, b * y) for b in (-1.0, 1.0) for a in (-1.0, 0.0, 1.0)]
    first = len(family.words) - len(places)
    markers = tuple(
        FloorMarker(first + k, round(a, 6), round(b, 6), size=_SIZE) for k, (a, b) in enumerate(places)
    )
    return Ground(markers=markers, family=family)
