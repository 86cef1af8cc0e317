"""How fiducials sit on robots, found from what the robots read of each other.

The sums of a brightness matrix over sensors and emitters point to the other robot whatever the board's curves
are, eqs (5)-(10) of the Droplet paper. Each robot's median tells the quarter turn by which its fiducial sits,
and all together whether the image is mirrored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.offline.datasets.droplets.places import CameraPose
from swarm_loc_estimator.offline.datasets.droplets.text import DropletRecordingError, Exchange

_QUARTER = 0.5 * math.pi
_CLEAR = 8.0
"""Matrices whose brightest reading is not above the noise by so much are not asked [sigma]."""
_ONE_WAY = 0.5
"""Directions whose mean vector is shorter contradict each other."""


@dataclass(frozen=True)
class Fiducials:
    """How all fiducials sit.

    Attributes:
        handedness: 1 where the image's x and y are those of map, -1 where y points the other way.
        turn_of: Robot -> from its fiducial's orientation to its own [rad], a multiple of a quarter turn.
        told: By how many exchanges each robot's was told.
    """

    handedness: int
    turn_of: Mapping[int, float]
    told: Mapping[int, int]

    def pose(self, robot: int, seen: CameraPose, metres_per_pixel: float) -> tuple[float, float, float]:
        """The robot's pose x, y [m], heading [rad] in map."""
        turned = self.handedness * seen.orientation + self.turn_of[robot]
        x, y = metres_per_pixel * seen.x, self.handedness * metres_per_pixel * seen.y
        return x, y, float(wrap_angle(turned))


def find_fiducials(
    exchanges: Sequence[Exchange], poses: Sequence[Mapping[int, CameraPose]], angles: FloatArray
) -> Fiducials:
    """Find how fiducials sit.

    Args:
        exchanges: All.
        poses: One per exchange: where robots stood.
        angles: (n,) directions of the elements in base_link [rad].

    Raises:
        DropletRecordingError: Matrices and camera contradict each other however the image is turned.
    """
    floor = _CLEAR * _noise(exchanges)
    rows = [
        (one, where)
        for one, where in zip(exchanges, poses, strict=True)
        if one.receiver in where and one.transmitter in where and one.readings.max() > floor
    ]
    best, told = max(((_turns(rows, angles, sign), sign) for sign in (1, -1)), key=lambda pair: pair[0][0])
    share, turns, counts = best
    if share < _ONE_WAY:
        raise DropletRecordingError(
            f"what robots read and what the camera saw contradict each other: directions agree to {share:.2f}"
            f" of 1 in {len(rows)} exchanges, at least {_ONE_WAY} is needed."
        )
    usual = float(np.median(list(turns.values())))
    everybody = {robot for where in poses for robot in where}
    return Fiducials(told, {robot: turns.get(robot, usual) for robot in everybody}, counts)


def _turns(
    rows: Sequence[tuple[Exchange, Mapping[int, CameraPose]]], angles: FloatArray, sign: int
) -> tuple[float, dict[int, float], dict[int, int]]:
    """How well directions agree, the turn of each robot that took part, and how often it did."""
    said: dict[int, list[complex]] = {}
    units = np.exp(1j * angles)
    for one, where in rows:
        light = np.clip(one.readings, 0.0, None)
        bearing = np.angle(units @ light.sum(axis=1))
        heading = np.angle(-(units @ light @ units.conj()))
        receiver, transmitter = where[one.receiver], where[one.transmitter]
        along = math.atan2(sign * (transmitter.y - receiver.y), transmitter.x - receiver.x)
        forward = along - bearing
        said.setdefault(one.receiver, []).append(np.exp(1j * (forward - sign * receiver.orientation)))
        turned = forward + heading - sign * transmitter.orientation
        said.setdefault(one.transmitter, []).append(np.exp(1j * turned))
    sums = {robot: sum(values) for robot, values in said.items()}
    turns = {robot: _QUARTER * round(np.angle(total) / _QUARTER) for robot, total in sums.items()}
    share = sum(abs(total) for total in sums.values()) / max(sum(map(len, said.values())), 1)
    return share, turns, {robot: len(values) for robot, values in said.items()}


def _noise(exchanges: Sequence[Exchange]) -> float:
    """Robust scatter of what sensors read, most of which is no light [count]."""
    values = np.concatenate([one.readings.ravel() for one in exchanges])
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1.0)
