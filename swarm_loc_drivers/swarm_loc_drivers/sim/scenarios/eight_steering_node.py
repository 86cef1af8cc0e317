"""Drives the robots of a swarm along the e-puck paper's eight, as a ROS 2 node.

    ./run swarm_loc_drivers eight_steering_node --ros-args -p swarm_file:=swarm.yaml -p speed:=0.06

It steers by `<robot>/ground_truth` (geometry_msgs/PoseStamped, motion capture or simulation), so that the way
does not depend on how well the robots are located, and publishes `<robot>/cmd_vel` at the poses' rate. The
eight begins when all robots have sent odometry, so that none is left behind, and with `wait_for_poses` when
all who locate them are there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from swarm_loc_drivers.sim.scenarios.eight import EightSteering
from swarm_loc_drivers.sim.truth_steering import TruthSteering
from swarm_loc_estimator.common.node import ConfiguredNode, run_node
from swarm_loc_estimator.common.parameters import flag, number, text
from swarm_loc_estimator.swarm.swarm_file import load_swarm


@dataclass(frozen=True)
class SteeringParameters:
    """Parameters of `eight_steering_node`."""

    swarm_file: str = text("", "path of the swarm description: which robots there are", required=True)
    speed: float = number(0.06, "m/s", 0.001, 0.12, "along the eight")
    wait_for_poses: bool = flag(
        False, "begin only when swarm/poses and the detections of all robots are announced"
    )
    aerial: bool = flag(
        False,
        "the detections to wait for are aerial/detections, of a camera above, in place of the robots' own",
    )


class EightSteeringNode(ConfiguredNode[SteeringParameters]):
    """Turns poses into velocities."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("eight_steering", SteeringParameters, **node_arguments)
        parameters = self.params
        names = [robot.name for robot in load_swarm(Path(parameters.swarm_file)).robots]
        seen = ["aerial/detections"] if parameters.aerial else [f"{name}/detections" for name in names]
        located = ["swarm/poses", *seen]
        steer = EightSteering(len(names), parameters.speed).command
        self._steering = TruthSteering(self, names, steer, located if parameters.wait_for_poses else ())


main = partial(run_node, "eight_steering_node", EightSteeringNode)
