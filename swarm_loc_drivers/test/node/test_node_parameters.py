"""Parameters of nodes: pages have what the tables say, and wrong ones end a node with one sentence."""

from pathlib import Path

import pytest
from node_world import Program

from bench.scenarios.droplets_run import DropletRunSettings, describe_droplets
from bench.scenarios.eight_run import EightSettings, describe
from bench.shared.parameter_table import markdown_table
from swarm_loc_drivers.dotbot.dotbot_node import DotbotParameters
from swarm_loc_drivers.sim.scenarios.droplets import starts
from swarm_loc_drivers.sim.scenarios.eight import eight_starts
from swarm_loc_drivers.sim.scenarios.steering_nodes import DropletSteeringParameters, SteeringParameters
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_vision.laser.calibrate_laser_node import CalibrateLaserParameters

ROOT = Path(__file__).parents[3]
EXECUTABLES = {
    "event_tracker": ("event_tracker_node", "swarm_loc_vision"),
    "calibrate_laser": ("calibrate_laser", "swarm_loc_vision"),
}
SERIAL, EIGHT = {"address": "/dev/nothing"}, {"swarm_file": "eight.yaml"}
DROPLETS = {"swarm_file": "droplets.yaml", "link_folder": "."}


@pytest.mark.parametrize(
    ("page", "parameters"),
    [
        ("swarm_loc_drivers/doc/epuck_world_node.md", SteeringParameters),
        ("swarm_loc_drivers/doc/droplet_world_node.md", DropletSteeringParameters),
        ("swarm_loc_drivers/doc/dotbot_node.md", DotbotParameters),
        ("swarm_loc_vision/doc/calibrate_laser.md", CalibrateLaserParameters),
    ],
)
def test_the_page_says_what_the_table_says(page: str, parameters: type) -> None:
    assert markdown_table(parameters) in (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "parameters", "sentence"),
    [
        ("epuck_driver", {**SERIAL, "reading_rate": 0.01}, "reading_rate = 0.01 must lie in [0.1, 200] 1/s."),
        ("epuck_driver", {**SERIAL, "model": "epuck3"}, "model = 'epuck3' must be one of epuck1, epuck2."),
        ("epuck_world", {**EIGHT, "model": "epuck1"}, "model = 'epuck1' needs the parameter link_folder"),
        ("droplet_driver", {}, "parameter address is not set"),
        ("droplet_world", {**DROPLETS, "world": "d7"}, "world = 'd7' must be one of d0, d1."),
        ("droplet_world", {**DROPLETS, "fixed": '["droplet9"]'}, "fixed has 'droplet9', who is not in the"),
        ("droplet_world", {**DROPLETS, "link_folder": "/x"}, "link_folder = /x cannot be used for drop"),
        ("pushbot_driver", {"address": "udp://x"}, "address = 'udp://x' must be the path of a serial port"),
        ("pushbot_world", {"swarm_file": "missing.yaml"}, "missing.yaml cannot be read"),
        ("event_tracker", {"calibration": "missing.yaml"}, "missing.yaml cannot be read"),
        ("event_tracker", {"light_frequencies": "['abc']"}, "'abc' must lie in [10, 5000]"),
        ("calibrate_laser", {}, "parameter output is not set"),
        ("calibrate_laser", {"output": "x", "stop_distance": 2.0}, "stop_distance = 2.0 must be less"),
    ],
)
def test_a_wrong_parameter_ends_a_node_with_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, parameters: dict[str, object], sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    save_swarm(describe(EightSettings(robots=2), eight_starts(2)), tmp_path / "eight.yaml")
    droplets = DropletRunSettings(robots=3, start_known=True)
    save_swarm(describe_droplets(droplets, starts(1, 3)), tmp_path / "droplets.yaml")
    executable, package = EXECUTABLES.get(name, (f"{name}_node", "swarm_loc_drivers"))
    with Program(executable, tmp_path / "log", parameters, package=package) as program:
        assert program.end() == 1
        (line,) = program.output.splitlines()
    assert line.startswith(f"{executable}: ")
    assert sentence in line
