"""Messages of poses, images from above and events: what is written is read, also by the type store."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import typestore
from swarm_loc_estimator.common.messages.cdr import (
    ANONYMOUS_DETECTIONS,
    EVENT_PACKETS,
    MARKERS,
    MESSAGE_PACKAGE,
    ROBOT_IDENTITIES,
    SEQUENCE,
    SWARM_POSES,
    CdrError,
    fields_of,
)
from swarm_loc_estimator.common.messages.detections import (
    ANONYMOUS_DTYPE,
    decode_detections,
    encode_detections,
    encode_identities,
)
from swarm_loc_estimator.common.messages.event_encoding import (
    ENCODING,
    MAX_SPAN_NS,
    EventError,
    Events,
    decode_events,
    encode_events,
)
from swarm_loc_estimator.common.messages.poses import EstimateMessage, SwarmPosesEncoder, SwarmPosesReader
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements, Verdict
from swarm_loc_estimator.filter.models import POLAR
from swarm_loc_estimator.offline.export import write_mcap
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.aerial import MAX_ANONYMOUS
from swarm_loc_estimator.sensors.inputs import Batch, Ingest
from swarm_loc_estimator.swarm.swarm import Landmark, Robot, Swarm
from swarm_loc_estimator.timeline.sightings import (
    Recent,
    Sightings,
    decode_sightings,
    encode_sightings,
    newest_sightings,
)
from swarm_loc_estimator.watch.markers import MarkersEncoder, ellipses

SECOND = 1_000_000_000


def estimate_of(names: list[str], seed: int, stamp_ns: int = 5 * SECOND + 3) -> EstimateMessage:
    random, n = np.random.default_rng(seed), len(names)
    pose = random.normal(size=(n, 3))
    root = random.normal(size=(n, 3, 3))
    covariance = root @ np.swapaxes(root, 1, 2)
    status = random.integers(0, 5, n).astype(np.uint8)
    pose[status == 0] = covariance[status == 0] = np.nan
    age, known = random.normal(size=n), (status > 0) & (random.random(n) < 0.5)
    return EstimateMessage(stamp_ns, "map", tuple(names), pose, covariance, age, status, known)


@given(
    st.lists(st.lists(st.text("abcé_1", min_size=1, max_size=9), unique=True, max_size=5), max_size=4),
    st.integers(0, 99),
)
def test_swarm_poses_are_read_whoever_is_in_them(swarms: list[list[str]], seed: int) -> None:
    reader = SwarmPosesReader()
    for names in swarms * 2:
        one = estimate_of(names, seed)
        data = SwarmPosesEncoder(names, "map").encode(one.stamp_ns, *one[3:])
        found = reader.read(data)
        official: Any = typestore().deserialize_cdr(data, SWARM_POSES)
        assert found[:3] == one[:3]
        assert [robot.name for robot in official.robots] == names
        for k, robot in enumerate(official.robots):
            told = (robot.x, robot.y, robot.theta, *robot.covariance)
            np.testing.assert_array_equal(told, [*one.pose[k], *one.covariance[k].ravel()])
            expected = (one.fix_age_s[k], one.status[k], one.heading_known[k])
            assert (robot.fix_age_s, robot.status, robot.heading_known) == expected
        for mine, theirs in zip(found[3:], one[3:], strict=True):
            np.testing.assert_array_equal(mine, theirs)


@given(st.binary(max_size=200), st.integers(0, 400))
def test_bytes_that_are_no_swarm_poses_are_refused(noise: bytes, cut: int) -> None:
    one = estimate_of(["a", "bb"], 1)
    whole = SwarmPosesEncoder(["a", "bb"], "map").encode(one.stamp_ns, *one[3:])
    for data in (noise, whole[: min(cut, len(whole) - 1)]):
        try:
            SwarmPosesReader().read(data)
        except CdrError:
            continue
        assert data == noise, "a message that was cut off is read"


@given(st.integers(0, 9), st.integers(0, 99))
def test_sightings_come_back_as_they_were(count: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    one = Sightings(
        random.integers(-1, 5, count).astype(np.int32),
        random.integers(-3, 5, count).astype(np.int32),
        random.integers(0, 5, count).astype(np.uint8),
        random.normal(size=count).astype(np.float32),
        random.random(count).astype(np.float32),
    )
    data = encode_sightings("map", 7 * SECOND, one)
    stamp_ns, found = decode_sightings(data)
    assert stamp_ns == 7 * SECOND
    official = typestore().deserialize_cdr(data, f"{MESSAGE_PACKAGE}/msg/SwarmSightings")
    for name, mine, theirs in zip(one._fields, found, one, strict=True):
        np.testing.assert_array_equal(mine, theirs)
        np.testing.assert_array_equal(getattr(official, name), theirs)


@given(
    st.lists(
        st.tuples(st.integers(0, 3000), st.integers(0, 2), st.integers(-2, 2), st.integers(0, 4)), max_size=40
    )
)
def test_of_each_pair_the_newest_measurement_is_published(measured: list[tuple[int, int, int, int]]) -> None:
    measured = sorted(measured)
    rows = Measurements.empty(len(measured))
    for k, (at_ms, observer, target, _) in enumerate(measured):
        rows.stamp_ns[k], rows.observer[k], rows.model[k] = at_ms * 1_000_000, observer, POLAR
        rows.target[k], rows.landmark[k] = (target, NOBODY) if target >= 0 else (NOBODY, -1 - target)
    verdicts = np.array([verdict for *_, verdict in measured], dtype=np.uint8)
    found = newest_sightings(Recent(rows, verdicts, np.ones(len(measured))), 3 * SECOND)
    expected = {(a, b): (at_ms, verdict) for at_ms, a, b, verdict in measured if at_ms >= 1000}
    pairs = list(zip(found.observer.tolist(), found.target.tolist(), strict=True))
    assert sorted(pairs) == sorted(expected)
    for pair, age_s, verdict, nis in zip(pairs, found.age_s, found.verdict, found.nis, strict=True):
        assert age_s == pytest.approx((3000 - expected[pair][0]) / 1e3, abs=1e-6)
        assert np.isnan(nis) == (verdict not in (Verdict.USED, Verdict.GATED))


def test_markers_are_what_viewers_read() -> None:
    swarm = Swarm(
        robots=(Robot("a"), Robot("b"), Robot("c")), landmarks=(Landmark(1, 1.0, 2.0, yaw=0.0), Landmark(2))
    )
    pose = np.array([[1.0, 2.0, np.pi / 2], [3.0, 4.0, 0.0], [np.nan] * 3])
    covariance = np.tile(np.diag([0.04, 0.01, 0.1]), (3, 1, 1))
    one = EstimateMessage(
        SECOND,
        "map",
        ("a", "b", "c"),
        pose,
        covariance,
        np.zeros(3),
        np.array([1, 4, 0], np.uint8),
        np.array([True, False, False]),
    )
    seen = Sightings(
        np.array([0, 0, 2, -1], np.int32),
        np.array([1, -2, 0, 0], np.int32),
        np.array([1, 2, 3, 1], np.uint8),
        np.zeros(4, np.float32),
        np.zeros(4, np.float32),
    )
    array: Any = typestore().deserialize_cdr(MarkersEncoder(swarm, "map").encode(one, seen), MARKERS)
    markers = array.markers
    assert markers[0].action == 3, "what was shown before must go"
    named = {marker.ns: marker for marker in markers[1:] if marker.ns != "names"}
    assert [(p.x, p.y) for p in named["robots"].points] == [(1.0, 2.0), (3.0, 4.0)]
    assert named["robots"].colors[0].b > 0.6
    start, end = named["headings"].points  # that of b is unknown
    assert (start.x, start.y) == (1.0, 2.0)
    assert end.x == pytest.approx(1.0)
    assert end.y > 2.0
    assert [(p.x, p.y) for p in named["sightings"].points] == [(1.0, 2.0), (3.0, 4.0), (1.0, 2.0), (0.0, 0.0)]
    assert [marker.text for marker in markers if marker.ns == "names"] == ["a", "b"]
    assert all(marker.header.frame_id == "map" and marker.header.stamp.sec == 1 for marker in markers)


@given(st.integers(0, 99))
def test_an_ellipse_is_where_the_mahalanobis_distance_is_that_of_95_percent(seed: int) -> None:
    one = estimate_of(["a", "b"], seed)
    located = np.isfinite(one.pose).all(axis=1)
    pose, covariance = one.pose[located], one.covariance[located]
    points = ellipses(pose, covariance)[:, :2].reshape(len(pose), 48, 2)
    for k in range(len(pose)):
        off = points[k] - pose[k, :2]
        distance = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance[k, :2, :2]), off)
        np.testing.assert_allclose(distance, 5.991, rtol=1e-4)


def test_a_run_is_written_as_mcap(tmp_path: Path) -> None:
    stamp_ns = np.arange(1, 4) * SECOND
    pose, covariance = np.zeros((3, 2, 3)), np.tile(np.eye(3), (3, 2, 1, 1))
    pose[0, 1] = np.nan
    result = ReplayResult(
        "run",
        Swarm(robots=(Robot("a"), Robot("b"))),
        stamp_ns,
        pose,
        covariance,
        np.isfinite(pose[..., 0]).view(np.uint8),
        heading_known=np.array([[True, False], [True, True], [False, True]]),
    )
    file = tmp_path / "run.mcap"
    file.write_bytes(b"an older one")
    write_mcap(result, file)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
    reader = SwarmPosesReader()
    with BagReader(file) as bag:
        assert {topic.name for topic in bag.topics} == {"swarm/poses", "tf", "swarm/markers"}
        poses = [reader.read(bytes(data)) for _, _, _, data in bag.messages(["swarm/poses"])]
        (first, *_) = [bytes(data) for _, _, _, data in bag.messages(["tf"])]
    assert [one.stamp_ns for one in poses] == stamp_ns.tolist()
    assert [one.status.tolist() for one in poses] == [[1, 0], [1, 1], [1, 1]]
    assert [one.heading_known.tolist() for one in poses] == result.heading_known.tolist()
    transforms: Any = typestore().deserialize_cdr(first, "tf2_msgs/msg/TFMessage")
    (transform,) = transforms.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "a/base_link")


NAMES = st.sampled_from(["", "a", "map", "ab/base_link", "r\u00f6"])


def detections(count: int, seed: int = 1) -> NDArray[np.void]:
    rng = np.random.default_rng(seed)
    out = np.zeros(count, dtype=ANONYMOUS_DTYPE)
    for name in ANONYMOUS_DTYPE.names or ():
        out[name] = rng.uniform(-1.0, 1.0, out[name].shape)
    out["theta"][::2] = np.nan
    return out


def read(*messages: tuple[bytes, int]) -> tuple[Batch, Ingest]:
    ingest = Ingest(Swarm((Robot("a"), Robot("b"))))
    handle = ingest.handle_of["aerial/detections"]
    (found,) = ingest.read(MessageBatch.of([SerializedMessage(handle, data, at) for data, at in messages]))
    return found, ingest


@given(
    frame=NAMES,
    stamp_ns=st.integers(0, 2**60),
    count=st.integers(0, 5),
    seed=st.integers(0, 99),
    swapped=st.booleans(),
)
def test_images_read_as_the_type_store_writes_them(
    frame: str, stamp_ns: int, count: int, seed: int, swapped: bool
) -> None:
    shown = detections(count, seed)
    data = encode_detections(frame, stamp_ns, shown)
    message = typestore().deserialize_cdr(data, ANONYMOUS_DETECTIONS)
    rewritten = typestore().serialize_cdr(message, ANONYMOUS_DETECTIONS, little_endian=not swapped)
    for one in (
        decode_detections(data, ANONYMOUS_DETECTIONS),
        decode_detections(bytes(rewritten), ANONYMOUS_DETECTIONS),
    ):
        assert (one.stamp_ns, one.frame_id) == (stamp_ns, frame)
        assert one.detections.tobytes() == shown.tobytes()


def test_images_become_rows_and_those_that_cannot_be_used_are_counted() -> None:
    far_too_many = encode_detections("map", 4, detections(MAX_ANONYMOUS + 1))
    images = [
        (encode_detections("map", 1, detections(2)), 10),
        (encode_detections("odom", 2, detections(3)), 11),
        (encode_detections("map", 3, detections(0)), 12),
        (far_too_many, 13),
        (b"nonsense", 14),
        (encode_detections("map", 5, detections(1, 2)), 15),
    ]
    found, ingest = read(*images)
    rows = found["aerial"]
    assert rows.stamp_ns.tolist() == [1, 1, 5]
    assert rows.number.tolist() == [0, 1, 0]
    assert rows.arrival_ns.tolist() == [10, 10, 15]
    assert rows.robot.tolist() == [-1, -1, -1]
    np.testing.assert_array_equal(rows.pose[2, :2], [detections(1, 2)["x"][0], detections(1, 2)["y"][0]])
    assert np.isnan(rows.pose[0, 2])
    assert found.dropped == {"aerial_frame": 1, "aerial_too_many": 1, "bad_message": 1}
    assert ingest.received() == {"aerial/detections": 6}


def test_identities_read_as_the_type_store_reads_them() -> None:
    names, place, probability = ["a", "epuck12"], np.array([3, -1]), np.array([0.995, 0.25])
    data = encode_identities("map", 7_000_000_001, names, place, probability)
    message: Any = typestore().deserialize_cdr(data, ROBOT_IDENTITIES)
    told = [(one.name, one.detection, one.probability) for one in message.identities]
    assert told == [("a", 3, 0.995), ("epuck12", -1, 0.25)]
    assert (message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec) == ("map", 7, 1)


SIZE = (640, 480)


def events(seed: int, count: int) -> Events:
    rng = np.random.default_rng(seed)
    return Events(
        rng.integers(0, SIZE[0], count).astype(np.uint16),
        rng.integers(0, SIZE[1], count).astype(np.uint16),
        rng.random(count) < 0.5,
        np.sort(rng.integers(0, MAX_SPAN_NS, count, endpoint=True)),
    )


@given(seed=st.integers(0, 2**31), count=st.integers(0, 50))
def test_what_is_encoded_comes_back(seed: int, count: int) -> None:
    sent = events(seed, count)
    for one, other in zip(decode_events(encode_events(sent), ENCODING, SIZE), sent, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_layout_is_that_of_event_camera_msgs() -> None:
    """Time in the lowest 32 bits, then column and row, polarity in the highest bit."""
    one = Events(np.array([37], np.uint16), np.array([100], np.uint16), np.array([True]), np.array([5000]))
    assert encode_events(one) == (1 << 63 | 100 << 48 | 37 << 32 | 5000).to_bytes(8, "little")


def test_our_copy_of_the_message_has_the_fields_of_event_camera_msgs() -> None:
    expected = {"header": "std_msgs/msg/Header", "height": "I", "width": "I", "seq": "Q", "time_base": "Q"}
    expected |= {"encoding": "string", "is_bigendian": "?", "events": "B"}
    fields = fields_of(EVENT_PACKETS[-1])
    assert [(one.name, one.type) for one in fields] == [*expected.items()]
    assert [one.name for one in fields if one.size == SEQUENCE] == ["events"]


def test_the_other_order_of_bytes_is_read() -> None:
    sent = events(1, 20)
    swapped = np.frombuffer(encode_events(sent), "<u8").astype(">u8").tobytes()
    np.testing.assert_array_equal(decode_events(swapped, ENCODING, SIZE, is_bigendian=True).x, sent.x)


@pytest.mark.parametrize(
    ("data", "encoding", "reason"),
    [
        (encode_events(events(2, 5))[:-3], ENCODING, "cut"),
        (encode_events(events(2, 5)), "evt3", "evt3"),
        ((640 << 32).to_bytes(8, "little"), ENCODING, "outside"),
        (encode_events(events(2, 5))[::-1], ENCODING, "outside|step back"),
        (encode_events(events(2, 5))[8:] + encode_events(events(2, 5))[:8], ENCODING, "step back"),
    ],
)
def test_broken_packets_are_refused(data: bytes, encoding: str, reason: str) -> None:
    with pytest.raises(EventError, match=reason):
        decode_events(data, encoding, SIZE)
