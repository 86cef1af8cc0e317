"""Lets Droplets wander around the places where they began, as a ROS 2 node.

    ./run swarm_loc_drivers droplet_steering_node --ros-args -p swarm_file:=swarm.yaml

It steers by `<robot>/ground_truth` (geometry_msgs/PoseStamped) and publishes `<robot>/cmd_vel`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from swarm_loc_drivers.sim.scenarios.droplets import Wander
from swarm_loc_drivers.sim.truth_steering import TruthSteering
from swarm_loc_estimator.common.node import ConfiguredNode, run_node
from swarm_loc_estimator.common.parameters import ParameterError, number, text
from swarm_loc_estimator.swarm.swarm_file import load_swarm


@dataclass(frozen=True)
class DropletSteeringParameters:
    """Parameters of `droplet_steering_node`."""

    swarm_file: str = text("", "path of the swarm description; every robot needs a start", required=True)
    seed: int = number(1, "1", 0, 2**31 - 1, "fixes where they go")
    every: int = number(2, "1", 1, 10_000, "2: every second robot wanders, and so on; the others stand")


class DropletSteeringNode(ConfiguredNode[DropletSteeringParameters]):
    """Turns poses into velocities."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("droplet_steering", DropletSteeringParameters, **node_arguments)
        parameters = self.params
        robots = load_swarm(Path(parameters.swarm_file)).robots
        homes = [robot.start for robot in robots if robot.start is not None]
        if len(homes) < len(robots):
            raise ParameterError(
                f"parameter swarm_file = '{parameters.swarm_file}': a robot has no start to wander around."
            )
        walking = np.arange(len(robots)) % parameters.every == parameters.every - 1
        wander = Wander(np.array(homes), walking, parameters.seed)
        self._steering = TruthSteering(self, [robot.name for robot in robots], wander.command)


main = partial(run_node, "droplet_steering_node", DropletSteeringNode)
