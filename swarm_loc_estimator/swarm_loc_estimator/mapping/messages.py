"""Messages of the mapper: maps, laser distances and frequencies of lights."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import (
    LASER,
    LASER_SCAN,
    LIGHTS,
    OCCUPANCY_GRID,
    CdrError,
    decode,
    nanoseconds,
)
from swarm_loc_estimator.common.messages.poses import planar_pose
from swarm_loc_estimator.common.parameters import ParameterError

MAX_CELLS = 4_000_000  # Maximum number of cells of a valid map


class GridMessage(NamedTuple):
    """A map."""

    stamp_ns: int  # Time of the map
    frame_id: str  # Frame of the origin
    resolution: float  # Side of a cell [m]
    origin: tuple[float, float, float]  # x [m], y [m], yaw [rad] of the outer corner of the first cell
    cells: NDArray[np.int8]  # (height, width), x along the rows: -1 unknown, else occupied by 0 to 100 %


def decode_occupancy_grid(data: bytes) -> GridMessage:
    """Read a nav_msgs/OccupancyGrid.

    Raises:
        CdrError: The bytes are not a valid OccupancyGrid.
    """
    message = decode(data, OCCUPANCY_GRID)
    header, about, cells = message.header, message.info, message.data
    origin = planar_pose(about.origin)
    if not 0 < cells.size <= MAX_CELLS or cells.size != about.width * about.height:
        raise CdrError(f"a map of {about.width} x {about.height} cells has {cells.size} of them.")
    if not (about.resolution > 0.0 and all(map(math.isfinite, (about.resolution, *origin)))):
        raise CdrError("the place of a map is not finite.")
    cells = cells.reshape(about.height, about.width)
    return GridMessage(nanoseconds(header.stamp), header.frame_id, about.resolution, origin, cells)


class LaserMessage(NamedTuple):
    """A swarm_loc_msgs/LaserDistance: distance and sigma [m], row of the spot [px]; NaN: no spot."""

    stamp_ns: int
    distance: float
    sigma: float
    row: float


class ScanMessage(NamedTuple):
    """A sensor_msgs/LaserScan; its stamp is the time of the first beam."""

    stamp_ns: int  #: Time of the first beam
    angle_min: float  #: Direction of the first beam [rad]
    angle_max: float  #: Direction of the last beam [rad]
    angle_increment: float  #: From a beam to the next one [rad]
    time_increment: float  #: From a beam to the next one [s]
    range_min: float  #: [m]
    range_max: float  #: [m]
    ranges: FloatArray  #: (b,) [m]

    @property
    def frame_id(self) -> str:
        """Not read: the mount is that of the swarm description."""
        return ""


class LightMessage(NamedTuple):
    """One light of swarm_loc_msgs/LightBearingArray."""

    stamp_ns: int
    frequency: float
    bearing: float
    sigma: float


def decode_laser(data: bytes) -> LaserMessage:
    """Read a swarm_loc_msgs/LaserDistance.

    Raises:
        CdrError: The bytes are not one.
    """
    message = decode(data, LASER)
    return LaserMessage(nanoseconds(message.header.stamp), message.distance, message.sigma, message.v_px)


def decode_scan(data: bytes) -> ScanMessage:
    """Read a sensor_msgs/LaserScan.

    Raises:
        CdrError: The bytes are not one.
    """
    message = decode(data, LASER_SCAN)
    numbers = {name: float(getattr(message, name)) for name in ScanMessage._fields[1:-1]}
    return ScanMessage(nanoseconds(message.header.stamp), **numbers, ranges=message.ranges.astype(float))


def decode_lights(data: bytes) -> list[LightMessage]:
    """Read a swarm_loc_msgs/LightBearingArray; lights with non-finite numbers are skipped.

    Raises:
        CdrError: The bytes are not one.
    """
    message = decode(data, LIGHTS)
    lights, stamp_ns = message.lights, nanoseconds(message.header.stamp)
    columns = lights["frequency"], lights["bearing"], np.sqrt(np.maximum(0.0, lights["covariance"][:, 0]))
    is_finite = np.isfinite(columns).all(axis=0)
    rows = zip(*(column[is_finite].tolist() for column in columns), strict=True)
    return [LightMessage(stamp_ns, *row) for row in rows]


def led_frequencies(entries: Collection[str], robots: Collection[str]) -> dict[str, float]:
    """Robot -> frequency of its LEDs [Hz].

    Raises:
        ParameterError: An entry is not a robot's name, '=' and a number above 0.
    """
    found: dict[str, float] = {}
    for entry in entries:
        name, _, value = entry.partition("=")
        try:
            frequency = float(value)
        except ValueError:
            frequency = 0.0
        if name not in robots or not 0.0 < frequency < 1e6:
            raise ParameterError(
                f"parameter led_frequencies: '{entry}' must be the name of a robot that maps, '=' and a"
                " frequency in (0, 1e6) Hz."
            )
        found[name] = frequency
    return found
