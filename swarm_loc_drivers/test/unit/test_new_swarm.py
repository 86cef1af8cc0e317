"""Swarms that `new` describes: numbers are those of drivers, commands exist, simulated robots are located."""

import re
from configparser import ConfigParser
from pathlib import Path

import numpy as np
import pytest

from bench.scenarios import eight_run as eight
from bench.scenarios.bags import write_bag
from bench.scenarios.lived_run import SimulatedRun
from bench.scenarios.sightings import observe_markers
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_drivers.pushbot.parameters import PushbotParameters
from swarm_loc_drivers.sim.worlds import ErrorModel
from swarm_loc_estimator.cli.new import main, start_lines
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.new_swarm import KNOWN_ROBOTS, SwarmPlan
from swarm_loc_estimator.swarm.swarm_file import load_swarm

ROOT = Path(__file__).parents[3]


def test_numbers_are_those_of_drivers_and_simulations() -> None:
    drivers: dict[str, EpuckParameters | PushbotParameters] = {
        **dict.fromkeys(("epuck", "epuck2", "pipuck"), EpuckParameters("/dev/rfcomm0")),
        "pushbot": PushbotParameters("/dev/ttyUSB0"),
    }
    for name, driver in drivers.items():
        assert KNOWN_ROBOTS[name].odometry == OdometryModel(driver.wheel_separation, driver.wheel_noise), name
    for name in ("epuck", "epuck2", "pipuck"):
        assert KNOWN_ROBOTS[name].camera == eight.CAMERA
        faces = [
            (face.name, face.x, face.y, face.z, face.yaw, face.size) for face in KNOWN_ROBOTS[name].faces
        ]
        assert faces == [(face.name, face.x, face.y, face.z, face.yaw, face.size) for face in eight.faces(10)]


@pytest.mark.parametrize("name", KNOWN_ROBOTS)
def test_printed_commands_exist_with_their_options_on_their_pages(name: str) -> None:
    for sensor in KNOWN_ROBOTS[name].sensors:
        for line in start_lines(SwarmPlan(name, 2, name, (sensor,)), "swarm.yaml"):
            command = line.partition("#")[0].split()
            if not command:
                continue
            _, package, executable, *rest = command
            config = ConfigParser()
            config.read(ROOT / package / "setup.cfg", encoding="utf-8")
            assert f"\n{executable} = " in config["options.entry_points"]["console_scripts"]
            page = {"graph": "commands", "localizer_bridge": "motion_capture"}.get(executable, executable)
            text = (ROOT / package / "doc" / f"{page}.md").read_text(encoding="utf-8")
            parameters = re.findall(r"-p (\S+):=", line)
            assert [name for name in parameters if f"| `{name}` |" not in text] == []
            options = [word for word in rest if word.startswith("--") and word != "--ros-args"]
            assert [option for option in options if f"`{option}" not in text] == []


def test_simulated_epucks_are_located_by_a_written_description(tmp_path: Path) -> None:
    path = tmp_path / "swarm.yaml"
    assert main([str(path), "--yes", "--type", "epuck", "--robots", "3"]) == 0
    swarm = load_swarm(path)
    settings = eight.EightSettings(seed=4, duration_s=15.0, robots=3)
    rng = np.random.default_rng(settings.seed)
    _, truth, odometry = eight.drive_eight(rng, settings)
    exposures = eight.camera_exposures(rng, 3, truth)
    sensor = swarm.robots[0].sensor
    errors = ErrorModel(sensor.forward_sigma, sensor.left_sigma, sensor.heading_sigma)
    frames, sightings = observe_markers(rng, swarm, truth, exposures, eight.VIEW, errors)
    write_bag(SimulatedRun(swarm, truth, odometry, frames, sightings), tmp_path / "bag", "")
    result = replay(tmp_path / "bag", swarm)
    assert np.isfinite(result.poses[result.stamp_ns > truth.stamp_ns[0] + 5_000_000_000]).all()
    assert result.overall.position_rmse < 0.01
    assert result.overall.heading_rmse < 0.1
    assert result.overall.nees < 6.0
