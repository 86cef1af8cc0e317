"""Drives the robots of a swarm along the e-puck paper's eight, as a ROS 2 node.

    ./run swarm_loc_drivers eight_steering_node --ros-args -p swarm_file:=swarm.yaml -p speed:=0.06

It steers by `<robot>/ground_truth` (geometry_msgs/PoseStamped, motion capture or simulation), so that the way
does not depend on how well the robots are located, and publishes `<robot>/cmd_vel` at the poses' rate. The
eight begins when the drivers of all robots listen, and with `wait_for_poses` when all who locate them are
there.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.node import Node

from swarm_loc_drivers.nodes.truth_steering import TruthSteering
from swarm_loc_drivers.sim.steering import EightSteering
from swarm_loc_estimator.core.number_spec import number
from swarm_loc_estimator.io.swarm_file import load_swarm
from swarm_loc_estimator.nodes.declare import declare_parameters
from swarm_loc_estimator.nodes.parameter_table import flag, text
from swarm_loc_estimator.nodes.running import run_node, spin


@dataclass(frozen=True)
class SteeringParameters:
    """Parameters of `eight_steering_node`."""

    swarm_file: str = text("", "path of the swarm description: which robots there are", required=True)
    speed: float = number(0.06, "m/s", 0.001, 0.12, "along the eight")
    wait_for_poses: bool = flag(
        False, "begin only when swarm/poses and the detections of all robots are announced"
    )


class EightSteeringNode(Node):
    """Turns poses into velocities.

    Args:
        node_arguments: Further arguments of `rclpy.node.Node`.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("eight_steering", **node_arguments)
        wishes = declare_parameters(self, SteeringParameters)
        names = [robot.name for robot in load_swarm(Path(wishes.swarm_file)).robots]
        located = ["swarm/poses", *(f"{name}/detections" for name in names)]
        steer = EightSteering(len(names), wishes.speed).command
        self._steering = TruthSteering(self, names, steer, located if wishes.wait_for_poses else ())


def main() -> int:
    """Run until SIGINT or SIGTERM; 1 when a parameter cannot be used."""
    return run_node("eight_steering_node", EightSteeringNode, spin)


if __name__ == "__main__":
    sys.exit(main())
