"""Recorded motion capture gives fixes or ground truth in bags, as `localizer_bridge` gives them live."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import POSE_STAMPED, decode, encode
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.doctor.doctor import evidence_of_bag
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.sensors.inputs import input_topics
from swarm_loc_estimator.sensors.localizers import BODY, SOURCES
from swarm_loc_estimator.swarm.swarm import Anchor, Localizer, Robot, Swarm, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import SwarmFileError, load_swarm, save_swarm

BAG = Path(__file__).parents[3] / "bags" / "eight_five_robots"
ROBOTS = ("epuck1", "epuck2")
BODIES = ("cf1=epuck1", "cf2=epuck2")


def bodies(source: str, name: str, header: Any, pose: Any) -> tuple[str, dict[str, Any]]:
    """Topic and message about one body."""
    place, turn = vars(pose.position), vars(pose.orientation)
    header = {"stamp": header.stamp, "frame_id": "world"}
    if source == "tf":
        joint = {"translation": place, "rotation": turn}
        return "tf", {"transforms": [{"header": header, "child_frame_id": name, "transform": joint}]}
    of_body = {"position": place, "orientation": turn}
    if source == "named_poses":
        return "poses", {"header": header, "poses": [{"name": name, "pose": of_body}]}
    return f"vrpn_mocap/{name}/pose", {"header": header, "pose": of_body}


def recorded(bag: Path, source: str) -> None:
    """Odometry of two robots for 15 s, and their ground truth as motion capture."""
    with BagReader(BAG) as reader, BagWriter(bag) as writer:
        for robot in ROBOTS:
            writer.add_topic(f"{robot}/odom", "nav_msgs/msg/Odometry")
        kind = SOURCES[source].message_type
        for body in ("cf1", "cf2") if source == "pose" else ("",):
            writer.add_topic(SOURCES[source].topic.replace(BODY, body).lstrip("/"), kind)
        wanted = [f"{robot}/{topic}" for robot in ROBOTS for topic in ("odom", "ground_truth")]
        for name, _, log_ns, data in reader.messages(wanted):
            if log_ns > reader.time_range_ns[0] + 15e9:
                break
            if name.endswith("odom"):
                writer.write(name, log_ns, data)
                continue
            message = decode(data, POSE_STAMPED)
            topic, fields = bodies(source, f"cf{name[5]}", message.header, message.pose)
            writer.write(topic, log_ns, encode(fields, kind))


def swarm(source: str, output: str) -> Swarm:
    localizer = Localizer(source, output=output, bodies=BODIES)
    return Swarm(tuple(Robot(name, camera=None) for name in ROBOTS), localizer=localizer)


@pytest.mark.parametrize("source", ["pose", "tf", "named_poses"])
def test_motion_capture_in_a_bag_locates_robots(tmp_path: Path, source: str) -> None:
    recorded(tmp_path / "bag", source)
    fixed = replay(tmp_path / "bag", swarm(source, "fix"))
    assert fixed.counters["messages on <robot>/fix"] == 302
    assert not fixed.truth
    judged = replay(tmp_path / "bag", swarm(source, "ground_truth"))
    assert "messages on <robot>/fix" not in judged.counters
    with BagReader(BAG) as reader:
        log_ns = [log_ns for _, _, log_ns, _ in reader.messages(["epuck1/ground_truth"])]
    assert {len(track.stamp_ns) for track in judged.truth.values()} == {151} != {len(log_ns)}
    for index, name in enumerate(ROBOTS):
        track = judged.truth[name]
        known = np.isfinite(fixed.poses[:, index, 0])
        true = np.stack(
            [np.interp(fixed.stamp_ns[known], track.stamp_ns, xy) for xy in track.pose[:, :2].T], 1
        )
        assert known.mean() > 0.9
        assert np.abs(fixed.poses[known, index, :2] - true).max() < 0.01


def test_the_doctor_hears_the_localizer_of_a_bag(tmp_path: Path) -> None:
    recorded(tmp_path / "bag", "tf")
    evidence = evidence_of_bag(tmp_path / "bag", swarm("tf", "fix"), 60.0, unwatched)
    assert np.unique(evidence.rows("fixes").robot).tolist() == [0, 1]


def test_what_the_localizer_drops_is_said(tmp_path: Path) -> None:
    recorded(tmp_path / "bag", "pose")
    described = swarm("pose", "fix")
    elsewhere = Localizer(bodies=BODIES, source_frame="lab")
    result = replay(tmp_path / "bag", Swarm(described.robots, localizer=elsewhere))
    assert "Dropped messages of the localizer: 302 foreign_frame." in result.remarks


def test_topics_have_other_names_for_all_robots_or_one(tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text(
        "fileversion: 1\nrobots: {r1: {}, r2: {}}\ntopics:\n  <robot>/odom: /lab/<robot>/odometry/filtered\n"
        "  r2/odom: second/odom\nlocalizer: {source: tf, bodies: [b=r1], latency_s: 0.1}\n"
    )
    found = load_swarm(path)
    names = [topic.name for topic in input_topics(found) if topic.kind.name == "odometry"]
    assert names == ["lab/r1/odometry/filtered", "second/odom"]
    assert found.topic("r1", "fix") == "r1/fix"
    save_swarm(found, tmp_path / "again.yaml")
    assert load_swarm(tmp_path / "again.yaml") == found


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("topics: {odom: x}", "topics.odom must begin with <robot> or the name of a robot or camera, and /"),
        ("topics: {r9/odom: x}", "topics.r9/odom must begin with <robot>"),
        ("topics: {r1/odom: 'a b'}", "topics.r1/odom is 'a b' but must be a topic"),
        ("topics: {<robot>/odom: odom}", "must be the topic of only one robot"),
        ("topics: {r1/odom: odom, r2/odom: odom}", "must be the topic of only one robot"),
        ("localizer: {sorce: tf}", "'localizer.sorce' is not a known key; the nearest one is 'source'"),
        ("localizer: {source: ft}", "localizer.source = 'ft' must be one of pose,"),
        ("localizer: {latency_s: 3}", "localizer.latency_s = 3.0 must lie in [0, 2] s"),
        (f"localizer: {{latency_s: -{10**400}}}", "localizer.latency_s = -inf must lie in [0, 2] s"),
    ],
)
def test_wrong_topics_and_localizers_are_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text(f"fileversion: 1\nrobots: {{r1: {{}}, r2: {{}}}}\n{text}\n")
    with pytest.raises(SwarmFileError) as error:
        load_swarm(path)
    assert said in str(error.value)


@pytest.mark.parametrize("name", ["r1/odm", "r1/x/odom"])
def test_a_topic_that_nobody_reads_is_refused(name: str) -> None:
    with pytest.raises(UserError, match=rf"topics has {name}, but topics of robots are .*odom"):
        input_topics(Swarm((Robot("r1"),), topics={name: "x"}))


@pytest.mark.parametrize(
    ("topics", "range_topic", "name"),
    [
        ({"r1/odom": "r2/odom"}, "", "r2/odom"),
        ({"<robot>/odom": "x/<robot>", "r1/odom": "x/r2"}, "", "x/r2"),
        ({}, "uwb/{from}{to}", "uwb/111"),
    ],
)
def test_a_topic_of_two_inputs_is_refused(topics: dict[str, str], range_topic: str, name: str) -> None:
    robots = (Robot("r1", uwb=UwbDevice(1)), Robot("r2", uwb=UwbDevice(12)))
    anchors = (Anchor(11), Anchor(2))
    with pytest.raises(UserError, match=rf"{name} is the topic of two inputs: correct topics or range_topic"):
        input_topics(Swarm(robots, anchors=anchors, topics=topics, range_topic=range_topic))


@pytest.mark.parametrize("output", ["fix", "ground_truth"])
def test_a_localizer_that_was_not_recorded_is_named(tmp_path: Path, output: str) -> None:
    recorded(tmp_path / "bag", "pose")
    localizer = Localizer(topic="/mocap/<body>/pose", output=output, bodies=BODIES)
    remarks = replay(tmp_path / "bag", Swarm(swarm("pose", "fix").robots, localizer=localizer)).remarks
    for name in ("mocap/cf1/pose", "mocap/cf2/pose"):
        assert f"The bag holds no geometry_msgs/msg/PoseStamped of the localizer on {name}." in remarks


def test_odometry_is_no_localizer_at_the_same_time(tmp_path: Path) -> None:
    recorded(tmp_path / "bag", "pose")
    described = Swarm(swarm("pose", "fix").robots, localizer=Localizer("odometry", "/<body>/odom"))
    with pytest.raises(UserError, match=r"localizer.topic: epuck1/odom is already a topic of another input"):
        replay(tmp_path / "bag", described)
