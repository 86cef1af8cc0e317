"""The list of a simulation's nodes, its command line, and how its world waits for those who see it."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swarm_loc_drivers.sim import simulate
from swarm_loc_drivers.sim.droplet.world import DROPLET_WORLDS
from swarm_loc_drivers.sim.epuck.parts import Unanswered
from swarm_loc_drivers.sim.simulation import (
    ROBOT_TYPES,
    WORLD_NAMES,
    SimulationOptions,
    graph_of,
    placed,
    simulated_swarm,
)
from swarm_loc_drivers.sim.worlds import WORLDS, WorldError
from swarm_loc_estimator import load_map
from swarm_loc_estimator.cli import new
from swarm_loc_estimator.common.launch import parsed_options
from swarm_loc_estimator.common.parameters import ParameterError, parameter_specs
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm, save_swarm
from swarm_loc_vision.aerial.ground_control import AerialParameters

BAGS = Path(__file__).parents[3] / "bags"
SECOND = 1_000_000_000
TWO = Swarm(tuple(Robot(name, start=(0.0, 0.0, 0.0)) for name in "ab"))


def test_every_robot_has_a_driver_on_its_link_and_a_detector_for_its_camera() -> None:
    options = SimulationOptions("swarm.yaml", world="w0", seed=3, rate=0.5, parameter_file="all.yaml")
    nodes = {node.full_name: node for node in graph_of(options, TWO, "/links")}

    assert list(nodes) == [
        *("estimator", "epuck_world", "eight_steering"),
        *("a/epuck_driver", "a/marker_detector", "b/epuck_driver", "b/marker_detector"),
    ]
    assert nodes["b/epuck_driver"].parameters["address"] == "/links/b"
    world = nodes["epuck_world"].parameters
    assert (world["link_folder"], world["world"], world["seed"], world["rate"]) == ("/links", "w0", 3, 0.5)
    detector = nodes["a/marker_detector"].parameters
    assert (detector["robot"], detector["swarm_file"]) == ("a", "swarm.yaml")
    for name, node in nodes.items():
        assert node.parameters.get("use_sim_time", False) is (name != "epuck_world")  # which makes the time
        assert node.parameter_file == "all.yaml"


def test_from_above_an_overhead_camera_is_all_that_locates(tmp_path: Path) -> None:
    swarm_file = str(BAGS / "eight_five_robots" / "swarm.yaml")
    options = SimulationOptions(swarm_file, world="w0", aerial=True, parameter_file="all.yaml")
    nodes = {node.full_name: node for node in graph_of(options, TWO, str(tmp_path))}

    assert list(nodes) == [
        *("estimator", "epuck_world", "eight_steering", "aerial/aerial_camera"),
        *("a/epuck_driver", "b/epuck_driver"),
    ]
    described = load_swarm(Path(str(nodes["estimator"].parameters["swarm_file"])))
    assert [robot.name for robot in described.robots] == [f"epuck{k}" for k in range(1, 6)]
    assert all((robot.start, robot.camera, robot.faces) == (None, None, ()) for robot in described.robots)
    assert not described.landmarks
    assert nodes["epuck_world"].parameters["swarm_file"] == swarm_file
    assert float(str(nodes["epuck_world"].parameters["aerial_rate"])) > 0.0
    camera = nodes["aerial/aerial_camera"]
    assert camera.parameters["control_points_file"] == nodes["epuck_world"].parameters["control_points_file"]
    known = {spec.name for spec in parameter_specs(AerialParameters)}
    assert {name for name in camera.parameters if not name.startswith("qos")} - {"use_sim_time"} <= known
    assert camera.parameter_file == "all.yaml"


def test_e_pucks_without_a_start_stand_on_the_eight_and_the_estimator_does_not_know(tmp_path: Path) -> None:
    swarm = load_swarm(BAGS / "eight_five_robots" / "swarm.yaml")
    first, *others = swarm.robots
    robots = (first, *(replace(robot, start=None) for robot in others))
    save_swarm(replace(swarm, robots=robots), tmp_path / "swarm.yaml")
    options = SimulationOptions(str(tmp_path / "swarm.yaml"), world="w0")
    nodes = {node.full_name: node for node in graph_of(options, simulated_swarm(options), str(tmp_path))}
    assert nodes["estimator"].parameters["swarm_file"] == options.swarm_file
    placed = load_swarm(Path(str(nodes["epuck_world"].parameters["swarm_file"])))
    found, expected = (np.array([robot.start for robot in one.robots], float) for one in (placed, swarm))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert [replace(robot, start=None) for robot in placed.robots[1:]] == list(robots[1:])


def test_droplets_get_a_table_one_fleet_of_drivers_and_a_tracker(tmp_path: Path) -> None:
    robots = load_swarm(BAGS / "droplets_twenty" / "swarm.yaml").robots
    swarm_file = tmp_path / "swarm.yaml"
    save_swarm(Swarm(tuple(replace(robot, start=(0.0, 0.0, 0.0)) for robot in robots)), swarm_file)
    options = SimulationOptions(str(swarm_file), seed=5)
    nodes = {node.full_name: node for node in graph_of(options, simulated_swarm(options), "/links")}

    assert list(nodes) == ["estimator", "droplet_world", "droplet_steering", "droplet_fleet"]
    world = nodes["droplet_world"].parameters
    assert (world["world"], world["seed"], world["fixed"]) == ("d1", 5, ["droplet1", "droplet20"])
    assert nodes["droplet_fleet"].parameters["link_folder"] == world["link_folder"] == "/links"
    for name, node in nodes.items():
        assert node.parameters.get("use_sim_time", False) is (name != "droplet_world")


def test_robots_without_cameras_are_in_a_room_whose_map_is_drawn_where_it_is_missing(tmp_path: Path) -> None:
    file, floor = tmp_path / "swarm.yaml", tmp_path / "map.yaml"
    options = ["--yes", "--type", "turtlebot4", "--robots", "2", "--map", str(floor)]
    assert new.main([str(file), *options, "--sensors", "lidar,map,mocap"]) == 0
    chosen = SimulationOptions(str(file), plan="tee")
    nodes = {node.full_name: node for node in graph_of(chosen, simulated_swarm(chosen), str(tmp_path))}
    assert list(nodes) == ["estimator", "room_world", "localizer_bridge"]
    assert nodes["estimator"].parameters["swarm_file"] == str(file)
    assert nodes["room_world"].parameters["plan"] == "tee"
    assert (load_map(floor).free.shape, floor.with_suffix(".pgm").exists()) == ((184, 144), True)
    before = floor.stat().st_mtime_ns
    graph_of(chosen, simulated_swarm(chosen), str(tmp_path))
    assert floor.stat().st_mtime_ns == before
    with pytest.raises(ParameterError, match="argument aerial = true must be false for robots without cam"):
        simulated_swarm(replace(chosen, aerial=True))


@pytest.mark.parametrize("robots", [2, 4, 5, 12])
def test_no_two_e_pucks_begin_at_one_place(tmp_path: Path, robots: int) -> None:
    swarm_file = tmp_path / "swarm.yaml"
    assert new.main([str(swarm_file), "--yes", "--type", "epuck", "--robots", str(robots)]) == 0
    options = SimulationOptions(str(swarm_file))
    starts = np.array([robot.start for robot in placed(options, simulated_swarm(options)).robots])
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(starts[:, :2], 2)) > 0.08


@pytest.mark.parametrize(
    ("kind", "told"),
    [("droplet", ["droplet_world", "droplet_steering"]), ("pushbot", ["pushbot_world", "mapper"])],
)
def test_robots_without_a_start_stand_where_their_world_puts_them(
    tmp_path: Path, kind: str, told: list[str]
) -> None:
    assert new.main([str(tmp_path / "swarm.yaml"), "--yes", "--type", kind, "--robots", "3"]) == 0
    options = SimulationOptions(str(tmp_path / "swarm.yaml"), plan="office")
    swarm = simulated_swarm(options)
    assert all(robot.start is None for robot in swarm.robots)
    nodes = {node.full_name: node for node in graph_of(options, swarm, str(tmp_path))}
    for name in told:
        whole = load_swarm(Path(str(nodes[name].parameters["swarm_file"])))
        starts = np.array([robot.start for robot in whole.robots], float)
        assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(starts[:, :2], 2)) > 0.03
    known = load_swarm(Path(str(nodes["estimator"].parameters["swarm_file"])))
    assert all((robot.start is None) == (kind == "droplet") for robot in known.robots)


@pytest.mark.parametrize("kind", ["epuck", "droplet", "pushbot"])
def test_robots_without_a_start_keep_away_from_those_that_have_one(tmp_path: Path, kind: str) -> None:
    """The last robot stands where the first would."""
    file = tmp_path / "swarm.yaml"
    assert new.main([str(file), "--yes", "--type", kind, "--robots", "5"]) == 0
    options = SimulationOptions(str(file), plan="office")
    swarm = load_swarm(file)
    starts = [robot.start for robot in placed(options, swarm).robots]
    first, *others, last = swarm.robots
    mixed = replace(swarm, robots=(first, *others, replace(last, start=starts[0])))
    found = placed(options, mixed).robots
    assert found[-1].start == starts[0]
    assert [robot.start for robot in found[:-1]] == starts[1:]


def test_a_hall_without_room_for_all_is_named(tmp_path: Path) -> None:
    assert new.main([str(tmp_path / "swarm.yaml"), "--yes", "--type", "pushbot", "--robots", "10"]) == 0
    hall = tmp_path / "hall.yaml"
    hall.write_text('{"free": [[0, 0, 3, 3]], "starts": [[1, 1], [2, 2]]}')
    with pytest.raises(WorldError, match=r"the floor plan .*hall.yaml' has starts for 2 robots, not 10."):
        simulated_swarm(SimulationOptions(str(tmp_path / "swarm.yaml"), plan=str(hall)))


def test_every_error_model_belongs_to_a_robot_type_and_no_other_is_accepted() -> None:
    worlds = {world for kind in ROBOT_TYPES.values() for world in kind.worlds}
    assert worlds == {*WORLDS, *DROPLET_WORLDS}
    swarm_file = str(BAGS / "eight_one_robot_slow" / "swarm.yaml")
    with pytest.raises(ParameterError, match="argument world = 'd1' must be one of w2, w0, w2fast"):
        simulated_swarm(SimulationOptions(swarm_file, world="d1"))


def test_the_command_line_becomes_options() -> None:
    line = ["swarm.yaml", "--world", "w0", "--seed", "7", "--speed", "0.08", "--rate", "2", "--aerial"]
    expected = SimulationOptions("swarm.yaml", world="w0", seed=7, speed=0.08, rate=2.0, aerial=True)
    assert parsed_options(SimulationOptions, None, line, {"world": WORLD_NAMES}) == expected


@pytest.mark.parametrize(
    ("bag", "old", "new", "words"),
    [
        ("droplets_twenty", "ir: {id: 4097}", "ir: null", "robot 'droplet1' has no infrared board"),
        ("eight_one_robot_slow", "fileversion: 1", "fileversion: 2", "fileversion is 2 but must be 1"),
    ],
)
def test_a_swarm_that_cannot_be_simulated_is_told_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bag: str, old: str, new: str, words: str
) -> None:
    described, swarm_file = (BAGS / bag / "swarm.yaml").read_text(), tmp_path / "swarm.yaml"
    assert old in described
    swarm_file.write_text(described.replace(old, new) if old else described)
    assert simulate.main([str(swarm_file)]) == 1
    said = capsys.readouterr()
    assert not said.out
    assert words in said.err
    assert said.err.count("\n") == 1


def test_a_world_waits_for_its_oldest_picture() -> None:
    unanswered = Unanswered(0.15)
    unanswered.ask(0, stamp_ns=10, now_ns=SECOND)
    unanswered.ask(1, stamp_ns=20, now_ns=SECOND + 100_000_000)
    assert not unanswered.is_late(SECOND + 149_000_000)
    assert unanswered.is_late(SECOND + 150_000_000)
    unanswered.answer(0, stamp_ns=10)
    assert not unanswered.is_late(SECOND + 200_000_000)
    assert unanswered.is_late(SECOND + 250_000_000)
    assert unanswered.give_up() == 1
    assert not unanswered.is_late(9 * SECOND)


def test_an_answer_stands_for_all_older_pictures_of_its_robot() -> None:
    unanswered = Unanswered(0.1)
    for stamp_ns in (10, 20, 30):
        unanswered.ask(0, stamp_ns, SECOND)
    unanswered.answer(0, 20)
    unanswered.answer(1, 30)
    assert unanswered.is_late(2 * SECOND)
    unanswered.answer(0, 30)
    assert not unanswered.is_late(2 * SECOND)


def test_a_world_that_does_not_wait_never_does() -> None:
    unanswered = Unanswered(0.0)
    unanswered.ask(0, 10, 0)
    assert not unanswered.is_late(100 * SECOND)
