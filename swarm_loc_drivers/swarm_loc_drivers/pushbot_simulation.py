"""The graph of simulated PushBots as data: a hall, drivers, event trackers, lasers calibrated beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swarm_loc_drivers.sim.common.world_error import WorldError, start_of
from swarm_loc_drivers.sim.pushbot.optics import assembled_robots
from swarm_loc_drivers.sim.pushbot.wall_drive import WallDriveSettings, drive_at_wall
from swarm_loc_estimator.core.description.swarm import Swarm
from swarm_loc_estimator.launching.graph import NodeSpec, ParameterValue
from swarm_loc_vision.core.laser.fit import fit_hyperbola
from swarm_loc_vision.io.laser_file import save_laser

TYPE = "pushbot"
"""The type, in a swarm description, of robots that are simulated so."""
_CALIBRATION = WallDriveSettings(speed=0.25)
_LASERS_HZ = (410.0, 430.0, 450.0, 470.0, 530.0, 550.0, 570.0, 590.0)
"""Each robot of a hall has its own; 500 Hz is a fraction of the LEDs' 1000."""
_LEDS_HZ = 1000.0

Parameters = dict[str, ParameterValue]


def has_pushbots(swarm: Swarm) -> bool:
    """Whether a swarm is one of PushBots.

    Raises:
        WorldError: Only some of it are, or one has no start.
    """
    types = {robot.type for robot in swarm.robots}
    if TYPE not in types:
        return False
    for robot in swarm.robots:
        if robot.type != TYPE:
            raise WorldError(
                f"robot '{robot.name}' is no {TYPE}, and others are: one world has one kind of robots."
            )
        start_of(robot)
    return True


def calibrate_lasers(robots: Sequence[str], seed: int, folder: Path) -> None:
    """Write the laser calibrations of a world's robots, from drives at a wall, to FOLDER/ROBOT.yaml."""
    rng = np.random.default_rng([seed, 1])
    for name, built in zip(robots, assembled_robots(seed, len(robots)), strict=True):
        drive, _ = drive_at_wall(rng, built, _CALIBRATION)
        save_laser(folder / f"{name}.yaml", fit_hyperbola(drive))


def pushbot_nodes(world: Parameters, robots: Sequence[str], links: str, file: str | None) -> list[NodeSpec]:
    """The nodes of a simulation of PushBots, in the order in which they start.

    Args:
        world: Parameters of the world: `swarm_file`, `plan`, `seed` and `rate`.
        robots: Names of the robots.
        links: Folder where their serial ports appear, and where their laser calibrations are.
        file: Path of a ROS parameter file for all nodes, None for none.
    """
    drivers, vision = "swarm_loc_drivers", "swarm_loc_vision"
    time: Parameters = {"use_sim_time": True}
    nodes = [
        NodeSpec(drivers, "pushbot_world_node", "pushbot_world", "", {**world, "link_folder": links}, file)
    ]
    for number, robot in enumerate(robots):
        laser: Parameters = {"laser_frequency": _LASERS_HZ[number % len(_LASERS_HZ)], **time}
        driver: Parameters = {"address": f"{links}/{robot}", "led_frequency": _LEDS_HZ, **laser}
        tracker: Parameters = {
            "calibration": f"{links}/{robot}.yaml",
            "light_frequencies": [str(_LEDS_HZ)],
            **laser,
        }
        nodes += [
            NodeSpec(drivers, "pushbot_driver_node", "pushbot_driver", robot, driver, file),
            NodeSpec(vision, "event_tracker_node", "event_tracker", robot, tracker, file),
        ]
    return nodes
