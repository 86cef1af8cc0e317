"""Encode plain little-endian CDR, the serialization of ROS 2 messages."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import ENCAPSULATION

Bytes = NDArray[np.uint8]

STAMP_SIZE = 8
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_NANOSECONDS = 1_000_000_000


class CdrWriter:
    """One message, field by field; numbers that are not known yet are zeros whose offsets are told."""

    def __init__(self) -> None:
        self._data = bytearray(_LITTLE_ENDIAN)

    @classmethod
    def with_header(cls, frame_id: str, stamp_ns: int = 0) -> Self:
        """A message that begins with a std_msgs/Header."""
        writer = cls()
        writer.raw(4, stamp_bytes(np.array([stamp_ns])).tobytes())
        writer.text(frame_id)
        return writer

    def raw(self, alignment: int, data: bytes) -> int:
        """Add bytes behind the padding that their first number needs; returns their offset."""
        self._data += bytes(-(len(self._data) - ENCAPSULATION) % alignment)
        offset = len(self._data)
        self._data += data
        return offset

    def text(self, value: str) -> None:
        """Add a string."""
        data = value.encode() + b"\x00"
        self.count(len(data))
        self._data += data

    def count(self, value: int) -> None:
        """Add a uint32, such as the length of a sequence."""
        self.raw(4, struct.pack("<I", value))

    def stamp(self) -> int:
        """Add a builtin_interfaces/Time; returns its offset."""
        return self.raw(4, bytes(STAMP_SIZE))

    def doubles(self, count: int) -> int:
        """Add float64 numbers; returns the offset of the first."""
        return self.raw(8, bytes(8 * count))

    def message(self) -> bytes:
        """The message."""
        return bytes(self._data)

    def messages(self, stamp_ns: IntArray, numbers: FloatArray) -> list[bytes]:
        """Messages (N,) with headers, stamped (N,), that differ in their last doubles (N, k)."""
        start = self.doubles(numbers.shape[1])
        rows = np.tile(np.frombuffer(self._data, np.uint8), (len(stamp_ns), 1))
        rows[:, ENCAPSULATION : ENCAPSULATION + STAMP_SIZE] = stamp_bytes(stamp_ns)
        rows[:, start:] = double_bytes(numbers)
        length, joined = rows.shape[1], rows.tobytes()
        return [joined[begin : begin + length] for begin in range(0, len(joined), length)]


def stamp_bytes(stamp_ns: IntArray) -> Bytes:
    """(n, 8) bytes of stamps (n,), as builtin_interfaces/Time has them."""
    stamp = np.empty((len(stamp_ns), 2), "<i4")
    stamp[:, 0], stamp[:, 1] = np.divmod(stamp_ns, _NANOSECONDS)
    raw: Bytes = stamp.view(np.uint8)
    return raw


def double_bytes(numbers: FloatArray) -> Bytes:
    """(n, 8 k) bytes of numbers (n, k)."""
    raw: Bytes = np.ascontiguousarray(numbers, dtype="<f8").view(np.uint8)
    return raw
