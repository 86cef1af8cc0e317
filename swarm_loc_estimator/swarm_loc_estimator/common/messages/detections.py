"""Detections, brightness matrices and messages with the readings of many robots, all of swarm_loc_msgs."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages import cdr
from swarm_loc_estimator.common.messages.cdr import CdrError, decode, encode

DETECTION_DTYPE = cdr.renamed(
    cdr.row_dtype(cdr.DETECTION),
    id=(),
    family=(),
    content=(),
    id_margin=(),
    corners_px=(4, 2),
    position=(3,),
    orientation=(4,),
    covariance=(6, 6),
    alternative_position=(3,),
    alternative_orientation=(4,),
    alternative_ratio=(),
)
"""A MarkerDetection in little-endian CDR, 4 bytes after a multiple of 8, else see `DETECTION_GAP`."""
DETECTION_GAP = DETECTION_DTYPE.fields["corners_px"][1]  # type: ignore[index]  # it has fields
"""A detection that starts at a multiple of 8 has 4 bytes of padding here, before its first double."""

ANONYMOUS_DTYPE = cdr.renamed(
    cdr.row_dtype(cdr.ANONYMOUS_DETECTION), x=(), y=(), theta=(), covariance=(3, 3), u_px=(), v_px=()
)
"""A swarm_loc_msgs/AnonymousDetection as it lies in little-endian CDR, at a multiple of 8 bytes."""


class DetectionArrayMessage(NamedTuple):
    """Detections of dtype `DETECTION_DTYPE` or, of an overhead camera, `ANONYMOUS_DTYPE`."""

    stamp_ns: int
    frame_id: str
    detections: cdr.Rows


class SharedMessage(NamedTuple):
    """Readings (n,) of many robots."""

    stamp_ns: int  # When the message was sent
    frame_id: str  # Frame of all readings
    swarm: int  # Which swarm's indices these are, see `swarm_key`
    robot: IntArray  # (n,) indices as sent
    # (n,) when each was acquired; -1 where the stamp has a second and more of nanoseconds
    reading_ns: IntArray
    columns: tuple[NDArray[Any], ...]  # (n, k) numbers of each, or (n,) detections


def decode_detections(data: bytes, message_type: str = cdr.DETECTIONS) -> DetectionArrayMessage:
    """Read a MarkerDetectionArray, or AnonymousDetectionArray; raises CdrError unless it is a whole one."""
    message = decode(data, message_type)
    rows = message.detections.view(DETECTION_DTYPE if message_type == cdr.DETECTIONS else ANONYMOUS_DTYPE)
    return DetectionArrayMessage(cdr.nanoseconds(message.header.stamp), message.header.frame_id, rows)


def encode_detections(frame_id: str, stamp_ns: int, detections: cdr.Rows) -> bytes:
    """Serialize one such message from (n,) detections, whose dtype decides of which type."""
    header = {"stamp": stamp_ns, "frame_id": frame_id}
    message_type = cdr.ANONYMOUS_DETECTIONS if detections.dtype == ANONYMOUS_DTYPE else cdr.DETECTIONS
    return encode({"header": header, "detections": detections}, message_type)


def blank_detections(ids: ArrayLike, content: int) -> cdr.Rows:
    """Detections (n,) of markers by ids (n,), at the origin, without a covariance."""
    rows = np.zeros(np.shape(ids), DETECTION_DTYPE)
    rows["id"], rows["content"] = ids, content
    rows["id_margin"] = rows["corners_px"] = rows["alternative_ratio"] = np.nan
    rows["covariance"][:, 0, 0] = -1.0
    rows["alternative_orientation"][:, 3] = 1.0
    return rows


def encode_identities(
    frame_id: str, stamp_ns: int, names: Sequence[str], place: IntArray, probability: FloatArray
) -> bytes:
    """A RobotIdentities: which detection each of N robots is (N,), -1: not known, and how probably (N,)."""
    columns = zip(names, place.tolist(), probability.tolist(), strict=True)
    identities = [{"name": name, "detection": which, "probability": sure} for name, which, sure in columns]
    header = {"stamp": stamp_ns, "frame_id": frame_id}
    return encode({"header": header, "identities": identities}, cdr.ROBOT_IDENTITIES)


def encode_brightness(
    frame_id: str,
    stamp_ns: int,
    pair: tuple[int, int],
    readings: NDArray[Any],
    power: int = 0,
    saturation: int = 0,
) -> bytes:
    """Serialize one swarm_loc_msgs/BrightnessMatrix of a receiver, whose base_link is `frame_id`.

    `stamp_ns` is the middle of the exchange, `pair` the ids of receiver and transmitter, `readings` (n, n)
    [count] by sensor and emitter, `power` the index of the power mode; from `saturation` [count] on a sensor
    is saturated, 0: not known.
    """
    message = {
        "header": {"stamp": stamp_ns, "frame_id": frame_id},
        "receiver": pair[0],
        "transmitter": pair[1],
        "n": len(readings),
        "readings": readings,
        "power": power,
        "saturation": saturation,
    }
    return encode(message, cdr.BRIGHTNESS)


def swarm_key(names: Iterable[str]) -> int:
    """The number by which swarms differ whose robots are not the same, or not in the same order."""
    return zlib.crc32("".join(f"{name}\n" for name in names).encode())


def decode_shared_numbers(data: bytes, widths: tuple[int, ...]) -> SharedMessage:
    """Read a SwarmOdometry or SwarmFixes, with `widths` numbers of a reading in each column.

    Raises CdrError if the bytes are not one whole message, or its columns differ in length.
    """
    message = decode(data, cdr.SWARM_ODOMETRY if len(widths) == 1 else cdr.SWARM_FIXES)
    columns = [message.pose] if len(widths) == 1 else [message.pose, message.covariance]
    for column, width in zip(columns, widths, strict=True):
        if column.size != width * message.robot.size:
            raise CdrError(f"a column has {column.size} numbers in place of {width * message.robot.size}.")
    return _shared(message, *(one.reshape(-1, w).copy() for one, w in zip(columns, widths, strict=True)))


def decode_shared_detections(data: bytes) -> SharedMessage:
    """Read a SwarmDetections; raises CdrError unless it is whole, with columns of one length."""
    message = decode(data, cdr.SWARM_DETECTIONS)
    if message.detections.size != message.robot.size:
        raise CdrError(f"a column has {message.detections.size} detections in place of {message.robot.size}.")
    return _shared(message, message.detections.view(DETECTION_DTYPE))


def _shared(message: Any, *columns: NDArray[Any]) -> SharedMessage:
    stamps = message.stamp
    if stamps.size != message.robot.size:
        raise CdrError("there are not as many stamps as robots.")
    reading_ns = stamps["sec"].astype(np.int64) * cdr.SECOND_NS + stamps["nanosec"]
    reading_ns[stamps["nanosec"] >= cdr.SECOND_NS] = -1
    robot = message.robot.astype(np.int64)
    stamp_ns, frame_id = cdr.nanoseconds(message.header.stamp), message.header.frame_id
    return SharedMessage(stamp_ns, frame_id, message.swarm, robot, reading_ns, columns)
