"""Events of event cameras in the `mono` encoding of event_camera_msgs: eight bytes each.

Bits 0-31 time after the packet's stamp [ns], 32-47 column, 48-62 row [px], 63 became brighter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, IntArray

ENCODING = "mono"
EVENT_BYTES = 8
MAX_SPAN_NS = (1 << 32) - 1  # A packet may not last longer


class EventError(ValueError):
    """A packet of events that cannot be decoded; the message says why."""


class Events(NamedTuple):
    """Events in the order of their time."""

    x: NDArray[np.uint16]  # (N,) columns [px]
    y: NDArray[np.uint16]  # (N,) rows [px]
    is_on: BoolArray  # (N,) whether the pixel became brighter
    time_ns: IntArray  # (N,) after the packet's stamp [ns]


def encode_events(events: Events) -> bytes:
    """The bytes of a packet; times must lie in [0, MAX_SPAN_NS]."""
    words = events.time_ns.astype(np.uint64)
    words |= events.x.astype(np.uint64) << np.uint64(32)
    words |= events.y.astype(np.uint64) << np.uint64(48)
    words |= events.is_on.astype(np.uint64) << np.uint64(63)
    return words.astype("<u8", copy=False).tobytes()


def decode_events(
    data: bytes | bytearray | memoryview, encoding: str, size: tuple[int, int], *, is_bigendian: bool = False
) -> Events:
    """The events of a packet in anything that has a buffer; `size` is width and height of the sensor [px].

    Raises EventError: another encoding than `mono`, a cut event, one outside of the sensor, decreasing times.
    """
    if encoding != ENCODING:
        raise EventError(f"encoding '{encoding[:40]}' is not {ENCODING}")
    if len(data) % EVENT_BYTES:
        raise EventError("the last event is cut")
    words = np.frombuffer(data, ">u8" if is_bigendian else "<u8")
    high = (words >> np.uint64(32)).astype(np.uint32)
    x, y = (high & 0xFFFF).astype(np.uint16), ((high >> 16) & 0x7FFF).astype(np.uint16)
    time_ns = (words & np.uint64(0xFFFFFFFF)).astype(np.int64)
    if len(words) and (int(x.max()) >= size[0] or int(y.max()) >= size[1]):
        raise EventError("an event lies outside of the sensor")
    if (time_ns[1:] < time_ns[:-1]).any():
        raise EventError("times step back")
    return Events(x, y, (high >> 31).astype(bool), time_ns)
