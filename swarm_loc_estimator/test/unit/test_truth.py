"""Ground truth: by robot, in order of its stamps, of all usual message types."""

import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from bench.shared.bags import copy_part, read_truth
from swarm_loc_estimator.cli.replay import main
from swarm_loc_estimator.common.bags.reader import BagError
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import decode, encode
from swarm_loc_estimator.common.messages.poses import encode_pose_stamped
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.recorded_bag import read_bag, unwatched
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.error_models import ClockModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm

SWARM = Swarm((Robot("a"), Robot("b"), Robot("silent")))
DEMO = Path(__file__).parents[3] / "bags" / "eight_five_robots"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
TRANSFORM_STAMPED = "geometry_msgs/msg/TransformStamped"
WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
POINT = "geometry_msgs/msg/PointStamped"


def test_truth_is_read_by_robot_in_order_of_its_stamps() -> None:
    stamp_ns = np.array([30, 10, 20], np.int64)
    poses = np.array([[0.3, 0.0, 0.1], [0.1, -1.0, 3.0], [np.nan, 0.0, 0.0]])
    messages = encode_pose_stamped("map", stamp_ns, poses)
    tracks = read_truth(SWARM, {"b": messages, "a": [messages[1], b"cut off"], "silent": []})
    assert set(tracks) == {"a", "b"}
    assert tracks["a"].stamp_ns.tolist() == [10]
    assert tracks["b"].stamp_ns.tolist() == [10, 30]
    assert tracks["b"].pose == pytest.approx(poses[[1, 0]])


def converted(data: bytes, message_type: str) -> bytes:
    old = decode(data, POSE_STAMPED)  # whose last 32 bytes, the orientation, a point has not
    header, pose, place = old.header, old.pose, old.pose.position
    with_covariance = {"pose": pose, "covariance": np.arange(36.0)}
    fields = {
        POSE_STAMPED: {"header": header, "pose": pose},
        WITH_COVARIANCE: {"header": header, "pose": with_covariance},
        ODOMETRY: {"header": header, "child_frame_id": "base", "pose": with_covariance},
        TRANSFORM_STAMPED: {
            "header": header,
            "child_frame_id": "base",
            "transform": {"translation": place, "rotation": pose.orientation},
        },
    }
    return encode(fields[message_type], message_type) if message_type != POINT else data[:-32]


def rewritten(bag: Path, source: Path, types: Sequence[str]) -> Path:
    type_of = {f"epuck{number}/ground_truth": name for number, name in enumerate(types, 1)}
    copy_part(
        source,
        bag,
        rename=lambda name, kind: (name, type_of.get(name, kind)),
        change=lambda name, at, data: (at, converted(data, type_of[name]) if name in type_of else data),
    )
    return bag


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags") / "short"
    copy_part(DEMO, folder, 4.0)
    return folder


def test_truth_of_all_usual_types_gives_the_same_errors(tmp_path: Path, short: Path) -> None:
    swarm = load_swarm(DEMO / "swarm.yaml")
    bag = rewritten(tmp_path / "bag", short, (POSE_STAMPED, WITH_COVARIANCE, ODOMETRY, TRANSFORM_STAMPED))
    expected, result = replay(short, swarm), replay(bag, swarm)
    assert result.summaries == expected.summaries
    assert len(result.summaries) == 5
    assert not result.remarks
    assert result.poses.tobytes() == expected.poses.tobytes()
    truth = read_recording(bag, swarm).truth
    for name, track in read_recording(short, swarm).truth.items():
        assert truth[name].pose.tobytes() == track.pose.tobytes()
        assert truth[name].stamp_ns.tobytes() == track.stamp_ns.tobytes()


def test_truth_of_another_type_is_named_with_the_types_allowed(tmp_path: Path, short: Path) -> None:
    bag = rewritten(tmp_path / "bag", short, (POINT,))
    summary = read_bag(bag, load_swarm(DEMO / "swarm.yaml"), lambda _: None, unwatched)
    (remark,) = summary.remarks
    assert f"epuck1/ground_truth has the type {POINT}, which is no ground truth" in remark
    assert all(name in remark for name in (POSE_STAMPED, WITH_COVARIANCE, ODOMETRY, TRANSFORM_STAMPED))
    assert len(summary.truth) == 4


def test_malformed_truth_is_named(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("a/ground_truth", TRANSFORM_STAMPED)
        good = converted(encode_pose_stamped("map", np.array([10]), np.zeros((1, 3)))[0], TRANSFORM_STAMPED)
        for data in (good, good[:-8], good + bytes(8), good):
            writer.write("a/ground_truth", 10, data)
    summary = read_bag(tmp_path / "bag", SWARM, lambda _: None, unwatched)
    assert f"2 messages on a/ground_truth are malformed: no {TRANSFORM_STAMPED} of ROS 2." in summary.remarks
    assert summary.truth["a"].stamp_ns.tolist() == [10, 10]


def error_of(capsys: pytest.CaptureFixture[str], bag: Path, out: Path) -> list[str]:
    assert main([str(bag), "--swarm", str(DEMO / "swarm.yaml"), "--out", str(out)]) == 1
    return capsys.readouterr().err.strip().splitlines()


def test_a_bag_with_other_topics_fails_and_names_the_candidates(
    tmp_path: Path, short: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {"odom": "odometry/filtered", "detections": "markers", "ground_truth": "ground_truth"}

    def rename(topic: str, message_type: str) -> tuple[str, str]:
        robot, name = topic.split("/")
        return f"{robot}/{names[name]}", message_type

    copy_part(short, tmp_path / "bag", rename=rename)
    first, odometry, detections = error_of(capsys, tmp_path / "bag", tmp_path / "out")
    assert first.endswith("holds no message that the estimator can use.")
    assert f"Expected {ODOMETRY} on <robot>/odom; the bag has this type on epuck" in odometry
    assert odometry.count("/odometry/filtered (") == 5
    assert "ground_truth" not in odometry
    assert odometry.endswith("map topics, such as --remap '<robot>/odom:=<robot>/odometry/filtered'.")
    assert detections.count("/markers (") == 5


@pytest.mark.parametrize(
    ("schema", "encoding", "data"),
    [("nav_msgs/Odometry", "ros1", b"of ROS 1"), (ODOMETRY, "json", b'{"header": {"frame_id": "odom"}}')],
    ids=["ros1", "json"],
)
def test_a_bag_of_ros_1_or_json_fails_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], schema: str, encoding: str, data: bytes
) -> None:
    bag = tmp_path / "bag.mcap"
    with bag.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(
            "/epuck1/odom", encoding, writer.register_schema(schema, encoding, b"")
        )
        for log_ns in range(10):
            writer.add_message(channel, log_ns, data, log_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    (said,) = error_of(capsys, bag, tmp_path / "out")
    assert (
        f"bag.mcap: the messages on epuck1/odom are serialized as {encoding}, not as cdr as in ROS 2" in said
    )
    assert ("rosbags-convert" if encoding == "ros1" else "record them again") in said


def test_messages_of_another_type_are_not_read(
    tmp_path: Path, short: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def rename(topic: str, message_type: str) -> tuple[str, str]:
        return topic, POSE_STAMPED if topic.endswith("/odom") else message_type

    copy_part(short, tmp_path / "bag", rename=rename)
    error_of(capsys, tmp_path / "bag", tmp_path / "out")
    report = (tmp_path / "out" / "report.txt").read_text(encoding="utf-8")
    assert f"epuck1/odom has the type {POSE_STAMPED}, expected is {ODOMETRY}: not read." in report
    assert "no message on epuck1/odom" not in report
    assert f"<robot>/odom; the bag has another type on epuck1/odom ({POSE_STAMPED})" in report
    assert "bad_message" not in report


def filtered(topic: str, message_type: str) -> tuple[str, str]:
    return topic.replace("/odom", "/odometry/filtered"), message_type


@pytest.mark.parametrize(
    "remap", [{}, {"<robot>/odom": "/<robot>/odometry/filtered"}], ids=["rules", "<robot>"]
)
def test_mapped_topics_give_the_same_poses(
    tmp_path: Path, short: Path, remap: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    swarm = load_swarm(DEMO / "swarm.yaml")
    remap = remap or {f"{r.name}/odom": f"{r.name}/odometry/filtered" for r in swarm.robots}
    bag, expected = tmp_path / "bag", replay(short, swarm)
    copy_part(short, bag, rename=filtered)
    result = replay(bag, swarm, remap=remap)
    assert result.poses.tobytes() == expected.poses.tobytes()
    assert not result.remarks
    rules = [text for own, stored in remap.items() for text in ("--remap", f"{own}:={stored}")]
    assert main([str(bag), "--swarm", str(DEMO / "swarm.yaml"), "--out", str(tmp_path / "out"), *rules]) == 0
    assert "filtered" not in capsys.readouterr().out
    read = read_recording(bag, swarm, remap=remap).odometry
    assert read.stamp_ns.tobytes() == read_recording(short, swarm).odometry.stamp_ns.tobytes()


def test_a_clock_that_is_behind_is_named_and_its_description_corrects_it(tmp_path: Path, short: Path) -> None:
    def delay(topic: str, log_ns: int, data: bytes) -> tuple[int, bytes]:
        if topic not in ("epuck2/odom", "epuck2/detections"):
            return log_ns, data
        sec, nanosec = struct.unpack_from("<iI", data, 4)
        stamp = divmod(sec * 10**9 + nanosec - 3 * 10**8, 10**9)
        return log_ns, data[:4] + struct.pack("<iI", *stamp) + data[12:]

    swarm, bag = load_swarm(DEMO / "swarm.yaml"), tmp_path / "bag"
    copy_part(short, bag, change=delay)
    (remark,) = replay(bag, swarm).remarks
    assert remark.startswith("epuck2 has a clock 0.3 s behind those of the other robots. Synchronize")
    assert remark.endswith("or set clock.offset_s to -0.3.")
    robots = tuple(
        replace(one, clock=ClockModel(-0.3)) if one.name == "epuck2" else one for one in swarm.robots
    )
    corrected, expected = replay(bag, replace(swarm, robots=robots)), replay(short, swarm)
    assert corrected.poses.tobytes() == expected.poses.tobytes()
    assert not corrected.remarks


def test_a_mapped_topic_takes_the_place_of_the_expected_one(short: Path) -> None:
    swarm = load_swarm(DEMO / "swarm.yaml")
    plain = read_recording(short, swarm).odometry
    swapped = read_recording(short, swarm, remap={"epuck1/odom": "epuck2/odom", "epuck2/odom": "epuck1/odom"})
    replaced = read_recording(short, swarm, remap={"epuck1/odom": "epuck2/odom"})
    first, second = plain.robot == 0, plain.robot == 1
    for read, robot in ((swapped, 0), (replaced, 0)):
        rows = read.odometry.robot == robot
        np.testing.assert_array_equal(read.odometry.pose[rows], plain.pose[second])
    np.testing.assert_array_equal(swapped.odometry.pose[swapped.odometry.robot == 1], plain.pose[first])
    assert "The bag holds no message on epuck2/odom." in replaced.remarks


@pytest.mark.parametrize(
    ("remap", "sentence"),
    [
        ({"epuck1/odometry": "epuck1/odom"}, "epuck1/odometry is none of the topics epuck1/odom, "),
        ({"<robot>/odom": "odom"}, "odom is mapped to epuck1/odom already"),
        (
            {"<robot>/odom": "<robot>/odo"},
            "has no topic epuck1/odo, epuck2/odo, .* it has epuck1/detections, ",
        ),
    ],
)
def test_rules_that_cannot_be_used_are_refused(short: Path, remap: dict[str, str], sentence: str) -> None:
    with pytest.raises(BagError, match=sentence):
        replay(short, load_swarm(DEMO / "swarm.yaml"), remap=remap)


def test_a_rule_without_a_topic_in_the_bag_is_named(short: Path) -> None:
    remap = {"epuck1/odom": "epuck1/odom", "epuck2/odom": "epuck2/odo"}
    result = replay(short, load_swarm(DEMO / "swarm.yaml"), remap=remap)
    assert "short: there is no topic epuck2/odo, which epuck2/odom is mapped to." in result.remarks


@pytest.mark.parametrize("rule", ["odom", ":=odom", "epuck1/odom:="])
def test_a_rule_that_is_none_is_refused(rule: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([str(DEMO), "--remap", rule])
    assert f"--remap: '{rule}' must be EXPECTED:=TOPIC" in capsys.readouterr().err


def test_a_replay_that_locates_nobody_fails(
    tmp_path: Path, short: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy_part(short, tmp_path / "bag", rename=filtered)
    *_, last = error_of(capsys, tmp_path / "bag", tmp_path / "out")
    assert last.startswith("No robot was located at any time")
    assert "/odometry/filtered" in (tmp_path / "out" / "report.txt").read_text(encoding="utf-8")
