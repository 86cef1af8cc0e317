"""The estimator as a managed node: its transitions by a client, and a signal in each of its states."""

import gc
import signal
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from managed_node import ACTIVATE, CLEANUP, CONFIGURE, DEACTIVATE, SHUTDOWN, Manager
from node_world import (
    SETTINGS,
    STEP_NS,
    SWARM_YAML,
    T0_NS,
    Program,
    Robots,
    Ros,
    newest_status,
    odometry_bytes,
    overrides,
)
from rcl_interfaces.msg import Log
from std_srvs.srv import Trigger

from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode
from swarm_loc_msgs.msg import SwarmPose
from swarm_loc_msgs.srv import SetRobotPose

WAITING = {"autostart": False, "use_sim_time": True, **SETTINGS}
START = "start: {x: 0.0, y: 0.0, theta: 0.0}"


def managed(ros: Ros, path: Path, **more: object) -> Manager:
    ros.add(EstimatorNode(parameter_overrides=overrides(swarm_file=str(path), **WAITING, **more)))
    return Manager(ros, "estimator")


def test_an_estimator_waits_until_its_description_is_right(ros: Ros, tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    log, heard = ros.listen(Log, "/rosout"), ros.listen(DiagnosticArray, "/diagnostics")
    manager = managed(ros, path, horizon_s=100.0)
    assert manager.state() == "unconfigured"
    states, transitions = manager.offers()
    assert states >= {"unconfigured", "inactive", "active", "finalized"}
    assert transitions == {"configure", "shutdown"}
    ros.until(lambda: newest_status(heard, "estimator").message == "unconfigured: nothing is published")
    assert newest_status(heard, "estimator").level == DiagnosticStatus.WARN

    sentence = "parameter horizon_s = 100.0 must lie in [0.05, 60] s."
    assert not manager.change(CONFIGURE)
    ros.until(lambda: any(entry.msg == sentence for entry in log))
    assert manager.set_values(horizon_s=100.0) == sentence
    assert not manager.set_values(horizon_s=3)
    assert not manager.change(CONFIGURE)
    assert manager.state() == "unconfigured"
    ros.until(lambda: any(str(path) in entry.msg for entry in log))
    path.write_text(f"{SWARM_YAML}\nmap: floor.yaml\n", encoding="utf-8")
    assert not manager.change(CONFIGURE)
    ros.until(lambda: any("floor.yaml" in entry.msg for entry in log))
    path.write_text(SWARM_YAML, encoding="utf-8")
    assert not manager.change(ACTIVATE)  # which rclpy alone would not survive
    assert manager.changes(CONFIGURE) == "inactive"
    refusal = "parameter horizon_s cannot be set while the node is inactive."
    assert manager.set_values(horizon_s=4.0) == refusal
    ros.until(lambda: newest_status(heard, "estimator").message == "inactive: nothing is published")
    assert not ros.tester.count_publishers("swarm/poses")
    assert not ros.tester.count_subscribers("alpha/odom")
    ros.until(lambda: len(manager.events) == 8)  # two of each attempt to configure
    assert [event.goal_state.label for event in manager.events] == [
        *("configuring", "unconfigured") * 3,
        *("configuring", "inactive"),
    ]


def test_an_activation_starts_anew(ros: Ros, swarm_file: Path) -> None:
    """What beta knew before the pause is not known after it, and the robots may have been carried away."""
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    manager, robots = managed(ros, swarm_file), Robots(ros)
    assert manager.changes(CONFIGURE, ACTIVATE) == "active"
    robots.wait_for_estimator()
    now_ns = robots.run_until(T0_NS, lambda: robots.located("beta"))
    ros.until(lambda: newest_status(heard, "estimator: beta").name)

    assert manager.changes(DEACTIVATE) == "inactive"
    ros.until(lambda: not ros.tester.count_publishers("swarm/poses"))
    assert not ros.tester.count_subscribers("alpha/odom")
    ros.until(lambda: newest_status(heard[-1:], "estimator").message == "inactive: nothing is published")
    count = len(robots.poses)
    for step in range(1, 5):
        robots.tell_time(now_ns + step * STEP_NS)
    refused = "Nothing was changed: the estimator is not active."
    answer = ros.call(Trigger, "estimator/reset", Trigger.Request())
    assert (answer.success, answer.message) == (False, refused)
    request = SetRobotPose.Request(robot="alpha", forget=True)
    answer = ros.call(SetRobotPose, "estimator/set_robot_pose", request)
    assert (answer.success, answer.message) == (False, refused)
    assert len(robots.poses) == count

    assert manager.changes(ACTIVATE) == "active"
    robots.wait_for_estimator()
    now_ns += 10 * STEP_NS
    for name in ("alpha", "beta"):
        robots.odometry(name, odometry_bytes(name, now_ns))
    robots.wait_until_received()
    robots.tell_time(now_ns)
    ros.until(lambda: len(robots.poses) > count)
    assert robots.newest("beta").status == SwarmPose.STATUS_WAITING
    robots.run_until(now_ns + STEP_NS, lambda: robots.newest("beta").status == SwarmPose.STATUS_TRACKED)


def test_a_cleaned_up_estimator_takes_another_swarm(ros: Ros, swarm_file: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(SWARM_YAML.replace("beta", "gamma"), encoding="utf-8")
    manager = managed(ros, swarm_file)
    assert manager.changes(CONFIGURE, ACTIVATE, DEACTIVATE, CLEANUP) == "unconfigured"
    assert manager.set_values(swarm_file=str(other)) == ""
    assert manager.changes(CONFIGURE, ACTIVATE) == "active"
    ros.until(lambda: ros.tester.count_subscribers("gamma/odom"))
    assert not ros.tester.count_subscribers("beta/odom")
    assert manager.changes(SHUTDOWN) == "finalized"
    ros.until(lambda: not ros.tester.count_publishers("swarm/poses"))
    assert not ros.tester.count_subscribers("gamma/odom")


def test_nothing_is_left_of_an_activation(ros: Ros, swarm_file: Path) -> None:
    """Also not under a shower of messages, of which an executor has some in its queue at each change."""
    node = EstimatorNode(parameter_overrides=overrides(swarm_file=str(swarm_file), **WAITING))
    ros.add(node)
    manager, robots = Manager(ros, "estimator"), Robots(ros)
    manager.changes(CONFIGURE)
    kept, entities = set(vars(node)), set(node._entities())
    now_ns = T0_NS
    for _ in range(10):
        manager.changes(ACTIVATE)
        robots.wait_for_estimator()
        for _ in range(20):
            now_ns += STEP_NS
            robots.tell_time(now_ns)
            robots.odometry("alpha", odometry_bytes("alpha", now_ns))
        manager.changes(DEACTIVATE)
        assert (set(vars(node)), set(node._entities())) == (kept, entities)


@pytest.mark.parametrize(
    "transitions",
    [
        (),
        (CONFIGURE,),
        (CONFIGURE, ACTIVATE, DEACTIVATE),
        (CONFIGURE, ACTIVATE),
        (CONFIGURE, ACTIVATE, SHUTDOWN),
    ],
    ids=["unconfigured", "inactive", "deactivated", "active", "finalized"],
)
def test_a_signal_ends_the_process_in_each_state(
    ros: Ros, tmp_path: Path, swarm_file: Path, transitions: tuple[int, ...]
) -> None:
    parameters = {"swarm_file": swarm_file, "autostart": "false"}
    with Program("estimator_node", tmp_path / "log", parameters) as program:
        program.wait_for("waiting for a lifecycle manager")
        manager = Manager(ros, "estimator")
        assert all(map(manager.change, transitions)), program.output
        assert program.end(signal.SIGINT) == 0
        assert "Traceback" not in program.output


@pytest.mark.parametrize("wrong", [{}, {"autostart": 3}])
def test_an_estimator_that_cannot_start_leaves_no_node(
    ros: Ros, tmp_path: Path, wrong: dict[str, Any]
) -> None:
    gc.disable()  # which would hide a node that only reference cycles keep
    try:
        with suppress(UserError):
            EstimatorNode(parameter_overrides=overrides(swarm_file=str(tmp_path / "nowhere.yaml"), **wrong))
            pytest.fail("it has started")
        ros.until(lambda: "estimator" not in ros.tester.get_node_names())
    finally:
        gc.enable()
