"""`new BAG` describes what a recording shows: the description replays, and what it says is right."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from core_messages import odometry_bytes

from swarm_loc_estimator.cli.new import main
from swarm_loc_estimator.cli.replay import main as replay_main
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.messages.cdr import (
    LASER_SCAN,
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    RANGE,
    TRANSFORMS,
    encode,
)
from swarm_loc_estimator.common.messages.poses import encode_pose_stamped
from swarm_loc_estimator.doctor.proposal import Proposal, heard_in, proposed
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.settings import Settings

BAGS = Path(__file__).parents[3] / "bags"
NAMES = ("lab/r01", "lab/r03", "lab/r04", "lab/r05")
NODES = {"r01": 7, "r03": 3, "r04": 4, "r05": 5}
ANCHORS = {1: (-3.0, -2.0), 6: (4.0, 3.0)}
TURNED = 0.5  # Of the body of r01


def proposal(bag: Path) -> Proposal:
    return proposed(heard_in(bag, unwatched).topics, lambda likely: likely, bag.parent)


@pytest.mark.parametrize(
    ("bag", "asked"),
    [
        ("aerial_five", []),
        ("droplets_twenty", ["droplet1"]),
        ("eight_five_robots", ["all markers"]),
        ("eight_five_robots_w2", ["all markers"]),
        ("eight_one_robot_fast", ["all markers"]),
        ("eight_one_robot_slow", ["all markers"]),
        ("eight_pictures", ["epuck1, epuck2: each has images but no detections"]),
        ("pushbot_one", []),
        ("pushbots_two", []),
    ],
)
def test_the_description_of_a_bag_replays_without_an_edit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bag: str, asked: list[str]
) -> None:
    path = tmp_path / "swarm.yaml"
    assert main(["--yes", str(BAGS / bag), str(path)]) == 0
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("# ?")]
    assert [line[4 : 4 + len(one)] for line, one in zip(lines, asked, strict=True)] == asked
    assert f"replay {shlex.quote(str(BAGS / bag))} --swarm {path}" in capsys.readouterr().out
    assert replay_main([str(BAGS / bag), "--swarm", str(path), "--out", str(tmp_path / "out")]) == 0
    found, described = load_swarm(path), load_swarm(BAGS / bag / "swarm.yaml")
    assert [robot.name for robot in found.robots] == [robot.name for robot in described.robots]
    assert [robot.type for robot in found.robots] == [robot.type for robot in described.robots]
    assert [robot.ir and robot.ir.id for robot in found.robots] == [
        r.ir and r.ir.id for r in described.robots
    ]


@pytest.mark.parametrize("bag", ["eight_five_robots", "eight_five_robots_w2"])
def test_markers_are_where_ground_truth_shows_them(bag: str) -> None:
    found, described = proposal(BAGS / bag).swarm, load_swarm(BAGS / bag / "swarm.yaml")
    assert {mark.id for mark in found.landmarks} == {mark.id for mark in described.landmarks}
    for robot, true in zip(found.robots, described.robots, strict=True):
        assert {face.id for face in robot.faces} == {face.id for face in true.faces}
    places = {mark.id: mark for mark in described.landmarks}
    for mark in found.landmarks:
        true_mark = places[mark.id]
        off = np.hypot(mark.x - true_mark.x, mark.y - true_mark.y)
        assert off < 3.0 * mark.position_sigma
    result = replay(BAGS / bag, found, Settings())
    errors = np.concatenate([one.error[:, :2] for one in result.errors.values()])
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.03


def drive(seconds: float, radius: float, place: tuple[float, float], heading: float) -> np.ndarray:
    """Poses (k, 3) at 20 Hz of a robot on a circle; radius 0: it stands."""
    times = np.arange(0.0, seconds, 0.05)
    turn = 0.3 * times if radius else 0.0 * times
    local = np.stack([radius * np.sin(turn), radius * (1.0 - np.cos(turn)), turn], axis=1)
    return se2.compose(np.array([*place, heading]), local)


def lab(bag: Path, *, apart_s: float = 0.0, before_iron: bool = False) -> Mapping[str, np.ndarray]:
    """Four robots with radios and motion capture, two anchors and a chair; returns the true poses."""
    rng = np.random.default_rng(1)
    tracks = {
        name: drive(20.0, radius, place, heading)
        for name, radius, place, heading in zip(
            NAMES,
            (0.6, 0.9, 0.0, 0.5),
            ((0.0, 0.0), (2.0, 0.5), (-1.0, 1.5), (1.0, 2.0)),
            (0.3, -1.0, 2.0, 1.0),
            strict=True,
        )
    }
    antennas = {NODES[name[4:]]: track[:, :2] for name, track in tracks.items()}
    antennas |= {node: np.tile(place, (400, 1)) for node, place in ANCHORS.items()}
    with BagWriter(bag) as writer:
        for name in NAMES:
            writer.add_topic(f"{name}/odom", ODOMETRY)
        for one in ("robot1_cap", "robot3_cap", "robot4_cap", "robot5_cap", "chair1"):
            writer.add_topic(f"vrpn/{one}/pose", POSE_STAMPED)
        pairs = [(a, b) for a in sorted(antennas) for b in sorted(antennas) if a < b]
        for a, b in pairs:
            writer.add_topic(f"uwb/n_{a}/n_{b}/distance", RANGE)
        for k in range(400):
            stamp_ns = 1_000_000_000_000 + k * 50_000_000
            at_ns = stamp_ns + round(apart_s * 1e9) + 5_000_000
            for name, track in tracks.items():
                pose = se2.between(track[0], track[k])
                writer.write(f"{name}/odom", at_ns, odometry_bytes(name, stamp_ns, pose, "odom"))
                body = se2.compose(track[k], [0.0, 0.0, TURNED if name == NAMES[0] else 0.0])
                topic = f"vrpn/robot{int(name[-2:])}_cap/pose"
                writer.write(topic, at_ns, encode_pose_stamped("world", np.array([stamp_ns]), body[None])[0])
            chair = np.array([[3.0, 3.0, 0.0]])
            writer.write(
                "vrpn/chair1/pose", at_ns, encode_pose_stamped("world", np.array([stamp_ns]), chair)[0]
            )
            a, b = pairs[k % len(pairs)]
            distance = float(np.hypot(*(antennas[a][k] - antennas[b][k]))) + 0.3 + 0.05 * rng.normal()
            fields = {"header": {"stamp": stamp_ns, "frame_id": "uwb"}, "max_range": 50.0, "range": distance}
            data = encode(fields, RANGE)
            writer.write(f"uwb/n_{a}/n_{b}/distance", at_ns, data[:-4] if before_iron else data)
    return tracks


@pytest.mark.parametrize(("apart_s", "before_iron"), [(0.0, False), (4e6, True)])
def test_radios_clocks_and_motion_capture_are_found(
    tmp_path: Path, apart_s: float, before_iron: bool
) -> None:
    tracks = lab(tmp_path / "bag", apart_s=apart_s, before_iron=before_iron)
    found = proposal(tmp_path / "bag")
    swarm = found.swarm
    assert [robot.name for robot in swarm.robots] == ["r01", "r03", "r04", "r05"]
    assert swarm.topics == {"<robot>/odom": "lab/<robot>/odom"}
    assert swarm.range_topic == "uwb/n_{from}/n_{to}/distance"
    assert {robot.name: robot.uwb and robot.uwb.address for robot in swarm.robots} == NODES
    assert {anchor.address for anchor in swarm.anchors} <= {*ANCHORS}
    for robot, track in zip(swarm.robots, tracks.values(), strict=True):
        assert robot.clock.offset_s == pytest.approx(-apart_s, abs=0.1)
        assert robot.start == pytest.approx(track[0].tolist(), abs=0.02)
        assert robot.uwb is not None
        assert robot.uwb.range_bias == pytest.approx(0.15, abs=0.05)
    localizer = swarm.localizer
    assert localizer is not None
    assert localizer.topic == "/vrpn/<body>/pose"
    assert localizer.bodies[0] == "robot1_cap=r01"
    (offset,) = localizer.offsets
    assert offset.startswith("r01=0,0,")
    assert float(offset.rpartition(",")[2]) == pytest.approx(TURNED, abs=0.02)
    assert any("chair1" in fact for fact in found.facts)
    result = replay(tmp_path / "bag", swarm, Settings())
    assert {*result.truth} == {robot.name for robot in swarm.robots}


def test_what_nothing_shows_is_asked(tmp_path: Path) -> None:
    """Radios, clocks that stand and starts without any ground truth."""
    with BagWriter(tmp_path / "bag") as writer:
        for name in ("r1/odom", "r2/odom"):
            writer.add_topic(name, ODOMETRY)
        writer.add_topic("uwb/1/2", RANGE)
        for k in range(100):
            at_ns = 1_000_000_000_000 + k * 50_000_000
            for name, stamp_ns in (("r1", at_ns), ("r2", 0)):
                data = odometry_bytes(name, stamp_ns, (0.01 * k, 0.0, 0.0), "odom")
                writer.write(f"{name}/odom", at_ns, data)
            fields = {"header": {"stamp": at_ns}, "max_range": 50.0, "range": 2.0}
            writer.write("uwb/1/2", at_ns, encode(fields, RANGE))
    asked = "\n".join(proposal(tmp_path / "bag").asked)
    for words in (
        "r2 has always the same stamp",
        "r1, r2: each has an unknown start",
        "radio 1, 2 measures ranges, but nothing shows which robot carries it",
    ):
        assert words in asked


def test_mounts_are_those_of_static_transforms(tmp_path: Path) -> None:
    """One robot without a namespace, one of whose lidars is turned by a quarter, and a map beside the bag."""
    scan = {
        "angle_min": -3.0,
        "angle_max": 3.0,
        "angle_increment": 0.1,
        "range_max": 12.0,
        "ranges": np.ones(61, np.float32),
    }
    joint = {"translation": {"x": 0.1}, "rotation": {"z": np.sqrt(0.5), "w": np.sqrt(0.5)}}
    parent = {"frame_id": "base_link"}
    joints = {"rplidar_link": joint, "rear_link": {"translation": {"x": -0.2}, "rotation": {"w": 1.0}}}
    static = {
        "transforms": [
            {"header": parent, "child_frame_id": child, "transform": one} for child, one in joints.items()
        ]
    }
    scans = {"scan": "rplidar_link", "scan_filtered": "rplidar_link", "scan_rear": "rear_link"}
    (tmp_path / "floor.yaml").write_text("image: floor.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with BagWriter(tmp_path / "bag") as writer:
        kinds = {"odom": ODOMETRY, "tf_static": TRANSFORMS, **dict.fromkeys(scans, LASER_SCAN)}
        for name, kind in kinds.items():
            writer.add_topic(name, kind)
        writer.write("tf_static", 1_000_000_000_000, encode(static, TRANSFORMS))
        for k in range(50):
            at_ns = 1_000_000_000_000 + k * 100_000_000
            writer.write("odom", at_ns, odometry_bytes("robot", at_ns, frame="odom"))
            for name, frame in scans.items():
                header = {"frame_id": frame, "stamp": at_ns}
                writer.write(name, at_ns, encode({**scan, "header": header}, LASER_SCAN))
    found = proposal(tmp_path / "bag")
    swarm = found.swarm
    (robot,) = swarm.robots
    assert robot.type == "turtlebot4"
    own = ("odom", "scan", "scan_rear")
    assert swarm.topics == {f"robot/{topic}": topic for topic in own}
    assert any("has scans on scan, scan_rear. Remove" in line for line in found.asked)
    assert robot.lidar.is_used
    assert (robot.lidar.x, robot.lidar.yaw) == pytest.approx((0.1, np.pi / 2))
    rear = robot.lidar.all["scan_rear"]
    assert (rear.x, rear.yaw) == pytest.approx((-0.2, 0.0))
    assert swarm.map == tmp_path / "floor.yaml"


def test_what_robots_publish_of_themselves_is_no_ground_truth(tmp_path: Path) -> None:
    """Filtered odometry and transforms of frames with the robot's name."""
    with BagWriter(tmp_path / "bag") as writer:
        for name, kind in (("r1/odom", ODOMETRY), ("r1/odometry/filtered", ODOMETRY), ("tf", TRANSFORMS)):
            writer.add_topic(name, kind)
        for k in range(100):
            at_ns = 1_000_000_000_000 + k * 50_000_000
            for name in ("r1/odom", "r1/odometry/filtered"):
                writer.write(name, at_ns, odometry_bytes("r1", at_ns, (0.01 * k, 0.0, 0.0)))
            joints = [
                {"header": {"frame_id": parent, "stamp": at_ns}, "child_frame_id": child}
                for parent, child in (
                    *(("map", "r1/odom"), ("r1/odom", "r1/base_link")),
                    ("r1/base_link", "r1/laser"),
                )
            ]
            joints = [{**one, "transform": {"rotation": {"w": 1.0}}} for one in joints]
            writer.write("tf", at_ns, encode({"transforms": joints}, TRANSFORMS))
    found = proposal(tmp_path / "bag")
    assert found.swarm.localizer is None
    assert found.swarm.topics == {}
    assert found.asked == ["r1 has an unknown start. Write start, or leave it to the estimator."]


def test_a_recording_without_robots_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("tf", TRANSFORMS)
        writer.write("tf", 1_000_000_000, encode({"transforms": []}, TRANSFORMS))
    assert main(["--yes", str(tmp_path / "bag"), str(tmp_path / "swarm.yaml")]) == 1
    assert "No robot was found: none of the topics tf is odometry." in capsys.readouterr().err
    assert not (tmp_path / "swarm.yaml").exists()


NAN, HUGE = float("nan"), 1e300
START_NS, STEP_NS = 1_000_000_000_000, 50_000_000


def odd(
    bag: Path,
    *,
    x: float | None = None,
    late_s: float = 0.0,
    others: Mapping[str, tuple[str, float]] = MappingProxyType({}),
) -> None:
    """Two robots with odometry and ground truth, all x of r1 in its odometry being `x`, and other topics."""
    with BagWriter(bag) as writer:
        for name in ("r1", "r2"):
            writer.add_topic(f"{name}/odom", ODOMETRY)
            if f"{name}/ground_truth" not in others:
                writer.add_topic(f"{name}/ground_truth", POSE_STAMPED)
        for name, (kind, _) in others.items():
            writer.add_topic(name, kind)
        for k in range(100):
            stamp_ns = START_NS + k * STEP_NS
            at_ns = stamp_ns + round(late_s * 1e9)
            for side, name in enumerate(("r1", "r2")):
                pose = (0.02 * k, 2.0 * side, 0.0)
                said = pose if x is None or side else (x, 0.0, 0.0)
                writer.write(f"{name}/odom", at_ns, odometry_bytes(name, stamp_ns, said, "odom"))
                if f"{name}/ground_truth" not in others:
                    data = encode_pose_stamped("map", np.array([stamp_ns]), np.array([pose]))[0]
                    writer.write(f"{name}/ground_truth", at_ns, data)
            for name, (kind, value) in others.items():
                fields: dict[str, object] = {"header": {"stamp": stamp_ns, "frame_id": "map"}}
                fields |= {"range": value, "max_range": 50.0} if kind == RANGE else {}
                writer.write(name, at_ns, encode({} if kind == TRANSFORMS else fields, kind))


@pytest.mark.parametrize("x", [NAN, HUGE])
def test_odometry_that_is_no_measurement_tells_no_start(tmp_path: Path, x: float) -> None:
    odd(tmp_path / "bag", x=x)
    assert main(["--yes", str(tmp_path / "bag"), str(tmp_path / "swarm.yaml")]) == 0
    first, second = load_swarm(tmp_path / "swarm.yaml").robots
    assert first.start == pytest.approx((0.0, 0.0, 0.0))
    assert second.start == pytest.approx((0.0, 2.0, 0.0))


@pytest.mark.parametrize(
    ("name", "kind"),
    [("r1/ground_truth", TRANSFORMS), ("pose", POSE_STAMPED), ("amcl_pose", POSE_WITH_COVARIANCE)],
)
def test_poses_on_topics_of_no_body_are_passed_over(tmp_path: Path, name: str, kind: str) -> None:
    odd(tmp_path / "bag", others={name: (kind, 0.0)})
    assert main(["--yes", str(tmp_path / "bag"), str(tmp_path / "swarm.yaml")]) == 0
    assert load_swarm(tmp_path / "swarm.yaml").localizer is None


def test_a_clock_of_1970_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odd(tmp_path / "bag", late_s=1.76e9)
    assert main(["--yes", str(tmp_path / "bag"), str(tmp_path / "swarm.yaml")]) == 0
    assert "r1, r2: each has stamps 1.76e+09 s before they arrived. Set its clock." in capsys.readouterr().out


@pytest.mark.parametrize(
    "name", ["uwb/0/1", f"uwb/{10**24}/1", "uwb{}/1/2", "uwb{x}/1/2", "a.b/1/2", "uwb/1"]
)
def test_ranges_on_topics_of_other_patterns_are_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    odd(tmp_path / "bag", others={name: (RANGE, 2.0)})
    assert main(["--yes", str(tmp_path / "bag"), str(tmp_path / "swarm.yaml")]) == 0
    assert f"{name} has not two decimal numbers from 1 on for two radios." in capsys.readouterr().out
    assert load_swarm(tmp_path / "swarm.yaml").range_topic == ""


@pytest.mark.parametrize(("distance", "carried"), [(2.0, True), (NAN, False), (1e30, False)])
def test_radios_are_given_to_robots_by_their_ranges_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], distance: float, carried: bool
) -> None:
    odd(tmp_path / "bag", others={"uwb/1/2": (RANGE, distance)})
    assert main(["--yes", str(tmp_path / "bag"), str(tmp_path / "swarm.yaml")]) == 0
    said = "radio 1, 2 measures ranges, but nothing shows which robot carries it"
    assert (said not in capsys.readouterr().out) == carried
    assert all((robot.uwb is not None) == carried for robot in load_swarm(tmp_path / "swarm.yaml").robots)


def test_a_recording_without_messages_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("r1/odom", ODOMETRY)
    assert main(["--yes", str(tmp_path / "bag"), str(tmp_path / "swarm.yaml")]) == 1
    assert capsys.readouterr().err == "No robot was found: there is no message.\n"


def test_what_a_cut_bag_has_lost_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = (BAGS / "pushbot_one" / "pushbot_one.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    assert main(["--yes", str(tmp_path / "cut.mcap"), str(tmp_path / "swarm.yaml")]) == 0
    assert "cut.mcap" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--use-sim-time", "--seconds=5"])
def test_options_of_a_live_graph_are_refused_without_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    assert main(["--yes", option, str(BAGS / "pushbot_one"), str(tmp_path / "swarm.yaml")]) == 1
    assert capsys.readouterr().err == "--seconds and --use-sim-time are for --live.\n"
