"""Sources of measurements: what they are given, and what is kept of messages."""

from collections.abc import Sequence

import numpy as np
import pytest
from core_messages import SECOND, big_endian
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_estimator.common.messages.cdr import DETECTIONS, ODOMETRY
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    decode_detections,
    encode_detections,
)
from swarm_loc_estimator.common.messages.poses import decode_odometry, encode_fix, encode_odometry
from swarm_loc_estimator.common.messages.streams import (
    DetectionReader,
    MessageBatch,
    PoseReader,
    SerializedMessage,
)
from swarm_loc_estimator.filter.sources import (
    AGREES,
    DEVIATES,
    SUSPECT,
    WELL_CONFIRMED,
    is_contradicted,
    widen_suspect_covariance,
)
from swarm_loc_estimator.filter.state import SourceArrays, SwarmState, new_sources
from swarm_loc_estimator.sensors.inputs import Ingest, WrongClock
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.error_models import ClockModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

Pose = tuple[float, float, float]
FRAMES = st.sampled_from(["", "a", "ab/odom", "robot17/odom", "r\u00f6/camera"])


TWIST = (0.25, -0.125, 2.0)


def test_clocks_are_compared_by_the_least_delays_and_corrected_by_their_descriptions() -> None:
    names, late_ns = "abcd", {"a": 0, "b": 50_000_000, "c": 350_000_000, "d": -300_000_000}

    def read(offset_s: float) -> Ingest:
        ingest = Ingest(
            Swarm(tuple(Robot(name, clock=ClockModel(offset_s * (name == "c"))) for name in names))
        )
        sent = [
            SerializedMessage(
                ingest.handle_of[f"{name}/odom"],
                odometry("", SECOND * k - late_ns[name] - (k % 3) * 100_000_000, (0.0, 0.0, 0.0)),
                SECOND * k,
            )
            for k in range(5, 15)
            for name in names
        ]
        list(ingest.read(MessageBatch.of(sent)))
        return ingest

    found = read(0.0).clocks_apart()
    assert [*found] == [2, 3]
    assert found[2].apart_s == found[2].offset_s == pytest.approx(-0.325)
    assert found[2].problem == "has a clock 0.33 s behind those of the other robots"
    assert found[3].problem == "has a clock 0.33 s ahead of those of the other robots"
    assert [*read(-0.325).clocks_apart()] == [3]
    assert read(0.4).clocks_apart()[2].offset_s == pytest.approx(-0.325)


@pytest.mark.parametrize(
    ("offset_s", "advice"),
    [
        (-0.3251, ", or set clock.offset_s to -0.325"),
        (1234.5678, ", or set clock.offset_s to 1234.568"),
        (-987654321.0987, ", or set clock.offset_s to -987654321.099"),
        (-1.79e9, ""),
    ],
)
def test_the_offset_to_set_is_exact_to_a_millisecond_and_in_range(offset_s: float, advice: str) -> None:
    """A computer without a hardware clock begins in 1970."""
    clock = WrongClock(offset_s, offset_s)
    assert clock.remedy == f"Synchronize it with the others (chrony){advice}"


def test_clocks_of_two_robots_are_not_judged() -> None:
    ingest = Ingest(Swarm((Robot("a"), Robot("b"))))
    sent = [
        SerializedMessage(ingest.handle_of[f"{name}/odom"], odometry("", k, (0.0, 0.0, 0.0)), k + late_ns)
        for k in range(SECOND, 2 * SECOND, SECOND // 10)
        for name, late_ns in (("a", 0), ("b", SECOND))
    ]
    list(ingest.read(MessageBatch.of(sorted(sent, key=lambda one: one.log_ns))))
    assert ingest.clocks_apart() == {}


def test_offsets_of_clocks_leave_fixes_alone() -> None:
    robots = (Robot("a", clock=ClockModel(0.5)), Robot("b"))
    stamps: dict[str, list[int]] = {}
    for swarm in (Swarm(robots), Swarm((Robot("a"), Robot("b")))):
        ingest = Ingest(swarm)
        sent = [
            SerializedMessage(ingest.handle_of["a/odom"], odometry("", SECOND, (0.0, 0.0, 0.0)), SECOND),
            SerializedMessage(ingest.handle_of["a/detections"], detections("", SECOND, 2), SECOND),
            SerializedMessage(
                ingest.handle_of["a/fix"], encode_fix("map", SECOND, (0.0, 0.0, 0.0), np.eye(3)), SECOND
            ),
        ]
        (batch,) = ingest.read(MessageBatch.of(sent))
        for sensor in ("odometry", "detections", "fixes"):
            stamps.setdefault(sensor, []).append(batch[sensor].stamp_ns[0] - SECOND)
    assert stamps == {"odometry": [-SECOND // 2, 0], "detections": [-SECOND // 2, 0], "fixes": [0, 0]}


def odometry(frame: str, stamp_ns: int, pose: Pose, child: str = "base") -> bytes:
    (data,) = encode_odometry(
        frame, child, np.array([stamp_ns]), np.array([pose]), np.array([TWIST]), np.eye(6), np.eye(6)
    )
    return data


def detections(frame: str, stamp_ns: int, count: int) -> bytes:
    rows = np.zeros(count, DETECTION_DTYPE)
    rows["id"] = 7 + np.arange(count)
    rows["position"] = np.arange(3 * count).reshape(-1, 3)
    rows["alternative_ratio"] = 0.5
    return encode_detections(frame, stamp_ns, rows)


def batch_of(
    messages: Sequence[bytes], topics: Sequence[int] = (), times: Sequence[int] = ()
) -> MessageBatch:
    n = len(messages)
    return MessageBatch.of(list(map(SerializedMessage, topics or [0] * n, messages, times or [0] * n)))


@given(
    st.lists(st.tuples(st.integers(0, 2), FRAMES, FRAMES, st.integers(0, 2**62 // 10**9), st.booleans())),
    st.booleans(),
)
def test_odometry_reads_as_by_the_complete_reader(
    rows: list[tuple[int, str, str, int, bool]], at_once: bool
) -> None:
    reader, messages = PoseReader(3, decode_odometry, names=2), []
    for _, frame, child, stamp_ns, swapped in rows:
        data = odometry(frame, stamp_ns, (1.5, -2.5, 3.0), child)
        messages.append(big_endian(data, ODOMETRY) if swapped else data)
    batch = batch_of(messages, [row[0] for row in rows])
    slices = [slice(None)] if at_once else [slice(k, k + 1) for k in range(len(rows))]
    parts = [reader.read(batch.chosen(rows)) for rows in slices]
    stamps = [stamp for part in parts for stamp in part.stamp_ns.tolist()]
    poses = [tuple(pose) for part in parts for pose in part.pose.tolist()]
    expected = [decode_odometry(data) for data in messages]
    assert stamps == [message.stamp_ns for message in expected]
    assert poses == [message.pose for message in expected]
    twists = [tuple(twist) for part in parts for twist in part.twist.tolist()]
    assert twists == [message.twist for message in expected] == [TWIST] * len(rows)
    for topic, frame, *_ in rows:
        newest = [row for row in rows if row[0] == topic][-1]
        assert reader.frame_ids[topic] == newest[1], frame


@given(st.lists(st.tuples(st.integers(0, 2), FRAMES, st.integers(0, 4), st.booleans()), max_size=8))
def test_detections_read_as_by_the_complete_reader(rows: list[tuple[int, str, int, bool]]) -> None:
    reader, messages = DetectionReader(3), []
    for k, (_, frame, count, swapped) in enumerate(rows):
        data = detections(frame, 5 + k, count)
        messages.append(big_endian(data, DETECTIONS) if swapped else data)
    columns = reader.read(batch_of(messages, [row[0] for row in rows]))
    expected = [decode_detections(data) for data in messages]
    assert columns.stamp_ns.tolist() == [message.stamp_ns for message in expected]
    assert columns.count.tolist() == [message.detections.size for message in expected]
    assert columns.detection.dtype == DETECTION_DTYPE
    for name in DETECTION_DTYPE.names or ():
        wanted = [message.detections[name] for message in expected]
        found = columns.detection[name]
        assert np.array_equal(found, np.concatenate(wanted) if wanted else found[:0])


@pytest.mark.parametrize("kind", ["odometry", "detections"])
def test_damaged_bytes_are_refused_before_and_after_a_good_message(kind: str) -> None:
    is_odometry = kind == "odometry"
    good = odometry("a/odom", 5, (0.0, 0.0, 0.0)) if is_odometry else detections("a/camera", 5, 2)
    reader = PoseReader(1, decode_odometry, names=2) if is_odometry else DetectionReader(1)
    bad_stamp = good[:8] + b"\xff\xff\xff\xff" + good[12:]
    broken = [b"", good[:3], good[:40], good[:-30], good + bytes(50), b"\x07" + good[1:], bad_stamp]
    columns = reader.read(batch_of([*broken, good, *broken, good, good[:-1] + b"\x01"]))
    bad = [False] * len(broken)
    assert columns.valid.tolist() == [*bad, True, *bad, True, True]


def test_each_topic_is_read_and_counted_and_malformed_ones_go_no_further() -> None:
    ingest = Ingest(Swarm((Robot("a"), Robot("b", camera=None))))
    kinds = ("odom", "detections", "brightness", "fix")
    of_robots = [f"{name}/{kind}" for name in "ab" for kind in kinds]
    assert [topic.name for topic in ingest.topics] == [
        *of_robots,
        "aerial/detections",
        "swarm/odom",
        "swarm/detections",
        "swarm/fixes",
    ]
    assert [topic.name for topic in ingest.topics if topic.expected] == ["a/odom", "a/detections", "b/odom"]

    odom, seen = ingest.handle_of["b/odom"], ingest.handle_of["a/detections"]
    pose = (1.0, 2.0, 0.0)
    messages = [
        odometry("b/odom", 10, pose),
        odometry("b/odom", 20, pose),
        b"x",
        detections("a/camera", 15, 2),
    ]
    (read,) = ingest.read(batch_of(messages, [odom, odom, odom, seen], [14, 30, 40, 50]))

    driven = [column.tolist() for column in read["odometry"]]
    assert driven == [[1, 1], [10, 20], [[*pose], [*pose]], [[*TWIST], [*TWIST]], [14, 30]]
    assert read["detections"].detection["id"].tolist() == [7, 8]
    assert [read["detections"].robot.tolist(), read["detections"].stamp_ns.tolist()] == [[0, 0], [15, 15]]
    assert read["detections"].arrival_ns.tolist() == [50, 50]
    assert (read.begin_ns, read.end_ns, read.dropped) == (14, 50, {"bad_message": 1})
    statistics = ingest.statistics[odom]
    assert (statistics.received, statistics.malformed) == (3, 1)
    assert statistics.last_arrival_ns == 30
    assert (statistics.mean_period_ns, ingest.statistics[seen].mean_period_ns) == (16.0, None)
    assert (statistics.late_sum_ns, statistics.late_max_ns, statistics.late_count) == (14, 10, 2)
    statistics.restart()
    assert (statistics.late_sum_ns, statistics.late_max_ns, statistics.late_count) == (0, None, 0)
    assert ingest.frame_id(odom) == "b/odom"
    assert ingest.topics[seen].kind.name == "detections"
    assert ingest.statistics[0].last_arrival_ns is None


def test_messages_are_parted_where_time_goes_back() -> None:
    ingest = Ingest(Swarm((Robot("a"),)))
    messages = [odometry("a/odom", k, (0.0, 0.0, 0.0)) for k in range(6)]
    parts = list(ingest.read(batch_of(messages, times=[5, 5, 9, 3, 4, 1])))
    assert [(part.begin_ns, part.end_ns) for part in parts] == [(5, 9), (3, 4), (1, 1)]
    assert [part["odometry"].stamp_ns.tolist() for part in parts] == [[0, 1, 2], [3, 4], [5]]
    assert not list(ingest.read(MessageBatch.of([])))


@pytest.mark.parametrize("size", [1, 5, 6, 7, 100])
def test_parts_have_all_messages_in_order_and_at_most_one_above_the_size_asked(size: int) -> None:
    sent = [SerializedMessage(k, bytes(length), k) for k, length in enumerate([3, 0, 9, 2, 2, 1])]
    parts = list(MessageBatch.parts_of([*sent], size))
    assert [one for part in parts for one in part.messages()] == [
        (k, log_ns, data) for k, data, log_ns in sent
    ]
    assert all(part.length[1:].sum() <= size for part in parts)
    assert not list(MessageBatch.parts_of([], size))


def test_a_quaternion_of_zeros_has_no_yaw() -> None:
    data = bytearray(odometry("a/odom", 5, (0.0, 0.0, 0.0)))
    start = len(data) - 8 * 85
    data[start + 24 : start + 56] = bytes(32)
    columns = PoseReader(1, decode_odometry, names=2).read(batch_of([bytes(data)] * 2))
    assert columns.valid.all()
    assert np.isnan(columns.pose[:, 2]).all()


NOW_NS, LONG_NS = 10**12, 10**9
ROBOTS, LANDMARKS = 2, 3


def confirmed() -> SourceArrays:
    """Two robots whose poses are confirmed; the first one has just seen the first landmark."""
    state = new_sources(ROBOTS, LANDMARKS)
    state.confirmations[:], state.measured_ns[:] = WELL_CONFIRMED, NOW_NS
    state.source[0, 0], state.seen_ns[0, 0] = ROBOTS, NOW_NS
    return state


def is_widened(state: SourceArrays) -> bool:
    covariance = np.zeros((3, 3))
    widen_suspect_covariance(state, 0, covariance)
    return bool(covariance.any())


def test_a_confirmed_pose_is_widened_while_it_measures_a_suspect_source() -> None:
    state = confirmed()
    assert not is_widened(state)
    state.score[ROBOTS] = SUSPECT
    assert is_widened(state)
    state.seen_ns[0, 0] -= LONG_NS
    assert not is_widened(state)


def test_a_suspect_source_that_a_robot_does_not_measure_does_not_concern_it() -> None:
    state = confirmed()
    state.score[ROBOTS + 1] = SUSPECT
    assert not is_widened(state)


def test_a_pose_that_is_little_confirmed_is_widened() -> None:
    state = confirmed()
    state.confirmations[0] = 0.5 * WELL_CONFIRMED
    assert is_widened(state)


@pytest.mark.parametrize(("evidence", "contradicted"), [(2.0, False), (4.0, True)])
def test_radios_deny_a_pose_when_half_of_them_have_deviated_more_than_once(
    evidence: float, contradicted: bool
) -> None:
    state = SwarmState(ParameterTable.of([Robot("a"), Robot("b")]))
    links = state.sources
    for place, finding in enumerate((DEVIATES, AGREES)):
        links.source[0, place], links.seen_ns[0, place] = links.score.size + place, NOW_NS
        links.finding[0, place], links.evidence[0, place] = finding, evidence * (finding == DEVIATES)
    assert is_contradicted(state.arrays(), 0) == contradicted
