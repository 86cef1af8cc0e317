"""Poses of bodies become poses of robots: all kinds of messages, offsets, latency, and what is dropped."""

import math
from typing import Any

import numpy as np
import pytest

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.health import Health
from swarm_loc_estimator.common.messages.cdr import decode, encode
from swarm_loc_estimator.common.messages.poses import planar_covariance
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.sensors.fix import HEADING_UNKNOWN
from swarm_loc_estimator.sensors.localizers import SOURCES, BridgeParameters, LocalizedRobots, RobotPose

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
    """A geometry_msgs/Pose, 0.2 m above the floor."""
    return {"position": {"x": pose[0], "y": pose[1], "z": 0.2}, "orientation": turn(pose[2], roll)}


def header(frame: str = "world", stamp_ns: int = STAMP_NS) -> dict[str, Any]:
    return {"frame_id": frame, "stamp": stamp_ns}


def message(source: str, fields: dict[str, Any]) -> Any:
    """A message of a source as it comes out of its serialized form."""
    return decode(encode(fields, SOURCES[source].message_type), SOURCES[source].message_type)


def stamped(frame: str = "world", stamp_ns: int = STAMP_NS, **pose: Any) -> Any:
    """A geometry_msgs/PoseStamped."""
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
    step, jacobian = 1e-6, np.zeros((3, 3))
    for k, axis in enumerate(np.eye(3)):
        ends = [se2.compose(np.array(POSE) + sign * step * axis, se2.inverse(offset)) for sign in (1, -1)]
        jacobian[:, k] = (ends[0] - ends[1]) / (2.0 * step)
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
