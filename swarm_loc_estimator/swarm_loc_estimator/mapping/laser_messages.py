"""Read messages of laser distances and lights from their bytes, as a bag and a raw subscription have them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from swarm_loc_estimator.common.messages.typestore import MESSAGE_PACKAGE, typestore

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
