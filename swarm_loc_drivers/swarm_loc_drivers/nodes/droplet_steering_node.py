"""Lets Droplets wander around the places where they began, as a ROS 2 node.

    ./run swarm_loc_drivers droplet_steering_node --ros-args -p swarm_file:=swarm.yaml

It steers by `<robot>/ground_truth` (geometry_msgs/PoseStamped) and publishes `<robot>/cmd_vel`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node

from swarm_loc_drivers.nodes.truth_steering import TruthSteering
from swarm_loc_drivers.sim.droplet_swarm import Wander
from swarm_loc_estimator.core.number_spec import number
from swarm_loc_estimator.io.swarm_file import load_swarm
from swarm_loc_estimator.nodes.declare import declare_parameters
from swarm_loc_estimator.nodes.parameter_table import ParameterError, text
from swarm_loc_estimator.nodes.running import run_node, spin


@dataclass(frozen=True)
class DropletSteeringParameters:
    """Parameters of `droplet_steering_node`."""

    swarm_file: str = text("", "path of the swarm description; every robot needs a start", required=True)
    seed: int = number(1, "1", 0, 2**31 - 1, "fixes where they go")
    every: int = number(2, "1", 1, 10_000, "every so many-th robot wanders, the others stand")


class DropletSteeringNode(Node):
    """Turns poses into velocities.

    Args:
        node_arguments: Further arguments of `rclpy.node.Node`.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("droplet_steering", **node_arguments)
        wishes = declare_parameters(self, DropletSteeringParameters)
        robots = load_swarm(Path(wishes.swarm_file)).robots
        homes = [robot.start for robot in robots if robot.start is not None]
        if len(homes) < len(robots):
            raise ParameterError(
                f"parameter swarm_file = '{wishes.swarm_file}': a robot has no start to wander around."
            )
        walking = np.arange(len(robots)) % wishes.every == wishes.every - 1
        wander = Wander(np.array(homes), walking, wishes.seed)
        self._steering = TruthSteering(self, [robot.name for robot in robots], wander.command)


def main() -> int:
    """Run until SIGINT or SIGTERM; 1 when a parameter cannot be used."""
    return run_node("droplet_steering_node", DropletSteeringNode, spin)


if __name__ == "__main__":
    sys.exit(main())
