"""Inputs of the estimator's node: aerial images, ranges, fixed cameras and the local frame."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_world import (
    LANDMARKS,
    SECOND,
    SETTINGS,
    STEP_NS,
    T0_NS,
    TRUE_POSES,
    Robots,
    Ros,
    Steps,
    detection_bytes,
    newest_status,
    odometry_bytes,
    overrides,
    report,
    sight,
    stamp_ns,
    values_of,
    xytheta,
)
from node_world import SWARM_YAML as SMALL_SWARM
from rcl_interfaces.msg import Log
from rclpy.exceptions import InvalidTopicNameException
from rclpy.publisher import Publisher
from rclpy.time import Time
from sensor_msgs.msg import Range as PairRange
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.common.messages.detections import (
    ANONYMOUS_DTYPE,
    DETECTION_DTYPE,
    encode_brightness,
    encode_detections,
)
from swarm_loc_estimator.common.messages.poses import encode_fix
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_estimator.swarm.ir_board import load_ir_platform
from swarm_loc_msgs.msg import (
    AnonymousDetectionArray,
    BrightnessMatrix,
    MarkerDetectionArray,
    Range,
    RangeArray,
    RobotIdentities,
    SwarmPose,
)

SWARM_YAML = """
fileversion: 1
types:
  droplet: {odometry: null, camera: null, ir: {platform: droplet}}
robots:
  alpha: {type: droplet, odometry: {}, ir: {id: 1}, start: {x: 0.0, y: 0.0, theta: 0.0}}
  beta: {type: droplet, ir: {id: 2}}
  gamma: {type: droplet, ir: null}
"""
BETA = (0.1, 0.5, -1.0)  # Range, bearing and heading of beta, from alpha at the origin
GAMMA = (0.3, 0.2, 1.5)
KINDS = {"odom": Odometry, "brightness": BrightnessMatrix, "fix": PoseWithCovarianceStamped}


class Droplets:
    """The swarm's drivers."""

    def __init__(self, ros: Ros) -> None:
        self._publisher = {
            topic: ros.tester.create_publisher(KINDS[topic.partition("/")[2]], topic, 100)
            for topic in ("alpha/odom", "alpha/brightness", "gamma/fix")
        }
        self._steps = Steps(ros, *self._publisher.values())
        self._bright = np.minimum(np.rint(expected_brightness(load_ir_platform("droplet"), BETA)[0]), 255)

    def step(self, now_ns: int, frame: str = "map", transmitter: int = 2) -> None:
        """What comes in a step; wait for the estimate that follows."""
        lights = [
            encode_brightness("alpha/base_link", now_ns, (1, transmitter), readings, power)
            for power, readings in enumerate(self._bright)
        ]
        self._steps.step(
            now_ns,
            (self._publisher["alpha/odom"], odometry_bytes("alpha", now_ns)),
            *((self._publisher["alpha/brightness"], light) for light in lights),
            (self._publisher["gamma/fix"], encode_fix(frame, now_ns, GAMMA, np.diag([1e-6, 1e-6, 1e-4]))),
        )

    def newest(self, robot: str) -> SwarmPose:
        """The last estimate of a robot."""
        (pose,) = [pose for pose in self._steps.poses[-1].robots if pose.name == robot]
        return pose


@pytest.fixture
def droplets(ros: Ros, tmp_path: Path) -> Droplets:
    path = tmp_path / "swarm.yaml"
    path.write_text(SWARM_YAML, encoding="utf-8")
    parameters = overrides(swarm_file=str(path), use_sim_time=True, fusion_load=1.0)
    ros.add(EstimatorNode(parameter_overrides=parameters))
    return Droplets(ros)


def until_told(ros: Ros, heard: list[DiagnosticArray], now_ns: int) -> None:
    ros.until(lambda: bool(heard) and stamp_ns(heard[-1]) >= now_ns)


def test_robots_without_odometry_are_located_by_light_and_by_fixes(ros: Ros, droplets: Droplets) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    for step in range(8):
        now_ns = T0_NS + step * SECOND // 2
        droplets.step(now_ns)
    until_told(ros, heard, now_ns)

    away, bearing, heading = BETA
    beta = [away * math.cos(bearing), away * math.sin(bearing), heading]
    for name, pose in (("alpha", (0.0, 0.0, 0.0)), ("beta", beta), ("gamma", GAMMA)):
        assert droplets.newest(name).status == SwarmPose.STATUS_TRACKED, name
        assert xytheta(droplets.newest(name)) == pytest.approx(pose, abs=0.01), name
    assert droplets.newest("beta").fix_age_s == -1.0
    assert droplets.newest("gamma").fix_age_s == pytest.approx(0.0)
    status, values = report(heard, "estimator: alpha")
    assert (status.level, values["brightness received"]) == (DiagnosticStatus.OK, "16")
    status, values = report(heard, "estimator: gamma")
    assert (status.level, values["fix received"]) == (DiagnosticStatus.OK, "8")
    assert "odom received" not in values
    status, values = report(heard, "estimator")
    assert values["infrared exchanges measured"] == "8"
    assert "no messages received on beta/brightness (no publisher)" in status.message
    assert "gamma" not in status.message
    assert not [key for key in values if key.startswith("dropped: ir")]


def test_light_of_strangers_and_fixes_in_a_foreign_frame_are_dropped_and_named(
    ros: Ros, droplets: Droplets
) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    for step in range(3):
        now_ns = T0_NS + step * SECOND // 2
        droplets.step(now_ns, frame="world", transmitter=77)
    until_told(ros, heard, now_ns)

    _, values = report(heard, "estimator")
    assert (values["dropped: ir_unknown_id"], values["dropped: fix_frame"]) == ("6", "3")
    status, _ = report(heard, "estimator: gamma")
    assert status.message == "gamma/fix is in frame 'world' but must be in 'map'"
    assert droplets.newest("beta").status == droplets.newest("gamma").status == SwarmPose.STATUS_WAITING


def image(frame: str, at_ns: int) -> bytes:
    """Beta, alpha and a stranger."""
    shown = np.zeros(3, dtype=ANONYMOUS_DTYPE)
    shown["x"], shown["y"] = np.array([TRUE_POSES["beta"], TRUE_POSES["alpha"], (5.0, 5.0, 0.0)]).T[:2]
    shown["theta"] = np.nan
    shown["covariance"][:, 0, 0] = -1.0
    return encode_detections(frame, at_ns, shown)


def test_robots_seen_from_above_are_told_apart_and_a_wrong_frame_is_named(ros: Ros, robots: Robots) -> None:
    identities = ros.listen(RobotIdentities, "aerial/identities")
    reports = ros.listen(DiagnosticArray, "/diagnostics")
    camera = ros.tester.create_publisher(AnonymousDetectionArray, "aerial/detections", 10)
    ros.until(lambda: camera.get_subscription_count() and ros.tester.count_publishers("aerial/identities"))
    seen_ns = robots.run(T0_NS, 20)
    camera.publish(image("map", seen_ns))
    now_ns = robots.run(seen_ns + STEP_NS, 4)
    ros.until(lambda: identities)
    newest = identities[-1]
    assert (newest.header.frame_id, stamp_ns(newest)) == ("map", seen_ns)
    assert [(one.name, one.detection) for one in newest.identities] == [("alpha", 1), ("beta", 0)]
    assert all(one.probability > 0.99 for one in newest.identities)

    camera.publish(image("table", now_ns))
    last_ns = robots.run(now_ns + STEP_NS, 4)
    ros.until(lambda: reports and stamp_ns(reports[-1]) >= last_ns)
    status = newest_status(reports, "estimator")
    values = values_of(status)
    assert values["dropped: aerial_frame"] == "1"
    assert values["dropped: aerial_unassigned"] == "1"
    assert values["aerial/detections received"] == "2"
    assert "aerial/detections is in frame 'table' but must be in 'map'" in status.message
    assert values_of(newest_status(reports, "estimator: alpha"))["aerial detection"] == "1"


SWARM = """
fileversion: 1
robots:
  alpha: {camera: null, faces: {top: {z: 0.1, yaw: 0.0, size: 0.05, lies: true}}, ids: {top: 4}}
cameras:
  ceiling1: {x: 1.0, y: 0.5, z: 2.1}
  ceiling2: {x: 3.0, y: 0.5, z: 2.1}
"""


def below(marker_id: int) -> Any:
    """A marker 2 m under the camera whose right points to the top of the image, to map's x."""
    one = np.zeros(1, DETECTION_DTYPE)
    one["id"], one["content"], one["position"] = marker_id, 2, (-0.2, 0.0, 2.0)
    half = math.sqrt(0.5)
    one["orientation"] = (half, -half, 0.0, 0.0)  # its x is up in the image, its z towards the camera
    one["covariance"] = np.diag([1e-8, 1e-8, 1e-4, 1e-3, 1e-3, 1e-5])
    return one


@pytest.fixture
def estimator(ros: Ros, tmp_path: Path) -> EstimatorNode:
    path = tmp_path / "swarm.yaml"
    path.write_text(SWARM, encoding="utf-8")
    given = overrides(swarm_file=str(path), use_sim_time=True, **SETTINGS)
    node: EstimatorNode = ros.add(EstimatorNode(parameter_overrides=given))
    return node


def test_detections_of_a_fixed_camera_locate_a_robot(ros: Ros, estimator: EstimatorNode) -> None:
    odometry = ros.tester.create_publisher(Odometry, "alpha/odom", 100)
    detections = ros.tester.create_publisher(MarkerDetectionArray, "ceiling1/detections", 100)
    diagnostics: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
    steps = Steps(ros, odometry, detections)
    (topic,) = ros.tester.get_subscriptions_info_by_topic("/ceiling2/detections")
    assert topic.node_name == estimator.get_name()
    for k in range(30):
        now_ns = T0_NS + k * SECOND // 10
        seen = [(detections, detection_bytes("ceiling1", now_ns, below(marker_id))) for marker_id in (4, 99)]
        steps.step(now_ns, (odometry, odometry_bytes("alpha", now_ns)), *seen)
    (alpha,) = steps.poses[-1].robots
    assert alpha.status == SwarmPose.STATUS_TRACKED
    assert (alpha.x, alpha.y, alpha.theta) == pytest.approx((1.0, 0.7, 0.0), abs=2e-3)
    ros.until(lambda: "dropped: unknown_id" in values_of(newest_status(diagnostics, "estimator: ceiling1")))
    assert newest_status(diagnostics, "estimator: ceiling1").message == "seeing"
    missing = newest_status(diagnostics, "estimator: ceiling2").message
    assert missing.startswith("no messages received on ceiling2/detections")


def test_poses_without_a_map_are_in_a_frame_of_a_robot_until_landmarks_come(
    ros: Ros, swarm_file: Path
) -> None:
    swarm_file.write_text(SMALL_SWARM.replace(", start: {x: 0.0, y: 0.0, theta: 0.0}", ""), encoding="utf-8")
    parameters = overrides(swarm_file=str(swarm_file), use_sim_time=True, origin_after_s=0.5, **SETTINGS)
    ros.add(EstimatorNode(parameter_overrides=parameters))
    robots, alpha, beta = Robots(ros), (1.0, 1.0, np.pi), (0.0, 1.0, 0.0)
    robots.wait_for_estimator()
    transforms, log = ros.listen(TFMessage, "/tf"), ros.listen(Log, "/rosout")
    ros.until(lambda: ros.tester.count_publishers("/tf"))
    now_ns = T0_NS

    def step(ids: tuple[int, ...]) -> int:
        nonlocal now_ns
        now_ns, heard = now_ns + STEP_NS, len(robots.poses)
        robots.tell_time(now_ns)
        robots.odometry("alpha", odometry_bytes("alpha", now_ns))
        robots.odometry("beta", odometry_bytes("beta", now_ns))
        seen = sight(alpha, ids, {2: beta, **LANDMARKS})
        robots.detections("alpha", detection_bytes("alpha", now_ns, seen))
        ros.until(lambda: any(stamp_ns(pose) == now_ns for pose in robots.poses[heard:]))
        return now_ns

    while robots.poses[-1:] == [] or robots.poses[-1].header.frame_id == "map":
        assert step((2,)) < T0_NS + 20 * SECOND
    frame = robots.poses[-1].header.frame_id
    assert frame in {"alpha/start", "beta/start"}
    while not robots.located("beta"):
        assert step((2,)) < T0_NS + 20 * SECOND
    ros.until(lambda: transforms and stamp_ns(transforms[-1].transforms[0]) == now_ns)
    assert {one.header.frame_id for one in transforms[-1].transforms} == {frame}
    ros.until(lambda: any(f"poses are relative to {frame[:-6]}, in '{frame}'" in one.msg for one in log))
    while robots.poses[-1].header.frame_id != "map":
        assert step((2, *LANDMARKS)) < T0_NS + 40 * SECOND
    assert xytheta(robots.newest("beta")) == pytest.approx(beta, abs=0.1)
    ros.until(lambda: any(f"poses are in 'map' now, no longer in '{frame}'" in one.msg for one in log))


ANCHORS = {16: (-3.0, -3.0), 17: (3.0, -3.0), 18: (0.0, 3.0)}
ANCHORED = """
fileversion: 1
robots:
  alpha:
    camera: null
    uwb: {address: 1, range_sigma: 0.02}
    start: {x: 0.1, y: -0.1, theta: 0.0}
    start_sigma: {x: 0.2, y: 0.2}
anchors:
""" + "".join(
    f"  - {{address: {a}, x: {x}, y: {y}, z: 1.0, range_bias_sigma: 0.0}}\n" for a, (x, y) in ANCHORS.items()
)


def after_ranges(
    ros: Ros, odometry: Publisher, ranges: Sequence[tuple[Publisher, Callable[..., Any]]]
) -> list[DiagnosticArray]:
    """Send ranges of four seconds, after which alpha is where it is; returns the diagnostics."""
    heard: list[DiagnosticArray] = ros.listen(DiagnosticArray, "/diagnostics")
    steps = Steps(ros, odometry, *(publisher for publisher, _ in ranges))
    for step in range(8):
        now_ns = T0_NS + step * SECOND // 2
        header = Header(stamp=Time(nanoseconds=now_ns).to_msg())
        messages = [(publisher, message(header=header)) for publisher, message in ranges]
        steps.step(now_ns, (odometry, odometry_bytes("alpha", now_ns)), *messages)
    until_told(ros, heard, now_ns)
    (alpha,) = steps.poses[-1].robots
    assert alpha.status == SwarmPose.STATUS_TRACKED
    assert (alpha.x, alpha.y) == pytest.approx((0.0, 0.0), abs=0.02)
    return heard


@pytest.mark.parametrize(
    "topics",
    [
        {"odom": "alpha/odom", "ranges": "alpha/ranges"},
        {"odom": "lab/alpha/odometry/filtered", "ranges": "radios/first"},
    ],
)
def test_ranges_correct_a_start(ros: Ros, tmp_path: Path, topics: dict[str, str]) -> None:
    """Topics have the expected names, or those of the description."""
    path = tmp_path / "swarm.yaml"
    of_others = "topics: {<robot>/odom: lab/<robot>/odometry/filtered, alpha/ranges: /radios/first}"
    named = "" if topics["ranges"] == "alpha/ranges" else of_others
    path.write_text(f"{ANCHORED}{named}\n", encoding="utf-8")
    ros.add(EstimatorNode(parameter_overrides=overrides(swarm_file=str(path), use_sim_time=True)))
    odometry = ros.tester.create_publisher(Odometry, topics["odom"], 100)
    ranges = ros.tester.create_publisher(RangeArray, topics["ranges"], 100)
    measured = [Range(device=a, range=float(np.hypot(np.hypot(x, y), 1.0))) for a, (x, y) in ANCHORS.items()]
    measured.append(Range(device=99, range=1.0))
    heard = after_ranges(ros, odometry, [(ranges, partial(RangeArray, ranges=measured))])
    assert values_of(newest_status(heard, "estimator: alpha"))["ranges received"] == "8"
    assert values_of(newest_status(heard, "estimator"))["dropped: uwb_unknown_address"] == "8"


def test_ranges_on_topics_of_pairs_correct_a_start(ros: Ros, tmp_path: Path) -> None:
    """The topics have names of radios, in both orders, as the drivers of tags and of anchors publish them."""
    path = tmp_path / "swarm.yaml"
    named = ANCHORED.replace("{address: 1,", "{address: 1, name: tag,").replace(
        "address: 16,", "address: 16, name: west,"
    )
    path.write_text(f"{named}range_topic: /uwb/n_{{from}}/n_{{to}}/distance\n", encoding="utf-8")
    ros.add(EstimatorNode(parameter_overrides=overrides(swarm_file=str(path), use_sim_time=True)))
    odometry = ros.tester.create_publisher(Odometry, "alpha/odom", 100)
    names = {16: "uwb/n_tag/n_west/distance", 17: "uwb/n_17/n_tag/distance", 18: "uwb/n_tag/n_18/distance"}
    measured: list[tuple[Publisher, Callable[..., Any]]] = []
    for a, (x, y) in ANCHORS.items():
        away = float(np.hypot(np.hypot(x, y), 1.0))
        measured.append(
            (ros.tester.create_publisher(PairRange, names[a], 10), partial(PairRange, range=away))
        )
    heard = after_ranges(ros, odometry, measured)
    assert values_of(newest_status(heard, "estimator: alpha"))["measurements used"] == "24"


@pytest.mark.usefixtures("ros")
def test_a_topic_that_ros_refuses_is_a_mistake_of_the_user(tmp_path: Path) -> None:
    """Tokens of topics must not begin with a digit."""
    path = tmp_path / "swarm.yaml"
    path.write_text(f"{ANCHORED}range_topic: /uwb/{{from}}/{{to}}/distance\n", encoding="utf-8")
    with pytest.raises(InvalidTopicNameException, match="must not start with a number"):
        EstimatorNode(parameter_overrides=overrides(swarm_file=str(path), use_sim_time=True))
