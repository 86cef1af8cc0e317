"""Other localizers: the bridge, in bags, and the local frame."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core_geometry import nees, slopes_of, wrapped
from core_messages import SECOND, T0, Event, give_fix
from core_run import on_time, play, ticks
from core_world import Plan, World, simulate

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.bags.writer import BagWriter
from swarm_loc_estimator.common.health import Health
from swarm_loc_estimator.common.messages.cdr import POSE_STAMPED, decode, encode
from swarm_loc_estimator.common.messages.poses import HEADING_UNKNOWN, planar_covariance
from swarm_loc_estimator.common.parameters import ParameterError, UserError
from swarm_loc_estimator.doctor.doctor import evidence_of_bag
from swarm_loc_estimator.filter.state import InitialPose, SwarmState
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.offline.recorded_bag import unwatched
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.sensors.inputs import input_topics
from swarm_loc_estimator.sensors.localizers import SOURCES, BridgeParameters, LocalizedRobots, RobotPose
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.swarm import BODY, Anchor, Localizer, Robot, Swarm, UwbDevice
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_estimator.timeline.estimator import Estimate, Estimator, Status
from swarm_loc_estimator.timeline.settings import Settings

ROBOTS = ["alpha", "beta"]
STAMP_NS = 5_000_000_123
ARRIVAL_NS = 7_000_000_000
POSE = (1.5, -0.5, 0.7)


def turn(yaw: float, roll: float = 0.0) -> dict[str, float]:
    """A quaternion of a yaw, applied after a roll."""
    return {
        "x": math.cos(yaw / 2) * math.sin(roll / 2),
        "y": math.sin(yaw / 2) * math.sin(roll / 2),
        "z": math.sin(yaw / 2) * math.cos(roll / 2),
        "w": math.cos(yaw / 2) * math.cos(roll / 2),
    }


def pose_of(pose: tuple[float, float, float] = POSE, roll: float = 0.0) -> dict[str, Any]:
    return {"position": {"x": pose[0], "y": pose[1], "z": 0.2}, "orientation": turn(pose[2], roll)}


def header(frame: str = "world", stamp_ns: int = STAMP_NS) -> dict[str, Any]:
    return {"frame_id": frame, "stamp": stamp_ns}


def message(source: str, fields: dict[str, Any]) -> Any:
    return decode(encode(fields, SOURCES[source].message_type), SOURCES[source].message_type)


def stamped(frame: str = "world", stamp_ns: int = STAMP_NS, **pose: Any) -> Any:
    return message("pose", {"header": header(frame, stamp_ns), "pose": pose or pose_of()})


class Bridge:
    """Robots by the bodies of messages, with the health that counts drops."""

    def __init__(self, **parameters: Any) -> None:
        self.parameters = BridgeParameters(swarm_file="swarm.yaml", **parameters)
        self.warnings: list[str] = []
        self.health = Health(self.warnings.append)
        self.robots = LocalizedRobots(self.parameters, ROBOTS, self.health)

    def take(self, one: Any, of_topic: str = "alpha") -> list[RobotPose]:
        """The poses of robots by a message."""
        bodies = SOURCES[self.parameters.source].bodies(one)
        return list(self.robots.convert(bodies, of_topic, ARRIVAL_NS))

    def refuse(self, one: Any, reason: str, said: str) -> None:
        """Check that a message is dropped, counted and explained."""
        assert self.take(one) == []
        assert self.health.drops == {reason: 1}
        self.health.warn_of_drops()
        assert said in self.warnings[-1]


FULL = planar_covariance(0.04, 0.09, 0.01)
FULL[0, 1] = FULL[1, 0] = 0.02
WITH_COVARIANCE = {"pose": pose_of(), "covariance": FULL}
MESSAGES: dict[str, dict[str, Any]] = {
    "pose": {"header": header(), "pose": pose_of()},
    "pose_with_covariance": {"header": header("map"), "pose": WITH_COVARIANCE},
    "odometry": {"header": header("map"), "child_frame_id": "alpha/base_link", "pose": WITH_COVARIANCE},
    "tf": {
        "transforms": [
            {"header": header("odom"), "child_frame_id": "wheel"},
            {
                "header": header("map"),
                "child_frame_id": "alpha",
                "transform": {"translation": pose_of()["position"], "rotation": pose_of()["orientation"]},
            },
        ]
    },
    "named_poses": {"header": header(), "poses": [{"name": "alpha", "pose": pose_of()}]},
    "rigid_bodies": {
        "header": header("map"),
        "frame_number": 9,
        "rigidbodies": [
            {
                "header": header("", 1),
                "rigid_body_name": "alpha",
                "markers": [{"index": 3, "translation": {"x": 1.0}}],
                "pose": pose_of(),
            }
        ],
    },
}


@pytest.mark.parametrize("source", SOURCES)
def test_all_kinds_of_messages_give_the_pose_of_the_robot(source: str) -> None:
    bridge = Bridge(source=source)
    (found,) = bridge.take(
        message(source, MESSAGES[source]), "alpha" if "<body>" in SOURCES[source].topic else ""
    )
    assert (found.robot, found.stamp_ns) == ("alpha", STAMP_NS)
    assert found.pose == pytest.approx(POSE)
    expected = np.diag([1e-6, 1e-6, 25e-6])
    if source in ("pose_with_covariance", "odometry"):
        expected = np.array([[0.04, 0.02, 0.0], [0.02, 0.09, 0.0], [0.0, 0.0, 0.01]])
    assert found.covariance == pytest.approx(expected)
    assert not bridge.health.drops
    assert bridge.robots.used == 1


def test_bodies_are_mapped_by_name_and_those_of_no_robot_are_noted_once() -> None:
    bridge = Bridge(source="named_poses", bodies=("cf1=beta", "alpha"))
    poses = [{"name": name, "pose": pose_of()} for name in ("cf1", "alpha", "beta", "ghost", "ghost")]
    found = bridge.take(message("named_poses", {"header": header(), "poses": poses}), "")
    assert [one.robot for one in found] == ["beta", "alpha"]
    assert bridge.robots.strangers == {"beta", "ghost"}
    assert bridge.health.drops == {"unknown_body": 3}


def test_the_robot_stands_where_its_offset_says() -> None:
    offset = np.array([0.03, -0.02, 2.5])
    bridge = Bridge(offsets=("alpha=0.03,-0.02,2.5",))
    robot = np.array([2.0, 1.0, -3.0])
    body = tuple(se2.compose(robot, offset).tolist())
    (found,) = bridge.take(stamped(**pose_of(body)))
    assert found.pose == pytest.approx(robot)


def test_the_covariance_contains_the_lever_between_robot_and_body() -> None:
    offset, covariance = np.array([0.3, -0.2, 2.5]), FULL[np.ix_((0, 1, 5), (0, 1, 5))]
    bridge = Bridge(source="pose_with_covariance", offsets=("alpha=0.3,-0.2,2.5",))
    (found,) = bridge.take(message("pose_with_covariance", MESSAGES["pose_with_covariance"]))
    jacobian = slopes_of(lambda change: se2.compose(POSE + change, se2.inverse(offset)), 3)
    assert found.covariance == pytest.approx(jacobian @ covariance @ jacobian.T)
    assert found.covariance[0, 2] != pytest.approx(0.0)


def test_the_latency_is_subtracted_from_stamps_and_from_the_time_of_arrival() -> None:
    (found,) = Bridge(latency_s=0.25).take(stamped())
    assert found.stamp_ns == STAMP_NS - 250_000_000
    (found,) = Bridge(latency_s=0.25, stamp_on_arrival=True).take(stamped(stamp_ns=0))
    assert found.stamp_ns == ARRIVAL_NS - 250_000_000


def test_a_body_without_orientation_gives_a_position() -> None:
    for number in (0.0, math.nan):
        pose: dict[str, Any] = {
            "position": {"x": 1.0, "y": 2.0},
            "orientation": dict.fromkeys("xyzw", number),
        }
        (found,) = Bridge().take(stamped(**pose))
        assert found.pose == pytest.approx([1.0, 2.0, 0.0])
        assert found.covariance[2, 2] > HEADING_UNKNOWN
        assert np.linalg.eigvalsh(found.covariance)[0] > 0.0
        for needs in ({"output": "ground_truth"}, {"offsets": ("alpha=0.1,0,0",)}):
            Bridge(**needs).refuse(stamped(**pose), "no_heading", "have no heading")


@pytest.mark.parametrize(
    ("one", "reason", "said"),
    [
        (stamped("odom"), "foreign_frame", "'alpha' are in frame 'odom', not map or world"),
        (stamped(stamp_ns=0), "no_stamp", "set stamp_on_arrival"),
        (stamped(**pose_of(roll=math.pi / 2)), "tilted", "leans by 90 deg"),
        (stamped(**pose_of((math.nan, 0.0, 0.0))), "not_finite", "NaN or infinite"),
        (stamped(**pose_of((0.0, math.inf, 0.0))), "not_finite", "NaN or infinite"),
    ],
)
def test_what_cannot_be_used_is_counted_and_explained(one: Any, reason: str, said: str) -> None:
    Bridge().refuse(one, reason, said)


def test_a_named_source_frame_is_the_only_one() -> None:
    bridge = Bridge(source_frame="optitrack")
    assert len(bridge.take(stamped("optitrack"))) == 1
    bridge.refuse(stamped("map"), "foreign_frame", "in frame 'map', not optitrack")


def test_a_body_may_lean_a_little() -> None:
    (found,) = Bridge().take(stamped(**pose_of(roll=0.2)))
    assert found.pose[2] == pytest.approx(POSE[2], abs=0.02)


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"bodies": ("cf1=gamma",)}, "parameter bodies: there is no robot 'gamma', but alpha, beta"),
        ({"bodies": ("cf1=alpha", "cf1=beta")}, "'cf1=beta' names a body or a robot a second time"),
        ({"bodies": ("cf1=alpha", "cf2=alpha")}, "'cf2=alpha' names a body or a robot a second time"),
        ({"bodies": ("cf 1=alpha",)}, "'cf 1' cannot be part of a topic"),
        ({"offsets": ("gamma=0,0,0",)}, "parameter offsets: there is no robot 'gamma'"),
        ({"offsets": ("alpha=0,0",)}, "'alpha=0,0' must be a robot and x, y, yaw"),
        ({"offsets": ("alpha=0,x,0",)}, "'alpha=0,x,0' must be a robot and x, y, yaw"),
        ({"offsets": ("alpha=0,nan,0",)}, "'alpha=0,nan,0' must be a robot and x, y, yaw"),
        (
            {"topic": "/optitrack/pose"},
            "must contain <body>: messages of the source 'pose' do not name bodies",
        ),
        (
            {"source": "tf", "topic": "/<body>/tf"},
            "must not contain <body>: messages of the source 'tf' name",
        ),
    ],
)
def test_a_wrong_parameter_is_named(parameters: dict[str, Any], said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        Bridge(**parameters)


BAG = Path(__file__).parents[3] / "bags" / "eight_five_robots"
EPUCKS = ("epuck1", "epuck2")
BODIES = ("cf1=epuck1", "cf2=epuck2")


def bodies(source: str, name: str, header: Any, pose: Any) -> tuple[str, dict[str, Any]]:
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
        for robot in EPUCKS:
            writer.add_topic(f"{robot}/odom", "nav_msgs/msg/Odometry")
        kind = SOURCES[source].message_type
        for body in ("cf1", "cf2") if source == "pose" else ("",):
            writer.add_topic(SOURCES[source].topic.replace(BODY, body).lstrip("/"), kind)
        wanted = [f"{robot}/{topic}" for robot in EPUCKS for topic in ("odom", "ground_truth")]
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
    return Swarm(tuple(Robot(name, camera=None) for name in EPUCKS), localizer=localizer)


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
    for index, name in enumerate(EPUCKS):
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


AFTER_S = 2.0
SETTINGS = Settings(origin_after_s=AFTER_S)
BLIND = Plan(robots=4, duration_s=14.0, arena=0.6, start_known=(False,), reach=3.0)
LANDMARK_IDS = 1000
FIX = np.diag([0.01**2, 0.01**2, 0.02**2])


def without_landmarks(world: World, until_s: float = np.inf) -> World:
    """The world in which no landmark is seen before an instant."""
    events = []
    for event in world.events:
        seen = event.detections
        if seen.size and event.stamp_ns < T0 + until_s * 1e9:
            seen = seen[seen["id"] < LANDMARK_IDS]
        if event.pose is not None or seen.size:
            events.append(replace(event, detections=seen))
    return replace(world, events=tuple(events))


def end_of(world: World) -> int:
    return int(world.stamp_ns[-1])


def run(estimator: Estimator, world: World, until_s: float | None = None) -> Estimate:
    end_ns = end_of(world) if until_s is None else T0 + round(until_s * 1e9)
    events = [(at_ns, event) for at_ns, event in on_time(world) if at_ns <= end_ns]
    return play(estimator, events, ticks(T0 + SECOND // 10, end_ns))[-1]


def relative_to_first(poses: FloatArray, truth: FloatArray) -> FloatArray:
    """Errors (N, 3) of poses (N, 3) moved such that the first robot has its true pose."""
    motion = se2.compose(truth[0], se2.inverse(poses[0]))
    return wrapped(se2.compose(motion, poses) - truth)


@pytest.mark.parametrize("seed", range(3))
def test_robots_are_located_relative_to_one_of_them(seed: int) -> None:
    world = without_landmarks(simulate(BLIND, seed))
    estimator = Estimator(world.swarm, SETTINGS)
    early = run(estimator, world, AFTER_S)
    assert np.isnan(early.poses).all()
    assert estimator.origin == ""
    estimator = Estimator(world.swarm, SETTINGS)
    last = run(estimator, world)
    assert estimator.origin in {robot.name for robot in world.swarm.robots}
    assert (last.status == Status.TRACKED).all()
    error = relative_to_first(last.poses, world.at(end_of(world)))
    assert np.abs(error[:, :2]).max() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_the_swarm_moves_to_the_map_as_a_whole_when_landmarks_come(seed: int) -> None:
    world = without_landmarks(simulate(BLIND, seed), until_s=8.0)
    estimator = Estimator(world.swarm, SETTINGS)
    run(estimator, world, 7.9)
    assert estimator.origin != ""
    estimator = Estimator(world.swarm, SETTINGS)
    estimates = play(estimator, on_time(world), ticks(T0 + SECOND // 10, end_of(world)))
    assert (estimator.origin, estimator.frame_moves) == ("", 1)
    last = estimates[-1]
    assert (last.status == Status.TRACKED).all()
    errors = wrapped(last.poses - world.at(end_of(world)))
    assert nees(errors, last.covariances).max() < 25.0
    assert np.abs(errors[:, :2]).max() < 0.1


@pytest.mark.parametrize("tracked", [True, False])
def test_one_fix_with_heading_moves_them_too(tracked: bool) -> None:
    """Or two, of a robot that nobody has located: the others wait for sightings then."""
    world = without_landmarks(simulate(BLIND, 1))
    robot, at_s = 2, 8.0
    if not tracked:  # nobody sees it, and it sees nobody
        world = replace(world, events=tuple(_unseen(event, robot) for event in world.events))
    estimator = Estimator(world.swarm, SETTINGS)
    run(estimator, world, at_s)
    before = estimator.tick(T0 + round(at_s * 1e9))
    assert np.isfinite(before.poses[robot]).all() == tracked
    for k in range(12):
        at_ns = T0 + round((at_s + 0.2 * k) * 1e9)
        for _, event in on_time(world):
            if at_ns - SECOND // 5 < event.stamp_ns <= at_ns:
                event.give(estimator, at_ns)
        give_fix(estimator, robot, at_ns, world.at(at_ns)[robot], FIX, at_ns)
        last = estimator.tick(at_ns)
    assert (estimator.origin, estimator.frame_moves) == ("", 1)
    located = np.asarray(np.isfinite(last.poses).all(axis=1))
    assert located.all() if tracked else located[robot]
    errors = wrapped(last.poses - world.at(at_ns))
    assert nees(errors[located], last.covariances[located]).max() < 25.0


def test_a_local_frame_ends_when_all_its_robots_are_forgotten() -> None:
    world = without_landmarks(simulate(BLIND, 0))
    estimator, at_ns = Estimator(world.swarm, SETTINGS), T0 + 8 * SECOND
    run(estimator, world, 8.0)
    assert estimator.origin
    for robot in range(4):
        estimator.forget(robot, at_ns)
    estimator.tick(at_ns)
    assert estimator.origin == ""
    kept = estimator.counters["constraints kept"]
    give_fix(estimator, 1, at_ns + SECOND // 10, np.array([0.1, 0.2, 0.3]), FIX, at_ns + SECOND // 5)
    estimator.tick(at_ns + SECOND // 5)
    assert estimator.counters["constraints kept"] == kept + 1


def _unseen(event: Event, robot: int) -> Event:
    seen = event.detections
    return replace(event, detections=seen[:0] if event.robot == robot else seen[seen["id"] // 10 != robot])


def test_starts_landmarks_and_a_time_of_zero_keep_the_swarm_in_the_map() -> None:
    world = without_landmarks(simulate(BLIND, 0))
    started = simulate(replace(BLIND, start_known=(True, False, False, False)), 0)
    for swarm, settings, events in (
        (world.swarm, Settings(origin_after_s=0.0), world),
        (started.swarm, SETTINGS, without_landmarks(started)),
        (world.swarm, SETTINGS, simulate(BLIND, 0)),
    ):
        estimator = Estimator(swarm, settings)
        run(estimator, events)
        assert (estimator.origin, estimator.frame_moves) == ("", 0)


def test_a_move_has_the_covariance_of_sampled_errors() -> None:
    """A frame of three robots with correlated errors, of which the second gets a pose in `map`."""
    rng = np.random.default_rng(0)
    state = SwarmState(ParameterTable.of([Robot(f"r{i}") for i in range(4)]))
    for robot in range(3):
        state.initialize(robot, InitialPose(rng.normal(0.0, 1.0, 3), np.eye(3)), Preintegrated.begin(T0))
    root = 1e-3 * rng.standard_normal((9, 9))
    state.filter.covariance[:9, :9] = root @ root.T
    transforms, joint = state.transform[:3].copy(), state.filter.covariance[:9, :9].copy()
    pose, own = np.array([3.0, -1.0, 2.0]), np.diag([1e-4, 4e-4, 1e-5])
    state.move(1, InitialPose(pose, own))
    count = 20_000
    twists = rng.multivariate_normal(np.zeros(9), joint, count).reshape(count, 3, 3)
    new = rng.multivariate_normal(np.zeros(3), own, count)
    true = se2.compose(se2.exp(twists), transforms)
    fixed = se2.compose(se2.exp(new), pose)
    moved = se2.compose(se2.compose(fixed, se2.inverse(true[:, 1]))[:, None], true)
    errors = se2.log(se2.compose(moved, se2.inverse(state.transform[:3])))
    expected = np.cov(errors.reshape(count, 9).T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(state.filter.covariance[:9, :9] / scale, expected / scale, atol=0.05)
    np.testing.assert_array_equal(state.filter.covariance[9:12, :9], 0.0)
