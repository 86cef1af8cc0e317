"""Reading and writing CDR agree with the type store of `rosbags`; what is not a whole message is refused."""

import math
import struct
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import pytest
from core_messages import big_endian
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.cdr import (
    ANONYMOUS_DETECTIONS,
    DETECTIONS,
    MESSAGE_PACKAGE,
    NUMBERS,
    ODOMETRY,
    POSE_STAMPED,
    SEQUENCE,
    STANDARD,
    CdrError,
    DefinitionsNotFoundError,
    decode,
    encode,
    fields_of,
    message_folder,
)
from swarm_loc_estimator.common.messages.detections import (
    ANONYMOUS_DTYPE,
    decode_detections,
    encode_brightness,
    encode_detections,
)
from swarm_loc_estimator.common.messages.poses import (
    decode_fix,
    decode_odometry,
    decode_pose_stamped,
    encode_fix,
    encode_odometry,
    encode_pose_stamped,
)
from swarm_loc_estimator.sensors.infrared import BrightnessSensor

FINITE = st.floats(-1e6, 1e6)
ANGLE = st.floats(-3.1, 3.1)
NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=17)
STAMPS = st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9 + 999_999_999)
MAX_CUTS = 200  # Lengths at which a message is cut off; a message has up to 10 000 bytes, and 100 are drawn


def theirs(field: Any) -> tuple[str, int, bool]:
    """Type, size and whether it is an array, of a field as `rosbags` describes it."""
    kind, about = field
    if kind.name == "NAME":
        return about, 1, False
    if kind.name == "BASE":
        return NUMBERS.get(about[0], about[0]), 1, False
    (element, size) = about
    return theirs(element)[0], SEQUENCE if kind.name == "SEQUENCE" else size, True


KNOWN = [f"{MESSAGE_PACKAGE}/msg/{path.stem}" for path in sorted(message_folder().glob("*.msg"))]
KNOWN += [line.partition(": ")[0].replace("/", "/msg/") for line in STANDARD.splitlines() if ": " in line]


@pytest.mark.parametrize("message_type", KNOWN)
def test_definitions_are_those_of_ros(message_type: str) -> None:
    _, fields = typestore().fielddefs[message_type]
    assert [tuple(field) for field in fields_of(message_type)] == [(n, *theirs(one)) for n, one in fields]


def some_message(message_type: str, random: np.random.Generator) -> dict[str, Any]:

    def value(kind: str) -> Any:
        if kind == "string":
            return "é" * int(random.integers(0, 6))
        return random.integers(0, 2) if kind in NUMBERS.values() else some_message(kind, random)

    return {
        field.name: [
            value(field.type) for _ in range(field.size if field.size >= 0 else random.integers(0, 4))
        ]
        if field.is_array
        else value(field.type)
        for field in fields_of(message_type)
    }


@pytest.mark.parametrize("message_type", KNOWN)
@given(seed=st.integers(0, 2**32), little_endian=st.booleans())
def test_every_type_is_written_and_read_as_by_the_type_store(
    message_type: str, seed: int, little_endian: bool
) -> None:
    random = np.random.default_rng(seed)
    data = encode(some_message(message_type, random), message_type)
    message = typestore().deserialize_cdr(data, message_type)
    assert bytes(typestore().serialize_cdr(message, message_type)) == data
    sent = bytes(typestore().serialize_cdr(message, message_type, little_endian=little_endian))
    found = decode(sent, message_type)
    assert encode(found, message_type) == data
    for length in random.permutation(len(sent))[:MAX_CUTS].tolist():
        with pytest.raises(CdrError):
            decode(sent[:length], message_type)


def test_unknown_fields_and_types_are_named() -> None:
    with pytest.raises(KeyError, match="has no frame"):
        encode({"frame": "map"}, "std_msgs/msg/Header")
    with pytest.raises(DefinitionsNotFoundError, match="std_msgs/msg/Nothing is not defined"):
        decode(bytes([0, 1, 0, 0]), "std_msgs/msg/Nothing")


def header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": stamp_ns, "frame_id": frame_id}


def pose_fields(x: float, y: float, yaw: float, z: float = 0.5) -> dict[str, Any]:
    turn = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    return {"position": {"x": x, "y": y, "z": z}, "orientation": turn}


def odometry_message(
    stamp_ns: int,
    frames: tuple[str, str],
    pose: tuple[float, float, float],
    twist: tuple[float, ...],
    z: float = 0.5,
) -> bytes:
    covariance = np.arange(36.0)
    return encode(
        {
            "header": header(stamp_ns, frames[0]),
            "child_frame_id": frames[1],
            "pose": {"pose": pose_fields(*pose, z), "covariance": covariance},
            "twist": {
                "twist": {"linear": {"x": twist[0], "y": twist[1]}, "angular": {"z": twist[2]}},
                "covariance": covariance,
            },
        },
        ODOMETRY,
    )


def pose_message(stamp_ns: int, frame: str, pose: tuple[float, float, float], z: float = 0.5) -> bytes:
    return encode({"header": header(stamp_ns, frame), "pose": pose_fields(*pose, z)}, POSE_STAMPED)


def detections_of(count: int) -> list[dict[str, Any]]:
    found = []
    for number in range(count):
        values = np.arange(1.0, 60.0) + 100 * number
        found.append(
            {
                "id": number + 7,
                "family": number % 4,
                "content": 1 + number % 3,
                "id_margin": 0.5 + number,
                "corners_px": values[40:48],
                "pose": {"pose": pose_fields(values[0], values[1], 0.3), "covariance": values[2:38]},
                "alternative": pose_fields(values[50], values[51], -0.4),
                "alternative_ratio": 1.5 + number,
            }
        )
    return found


def detections_message(stamp_ns: int, frame: str, count: int) -> bytes:
    return encode({"header": header(stamp_ns, frame), "detections": detections_of(count)}, DETECTIONS)


ODOMETRY_BYTES = odometry_message(5, ("robot1/odom", "robot1/base_link"), (1.0, 2.0, 0.5), (0.1, 0.0, 0.2))
POSE_BYTES = pose_message(5, "map", (1.0, 2.0, 0.5))
decode_anonymous = partial(decode_detections, message_type=ANONYMOUS_DETECTIONS)
CASES = [
    (ODOMETRY_BYTES, decode_odometry),
    (POSE_BYTES, decode_pose_stamped),
    (detections_message(5, "robot1/camera_optical_frame", 3), decode_detections),
    (encode_brightness("a", 5, (1, 2), np.ones((6, 6))), BrightnessSensor.decode),
    (encode_fix("map", 5, (0.0, 0.0, 0.0), np.eye(3)), decode_fix),
    *((encode_detections("map", 5, np.ones(count, ANONYMOUS_DTYPE)), decode_anonymous) for count in (0, 2)),
]


odometry_fields = given(
    stamp=STAMPS,
    frames=st.tuples(NAMES, NAMES),
    pose=st.tuples(FINITE, FINITE, ANGLE),
    twist=st.tuples(FINITE, FINITE, FINITE),
)


@odometry_fields
def test_odometry_is_read_in_both_orders_of_bytes(
    stamp: int, frames: tuple[str, str], pose: tuple[float, float, float], twist: tuple[float, float, float]
) -> None:
    data = odometry_message(stamp, frames, pose, twist)
    for raw in (data, big_endian(data, ODOMETRY)):
        message = decode_odometry(raw)
        assert (message.stamp_ns, message.frame_id, message.child_frame_id) == (stamp, *frames)
        assert message.pose == pytest.approx(pose, abs=1e-12)
        assert message.twist == twist
        assert message.covariance.tolist() == [[0, 1, 5], [6, 7, 11], [30, 31, 35]]


@given(stamp=STAMPS, frame=NAMES, pose=st.tuples(FINITE, FINITE, ANGLE))
def test_a_pose_is_read_in_both_orders_of_bytes(
    stamp: int, frame: str, pose: tuple[float, float, float]
) -> None:
    data = pose_message(stamp, frame, pose)
    for raw in (data, big_endian(data, POSE_STAMPED)):
        message = decode_pose_stamped(raw)
        assert (message.stamp_ns, message.frame_id) == (stamp, frame)
        assert message.pose == pytest.approx(pose, abs=1e-12)


@given(stamp=STAMPS, frame=NAMES, count=st.integers(0, 5), swapped=st.booleans())
def test_detections_are_read_in_both_orders_of_bytes(
    stamp: int, frame: str, count: int, swapped: bool
) -> None:
    data = detections_message(stamp, frame, count)
    message = decode_detections(big_endian(data, DETECTIONS) if swapped else data)
    assert (message.stamp_ns, message.frame_id, len(message.detections)) == (stamp, frame, count)
    for row, told in zip(message.detections, detections_of(count), strict=True):
        for name in ("id", "family", "content", "id_margin", "alternative_ratio"):
            assert row[name] == told[name]
        assert row["corners_px"].ravel().tolist() == told["corners_px"].tolist()
        assert row["covariance"].ravel().tolist() == told["pose"]["covariance"].tolist()
        for place, orientation, pose in (
            ("position", "orientation", told["pose"]["pose"]),
            ("alternative_position", "alternative_orientation", told["alternative"]),
        ):
            assert row[place].tolist() == [*pose["position"].values()]
            assert row[orientation].tolist() == [0.0, 0.0, *pose["orientation"].values()]


@pytest.mark.parametrize(("data", "decode"), CASES)
def test_what_is_no_whole_message_is_one_error(data: bytes, decode: Any) -> None:
    decode(data)
    for length in range(len(data)):
        with pytest.raises(CdrError):
            decode(data[:length])
    for bad in (b"\x07" + data[1:], data[:8] + b"\xff" * 4 + data[12:]):
        with pytest.raises(CdrError):
            decode(bad)


@pytest.mark.parametrize(("data", "decode"), CASES)
def test_padding_is_taken_and_more_is_refused(data: bytes, decode: Any) -> None:
    assert decode(data + bytes(3)).stamp_ns == 5
    with pytest.raises(CdrError, match="more than the message has"):
        decode(data + bytes(8))


@pytest.mark.parametrize(("good", "decode"), CASES)
@given(data=st.data())
def test_damaged_bytes_never_raise_anything_else(good: bytes, decode: Any, data: st.DataObject) -> None:
    raw = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, min(len(raw) - 1, 80)))] = data.draw(st.integers(0, 255))
    with suppress(CdrError):
        decode(bytes(raw))


def test_wrong_encapsulation_and_stamp_are_named() -> None:
    data = ODOMETRY_BYTES
    with pytest.raises(CdrError, match="00030000 is not plain CDR"):
        decode_odometry(b"\0\3\0\0" + data[4:])
    with pytest.raises(CdrError, match="1000000000 nanoseconds"):
        decode_odometry(data[:8] + struct.pack("<I", 10**9) + data[12:])


def test_zero_quaternion_has_no_heading() -> None:
    assert math.isnan(decode_pose_stamped(POSE_BYTES[:-32] + bytes(32)).pose[2])


@odometry_fields
def test_many_odometry_messages_are_what_the_serializer_writes(
    stamp: int, frames: tuple[str, str], pose: tuple[float, float, float], twist: tuple[float, float, float]
) -> None:
    covariance, zeros = np.arange(36.0).reshape(6, 6), (0.0, 0.0, 0.0)
    stamps, poses, twists = np.array([7, stamp]), np.array([zeros, pose]), np.array([zeros, twist])
    sent = encode_odometry(*frames, stamps, poses, twists, covariance, covariance)[1]
    assert sent == odometry_message(stamp, frames, pose, twist, z=0.0)


@given(stamp=STAMPS, frame=NAMES, pose=st.tuples(FINITE, FINITE, ANGLE))
def test_many_poses_are_what_the_serializer_writes(
    stamp: int, frame: str, pose: tuple[float, float, float]
) -> None:
    (data,) = encode_pose_stamped(frame, np.array([stamp]), np.array([pose]))
    assert data == pose_message(stamp, frame, pose, z=0.0)


@given(frame=NAMES, count=st.integers(0, 4))
def test_detections_are_what_the_serializer_writes(frame: str, count: int) -> None:
    data = detections_message(5, frame, count)
    assert encode_detections(frame, 5, decode_detections(data).detections) == data
