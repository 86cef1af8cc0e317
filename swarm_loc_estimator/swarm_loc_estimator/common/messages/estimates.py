"""Read what the estimator publishes: swarm/poses and swarm/sightings, straight to columns."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import ENCAPSULATION, CdrError
from swarm_loc_estimator.common.messages.cdr_writer import CdrWriter
from swarm_loc_estimator.timeline.sightings import Sightings

_DOUBLES = 3 + 9 + 1
_NANOSECONDS = 1_000_000_000


class EstimateMessage(NamedTuple):
    """One swarm/poses.

    Attributes:
        stamp_ns: The instant.
        frame_id: Frame of the poses.
        names: N robots.
        pose: (N, 3) x [m], y [m], theta [rad]; NaN: not located.
        covariance: (N, 3, 3) likewise.
        fix_age_s: (N,) [s]; -1: never.
        status: (N,) of `Status`.
    """

    stamp_ns: int
    frame_id: str
    names: tuple[str, ...]
    pose: FloatArray
    covariance: FloatArray
    fix_age_s: FloatArray
    status: NDArray[np.uint8]


class _Layout(NamedTuple):
    """Where the numbers of a message stand, as long as its texts are the same."""

    texts: NDArray[np.intp]
    said: NDArray[np.uint8]
    numbers: NDArray[np.intp]
    status: NDArray[np.intp]
    frame_id: str
    names: tuple[str, ...]


class SwarmPosesReader:
    """Reads serialized SwarmPoses; names are walked through only when they change."""

    def __init__(self) -> None:
        self._layouts: dict[int, _Layout] = {}

    def read(self, data: bytes) -> EstimateMessage:
        """The columns of a message.

        Raises:
            CdrError: It is no whole SwarmPoses of little-endian CDR.
        """
        raw = np.frombuffer(data, dtype=np.uint8)
        layout = self._layouts.get(len(data))
        if layout is None or not np.array_equal(raw[layout.texts], layout.said):
            self._layouts = {len(data): (layout := _laid_out(data))}
        seconds, nanoseconds = struct.unpack_from("<iI", data, ENCAPSULATION)
        numbers = raw[layout.numbers].view("<f8").reshape(-1, _DOUBLES)
        return EstimateMessage(
            seconds * _NANOSECONDS + nanoseconds,
            layout.frame_id,
            layout.names,
            numbers[:, :3],
            numbers[:, 3:12].reshape(-1, 3, 3),
            numbers[:, 12],
            raw[layout.status],
        )


def _laid_out(data: bytes) -> _Layout:
    """Walk through a message."""
    walk = _Walk(data)
    walk.take(4, 8)
    frame_id = walk.text()
    names, numbers, status = [], [], []
    for _ in range(walk.count()):
        names.append(walk.text())
        numbers.append(walk.take(8, 8 * _DOUBLES))
        status.append(walk.take(1, 1))
    texts = np.array(walk.texts, dtype=np.intp)
    places = np.array(numbers, dtype=np.intp).reshape(-1, 1) + np.arange(8 * _DOUBLES)
    said = np.frombuffer(data, dtype=np.uint8)[texts]
    return _Layout(texts, said, places, np.array(status, dtype=np.intp), frame_id, tuple(names))


class _Walk:
    """Field after field of a message.

    Args:
        data: The message.

    Attributes:
        texts: Offsets of all bytes that stand for texts and lengths.
    """

    def __init__(self, data: bytes) -> None:
        if data[:2] != b"\x00\x01":
            raise CdrError("The message is no plain little-endian CDR.")
        self._data = data
        self._at = ENCAPSULATION
        self.texts: list[int] = [*range(ENCAPSULATION)]

    def take(self, alignment: int, size: int) -> int:
        """Offset of the next field, which is gone behind."""
        begin = self._at + -(self._at - ENCAPSULATION) % alignment
        if begin + size > len(self._data):
            raise CdrError("The message ends too early.")
        self._at = begin + size
        return begin

    def count(self) -> int:
        """A uint32."""
        begin = self.take(4, 4)
        self.texts += range(begin, self._at)
        value: int = struct.unpack_from("<I", self._data, begin)[0]
        if value > len(self._data):
            raise CdrError("A length is longer than the message.")
        return value

    def text(self) -> str:
        """A string."""
        begin = self.take(1, self.count())
        self.texts += range(begin, self._at)
        return self._data[begin : max(begin, self._at - 1)].decode(errors="replace")


def encode_sightings(frame_id: str, stamp_ns: int, sightings: Sightings) -> bytes:
    """Serialize one swarm_loc_msgs/SwarmSightings."""
    writer = CdrWriter.with_header(frame_id, stamp_ns)
    for column in sightings:
        writer.count(len(column))
        writer.raw(column.itemsize, column.tobytes())
    return writer.message()


def decode_sightings(data: bytes) -> tuple[int, Sightings]:
    """Stamp [ns] and columns of a serialized SwarmSightings.

    Raises:
        CdrError: It is no whole one, or its columns differ in length.
    """
    walk = _Walk(data)
    seconds, nanoseconds = struct.unpack_from("<iI", data, walk.take(4, 8))
    walk.text()
    columns = []
    for kind in ("<i4", "<i4", "<u1", "<f4", "<f4"):
        size, count = np.dtype(kind).itemsize, walk.count()
        columns.append(np.frombuffer(data, kind, count, walk.take(size if count else 1, size * count)))
    if len({len(column) for column in columns}) != 1:
        raise CdrError("The columns of the sightings differ in length.")
    return seconds * _NANOSECONDS + nanoseconds, Sightings(*columns)
