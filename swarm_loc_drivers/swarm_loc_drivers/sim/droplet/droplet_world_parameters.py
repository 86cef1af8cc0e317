"""Parameters of `droplet_world_node`, and the world made of them. No ROS here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swarm_loc_drivers.sim.droplet.world import (
    DROPLET_WORLDS,
    DropletWorld,
    DropletWorldSettings,
)
from swarm_loc_drivers.sim.scenarios.eight import START_NS
from swarm_loc_drivers.sim.worlds import WorldError, start_of
from swarm_loc_estimator.common.parameters import ParameterError, choice, number, text, texts
from swarm_loc_estimator.swarm.robot_ir import RobotIr
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm


@dataclass(frozen=True)
class DropletWorldParameters:
    """Parameters of `droplet_world_node`."""

    swarm_file: str = text(
        "", "path of the swarm description; every robot needs a start and an infrared board", required=True
    )
    world: str = choice("d1", tuple(DROPLET_WORLDS), "how the robots err; see sim/droplet/world.py")
    seed: int = number(1, "1", 0, 2**31 - 1, "fixes the errors")
    rate: float = number(
        1.0, "1", 0.01, 100.0, "simulated seconds per second, as far as the machine keeps up"
    )
    link_folder: str = text("", "where each robot's serial port appears under its name", required=True)
    truth_rate: float = number(10.0, "1/s", 0.1, 200.0, "published true poses of each robot")
    fixed: tuple[str, ...] = texts("robots that a tracker above the table sees; it publishes <robot>/fix")
    fix_rate: float = number(1.0, "1/s", 0.01, 100.0, "fixes of each of these robots")
    fix_sigma: float = number(0.003, "m", 1e-6, 1.0, "noise of a fix along each axis, one standard deviation")
    fix_heading_sigma: float = number(
        0.02, "rad", 1e-6, 1.0, "noise of the heading of a fix, one standard deviation"
    )


def make_droplet_world(parameters: DropletWorldParameters) -> tuple[Swarm, DropletWorld]:
    """The swarm as described, and its world.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """
    swarm = load_swarm(Path(parameters.swarm_file))
    for name in parameters.fixed:
        if name not in swarm.index_of:
            raise ParameterError(f"parameter fixed has '{name}', who is not in the swarm description.")
    try:
        boards, starts = zip(*(_needed(robot) for robot in swarm.robots), strict=True)
        settings = DropletWorldSettings(
            parameters.seed, DROPLET_WORLDS[parameters.world], boards[0].platform, START_NS
        )
        return swarm, DropletWorld([board.id for board in boards], np.array(starts), settings)
    except WorldError as error:
        raise ParameterError(f"parameter swarm_file = '{parameters.swarm_file}': {error}") from error


def check_droplets(swarm: Swarm) -> None:
    """Make sure that every robot has a start and an infrared board.

    Raises:
        WorldError: One has none.
    """
    for robot in swarm.robots:
        _needed(robot)


def _needed(robot: Robot) -> tuple[RobotIr, Pose2]:
    """The board and the start of a robot.

    Raises:
        WorldError: It has none.
    """
    start = start_of(robot)
    if robot.ir is None:
        raise WorldError(f"robot '{robot.name}' has no infrared board, and a Droplet needs one.")
    return robot.ir, start
