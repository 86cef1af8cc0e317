"""Newest measurement of each pair of robots, with its verdict and NIS."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import SWARM_SIGHTINGS, CdrError, decode, encode, nanoseconds
from swarm_loc_estimator.filter.measurements import Measurements, Verdict, select

RECENT_NS = 2_000_000_000  # Maximum age of reported measurements


class Recent(NamedTuple):
    """Recent measurements with their verdicts."""

    measurements: Measurements  # (m,) sorted by stamp
    verdicts: NDArray[np.uint8]  # (m,) of `Verdict`
    nis: FloatArray  # (m,) normalized innovation squared


class Sightings(NamedTuple):
    """One row per pair (M,), sorted by observer and target."""

    observer: NDArray[np.int32]  # Index of the observing robot; -1: absolute fix
    target: NDArray[np.int32]  # Index of the observed robot; below 0: landmark -1 - target
    verdict: NDArray[np.uint8]  # Of `Verdict`
    nis: NDArray[np.float32]  # Normalized innovation squared; NaN if not evaluated
    age_s: NDArray[np.float32]  # Time since the measurement [s]


def newest_sightings(recent: Recent, now_ns: int) -> Sightings:
    """Newest measurement of each pair within the last two seconds.

    Args:
        recent: Measurements sorted by stamp.
        now_ns: The current instant.
    """
    rows, verdicts, nis = recent
    first = int(np.searchsorted(rows.stamp_ns, now_ns - RECENT_NS))
    rows, verdicts, nis = select(rows, slice(first, None)), verdicts[first:], nis[first:]
    robot, landmark = rows.target, rows.landmark
    target = np.where(landmark >= 0, -1 - landmark, robot)
    observer = rows.observer
    shown = verdicts <= Verdict.NOT_LOCALIZED
    chosen = np.flatnonzero(shown & ((landmark >= 0) | (robot >= 0)))[::-1]
    # np.unique keeps the first of equal keys, which is the newest in reversed order
    _, places = np.unique((observer[chosen] << 32) + target[chosen], return_index=True)
    kept = chosen[places]
    computed = np.isin(verdicts[kept], (Verdict.USED, Verdict.GATED))
    return Sightings(
        observer[kept].astype(np.int32),
        target[kept].astype(np.int32),
        verdicts[kept].astype(np.uint8),
        np.where(computed, nis[kept], np.nan).astype(np.float32),
        ((now_ns - rows.stamp_ns[kept]) * 1e-9).astype(np.float32),
    )


def encode_sightings(frame_id: str, stamp_ns: int, sightings: Sightings) -> bytes:
    """Serialize one swarm_loc_msgs/SwarmSightings."""
    header = {"stamp": stamp_ns, "frame_id": frame_id}
    return encode({"header": header, **sightings._asdict()}, SWARM_SIGHTINGS)


def decode_sightings(data: bytes) -> tuple[int, Sightings]:
    """Stamp [ns] and columns of a serialized SwarmSightings.

    Raises CdrError if the message is incomplete, or its columns differ in length.
    """
    message = decode(data, SWARM_SIGHTINGS)
    header, *columns = vars(message).values()
    if len({len(column) for column in columns}) != 1:
        raise CdrError("the columns of the sightings differ in length.")
    return nanoseconds(header.stamp), Sightings(*columns)
