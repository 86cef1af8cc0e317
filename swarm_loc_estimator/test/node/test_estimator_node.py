"""The estimator node over DDS: what comes in leads to what comes out."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from node_world import (
    PATIENCE_S,
    SETTINGS,
    STEP_NS,
    T0_NS,
    TRUE_POSES,
    UNKNOWN_ID,
    Robots,
    Ros,
    detection_bytes,
    odometry_bytes,
    overrides,
    report,
    sight,
    stamp_ns,
    xytheta,
)
from rcl_interfaces.msg import Log
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.health import Health
from swarm_loc_estimator.nodes.estimator_diagnostics import TickCost
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_estimator.sensors.inputs import Batch
from swarm_loc_estimator.timeline.estimator import Estimate
from swarm_loc_estimator.timeline.settings import Settings
from swarm_loc_estimator.timeline.timeline import HasBudget
from swarm_loc_msgs.msg import SwarmPose
from swarm_loc_msgs.srv import SetRobotPose


def planar(pose: Any) -> np.ndarray[Any, Any]:
    """x, y, theta of a geometry_msgs pose or transform."""
    place = getattr(pose, "position", None) or pose.translation
    turn = getattr(pose, "orientation", None) or pose.rotation
    return np.array([place.x, place.y, 2.0 * np.arctan2(turn.z, turn.w)])


def told_of(heard: list[DiagnosticArray], time_ns: int) -> Callable[[], bool]:
    """Whether diagnostics of the poses of some time have come; before a jump back there were later ones."""
    return lambda: bool(heard) and stamp_ns(heard[-1]) == time_ns


def test_poses_and_transforms_of_a_known_and_of_an_unknown_robot(ros: Ros, robots: Robots) -> None:
    poses = ros.listen(PoseWithCovarianceStamped, "alpha/pose")
    transforms = ros.listen(TFMessage, "/tf")
    ros.until(lambda: ros.tester.count_publishers("alpha/pose") and ros.tester.count_publishers("/tf"))
    now_ns = robots.run(T0_NS, 20)
    ros.until(lambda: poses and stamp_ns(poses[-1]) == now_ns)
    ros.until(lambda: transforms and stamp_ns(transforms[-1].transforms[0]) == now_ns)

    assert robots.poses[-1].header.frame_id == "map"
    for name, pose in TRUE_POSES.items():
        assert robots.located(name)
        assert xytheta(robots.newest(name)) == pytest.approx(pose, abs=0.03)
        assert robots.newest(name).fix_age_s == pytest.approx(0.0, abs=0.1)
    assert poses[-1].header.frame_id == "map"
    assert planar(poses[-1].pose.pose) == pytest.approx(xytheta(robots.newest("alpha")))
    assert np.linalg.eigvalsh(poses[-1].pose.covariance.reshape(6, 6))[0] > 0.0
    by_child = {transform.child_frame_id: transform for transform in transforms[-1].transforms}
    assert set(by_child) == {"alpha/odom", "beta/odom"}
    assert by_child["beta/odom"].header.frame_id == "map"
    # beta's odometry stands at its true pose, so its odom frame lies in map as the estimate errs
    beta = se2.compose(planar(by_child["beta/odom"].transform), np.array(TRUE_POSES["beta"]))
    assert beta == pytest.approx(xytheta(robots.newest("beta")), abs=1e-9)


def test_transforms_per_robot_are_post_dated_and_have_no_prefix(ros: Ros, swarm_file: Path) -> None:
    """As Nav2 has them with several robots: each robot's on <robot>/tf, between map and odom."""
    own = {"tf_per_robot": True, "transform_tolerance_s": 0.25, **SETTINGS}
    parameters = overrides(swarm_file=str(swarm_file), use_sim_time=True, **own)
    ros.add(EstimatorNode(parameter_overrides=parameters))
    robots = Robots(ros)
    robots.wait_for_estimator()
    heard = {name: ros.listen(TFMessage, f"{name}/tf") for name in TRUE_POSES}
    common, log = ros.listen(TFMessage, "/tf"), ros.listen(Log, "/rosout")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    static = TransformStamped(child_frame_id="odom")
    static.header.frame_id = "world"
    ros.add(Node("other")).create_publisher(TFMessage, "beta/tf_static", latched).publish(
        TFMessage(transforms=[static])
    )
    ros.until(lambda: all(ros.tester.count_publishers(f"{name}/tf") for name in TRUE_POSES))
    now_ns = robots.run(T0_NS, 20)
    post_dated_ns = now_ns + 250_000_000
    ros.until(lambda: all(one and stamp_ns(one[-1].transforms[0]) == post_dated_ns for one in heard.values()))
    for name, messages in heard.items():
        (transform,) = messages[-1].transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
        located = se2.compose(planar(transform.transform), np.array(TRUE_POSES[name]))
        assert located == pytest.approx(xytheta(robots.newest(name)), abs=1e-9)
    sentence = "beta/tf_static has a transform from 'world' to 'odom', which only the estimator may publish"
    ros.until(lambda: any(entry.msg == sentence for entry in log))
    assert not common


def test_a_waiting_robot_has_a_status_but_no_pose(ros: Ros, robots: Robots) -> None:
    poses, transforms = ros.listen(PoseWithCovarianceStamped, "beta/pose"), ros.listen(TFMessage, "/tf")
    others = ros.listen(PoseWithCovarianceStamped, "alpha/pose")
    robots.tell_time(T0_NS)
    robots.odometry("alpha", odometry_bytes("alpha", T0_NS))
    robots.odometry("beta", odometry_bytes("beta", T0_NS))
    ros.until(lambda: robots.poses and robots.located("alpha"))
    ros.until(lambda: transforms and others)

    waiting = robots.newest("beta")
    assert waiting.status == SwarmPose.STATUS_WAITING
    assert np.isnan(xytheta(waiting)).all()
    assert waiting.fix_age_s == -1.0
    assert [transform.child_frame_id for transform in transforms[-1].transforms] == ["alpha/odom"]
    assert not poses


def test_what_cannot_be_used_is_dropped_and_counted(ros: Ros, robots: Robots) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    now_ns = robots.run(T0_NS, 4)
    robots.odometry("alpha", odometry_bytes("alpha", now_ns + 1, (np.nan, 0.0, 0.0)))
    robots.odometry("alpha", odometry_bytes("alpha", now_ns + 2)[:100])
    robots.detections(
        "beta", detection_bytes("beta", now_ns + 3, sight(TRUE_POSES["beta"], [UNKNOWN_ID] * 3))
    )
    lame = sight(TRUE_POSES["beta"], [100])
    lame["position"] = np.inf
    robots.detections("beta", detection_bytes("beta", now_ns + 4, lame))
    now_ns = robots.run(now_ns + STEP_NS, 2)
    ros.until(told_of(heard, now_ns))

    _, values = report(heard, "estimator")
    dropped = {key: int(value) for key, value in values.items() if key.startswith("dropped")}
    assert dropped == {
        "dropped: odometry_non_finite": 1,
        "dropped: bad_message": 1,
        "dropped: unknown_id": 3,
        "dropped: non_finite": 1,
    }
    _, values = report(heard, "estimator: alpha")
    assert values["odom malformed"] == "1"
    assert np.isfinite(xytheta(robots.newest("alpha"))).all()


def test_time_that_jumps_back_resets_once(ros: Ros, robots: Robots, node: EstimatorNode) -> None:
    log, heard = ros.listen(Log, "/rosout"), ros.listen(DiagnosticArray, "/diagnostics")
    robots.run(T0_NS + 100 * STEP_NS, 20)
    robots.tell_time(T0_NS)  # the tick's timer begins a new period here
    ros.until(lambda: node.get_clock().now().nanoseconds == T0_NS)
    now_ns = robots.run(T0_NS + STEP_NS, 20)
    ros.until(told_of(heard, now_ns))
    ros.until(lambda: any("jumped back" in entry.msg for entry in log))

    assert report(heard, "estimator")[1]["time jumps"] == "1"
    assert sum("jumped back" in entry.msg for entry in log) == 1
    assert xytheta(robots.newest("beta")) == pytest.approx(TRUE_POSES["beta"], abs=0.03)


def test_services_reset_seat_and_forget(ros: Ros, robots: Robots) -> None:
    now_ns = robots.run(T0_NS, 4)
    name = "estimator/set_robot_pose"

    forget = SetRobotPose.Request(robot="alpha", forget=True)
    assert ros.call(SetRobotPose, name, forget).success
    robots.tell_time(now_ns := now_ns + STEP_NS)
    ros.until(lambda: robots.newest("alpha").status == SwarmPose.STATUS_WAITING)

    seat = SetRobotPose.Request(robot="alpha")
    seat.pose.pose.position.x = 5.0
    assert ros.call(SetRobotPose, name, seat).success
    robots.tell_time(now_ns := now_ns + STEP_NS)
    ros.until(lambda: robots.located("alpha"))
    assert robots.newest("alpha").x == pytest.approx(5.0)

    seat.pose.covariance[0] = -1.0
    response = ros.call(SetRobotPose, name, seat)
    assert not response.success
    assert "positive definite" in response.message
    response = ros.call(SetRobotPose, name, SetRobotPose.Request(robot="gamma"))
    assert not response.success
    assert "gamma" in response.message

    assert ros.call(Trigger, "estimator/reset", Trigger.Request()).success
    robots.step(now_ns + STEP_NS)
    assert robots.newest("alpha").x == pytest.approx(0.0, abs=0.03)


def test_a_description_is_fitted_beside_the_ticks(ros: Ros, robots: Robots, swarm_file: Path) -> None:
    """Robots that stand for a few seconds tell too little, so nothing is written."""
    said: list[str] = []

    def ask() -> str:
        response = ros.call(Trigger, "estimator/refine", Trigger.Request())
        assert not response.success
        said.append(response.message)
        return said[-1]

    assert ask() == "Nothing is refined: no message was received yet."
    now_ns = robots.run(T0_NS, 4)
    assert "are being fitted; ask again for what they give." in ask()
    end_s = time.monotonic() + 5.0 * PATIENCE_S
    while "ask again" in said[-1]:
        assert time.monotonic() < end_s
        count = len(robots.poses)
        now_ns = robots.run(now_ns + STEP_NS, 4)
        assert len(robots.poses) > count
        ask()
    assert said[-1].startswith(f"Nothing is refined: recording '{swarm_file.name}' holds ")
    assert [one.name for one in swarm_file.parent.iterdir()] == [swarm_file.name]


def test_a_seat_that_cannot_be_taken_is_refused_in_a_sentence(ros: Ros, robots: Robots) -> None:
    robots.tell_time(T0_NS)
    ros.until(lambda: robots.poses)
    name, seat = "estimator/set_robot_pose", SetRobotPose.Request(robot="alpha")
    response = ros.call(SetRobotPose, name, seat)
    assert (response.success, response.message) == (
        False,
        "Nothing was changed: the robot has sent no odometry yet.",
    )
    robots.run(T0_NS + STEP_NS, 2)
    seat.pose.pose.position.x = 2e6
    response = ros.call(SetRobotPose, name, seat)
    assert not response.success
    assert "within 1000 km" in response.message
    seat.pose.pose.position.x = np.nan
    response = ros.call(SetRobotPose, name, seat)
    assert not response.success
    assert "finite" in response.message
    assert robots.located("alpha")


def test_a_reset_counts_what_had_not_been_read_yet(ros: Ros, robots: Robots, node: EstimatorNode) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    assert not node.get_clock().now().nanoseconds
    for step in range(3):
        robots.odometry("alpha", odometry_bytes("alpha", T0_NS + step))
    robots.wait_until_received()
    assert ros.call(Trigger, "estimator/reset", Trigger.Request()).success
    robots.tell_time(T0_NS + STEP_NS)
    ros.until(lambda: "dropped: reset" in report(heard, "estimator")[1])
    assert report(heard, "estimator")[1]["dropped: reset"] == "3"


def test_drops_are_warned_of_once_in_a_while_and_ordinary_ones_never(ros: Ros, swarm_file: Any) -> None:
    estimator: Any = StandIn()
    node = ros.add(
        EstimatorNode(lambda *_: estimator, parameter_overrides=overrides(swarm_file=str(swarm_file)))
    )
    lines: list[str] = []
    now_s = [0.0]
    node.health = Health(lines.append, lambda: now_s[0])
    for now_s[0], drops in (
        (0.0, {"absurd": 3}),
        (1.0, {"absurd": 4, "non_finite": 40}),
        (29.0, {"absurd": 5, "non_finite": 40}),
        (31.0, {"absurd": 5, "non_finite": 40}),
        (90.0, {"absurd": 5, "non_finite": 40, "gated": 7}),
    ):
        estimator.drops = drops
        node._make_reports(TickCost(), 1.0)
    assert lines == ["dropped so far: 3 absurd", "dropped so far: 40 non_finite", "dropped so far: 5 absurd"]


def test_diagnostics_name_what_is_missing_and_why(ros: Ros, swarm_file: Any) -> None:
    stranger = ros.stranger()  # one participant cannot have both types
    stranger.create_publisher(PoseWithCovarianceStamped, "beta/odom", 1)
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    ros.add(EstimatorNode(parameter_overrides=overrides(swarm_file=str(swarm_file))))
    sentence = "beta/odom (published as geometry_msgs/msg/PoseWithCovarianceStamped)"
    ros.until(lambda: sentence in report(heard, "estimator")[0].message)

    status, _ = report(heard, "estimator")
    assert status.level == DiagnosticStatus.WARN
    assert (
        "no messages received on alpha/odom, alpha/detections, beta/detections (no publisher)"
        in status.message
    )
    status, _ = report(heard, "estimator: alpha")
    assert status.level == DiagnosticStatus.WARN
    assert "alpha/odom" in status.message


def test_diagnostics_say_that_the_clock_is_missing(ros: Ros, node: EstimatorNode) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    ros.until(lambda: heard)

    assert node.get_parameter("use_sim_time").value
    (status,) = heard[-1].status
    assert status.level == DiagnosticStatus.WARN
    assert "/clock" in status.message


def test_diagnostics_of_a_healthy_robot(ros: Ros, robots: Robots) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    now_ns = robots.run(T0_NS, 20)
    ros.until(told_of(heard, now_ns))

    status, values = report(heard, "estimator: alpha")
    assert (status.level, status.message) == (DiagnosticStatus.OK, "tracked")
    assert values["odom received"] == values["detections received"] == "20"
    assert float(values["NIS mean"]) < 1.0  # the simulated sightings are exact
    assert int(values["measurements used"]) == 40


class StandIn:
    """An estimator that only remembers what it was told."""

    def __init__(self, *_: object) -> None:
        self.odometry: list[tuple[int, int]] = []
        self.time_jumps = self.frame_moves = 0
        self.origin = ""
        self.drops: dict[str, int] = {}
        self.counters: dict[str, int] = {}
        self.identities = None
        self.is_fusing = False
        self.hint = ""
        self.settings = Settings()

    def receive(self, messages: Batch) -> None:
        """Remember whose and when."""
        assert not messages["detections"].robot.size
        assert not messages.dropped
        rows = messages["odometry"]
        assert np.all(rows.arrival_ns >= rows.stamp_ns)
        self.odometry += zip(rows.robot.tolist(), rows.stamp_ns.tolist(), strict=True)

    def drop(self, reason: str, count: int) -> None:
        """Nothing may go missing."""
        assert not count, reason

    def tick(self, now_ns: int, *, fuse: bool, has_budget: HasBudget) -> Estimate:
        """Always the same."""
        assert fuse
        assert has_budget()
        poses = np.array([[1.0, 2.0, 0.5], [np.nan, np.nan, np.nan]])
        covariances = np.tile(np.eye(3), (2, 1, 1))
        status, age_s = np.array([1, 0], np.uint8), np.array([0.25, -1.0])
        return Estimate(now_ns, poses, covariances, poses, status, age_s, status > 0)


def test_the_node_only_carries_between_topics_and_estimator(ros: Ros, swarm_file: Any) -> None:
    told: list[StandIn] = []

    def create(*_: object) -> Any:
        told.append(StandIn())
        return told[-1]

    parameters = overrides(swarm_file=str(swarm_file), use_sim_time=True, tick_period_s=1)
    ros.add(EstimatorNode(create, parameter_overrides=parameters))
    robots = Robots(ros)
    robots.wait_for_estimator()
    for step in range(5):
        robots.odometry("beta", odometry_bytes("beta", T0_NS + step))
    robots.tell_time(T0_NS + 10)
    ros.until(lambda: robots.poses)

    assert told[-1].odometry == [(1, T0_NS + step) for step in range(5)]
    assert xytheta(robots.newest("alpha")) == pytest.approx([1.0, 2.0, 0.5])
    assert robots.newest("alpha").fix_age_s == 0.25
    assert robots.newest("alpha").heading_known
    assert not robots.newest("beta").heading_known
    assert stamp_ns(robots.poses[-1]) == T0_NS + 10
