"""Reading and writing CDR agree with the type store of `rosbags`; what is not a whole message is refused."""

import math
import struct
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.cdr import (
    DETECTION,
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
    fields_of,
    message_folder,
)
from swarm_loc_estimator.common.messages.cdr import encode as our_encode
from swarm_loc_estimator.common.messages.detections import decode_detections, encode_detections
from swarm_loc_estimator.common.messages.poses import (
    decode_odometry,
    decode_pose_stamped,
    encode_odometry,
    encode_pose_stamped,
)

FINITE = st.floats(-1e6, 1e6)
ANGLE = st.floats(-3.1, 3.1)
NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=17)
STAMPS = st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9 + 999_999_999)
TYPES = typestore().types
MAX_CUTS = 200  # Lengths at which a message is cut off; a message has up to 10 000 bytes, and 100 are drawn


def encode(message: Any, message_type: str) -> bytes:
    """The bytes of a message as `rosbags` writes them."""
    return bytes(typestore().serialize_cdr(message, message_type))


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
    """A message whose numbers, texts and lengths are drawn."""

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
    data = our_encode(some_message(message_type, random), message_type)
    message = typestore().deserialize_cdr(data, message_type)
    assert encode(message, message_type) == data
    sent = bytes(typestore().serialize_cdr(message, message_type, little_endian=little_endian))
    found = decode(sent, message_type)
    assert our_encode(found, message_type) == data
    for length in random.permutation(len(sent))[:MAX_CUTS].tolist():
        with pytest.raises(CdrError):
            decode(sent[:length], message_type)


def test_unknown_fields_and_types_are_named() -> None:
    with pytest.raises(KeyError, match="has no frame"):
        our_encode({"frame": "map"}, "std_msgs/msg/Header")
    with pytest.raises(DefinitionsNotFoundError, match="std_msgs/msg/Nothing is not defined"):
        decode(bytes([0, 1, 0, 0]), "std_msgs/msg/Nothing")


def header(stamp_ns: int, frame_id: str) -> Any:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](sec, nanosec), frame_id)


def pose_object(x: float, y: float, yaw: float) -> Any:
    quaternion = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return TYPES["geometry_msgs/msg/Pose"](TYPES["geometry_msgs/msg/Point"](x, y, 0.5), quaternion)


def odometry_object(
    stamp_ns: int, frames: tuple[str, str], pose: tuple[float, float, float], twist: tuple[float, ...]
) -> Any:
    vector = TYPES["geometry_msgs/msg/Vector3"]
    return TYPES[ODOMETRY](
        header(stamp_ns, frames[0]),
        frames[1],
        TYPES["geometry_msgs/msg/PoseWithCovariance"](pose_object(*pose), np.arange(36.0)),
        TYPES["geometry_msgs/msg/TwistWithCovariance"](
            TYPES["geometry_msgs/msg/Twist"](vector(twist[0], twist[1], 0.0), vector(0.0, 0.0, twist[2])),
            np.arange(36.0),
        ),
    )


def detection_object(number: int) -> Any:
    values = np.arange(1.0, 60.0) + 100 * number
    pose = TYPES["geometry_msgs/msg/PoseWithCovariance"](
        pose_object(values[0], values[1], 0.3), values[2:38].copy()
    )
    return TYPES[DETECTION](
        id=number + 7,
        family=number % 4,
        content=1 + number % 3,
        id_margin=0.5 + number,
        corners_px=values[40:48].copy(),
        pose=pose,
        alternative=pose_object(values[50], values[51], -0.4),
        alternative_ratio=1.5 + number,
    )


def odometry_bytes() -> bytes:
    return encode(
        odometry_object(5, ("robot1/odom", "robot1/base_link"), (1.0, 2.0, 0.5), (0.1, 0.0, 0.2)), ODOMETRY
    )


def detections_bytes(count: int = 3, frame: str = "robot1/camera_optical_frame") -> bytes:
    return encode(
        TYPES[DETECTIONS](header(5, frame), [detection_object(k) for k in range(count)]), DETECTIONS
    )


def pose_bytes() -> bytes:
    return encode(TYPES[POSE_STAMPED](header(5, "map"), pose_object(1.0, 2.0, 0.5)), POSE_STAMPED)


CASES = [
    (odometry_bytes, decode_odometry),
    (pose_bytes, decode_pose_stamped),
    (detections_bytes, decode_detections),
]


def swap_simple(data: bytes, fields: list[tuple[int, int]]) -> bytes:
    """The same message in big-endian order; fields are (size, count), size 0 is a string."""
    out, offset = bytearray(data), 4
    out[:4] = b"\0\0\0\0"
    for size, count in fields:
        step = size or 4
        offset += -(offset - 4) % step
        length = struct.unpack_from("<I", data, offset)[0] if size == 0 else 0
        for k in range(count):
            out[offset + k * step : offset + (k + 1) * step] = data[
                offset + k * step : offset + (k + 1) * step
            ][::-1]
        offset += step * count + length
    return bytes(out)


odometry_fields = given(
    stamp=STAMPS,
    frames=st.tuples(NAMES, NAMES),
    pose=st.tuples(FINITE, FINITE, ANGLE),
    twist=st.tuples(FINITE, FINITE, FINITE),
)


@odometry_fields
def test_odometry_agrees_with_the_serializer(
    stamp: int, frames: tuple[str, str], pose: tuple[float, float, float], twist: tuple[float, float, float]
) -> None:
    data = encode(odometry_object(stamp, frames, pose, twist), ODOMETRY)
    for raw in (data, swap_simple(data, [(4, 2), (0, 1), (0, 1), (8, 85)])):
        message = decode_odometry(raw)
        assert (message.stamp_ns, message.frame_id, message.child_frame_id) == (stamp, *frames)
        assert message.pose == pytest.approx(pose, abs=1e-12)
        assert message.twist == twist
        assert message.covariance.tolist() == [[0, 1, 5], [6, 7, 11], [30, 31, 35]]


@given(stamp=STAMPS, frame=NAMES, pose=st.tuples(FINITE, FINITE, ANGLE))
def test_pose_agrees_with_the_serializer(stamp: int, frame: str, pose: tuple[float, float, float]) -> None:
    data = encode(TYPES[POSE_STAMPED](header(stamp, frame), pose_object(*pose)), POSE_STAMPED)
    for raw in (data, swap_simple(data, [(4, 2), (0, 1), (8, 7)])):
        message = decode_pose_stamped(raw)
        assert (message.stamp_ns, message.frame_id) == (stamp, frame)
        assert message.pose == pytest.approx(pose, abs=1e-12)


@given(stamp=STAMPS, frame=NAMES, count=st.integers(0, 5))
def test_detections_agree_with_the_serializer(stamp: int, frame: str, count: int) -> None:
    objects = [detection_object(k) for k in range(count)]
    message = decode_detections(encode(TYPES[DETECTIONS](header(stamp, frame), objects), DETECTIONS))
    assert (message.stamp_ns, message.frame_id, len(message.detections)) == (stamp, frame, count)
    for row, thing in zip(message.detections, objects, strict=True):
        assert (row["id"], row["family"], row["content"]) == (thing.id, thing.family, thing.content)
        assert (row["id_margin"], row["alternative_ratio"]) == (thing.id_margin, thing.alternative_ratio)
        assert row["corners_px"].ravel().tolist() == thing.corners_px.tolist()
        assert row["covariance"].ravel().tolist() == thing.pose.covariance.tolist()
        for place, orientation, pose in (
            ("position", "orientation", thing.pose.pose),
            ("alternative_position", "alternative_orientation", thing.alternative),
        ):
            assert row[place].tolist() == [pose.position.x, pose.position.y, pose.position.z]
            quaternion = pose.orientation
            assert row[orientation].tolist() == [quaternion.x, quaternion.y, quaternion.z, quaternion.w]


def test_big_endian_detections() -> None:
    one = [(4, 1), (1, 2), (4, 1), (8, 8 + 7 + 36 + 7), (4, 1)]
    for frame in ("ab", "abcdef"):
        little = detections_bytes(3, frame)
        big = swap_simple(little, [(4, 2), (0, 1), (4, 1), *one, *one, *one])
        np.testing.assert_array_equal(decode_detections(big).detections, decode_detections(little).detections)


@pytest.mark.parametrize(("make", "decode"), CASES)
def test_cut_off_anywhere_is_one_error(make: Any, decode: Any) -> None:
    data = make()
    decode(data)
    for length in range(len(data)):
        with pytest.raises(CdrError):
            decode(data[:length])


@pytest.mark.parametrize(("make", "decode"), CASES)
def test_padding_is_taken_and_more_is_refused(make: Any, decode: Any) -> None:
    data = make()
    assert decode(data + bytes(3)).stamp_ns == 5
    with pytest.raises(CdrError, match="more than the message has"):
        decode(data + bytes(8))


@pytest.mark.parametrize(("make", "decode"), CASES)
@given(data=st.data())
def test_damaged_bytes_never_raise_anything_else(make: Any, decode: Any, data: st.DataObject) -> None:
    raw = bytearray(make())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, min(len(raw) - 1, 80)))] = data.draw(st.integers(0, 255))
    with suppress(CdrError):
        decode(bytes(raw))


def test_wrong_encapsulation_and_stamp_are_named() -> None:
    data = odometry_bytes()
    with pytest.raises(CdrError, match="00030000 is not plain CDR"):
        decode_odometry(b"\0\3\0\0" + data[4:])
    with pytest.raises(CdrError, match="1000000000 nanoseconds"):
        decode_odometry(data[:8] + struct.pack("<I", 10**9) + data[12:])


def test_zero_quaternion_has_no_heading() -> None:
    raw = bytearray(pose_bytes())
    raw[-32:] = bytes(32)
    assert math.isnan(decode_pose_stamped(bytes(raw)).pose[2])


@odometry_fields
def test_many_odometry_messages_are_what_the_serializer_writes(
    stamp: int, frames: tuple[str, str], pose: tuple[float, float, float], twist: tuple[float, float, float]
) -> None:
    covariance = np.arange(36.0).reshape(6, 6)
    message: Any = odometry_object(stamp, frames, pose, twist)
    message.pose.pose.position.z = 0.0
    stamps, poses, twists = (
        np.array([7, stamp]),
        np.array([[0.0, 0.0, 0.0], pose]),
        np.array([[0.0, 0.0, 0.0], twist]),
    )
    assert encode_odometry(*frames, stamps, poses, twists, covariance, covariance)[1] == encode(
        message, ODOMETRY
    )


@given(stamp=STAMPS, frame=NAMES, pose=st.tuples(FINITE, FINITE, ANGLE))
def test_many_poses_are_what_the_serializer_writes(
    stamp: int, frame: str, pose: tuple[float, float, float]
) -> None:
    message: Any = TYPES[POSE_STAMPED](header(stamp, frame), pose_object(*pose))
    message.pose.position.z = 0.0
    (data,) = encode_pose_stamped(frame, np.array([stamp]), np.array([pose]))
    assert data == encode(message, POSE_STAMPED)


@given(frame=NAMES, count=st.integers(0, 4))
def test_detections_are_what_the_serializer_writes(frame: str, count: int) -> None:
    data = detections_bytes(count, frame)
    assert encode_detections(frame, 5, decode_detections(data).detections) == data
