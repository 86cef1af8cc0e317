"""From raw messages to calls of the estimator; the fast reader agrees with the complete one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm_loc_estimator.core.swarm import Robot, Swarm
from swarm_loc_estimator.io.cdr import DETECTION_DTYPE, CdrError, decode_detections, decode_odometry
from swarm_loc_estimator.io.ingest import Ingest, InputKind
from swarm_loc_estimator.io.messages import encode_detections, encode_odometry
from swarm_loc_estimator.io.streams import DetectionStream, OdometryStream
from swarm_loc_estimator.io.typestore import DETECTIONS, ODOMETRY, typestore

Pose = tuple[float, float, float]
FRAMES = st.sampled_from(["", "a", "ab/odom", "robot17/odom", "r\u00f6/camera"])


def odometry(frame: str, stamp_ns: int, pose: Pose, child: str = "base") -> bytes:
    (data,) = encode_odometry(
        frame, child, np.array([stamp_ns]), np.array([pose]), np.zeros((1, 3)), np.eye(6), np.eye(6)
    )
    return data


def detections(frame: str, stamp_ns: int, count: int) -> bytes:
    rows = np.zeros(count, DETECTION_DTYPE)
    rows["id"] = 7 + np.arange(count)
    rows["position"] = np.arange(3 * count).reshape(-1, 3)
    rows["alternative_ratio"] = 0.5
    return encode_detections(frame, stamp_ns, rows)


def big_endian(data: bytes, message_type: str) -> bytes:
    """The same message in the other byte order."""
    store = typestore()
    message = store.deserialize_cdr(data, message_type)
    return bytes(store.serialize_cdr(message, message_type, little_endian=False))


@given(st.lists(st.tuples(FRAMES, FRAMES, st.integers(0, 2**62 // 10**9), st.booleans()), max_size=6))
def test_odometry_reads_as_by_the_complete_reader(rows: list[tuple[str, str, int, bool]]) -> None:
    stream = OdometryStream()
    for frame, child, stamp_ns, swapped in rows:
        data = odometry(frame, stamp_ns, (1.5, -2.5, 3.0), child)
        data = big_endian(data, ODOMETRY) if swapped else data
        expected = decode_odometry(data)
        assert stream.read(data) == (expected.stamp_ns, expected.pose)
        assert stream.frame_id == frame


@given(st.lists(st.tuples(FRAMES, st.integers(0, 4), st.booleans()), max_size=6))
def test_detections_read_as_by_the_complete_reader(rows: list[tuple[str, int, bool]]) -> None:
    stream = DetectionStream()
    for frame, count, swapped in rows:
        data = detections(frame, 5, count)
        data = big_endian(data, DETECTIONS) if swapped else data
        expected = decode_detections(data)
        stamp_ns, found = stream.read(data)
        assert stamp_ns == expected.stamp_ns
        assert found.dtype == DETECTION_DTYPE
        for name in DETECTION_DTYPE.names or ():
            assert np.array_equal(found[name], expected.detections[name])


@pytest.mark.parametrize("good", [odometry("a/odom", 5, (0.0, 0.0, 0.0)), detections("a/camera", 5, 2)])
def test_damaged_bytes_are_refused_before_and_after_a_good_message(good: bytes) -> None:
    is_odometry = decodes(good)
    stream = OdometryStream() if is_odometry else DetectionStream()
    bad_stamp = good[:8] + b"\xff\xff\xff\xff" + good[12:]
    broken = [b"", good[:3], good[:40], good[:-30], good + bytes(50), b"\x07" + good[1:], bad_stamp]
    for _ in range(2):
        for data in broken:
            with pytest.raises(CdrError):
                stream.read(data)
        stream.read(good)


def decodes(data: bytes) -> bool:
    """Whether these bytes are odometry."""
    try:
        decode_odometry(data)
    except CdrError:
        return False
    return True


class Recorder:
    """Takes the place of the estimator."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []
        self.dropped: dict[str, int] = {}

    def add_odometry(self, robot: int, stamp_ns: int, pose: Pose, now_ns: int) -> None:
        """Keep the call."""
        self.calls.append(("odometry", robot, stamp_ns, pose, now_ns))

    def add_detections(self, robot: int, stamp_ns: int, found: NDArray[np.void], now_ns: int) -> None:
        """Keep the call."""
        self.calls.append(("detections", robot, stamp_ns, found["id"].tolist(), now_ns))

    def drop(self, reason: str, count: int = 1) -> None:
        """Count."""
        self.dropped[reason] = self.dropped.get(reason, 0) + count


def test_each_message_becomes_one_call_and_is_counted() -> None:
    recorder = Recorder()
    ingest = Ingest(Swarm((Robot("a"), Robot("b", camera=None))), recorder)
    assert [topic.name for topic in ingest.topics] == ["a/odom", "a/detections", "b/odom", "b/detections"]
    assert [topic.name for topic in ingest.topics if not topic.expected] == ["b/detections"]

    odom, seen = ingest.handle_of["b/odom"], ingest.handle_of["a/detections"]
    ingest.receive(odom, odometry("b/odom", 10, (1.0, 2.0, 0.0)), 14)
    ingest.receive(odom, odometry("b/odom", 20, (1.0, 2.0, 0.0)), 30)
    ingest.receive(odom, b"nonsense", 40)
    ingest.receive(seen, detections("a/camera", 15, 2), 50)

    assert recorder.calls == [
        ("odometry", 1, 10, (1.0, 2.0, 0.0), 14),
        ("odometry", 1, 20, (1.0, 2.0, 0.0), 30),
        ("detections", 0, 15, [7, 8], 50),
    ]
    assert recorder.dropped == {"bad_message": 1}
    statistics = ingest.statistics[odom]
    assert (statistics.received, statistics.malformed) == (3, 1)
    assert (statistics.last_stamp_ns, statistics.last_arrival_ns) == (20, 30)
    assert (statistics.late_sum_ns, statistics.late_max_ns, statistics.late_count) == (14, 10, 2)
    assert ingest.frame_id(odom) == "b/odom"
    assert ingest.topics[seen].kind is InputKind.DETECTIONS


def test_a_quaternion_of_zeros_has_no_yaw() -> None:
    data = bytearray(odometry("a/odom", 5, (0.0, 0.0, 0.0)))
    start = len(data) - 8 * 85
    data[start + 24 : start + 56] = bytes(32)
    stream = OdometryStream()
    for _ in range(2):
        assert math.isnan(stream.read(bytes(data))[1][2])
