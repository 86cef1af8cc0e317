"""Processes of the estimator: how they start and end, errors of tasks, ticks, and the clock."""

import math
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from node_world import (
    SECOND,
    SETTINGS,
    STEP_NS,
    T0_NS,
    TRUE_POSES,
    Poses,
    Program,
    Robots,
    Ros,
    odometry_bytes,
    overrides,
    stamp_ns,
)
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.time_source import TimeSource
from rosgraph_msgs.msg import Clock

from swarm_loc_estimator.common.node import _EACH_CHANGE, drop_negative_clocks
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode


def _program(tmp_path: Path, **parameters: object) -> Program:
    return Program("estimator_node", tmp_path / "log", parameters)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("tick_period_s", "7.0", "parameter tick_period_s = 7.0 must lie in [0.005, 1] s."),
        ("swarm_file", "/nowhere.yaml", "/nowhere.yaml"),
        ("swarm_file", "", "Couldn't parse"),
    ],
)
def test_a_bad_parameter_ends_the_node_with_one_sentence(
    tmp_path: Path, swarm_file: Path, name: str, value: str, sentence: str
) -> None:
    with _program(tmp_path, **{"swarm_file": swarm_file, name: value}) as program:
        assert program.end() == 1
        (line,) = [line for line in program.output.splitlines() if "[rcl]" not in line]
    assert line.startswith("estimator_node: ")
    assert sentence in line


def test_unknown_arguments_end_the_node_with_one_sentence(tmp_path: Path, swarm_file: Path) -> None:
    arguments = ["surplus"]
    with Program("estimator_node", tmp_path / "log", {"swarm_file": swarm_file}, arguments) as program:
        assert program.end() == 1
        (line,) = program.output.splitlines()
    assert line == "estimator_node: ROS does not know the arguments ['surplus']."


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"horizon_s": math.nan}, "parameter horizon_s = nan must lie in [0.05, 60] s."),
        ({"horizon_s": "long"}, "parameter horizon_s = 'long' must be a number."),
        ({"publish_tf": 1}, "parameter publish_tf = 1 must be true or false."),
        ({"map_frame": ""}, "parameter map_frame is not set: frame that all poses are in."),
        ({"swarm_file": ""}, "parameter swarm_file is not set: path of the swarm description."),
    ],
)
def test_the_sentence_about_a_parameter(
    ros: Ros, swarm_file: Path, values: dict[str, object], sentence: str
) -> None:
    assert ros.tester.context.ok()
    with pytest.raises(ParameterError) as caught:
        EstimatorNode(parameter_overrides=overrides(**{"swarm_file": str(swarm_file), **values}))
    assert str(caught.value) == sentence


def test_parameters_describe_themselves_and_cannot_be_changed_while_active(node: EstimatorNode) -> None:
    descriptor = node.describe_parameter("horizon_s")
    assert "delay" in descriptor.description
    assert descriptor.floating_point_range[0].to_value == 60.0
    (result,) = node.set_parameters([Parameter("horizon_s", value=3.0)])
    assert not result.successful
    assert result.reason == "parameter horizon_s cannot be set while the node is active."


@pytest.mark.parametrize(
    ("number", "sign"), [(signal.SIGINT, "no messages received on alpha/odom"), (signal.SIGTERM, "ready")]
)
def test_a_signal_ends_the_node_cleanly(
    tmp_path: Path, swarm_file: Path, number: signal.Signals, sign: str
) -> None:
    with _program(tmp_path, swarm_file=swarm_file) as program:
        program.wait_for(sign)
        assert program.end(number) == 0
        assert "Traceback" not in program.output
        assert program.output.count(sign) == 1


def test_a_signal_ends_the_node_also_while_it_starts(ros: Ros, tmp_path: Path) -> None:
    """Thousands of subscriptions take seconds to make, and would take many more to give up one by one."""
    path = tmp_path / "swarm.yaml"
    model = "odometry: {wheel_separation: 0.053, wheel_noise: 0.00002}"
    robots = "\n".join(f"  robot{number}: {{{model}}}" for number in range(1000))
    path.write_text(f"fileversion: 1\nrobots:\n{robots}\n", encoding="utf-8")
    with _program(tmp_path, swarm_file=path) as program:
        ros.until(lambda: ros.tester.count_subscribers("robot990/odom") > 0)
        assert "ready" not in program.output
        assert program.seconds_to_end(signal.SIGINT) < 3.0
        assert "Traceback" not in program.output


def test_an_estimator_that_was_killed_finds_all_robots_again(
    ros: Ros, tmp_path: Path, swarm_file: Path
) -> None:
    def driving(now_ns: int) -> Poses:
        x = 0.2 * (now_ns - T0_NS) * 1e-9
        return {"alpha": (x, 0.0, 0.0), "beta": (x, 1.0, 0.0)}

    robots = Robots(ros)
    with _program(tmp_path, swarm_file=swarm_file, use_sim_time="true", **SETTINGS) as program:
        robots.wake_estimator(T0_NS)
        now_ns = robots.run_until(T0_NS + STEP_NS, lambda: robots.located("beta"), driving)
        program.end(signal.SIGKILL)
    with _program(tmp_path, swarm_file=swarm_file, use_sim_time="true", **SETTINGS) as program:
        begin_ns = now_ns + 40 * STEP_NS
        robots.wake_estimator(begin_ns)
        now_ns = robots.run_until(begin_ns + STEP_NS, lambda: all(map(robots.located, TRUE_POSES)), driving)
        now_ns = robots.run(now_ns + STEP_NS, 40, driving)
        assert program.end(signal.SIGTERM) == 0
    for name, pose in driving(now_ns).items():
        assert robots.located(name)
        estimate = robots.newest(name)
        assert (estimate.x, estimate.y, estimate.theta) == pytest.approx(pose, abs=0.05)


def test_a_clock_before_zero_ends_nothing(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TimeSource, "clock_callback", TimeSource.clock_callback)  # put back afterwards
    drop_negative_clocks()
    node = ros.add(Node("simulated", parameter_overrides=overrides(use_sim_time=True)))
    (subscription,) = [one for one in node.subscriptions if one.topic_name == "/clock"]
    for sec, shown in ((7, 7), (-5, 7), (8, 8)):
        subscription.callback(Clock(clock=Time(sec=sec)))
        assert node.get_clock().now().nanoseconds == shown * 1_000_000_000


_FAILING = """
from rclpy.node import Node
from swarm_loc_estimator.common import node as running

class Failing(Node):
    def run(self, stop):
        self.create_timer(0.01, lambda: self.executor.create_task({task}))
        return running.spin(self, stop)

def fail():
    raise ValueError("this is why")

async def fail_later():
    raise ValueError("this is why")

raise SystemExit(running.run_node("failing", lambda: Failing("failing")))
"""


@pytest.mark.parametrize("task", ["fail", "fail_later"])
def test_an_error_in_a_task_is_told_and_ends_the_node(task: str) -> None:
    code = _FAILING.format(task=task)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "ValueError: this is why" in ended.stderr


BACKLOG = 20
PATIENCE = Duration(seconds=60)


def test_time_told_again_and_again_before_the_tick_neither_repeats_nor_delays_it(
    ros: Ros, robots: Robots
) -> None:
    due_ns = robots.run(T0_NS, 4) + STEP_NS
    told_ns = [due_ns - 2]
    others_work = ros.tester.create_publisher(Clock, "others_work", BACKLOG)

    def work(_: Clock) -> None:
        """While one of the waiting messages is handled, a new time comes in behind them."""
        told_ns.append(told_ns[-1] + 1)
        robots.tell_time(told_ns[-1])
        robots.wait_until_told()

    ros.tester.create_subscription(Clock, "others_work", work, BACKLOG)
    times = ros.listen(Clock, "/clock")
    ros.until(others_work.get_subscription_count)
    others_work.publish(Clock())
    ros.until(lambda: times)
    for _ in range(BACKLOG):
        others_work.publish(Clock())
        assert others_work.wait_for_all_acked(PATIENCE)
        robots.tell_time(due_ns - 1)
        robots.wait_until_told()
    ros.until(lambda: stamp_ns(robots.poses[-1]) >= due_ns)
    for step in range(1, 4):
        robots.step(told_ns[-1] + step * STEP_NS)

    stamps = [stamp_ns(pose) for pose in robots.poses]
    assert sum(due_ns <= stamp < due_ns + STEP_NS for stamp in stamps) == 1


def test_what_comes_with_a_time_that_waits_to_be_handled_is_not_of_the_future(
    ros: Ros, robots: Robots, node: EstimatorNode
) -> None:
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    due_ns = robots.run(T0_NS, 4) + STEP_NS
    later_ns = due_ns + SECOND

    def has_budget(_jump: object) -> None:
        """Between the time that makes a tick due and the tick, time and robots go on."""
        if node.get_clock().now().nanoseconds == due_ns:
            robots.tell_time(later_ns)
            for name, pose in TRUE_POSES.items():
                robots.odometry(name, odometry_bytes(name, later_ns, pose))
            robots.wait_until_told()
            robots.wait_until_received()

    jumps = node.get_clock().create_jump_callback(_EACH_CHANGE, post_callback=has_budget)
    robots.tell_time(due_ns)
    ros.until(lambda: stamp_ns(robots.poses[-1]) == later_ns)
    jumps.unregister()
    robots.step(later_ns + STEP_NS)
    ros.until(lambda: heard and stamp_ns(heard[-1]) == later_ns + STEP_NS)

    stamps = [stamp_ns(pose) for pose in robots.poses]
    assert len(set(stamps)) == len(stamps)
    values = {pair.key: pair.value for status in heard[-1].status for pair in status.values}
    assert "dropped: future_stamp" not in values
    assert values["odom received"] == "6"
