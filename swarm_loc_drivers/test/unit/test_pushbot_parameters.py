"""Parameters of the PushBots' nodes, their pages, and what is simulated of a swarm of them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.shared.parameter_table import markdown_table
from swarm_loc_drivers.pushbot.parameters import ExplorationParameters, PushbotParameters
from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlanError
from swarm_loc_drivers.sim.pushbot.wall_drive import calibrate_lasers
from swarm_loc_drivers.sim.pushbot.world import PushbotWorldParameters, make_pushbot_world
from swarm_loc_drivers.sim.simulation import SimulationOptions, graph_of, simulated_swarm
from swarm_loc_drivers.sim.worlds import WorldError
from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_vision.laser.calibration import load_laser

DOC = Path(__file__).parents[2] / "doc"
SWARM = """
fileversion: 1
types:
  pushbot: {odometry: {wheel_separation: 0.085}, camera: null, fix: {systematic_share: 1.0}}
robots:
  a: {type: pushbot, start: {x: 1.5, y: 1.5, theta: 0.0}}
  b: {type: pushbot, start: {x: 2.4, y: 1.1, theta: 0.0}}
"""


@pytest.fixture
def swarm_file(tmp_path: Path) -> Path:
    path = tmp_path / "swarm.yaml"
    path.write_text(SWARM, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("page", "parameters"),
    [
        ("pushbot_driver_node.md", PushbotParameters),
        ("pushbot_world_node.md", PushbotWorldParameters),
        ("exploration_node.md", ExplorationParameters),
    ],
)
def test_pages_have_the_parameters_as_they_are(page: str, parameters: type) -> None:
    assert markdown_table(parameters) in (DOC / page).read_text(encoding="utf-8")


def test_tcp_goes_to_the_radios_port() -> None:
    params = PushbotParameters(address="tcp://10.0.0.1")
    assert (params.link_address.host, params.link_address.port) == ("10.0.0.1", 56000)
    assert params.event_timestamps == "24bit"
    assert PushbotParameters(address="/dev/x", events=False).event_timestamps == ""


@pytest.mark.parametrize("name", ["laser_frequency", "led_frequency"])
def test_a_light_that_hardly_blinks_is_refused(name: str) -> None:
    slow: dict[str, Any] = {name: 2.0}
    with pytest.raises(ParameterError, match=f"{name} = 2.0 must be 0, or at least 10 Hz"):
        replace(PushbotParameters(address="/dev/x"), **slow)


def test_a_robot_within_a_wall_is_named(swarm_file: Path) -> None:
    swarm_file.write_text(SWARM.replace("x: 1.5", "x: 0.01"))
    with pytest.raises(ParameterError, match="robot 1 of the swarm begins within a wall"):
        make_pushbot_world(PushbotWorldParameters(swarm_file=str(swarm_file)))


def test_robots_run_into_walls_and_not_through(swarm_file: Path) -> None:
    _, world = make_pushbot_world(PushbotWorldParameters(swarm_file=str(swarm_file)))
    world.drivetrain.duties[:] = 0.8
    for _ in range(800):
        world.step()
    assert world.poses[0, 0] < world.poses[1, 0] < 12.0


def test_a_swarm_of_pushbots_gets_a_hall_drivers_and_calibrated_trackers(
    swarm_file: Path, tmp_path: Path
) -> None:
    options = SimulationOptions(str(swarm_file), seed=4, plan="office", rate=0.5)
    nodes = {node.full_name: node for node in graph_of(options, simulated_swarm(options), str(tmp_path))}
    assert list(nodes) == [
        *("estimator", "mapper", "pushbot_world", "exploration"),
        *("a/pushbot_driver", "a/event_tracker", "b/pushbot_driver", "b/event_tracker"),
    ]
    world = nodes["pushbot_world"].parameters
    assert (world["plan"], world["seed"], world["rate"]) == ("office", 4, 0.5)
    frequencies = {
        nodes[f"{name}/{kind}"].parameters["laser_frequency"]
        for name in "ab"
        for kind in ("pushbot_driver", "event_tracker")
    }
    assert len(frequencies) == 2
    leds = {name: nodes[f"{name}/pushbot_driver"].parameters["led_frequency"] for name in "ab"}
    assert nodes["mapper"].parameters["led_frequencies"] == [f"{name}={hz}" for name, hz in leds.items()]
    assert nodes["a/event_tracker"].parameters["light_frequencies"] == [str(leds["b"])]
    for name, node in nodes.items():
        assert node.parameters.get("use_sim_time", False) is (name != "pushbot_world")  # which makes the time
    described = {nodes[name].parameters["swarm_file"] for name in list(nodes)[:4]}
    assert described == {str(swarm_file)}
    for name in "ab":
        assert nodes[f"{name}/pushbot_driver"].parameters["address"] == f"{tmp_path}/{name}"
        calibration = str(nodes[f"{name}/event_tracker"].parameters["calibration"])
        assert load_laser(Path(calibration)).focal_base > 0.0


def test_calibrations_are_those_of_the_worlds_robots(swarm_file: Path, tmp_path: Path) -> None:
    _, world = make_pushbot_world(PushbotWorldParameters(swarm_file=str(swarm_file), seed=7))
    calibrate_lasers(["a", "b"], 7, tmp_path)
    depths = np.linspace(0.2, 2.0, 50)
    for name, built in zip("ab", world.optics, strict=True):
        found = load_laser(tmp_path / f"{name}.yaml")
        read = [found.focal_base / (built.spot(depth)[1] - found.row_at_infinity) for depth in depths]
        assert np.abs(read - depths).max() < 0.05


def test_a_swarm_that_is_not_one_of_pushbots_is_named(swarm_file: Path) -> None:
    swarm_file.write_text(SWARM.replace("b: {type: pushbot, ", "b: {"))
    with pytest.raises(WorldError, match="robot 'b' is no pushbot, and others are"):
        simulated_swarm(SimulationOptions(str(swarm_file)))


def test_a_hall_that_is_not_there_is_named(swarm_file: Path) -> None:
    with pytest.raises(FloorPlanError, match="no floor plan 'attic': it must be one of corridor, office"):
        simulated_swarm(SimulationOptions(str(swarm_file), plan="attic"))
