"""Messages of the mapper: maps, laser distances and frequencies of lights."""

from __future__ import annotations

import math
import struct
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.messages.cdr import ENCAPSULATION, MAX_PADDING, CdrError
from swarm_loc_estimator.common.messages.planar import yaw_of
from swarm_loc_estimator.common.messages.typestore import MESSAGE_PACKAGE, typestore
from swarm_loc_estimator.common.parameters import ParameterError

OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
MAX_CELLS = 4_000_000
"""A larger map is none of a swarm's."""
_NANOSECONDS = 1_000_000_000
_SIZE = struct.Struct("<fII")
_ORIGIN = struct.Struct("<7d")


class GridMessage(NamedTuple):
    """A map.

    Attributes:
        stamp_ns: When it was so.
        frame_id: Frame of the origin.
        resolution: Side of a cell [m].
        origin: x [m], y [m], yaw [rad] of the outer corner of the first cell.
        cells: (height, width), x along the rows: -1 unknown, else occupied by 0 to 100 %.
    """

    stamp_ns: int
    frame_id: str
    resolution: float
    origin: tuple[float, float, float]
    cells: NDArray[np.int8]


def decode_occupancy_grid(data: bytes) -> GridMessage:
    """Read a nav_msgs/OccupancyGrid of little-endian CDR.

    Raises:
        CdrError: The bytes are not one, or its numbers cannot be those of a map.
    """
    try:
        return _decode_grid(data)
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise CdrError(f"no OccupancyGrid: {error}.") from error


def _decode_grid(data: bytes) -> GridMessage:
    if bytes(data[:2]) != b"\x00\x01":
        raise CdrError("encapsulation is not plain little-endian CDR.")
    seconds, nanoseconds, length = struct.unpack_from("<iII", data, ENCAPSULATION)
    begin = ENCAPSULATION + 12
    frame_id = bytes(data[begin : begin + length]).rstrip(b"\x00").decode()
    at = _aligned(begin + length, 4) + 8  # behind the time at which the map was loaded
    resolution, width, height = _SIZE.unpack_from(data, at)
    at = _aligned(at + _SIZE.size, 8)
    x, y, _, qx, qy, qz, qw = _ORIGIN.unpack_from(data, at)
    at += _ORIGIN.size
    (count,) = struct.unpack_from("<I", data, at)
    origin = (x, y, yaw_of(qx, qy, qz, qw))
    if not 0 < count <= MAX_CELLS or count != width * height:
        raise CdrError(f"a map of {width} x {height} cells has {count} of them.")
    if not (resolution > 0.0 and all(map(math.isfinite, (resolution, *origin)))):
        raise CdrError("the place of a map is not finite.")
    if not 0 <= len(data) - (at + 4 + count) <= MAX_PADDING:
        raise CdrError(f"{len(data)} bytes are not those of a map of {count} cells.")
    cells = np.frombuffer(data, np.int8, count, at + 4).reshape(height, width)
    return GridMessage(seconds * _NANOSECONDS + nanoseconds, frame_id, resolution, origin, cells)


def _aligned(offset: int, alignment: int) -> int:
    """The next offset at which a number of so many bytes may stand."""
    return offset + -(offset - ENCAPSULATION) % alignment


LASER = f"{MESSAGE_PACKAGE}/msg/LaserDistance"
LIGHTS = f"{MESSAGE_PACKAGE}/msg/LightBearingArray"


class BadMessageError(ValueError):
    """Bytes that are no whole message of the type."""


class LaserMessage(NamedTuple):
    """A swarm_loc_msgs/LaserDistance: distance and sigma [m], row of the spot [px]; NaN: nothing was seen."""

    stamp_ns: int
    distance: float
    sigma: float
    row: float


class LightMessage(NamedTuple):
    """One light of swarm_loc_msgs/LightBearingArray."""

    stamp_ns: int
    frequency: float
    bearing: float
    sigma: float


def decode_laser(data: bytes) -> LaserMessage:
    """Read a swarm_loc_msgs/LaserDistance.

    Raises:
        BadMessageError: The bytes are not one.
    """
    message = _decoded(data, LASER)
    return LaserMessage(
        _stamp_ns(message), float(message.distance), float(message.sigma), float(message.v_px)
    )


def decode_lights(data: bytes) -> list[LightMessage]:
    """Read a swarm_loc_msgs/LightBearingArray: those lights whose numbers are finite.

    Raises:
        BadMessageError: The bytes are not one.
    """
    message = _decoded(data, LIGHTS)
    stamp_ns = _stamp_ns(message)
    lights = [
        LightMessage(
            stamp_ns, float(one.frequency), float(one.bearing), math.sqrt(max(0.0, one.covariance[0]))
        )
        for one in message.lights
    ]
    return [one for one in lights if all(math.isfinite(value) for value in one)]


def _decoded(data: bytes, message_type: str) -> Any:
    try:
        return typestore().deserialize_cdr(data, message_type)
    except Exception as error:  # the reader raises whatever its generated code meets
        raise BadMessageError(f"no {message_type}: {error}") from error


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


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
