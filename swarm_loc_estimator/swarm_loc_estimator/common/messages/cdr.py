"""Decode plain CDR, the serialization of ROS 2 messages, straight to numbers.

A subscription with `raw=True` and a bag both deliver the serialized message. Reading the few numbers that
matter straight from it costs a few microseconds, a tenth of building the message object. Bytes that are not
a whole message of the type raise `CdrError`.
"""

from __future__ import annotations

import math
import struct
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.common.messages.planar import PLANE, yaw_of

Array = npt.NDArray[np.float64]

ENCAPSULATION = 4
"""Bytes before the payload; alignment counts from behind them."""

MAX_PADDING = 7
"""Bytes that may come behind a message."""
SECOND_NS = 1_000_000_000


class Stamp(Protocol):
    """A builtin_interfaces/Time, whatever has built it."""

    @property
    def sec(self) -> int:
        """Whole seconds, which may be negative."""

    @property
    def nanosec(self) -> int:
        """The rest [ns]."""


def nanoseconds(stamp: Stamp) -> int:
    """A stamp [ns]; it may lie before zero, which `rclpy.time.Time` refuses."""
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


class CdrError(ValueError):
    """Bytes that are not a whole message of the expected type; the message is one sentence."""


class OdometryMessage(NamedTuple):
    """What the estimator reads of nav_msgs/Odometry.

    Attributes:
        stamp_ns: Acquisition time.
        frame_id: Frame of the pose.
        child_frame_id: Frame of the twist.
        pose: (x [m], y [m], yaw [rad]); yaw is NaN when the quaternion is zero.
        twist: (vx [m/s], vy [m/s], yaw rate [rad/s]).
        covariance: 3x3, of x, y, yaw, as published.
    """

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    pose: tuple[float, float, float]
    twist: tuple[float, float, float]
    covariance: Array


class PoseMessage(NamedTuple):
    """What evaluation reads of geometry_msgs/PoseStamped: pose is (x [m], y [m], yaw [rad])."""

    stamp_ns: int
    frame_id: str
    pose: tuple[float, float, float]


class DetectionArrayMessage(NamedTuple):
    """swarm_loc_msgs/MarkerDetectionArray: `detections` has dtype `DETECTION_DTYPE`."""

    stamp_ns: int
    frame_id: str
    detections: npt.NDArray[np.void]


class FixMessage(NamedTuple):
    """What the estimator reads of geometry_msgs/PoseWithCovarianceStamped.

    Attributes:
        stamp_ns: When the robot was there.
        frame_id: Frame of the pose.
        pose: (x [m], y [m], yaw [rad]); yaw is NaN when the quaternion is zero.
        covariance: 3x3, of x, y, yaw, as published.
    """

    stamp_ns: int
    frame_id: str
    pose: tuple[float, float, float]
    covariance: Array


class BrightnessMessage(NamedTuple):
    """swarm_loc_msgs/BrightnessMatrix, see there; `readings` (k,) need not have the promised size."""

    stamp_ns: int
    frame_id: str
    receiver: int
    transmitter: int
    n: int
    readings: npt.NDArray[np.int32]
    power: int
    saturation: int


def _anonymous_dtype(order: str) -> np.dtype[np.void]:
    """An anonymous detection's bytes; a multiple of 8, and so the same wherever it stands."""
    numbers = [(name, f"{order}f8") for name in ("x", "y", "theta")]
    pixels = [(name, f"{order}f4") for name in ("u_px", "v_px")]
    return np.dtype([*numbers, ("covariance", f"{order}f8", (3, 3)), *pixels])


ANONYMOUS_DTYPE = _anonymous_dtype("<")
"""A swarm_loc_msgs/AnonymousDetection as it lies in little-endian CDR, at a multiple of 8 bytes."""


class AnonymousMessage(NamedTuple):
    """swarm_loc_msgs/AnonymousDetectionArray: `detections` has dtype `ANONYMOUS_DTYPE`."""

    stamp_ns: int
    frame_id: str
    detections: npt.NDArray[np.void]


_DETECTION_FIELDS: tuple[tuple[str, str, tuple[int, ...]], ...] = (
    ("id", "u4", ()),
    ("family", "u1", ()),
    ("content", "u1", ()),
    ("id_margin", "f4", ()),
    ("corners_px", "f8", (4, 2)),
    ("position", "f8", (3,)),
    ("orientation", "f8", (4,)),
    ("covariance", "f8", (6, 6)),
    ("alternative_position", "f8", (3,)),
    ("alternative_orientation", "f8", (4,)),
    ("alternative_ratio", "f4", ()),
)


def _detection_dtype(order: str) -> np.dtype[np.void]:
    """One detection's bytes when it starts 4 bytes behind a multiple of 8.

    All but the first of an array do, since each ends there.
    """
    offset = 4
    offsets = []
    for _, kind, shape in _DETECTION_FIELDS:
        size = int(kind[1])
        offset += -offset % size
        offsets.append(offset - 4)
        offset += size * math.prod(shape)
    names = [name for name, _, _ in _DETECTION_FIELDS]
    formats = [(order + kind, shape) for _, kind, shape in _DETECTION_FIELDS]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": offset - 4})


DETECTION_DTYPE = _detection_dtype("<")
"""One detection as it lies in little-endian CDR; quaternions are x, y, z, w."""

DETECTION_PADDING = slice(6, 8)
"""Bytes of `DETECTION_DTYPE` that mean nothing."""

DETECTION_GAP = 12
"""A detection that starts at a multiple of 8 has 4 bytes of padding here, before its first double."""


class Layout:
    """Everything that depends on the byte order."""

    def __init__(self, order: str) -> None:
        self.header = struct.Struct(order + "iII")
        self.count = struct.Struct(order + "I")
        self.pair = struct.Struct(order + "IIB")
        self.reading = np.dtype(order + "i4")
        self.power = struct.Struct(order + "B3xi")
        self.pose = struct.Struct(order + "7d")
        self.twist = struct.Struct(order + "6d")
        self.double = np.dtype(order + "f8")
        self.detection = _detection_dtype(order)
        self.anonymous = _anonymous_dtype(order)


_LAYOUTS = {b"\x00\x00": Layout(">"), b"\x00\x01": Layout("<")}
_ODOMETRY_DOUBLES = 7 + 36 + 6 + 36


@lru_cache(maxsize=4096)
def _text(raw: bytes) -> str:
    """The characters of a string field, its terminating zero included in `raw`."""
    if raw and raw[-1] != 0:
        raise CdrError("a string is not terminated.")
    try:
        return raw[:-1].decode()
    except UnicodeDecodeError:
        raise CdrError("a string is not UTF-8.") from None


def layout_of(data: bytes) -> Layout:
    """The byte order's layout, from the encapsulation header."""
    layout = _LAYOUTS.get(bytes(data[:2]))
    if layout is None or len(data) < ENCAPSULATION:
        raise CdrError(f"encapsulation {bytes(data[:ENCAPSULATION]).hex() or 'missing'} is not plain CDR.")
    return layout


def _string(data: bytes, layout: Layout, offset: int) -> tuple[str, int]:
    """A string field at or after `offset`, and the offset behind it."""
    offset += -offset % 4
    begin = offset + 4
    if begin > len(data):
        raise CdrError(f"cut off after {len(data)} bytes.")
    end = begin + int(layout.count.unpack_from(data, offset)[0])
    if end > len(data):
        raise CdrError(f"cut off after {len(data)} bytes.")
    return _text(bytes(data[begin:end])), end


def read_header(data: bytes, layout: Layout) -> tuple[int, str, int]:
    """Stamp [ns], frame and the offset behind a std_msgs/Header."""
    if len(data) < ENCAPSULATION + 12:
        raise CdrError(f"cut off after {len(data)} bytes.")
    sec, nanosec, length = layout.header.unpack_from(data, ENCAPSULATION)
    if nanosec >= SECOND_NS:
        raise CdrError(f"stamp has {nanosec} nanoseconds, more than a second.")
    end = ENCAPSULATION + 12 + length
    if end > len(data):
        raise CdrError(f"cut off after {len(data)} bytes.")
    return sec * SECOND_NS + nanosec, _text(bytes(data[ENCAPSULATION + 12 : end])), end


def check_end(data: bytes, end: int) -> None:
    """Refuse a message that is too short for its type, or too long to be of it."""
    if len(data) < end:
        raise CdrError(f"cut off after {len(data)} of {end} bytes.")
    if len(data) > end + MAX_PADDING:
        raise CdrError(f"{len(data) - end} bytes more than the message has.")


def _pose2(x: float, y: float, qx: float, qy: float, qz: float, qw: float) -> tuple[float, float, float]:
    """Planar pose; the quaternion need not be normalised."""
    return x, y, yaw_of(qx, qy, qz, qw)


def _planar_covariance(data: bytes, layout: Layout, offset: int) -> Array:
    """3x3 over x, y, yaw of the 6x6 at an offset."""
    whole = np.frombuffer(data, layout.double, 36, offset)
    return whole.reshape(6, 6)[PLANE].astype(np.float64, copy=False)


def decode_odometry(data: bytes) -> OdometryMessage:
    """Read a nav_msgs/Odometry.

    Args:
        data: The serialized message with its encapsulation header.

    Raises:
        CdrError: The bytes are not one whole message.
    """
    layout = layout_of(data)
    stamp_ns, frame_id, offset = read_header(data, layout)
    child_frame_id, offset = _string(data, layout, offset)
    offset += -(offset - ENCAPSULATION) % 8
    check_end(data, offset + 8 * _ODOMETRY_DOUBLES)
    x, y, _, qx, qy, qz, qw = layout.pose.unpack_from(data, offset)
    vx, vy, _, _, _, rate = layout.twist.unpack_from(data, offset + 8 * 43)
    covariance = _planar_covariance(data, layout, offset + 56)
    return OdometryMessage(
        stamp_ns, frame_id, child_frame_id, _pose2(x, y, qx, qy, qz, qw), (vx, vy, rate), covariance
    )


def decode_pose_stamped(data: bytes) -> PoseMessage:
    """Read a geometry_msgs/PoseStamped.

    Raises:
        CdrError: The bytes are not one whole message.
    """
    layout = layout_of(data)
    stamp_ns, frame_id, offset = read_header(data, layout)
    offset += -(offset - ENCAPSULATION) % 8
    check_end(data, offset + 56)
    x, y, _, qx, qy, qz, qw = layout.pose.unpack_from(data, offset)
    return PoseMessage(stamp_ns, frame_id, _pose2(x, y, qx, qy, qz, qw))


def decode_fix(data: bytes) -> FixMessage:
    """Read a geometry_msgs/PoseWithCovarianceStamped.

    Raises:
        CdrError: The bytes are not one whole message.
    """
    layout = layout_of(data)
    stamp_ns, frame_id, offset = read_header(data, layout)
    offset += -(offset - ENCAPSULATION) % 8
    check_end(data, offset + 8 * (7 + 36))
    x, y, _, qx, qy, qz, qw = layout.pose.unpack_from(data, offset)
    covariance = _planar_covariance(data, layout, offset + 56)
    return FixMessage(stamp_ns, frame_id, _pose2(x, y, qx, qy, qz, qw), covariance)


def decode_brightness(data: bytes) -> BrightnessMessage:
    """Read a swarm_loc_msgs/BrightnessMatrix.

    Raises:
        CdrError: The bytes are not one whole message.
    """
    layout = layout_of(data)
    stamp_ns, frame_id, offset = read_header(data, layout)
    offset += -offset % 4
    if offset + 16 > len(data):
        raise CdrError(f"cut off after {len(data)} bytes.")
    receiver, transmitter, n = layout.pair.unpack_from(data, offset)
    (count,) = layout.count.unpack_from(data, offset + 12)
    offset += 16
    end = offset + 4 * count
    check_end(data, end + 8)
    readings = np.frombuffer(data, layout.reading, count, offset).astype(np.int32)
    power, saturation = layout.power.unpack_from(data, end)
    return BrightnessMessage(stamp_ns, frame_id, receiver, transmitter, n, readings, power, saturation)


def decode_anonymous(data: bytes) -> AnonymousMessage:
    """Read a swarm_loc_msgs/AnonymousDetectionArray.

    Raises:
        CdrError: The bytes are not one whole message.
    """
    layout = layout_of(data)
    stamp_ns, frame_id, offset = read_header(data, layout)
    offset += -offset % 4
    if offset + 4 > len(data):
        raise CdrError(f"cut off after {len(data)} bytes.")
    (count,) = layout.count.unpack_from(data, offset)
    offset += 4
    if count:
        offset += -(offset - ENCAPSULATION) % 8
    check_end(data, offset + count * ANONYMOUS_DTYPE.itemsize)
    detections = np.frombuffer(data, layout.anonymous, count, offset)
    return AnonymousMessage(stamp_ns, frame_id, detections.astype(ANONYMOUS_DTYPE))


def decode_detections(data: bytes) -> DetectionArrayMessage:
    """Read a swarm_loc_msgs/MarkerDetectionArray.

    Returns:
        Stamp, frame and a new array of `DETECTION_DTYPE`.

    Raises:
        CdrError: The bytes are not one whole message.
    """
    layout = layout_of(data)
    stamp_ns, frame_id, offset = read_header(data, layout)
    offset += -offset % 4
    if offset + 4 > len(data):
        raise CdrError(f"cut off after {len(data)} bytes.")
    (count,) = layout.count.unpack_from(data, offset)
    return DetectionArrayMessage(stamp_ns, frame_id, read_detections(data, layout, offset + 4, count))


def read_detections(data: bytes, layout: Layout, offset: int, count: int) -> npt.NDArray[np.void]:
    """The sequence's elements, without the padding that the first one may have."""
    if count == 0:
        check_end(data, offset)
        return np.empty(0, DETECTION_DTYPE)
    end = offset + count * layout.detection.itemsize
    if (offset - ENCAPSULATION) % 8 == 0:
        check_end(data, end + 4)
        packed = bytearray(data[offset : offset + DETECTION_GAP]) + data[offset + DETECTION_GAP + 4 : end + 4]
    else:
        check_end(data, end)
        packed = bytearray(data[offset:end])
    detections = np.frombuffer(packed, layout.detection)
    if layout.detection == DETECTION_DTYPE:
        return detections
    native = np.zeros(count, DETECTION_DTYPE)
    native[:] = detections
    return native
