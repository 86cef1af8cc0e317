"""Brightness matrices and absolute fixes from raw messages, into the estimator's columns and poses."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.cdr import BRIGHTNESS, POSE_WITH_COVARIANCE, CdrError
from swarm_loc_estimator.common.messages.detections import encode_brightness
from swarm_loc_estimator.common.messages.poses import decode_fix, encode_fix, encode_odometry
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.sensors.infrared import BrightnessSensor
from swarm_loc_estimator.sensors.inputs import Batch, Ingest, InputConverter
from swarm_loc_estimator.swarm.error_models import FixModel, OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

SECOND = 1_000_000_000
T0 = 1_000 * SECOND
SWARM = Swarm((Robot("a", odometry=OdometryModel(wheel_noise=1e-6)), Robot("b", stands=True)))
NAMES = st.sampled_from(["", "a", "ab/base_link", "r\u00f6/base_link"])
COVARIANCE = np.diag([1e-4, 4e-4, 1e-2])
FLOOR = np.diag(np.square([5e-4, 5e-4, 1e-3]))  # added to that of each fix


def big_endian(data: bytes, message_type: str) -> bytes:
    store = typestore()
    message = store.deserialize_cdr(data, message_type)
    return bytes(store.serialize_cdr(message, message_type, little_endian=False))


def read(*messages: tuple[str, bytes, int]) -> tuple[Batch, Ingest]:
    """Messages by topic and arrival."""
    ingest = Ingest(SWARM)
    batch = MessageBatch.of(
        [SerializedMessage(ingest.handle_of[topic], data, at) for topic, data, at in messages]
    )
    (found,) = ingest.read(batch)
    return found, ingest


@given(
    frame=NAMES,
    stamp_ns=st.integers(0, 2**60),
    pair=st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1)),
    n=st.integers(0, 7),
    power=st.integers(0, 255),
    saturation=st.integers(-(2**31), 2**31 - 1),
    swapped=st.booleans(),
)
def test_matrices_read_as_the_type_store_writes_them(
    frame: str, stamp_ns: int, pair: tuple[int, int], n: int, power: int, saturation: int, swapped: bool
) -> None:
    readings = np.arange(n * n, dtype=np.int32).reshape(n, n) - 5
    data = encode_brightness(frame, stamp_ns, pair, readings, power, saturation)
    one = BrightnessSensor.decode(big_endian(data, BRIGHTNESS) if swapped else data)
    assert (one.stamp_ns, one.frame_id, one.receiver, one.transmitter) == (stamp_ns, frame, *pair)
    assert (one.n, one.power, one.saturation) == (n, power, saturation)
    assert one.readings.dtype == np.int32
    assert one.readings.tolist() == readings.ravel().tolist()


@given(frame=NAMES, stamp_ns=st.integers(0, 2**60), yaw=st.floats(-3.1, 3.1), swapped=st.booleans())
def test_fixes_read_as_the_type_store_writes_them(
    frame: str, stamp_ns: int, yaw: float, swapped: bool
) -> None:
    data = encode_fix(frame, stamp_ns, (1.0, -2.0, yaw), COVARIANCE)
    one = decode_fix(big_endian(data, POSE_WITH_COVARIANCE) if swapped else data)
    assert (one.stamp_ns, one.frame_id) == (stamp_ns, frame)
    assert one.pose == pytest.approx((1.0, -2.0, yaw))
    np.testing.assert_array_equal(one.covariance, COVARIANCE)


@pytest.mark.parametrize("decode", [BrightnessSensor.decode, decode_fix])
def test_damaged_bytes_are_refused(decode: Any) -> None:
    good = (
        encode_brightness("a", 5, (1, 2), np.ones((6, 6)))
        if decode is not decode_fix
        else encode_fix("map", 5, (0.0, 0.0, 0.0), COVARIANCE)
    )
    decode(good)
    for size in range(len(good) - 7):
        with pytest.raises(CdrError):
            decode(good[:size])
    for bad in (good + bytes(8), b"\x07" + good[1:], good[:8] + b"\xff" * 4 + good[12:]):
        with pytest.raises(CdrError):
            decode(bad)


def test_a_matrix_that_promises_more_than_it_holds_is_no_message() -> None:
    good = bytearray(encode_brightness("", 5, (1, 2), np.ones((6, 6))))
    place = good.index(np.uint32(36).tobytes())
    good[place : place + 4] = b"\xff" * 4
    with pytest.raises(CdrError, match="cut off"):
        BrightnessSensor.decode(bytes(good))


def test_every_kind_of_input_comes_in_columns_of_its_own() -> None:
    (pose,) = encode_odometry(
        "a/odom", "a", np.array([T0]), np.zeros((1, 3)), np.zeros((1, 3)), np.eye(6), np.eye(6)
    )
    matrices = [encode_brightness("a", T0 + k, (3, 4), k * np.ones((k, k)), k, 9) for k in (2, 3)]
    found, ingest = read(
        ("a/brightness", matrices[0], T0 + 10),
        ("a/odom", pose, T0 + 11),
        ("b/fix", encode_fix("map", T0 + 5, (1.0, 2.0, 3.0), COVARIANCE), T0 + 12),
        ("b/brightness", b"no message", T0 + 13),
        ("b/brightness", matrices[1], T0 + 14),
        ("b/fix", encode_fix("odom", T0 + 5, (1.0, 2.0, 3.0), COVARIANCE), T0 + 15),
    )
    assert found["odometry"].robot.tolist() == [0]
    rows = found["brightness"]
    assert [rows.robot.tolist(), rows.arrival_ns.tolist()] == [[0, 1], [T0 + 10, T0 + 14]]
    assert [rows.stamp_ns.tolist(), rows.receiver.tolist()] == [[T0 + 2, T0 + 3], [3, 3]]
    assert [rows.transmitter.tolist(), rows.n.tolist(), rows.power.tolist()] == [[4, 4], [2, 3], [2, 3]]
    assert rows.saturation.tolist() == [9, 9]
    assert [readings.tolist() for readings in rows.readings] == [[2] * 4, [3] * 9]
    assert [found["fixes"].robot.tolist(), found["fixes"].stamp_ns.tolist()] == [[1], [T0 + 5]]
    np.testing.assert_allclose(found["fixes"].pose, [[1.0, 2.0, 3.0]])
    assert found.dropped == {"bad_message": 1, "fix_frame": 1}
    assert ingest.frame_id(ingest.handle_of["b/fix"]) == "odom"
    assert ingest.statistics[ingest.handle_of["b/brightness"]].malformed == 1
    assert ingest.statistics[ingest.handle_of["b/fix"]].received == 2


@pytest.mark.parametrize("unset", [np.diag([0.0, 0.0, 0.0]), np.diag([-1.0, 0.0, 0.0])])
@pytest.mark.parametrize(
    ("noise", "used"),
    [({}, ""), ({"position_sigma": 0.1}, "position"), ({"position_sigma": 0.1, "heading_sigma": 0.2}, "all")],
)
def test_fixes_without_covariance_have_that_of_the_description(
    unset: FloatArray, noise: dict[str, float], used: str
) -> None:
    swarm = Swarm((Robot("a"), Robot("b", fix=FixModel(**noise))))
    ingest, converter = Ingest(swarm), InputConverter(swarm, Settings())
    handle = ingest.handle_of["b/fix"]
    fixes = [encode_fix("map", T0 + k, (1.0, 2.0, 3.0), c) for k, c in enumerate((unset, COVARIANCE))]
    messages = [SerializedMessage(handle, data, T0 + 10) for data in fixes]
    (batch,) = ingest.read(MessageBatch.of(messages))
    measured = converter.convert(batch).rows["fixes"]
    assert converter.drops.total == ({} if used else {"fix_without_covariance": 1})
    *first, last = (measured.row(k) for k in range(measured.size))
    np.testing.assert_allclose(last.covariance, COVARIANCE + FLOOR)
    assert [bool(one.has_heading) for one in first] == {"": [], "position": [False], "all": [True]}[used]
    for one in first:
        expected = np.diag([0.1**2, 0.1**2, 0.2**2]) + FLOOR
        expected[2, 2] = expected[2, 2] if used == "all" else 1.0
        np.testing.assert_allclose(one.covariance, expected)
        np.testing.assert_allclose(one.value, [1.0, 2.0, 3.0 if used == "all" else 0.0])


@pytest.mark.parametrize(
    ("variance", "measured"),
    [(1e-2, True), (9.8, True), (0.0, False), (-1.0, False), (math.nan, False), (10.0, False), (1e9, False)],
)
def test_the_variance_of_its_heading_says_whether_a_fix_has_one(variance: float, measured: bool) -> None:
    data = encode_fix("map", T0, (1.0, 2.0, 3.0), np.diag([1e-4, 1e-4, variance]))
    found, _ = read(("b/fix", data, T0))
    assert math.isfinite(found["fixes"].pose[0, 2]) == measured


def test_fixes_locate_robots_that_stand_and_robots_that_drive() -> None:
    """Through the very path of live nodes and replay; heading from the fix, or from three places."""
    estimator, ingest = Estimator(SWARM), Ingest(SWARM)
    for k in range(30):
        now_ns, path = T0 + k * SECOND // 10, 0.02 * k
        blind = np.diag([1e-6, 1e-6, -1.0])
        (pose,) = encode_odometry(
            "a/odom",
            "a",
            np.array([now_ns]),
            np.array([[path, 0.0, 0.0]]),
            np.zeros((1, 3)),
            np.eye(6),
            np.eye(6),
        )
        messages = [("a/odom", pose), ("a/fix", encode_fix("map", now_ns, (1.0, path, 0.0), blind))]
        if k < 5:
            messages.append(("b/fix", encode_fix("map", now_ns, (2.0, 3.0, 0.5), 1e-6 * np.eye(3))))
        rows = [(ingest.handle_of[topic], data, now_ns) for topic, data in messages]
        for part in ingest.read(MessageBatch.of([SerializedMessage(*one) for one in rows])):
            estimator.receive(part)
        estimate = estimator.tick(now_ns)
    assert estimate.status.tolist() == [Status.TRACKED, Status.TRACKED]
    np.testing.assert_allclose(estimate.poses[0], [1.0, 0.58, math.pi / 2], atol=2e-3)
    np.testing.assert_allclose(estimate.poses[1], [2.0, 3.0, 0.5], atol=1e-6)
    assert estimate.fix_age_s == pytest.approx([0.0, 2.5])
    assert not estimator.drops


def test_odometry_of_a_robot_that_has_none_is_dropped() -> None:
    (pose,) = encode_odometry(
        "b/odom", "b", np.array([T0]), np.zeros((1, 3)), np.zeros((1, 3)), np.eye(6), np.eye(6)
    )
    found, _ = read(("b/odom", pose, T0))
    estimator = Estimator(SWARM)
    estimator.receive(found)
    assert estimator.drops == {"no_odometry": 1}


def test_fixes_that_cannot_be_used_are_dropped_with_a_reason() -> None:
    good, bad = COVARIANCE, np.diag([1e-4, -1e-4, 1e-2])
    found, _ = read(
        ("b/fix", encode_fix("map", T0, (math.nan, 0.0, 0.0), good), T0),
        ("b/fix", encode_fix("map", T0, (1e9, 0.0, 0.0), good), T0),
        ("b/fix", encode_fix("map", T0, (0.0, 0.0, 0.0), bad), T0),
        ("b/fix", encode_fix("map", T0 + SECOND, (0.0, 0.0, 0.0), good), T0),
    )
    estimator = Estimator(SWARM)
    estimator.receive(found)
    assert estimator.drops == {"absurd": 1, "bad_covariance": 1, "future_stamp": 1, "non_finite": 1}
