"""The estimator as a process: wrong parameters, signals, and a restart in the middle of a run."""

import math
import signal
from pathlib import Path

import pytest
from node_world import SETTINGS, STEP_NS, T0_NS, TRUE_POSES, Poses, Program, Robots, Ros, overrides
from rclpy.parameter import Parameter

from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_estimator.nodes.estimator_node import EstimatorNode

LONG_ROBOT = """  robot{}:
    odometry: {{wheel_separation: 0.053, wheel_noise: 0.00002}}
    sensor: {{forward_sigma: 0.02, left_sigma: 0.02, heading_sigma: 0.035}}
    faces: {{front: {{x: 0.035, yaw: 0.0, size: 0.036}}}}
    start: {{x: 1.0, y: 1.0, theta: 0.0}}"""


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


@pytest.mark.parametrize(
    ("robot", "sentence"),
    [
        ("  robot{}: {{}}", "robots names 10000 robots but must name at most 5000."),
        (LONG_ROBOT, "has more than the 2000000 bytes that are allowed."),
    ],
    ids=["short", "long"],
)
def test_ten_thousand_robots_are_refused_in_one_sentence(tmp_path: Path, robot: str, sentence: str) -> None:
    path = tmp_path / "swarm.yaml"
    robots = "\n".join(robot.format(number) for number in range(10_000))
    path.write_text(f"fileversion: 1\nrobots:\n{robots}\n", encoding="utf-8")
    with _program(tmp_path, swarm_file=path) as program:
        assert program.end() == 1
        (line,) = program.output.splitlines()
    assert line.startswith("estimator_node: ")
    assert line.endswith(sentence)


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
