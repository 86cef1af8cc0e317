"""Topics that all robots share, and channels of messages."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from core_messages import SECOND, big_endian, odometry_bytes
from hypothesis import given
from hypothesis import strategies as st

from bench.shared.bags import SharedHead, encode_shared_detections, encode_shared_numbers
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.cdr import (
    BRIGHTNESS,
    POSE_WITH_COVARIANCE,
    SWARM_DETECTIONS,
    SWARM_FIXES,
    SWARM_ODOMETRY,
    CdrError,
)
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    decode_shared_detections,
    decode_shared_numbers,
    encode_brightness,
    encode_detections,
    swarm_key,
)
from swarm_loc_estimator.common.messages.poses import decode_fix, encode_fix
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.sensors.infrared import BrightnessSensor
from swarm_loc_estimator.sensors.inputs import Batch, Ingest, InputConverter, live_topics
from swarm_loc_estimator.swarm.error_models import FixModel, OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

SWARM = Swarm(tuple(Robot(name) for name in "abc"))
KEY = swarm_key("abc")
READINGS = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 2**31 * 10**9 - 1)), max_size=9)


def head(robot: Any, stamp_ns: Any, frame_id: str = "odom", swarm: int = KEY) -> SharedHead:
    columns = (np.array(column, dtype=np.int64) for column in (robot, stamp_ns))
    return SharedHead(5, frame_id, swarm, *columns)


def markers(count: int) -> np.ndarray[Any, np.dtype[np.void]]:
    rows = np.zeros(count, DETECTION_DTYPE)
    rows["id"] = 7 + np.arange(count)
    rows["position"] = np.arange(3 * count).reshape(-1, 3)
    return rows


def read(*messages: tuple[str, bytes]) -> Batch:
    ingest = Ingest(SWARM)
    rows = [(ingest.handle_of[topic], data, 10 + k) for k, (topic, data) in enumerate(messages)]
    (inputs,) = ingest.read(MessageBatch.of([SerializedMessage(*one) for one in rows]))
    return inputs


@given(READINGS, st.sampled_from(["", "odom", "a_frame"]), st.booleans())
def test_what_is_written_is_read_by_us_and_by_others(
    readings: list[tuple[int, int]], frame_id: str, swapped: bool
) -> None:
    robot, stamp_ns = [r for r, _ in readings], [s for _, s in readings]
    n, first = len(readings), head(robot, stamp_ns, frame_id)
    numbers = np.arange(12.0 * n).reshape(n, 12)
    cases = (
        (SWARM_ODOMETRY, encode_shared_numbers(first, numbers[:, :3]), (3,)),
        (SWARM_FIXES, encode_shared_numbers(first, numbers[:, :3], numbers[:, 3:]), (3, 9)),
        (SWARM_DETECTIONS, encode_shared_detections(first, markers(n)), None),
    )
    for message_type, data, widths in cases:
        theirs: Any = typestore().deserialize_cdr(data, message_type)
        assert theirs.robot.tolist() == robot
        assert [time.sec * 10**9 + time.nanosec for time in theirs.stamp] == stamp_ns
        sent = big_endian(data, message_type) if swapped else data
        ours = decode_shared_numbers(sent, widths) if widths else decode_shared_detections(sent)
        assert (ours.stamp_ns, ours.frame_id, ours.swarm) == (5, frame_id, KEY)
        assert (ours.robot.tolist(), ours.reading_ns.tolist()) == (robot, stamp_ns)
        if widths is None:
            assert ours.columns[0]["id"].tolist() == markers(n)["id"].tolist()
            assert np.array_equal(ours.columns[0]["position"], markers(n)["position"])
        else:
            assert np.array_equal(np.concatenate(ours.columns, axis=1), numbers[:, : sum(widths)])


def test_a_message_of_many_says_what_each_would_have_said_alone() -> None:
    pose, many = np.array([[1.0, 2.0, 0.5], [3.0, 4.0, -0.5]]), [2, 0]
    own, shared = [], []
    for k, robot in enumerate("ca"):
        own += [
            (f"{robot}/odom", odometry_bytes(robot, k, pose[k])),
            (f"{robot}/detections", encode_detections("eye", k, markers(2)[k : k + 1])),
            (f"{robot}/fix", encode_fix("map", k, pose[k], np.diag([1.0, 2.0, 3.0 + 97.0 * k]))),
        ]
    covariance = np.array([np.diag([1.0, 2.0, 3.0]), np.diag([1.0, 2.0, 100.0])]).reshape(2, 9)
    shared += [
        ("swarm/odom", encode_shared_numbers(head(many, [0, 1]), pose)),
        ("swarm/detections", encode_shared_detections(head(many, [0, 1], ""), markers(2))),
        ("swarm/fixes", encode_shared_numbers(head(many, [0, 1], "map"), pose, covariance)),
    ]
    one, other = read(*own), read(*shared)
    for name in ("odometry", "detections", "fixes"):
        for column, mine, theirs in zip(one[name]._fields[:-1], one[name], other[name], strict=False):
            if column == "twist":  # messages of many robots have none
                assert np.isnan(theirs).all()
            elif mine.dtype.names:
                assert mine.dtype == theirs.dtype
                for field in mine.dtype.names:  # not the bytes between them, which may be any
                    np.testing.assert_array_equal(mine[field], theirs[field])
            else:
                np.testing.assert_allclose(mine, theirs, atol=1e-15)
    assert np.isnan(other["fixes"].pose[1, 2])
    assert other["odometry"].arrival_ns.tolist() == [10, 10]
    assert not other.dropped


def test_readings_of_both_layouts_come_in_order_of_arrival() -> None:
    alone = encode_detections("eye", 3, markers(1))
    together = encode_shared_detections(head([1, 2], [1, 2]), markers(2))
    inputs = read(("swarm/detections", together), ("a/detections", alone), ("swarm/detections", together))
    assert inputs["detections"].robot.tolist() == [1, 2, 0, 1, 2]
    assert inputs["detections"].arrival_ns.tolist() == [10, 10, 11, 12, 12]


def test_bad_readings_are_left_out_and_counted_and_the_others_stay() -> None:
    data = bytearray(encode_shared_numbers(head([0, 3, 1, 2], [1, 2, 3, 4]), np.arange(12.0).reshape(4, 3)))
    (at,) = [k for k in range(0, len(data) - 24, 4) if data[k : k + 8] == bytes([4, 0, 0, 0, 0, 0, 0, 0])][
        -1:
    ]
    data[at + 4 + 2 * 8 + 4 : at + 4 + 3 * 8] = (10**9).to_bytes(4, "little")  # of the third stamp
    inputs = read(("swarm/odom", bytes(data)))
    assert inputs["odometry"].robot.tolist() == [0, 2]
    assert inputs["odometry"].stamp_ns.tolist() == [1, 4]
    assert inputs["odometry"].pose.tolist() == [[0.0, 1.0, 2.0], [9.0, 10.0, 11.0]]
    assert inputs.dropped == {"unknown_robot": 1, "bad_stamp": 1}


@pytest.mark.parametrize(
    ("topic", "swarm", "frame_id", "reason"),
    [
        ("swarm/odom", KEY + 1, "odom", "other_swarm"),
        ("swarm/fixes", KEY, "odom", "fix_frame"),
        ("swarm/fixes", KEY, "map", ""),
    ],
)
def test_indices_of_another_swarm_and_foreign_frames_are_refused(
    topic: str, swarm: int, frame_id: str, reason: str
) -> None:
    columns = [np.zeros((2, 3)), *([np.zeros((2, 9))] if topic == "swarm/fixes" else [])]
    inputs = read((topic, encode_shared_numbers(head([0, 1], [1, 2], frame_id, swarm), *columns)))
    assert inputs.dropped == ({reason: 2} if reason else {})
    assert inputs["odometry"].robot.size + inputs["fixes"].robot.size == (0 if reason else 2)


def test_names_and_their_order_make_the_key() -> None:
    keys = {swarm_key(names) for names in (["a", "b"], ["b", "a"], ["ab"], ["a", "b", "c"], ["a\nb"])}
    assert len(keys) == 4, "a name has no line feed, so that the last one cannot come up"


def numbers_of(n: int) -> bytes:
    return encode_shared_numbers(head(range(n), range(n)), np.ones((n, 3)))


def columns_of_other_lengths(which: int) -> bytes:
    """A message of which one column is longer than the robots are many."""
    robot: IntArray = np.arange(2)
    stamp_ns: IntArray = np.arange(3 if which == 0 else 2)
    pose = np.ones((3 if which == 1 else 2, 3))
    return encode_shared_numbers(SharedHead(0, "odom", KEY, robot, stamp_ns), pose)


@pytest.mark.parametrize("data", [columns_of_other_lengths(0), columns_of_other_lengths(1), b"", b"\x00\x01"])
def test_columns_of_different_lengths_make_no_message(data: bytes) -> None:
    with pytest.raises(CdrError):
        decode_shared_numbers(data, (3,))


@given(st.binary(max_size=200), st.integers(0, 200), st.integers(0, 3))
def test_no_bytes_bring_the_reader_down(noise: bytes, cut: int, n: int) -> None:
    whole = encode_shared_detections(head(range(n), range(n)), markers(n))
    for data in (noise, whole[:cut] + noise, whole[: len(whole) - cut], numbers_of(n)[:cut] + noise):
        for kind in ("swarm/odom", "swarm/detections", "swarm/fixes"):
            inputs = read((kind, data))
            assert inputs["odometry"].robot.size <= n
            assert set(inputs.dropped) <= {
                "bad_message",
                "other_swarm",
                "unknown_robot",
                "bad_stamp",
                "fix_frame",
            }


def test_a_live_estimator_listens_to_few_topics_where_they_are_shared() -> None:
    own = [topic.name for topic in live_topics(SWARM, shared=False)]
    assert own == [
        *(f"{robot}/{kind}" for robot in "abc" for kind in ("odom", "detections", "brightness", "fix")),
        "aerial/detections",
    ]
    blind = Swarm(tuple(replace(robot, camera=None) for robot in SWARM.robots))
    for swarm, expected in ((SWARM, [True, True]), (blind, [True, False])):
        topics = live_topics(swarm, shared=True)
        assert {topic.kind.name for topic in topics} == {
            "aerial",
            "swarm_odometry",
            "swarm_detections",
            "swarm_fixes",
        }
        assert [t.expected for t in topics if t.kind.topic in ("swarm/odom", "swarm/detections")] == expected


def test_a_robot_cannot_flood_the_memory_of_all() -> None:
    """A message with more readings of one robot than wait of its own topic is dropped, and no other."""
    many = np.arange(1001, dtype=np.int64)
    one_robots = encode_shared_numbers(head(0 * many, many), np.zeros((1001, 3)))
    both_robots = encode_shared_numbers(head(many[:1000] % 2, many[:1000]), np.zeros((1000, 3)))
    inputs = read(("swarm/odom", one_robots), ("swarm/odom", both_robots))
    assert inputs["odometry"].robot.size == 1000
    assert inputs.dropped == {"shared_too_many": 1001}


T0 = 1_000 * SECOND
SWARM_CHANNELS = Swarm((Robot("a", odometry=OdometryModel(wheel_noise=1e-6)), Robot("b", stands=True)))
NAMES = st.sampled_from(["", "a", "ab/base_link", "r\u00f6/base_link"])
COVARIANCE = np.diag([1e-4, 4e-4, 1e-2])
FLOOR = np.diag(np.square([5e-4, 5e-4, 1e-3]))  # added to that of each fix


def read_channels(*messages: tuple[str, bytes, int]) -> tuple[Batch, Ingest]:
    ingest = Ingest(SWARM_CHANNELS)
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


def test_a_matrix_that_promises_more_than_it_holds_is_no_message() -> None:
    good = bytearray(encode_brightness("", 5, (1, 2), np.ones((6, 6))))
    place = good.index(np.uint32(36).tobytes())
    good[place : place + 4] = b"\xff" * 4
    with pytest.raises(CdrError, match="cut off"):
        BrightnessSensor.decode(bytes(good))


def test_every_kind_of_input_comes_in_columns_of_its_own() -> None:
    matrices = [encode_brightness("a", T0 + k, (3, 4), k * np.ones((k, k)), k, 9) for k in (2, 3)]
    found, ingest = read_channels(
        ("a/brightness", matrices[0], T0 + 10),
        ("a/odom", odometry_bytes("a", T0), T0 + 11),
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
    found, _ = read_channels(("b/fix", data, T0))
    assert math.isfinite(found["fixes"].pose[0, 2]) == measured


def test_fixes_locate_robots_that_stand_and_robots_that_drive() -> None:
    """Through the very path of live nodes and replay; heading from the fix, or from three places."""
    estimator, ingest = Estimator(SWARM_CHANNELS), Ingest(SWARM_CHANNELS)
    for k in range(30):
        now_ns, path = T0 + k * SECOND // 10, 0.02 * k
        blind = np.diag([1e-6, 1e-6, -1.0])
        pose = odometry_bytes("a", now_ns, (path, 0.0, 0.0))
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
    found, _ = read_channels(("b/odom", odometry_bytes("b", T0), T0))
    estimator = Estimator(SWARM_CHANNELS)
    estimator.receive(found)
    assert estimator.drops == {"no_odometry": 1}


def test_fixes_that_cannot_be_used_are_dropped_with_a_reason() -> None:
    good, bad = COVARIANCE, np.diag([1e-4, -1e-4, 1e-2])
    found, _ = read_channels(
        ("b/fix", encode_fix("map", T0, (math.nan, 0.0, 0.0), good), T0),
        ("b/fix", encode_fix("map", T0, (1e9, 0.0, 0.0), good), T0),
        ("b/fix", encode_fix("map", T0, (0.0, 0.0, 0.0), bad), T0),
        ("b/fix", encode_fix("map", T0 + SECOND, (0.0, 0.0, 0.0), good), T0),
    )
    estimator = Estimator(SWARM_CHANNELS)
    estimator.receive(found)
    assert estimator.drops == {"absurd": 1, "bad_covariance": 1, "future_stamp": 1, "non_finite": 1}
