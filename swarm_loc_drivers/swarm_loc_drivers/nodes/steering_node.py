"""Drives the robots of a swarm along the e-puck paper's eight, as a ROS 2 node.

    ./run swarm_loc_drivers eight_steering_node --ros-args -p swarm_file:=swarm.yaml -p speed:=0.06

It steers by `<robot>/ground_truth` (geometry_msgs/PoseStamped, motion capture or simulation), so that the way
does not depend on how well the robots are located, and publishes `<robot>/cmd_vel` at the poses' rate. The
eight begins when the drivers of all robots listen, and with `wait_for_poses` when all who locate them are
there.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.time import Time

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
        robots = load_swarm(Path(wishes.swarm_file)).robots
        self._steering = EightSteering(len(robots), wishes.speed)
        self._driving = False
        located = ["swarm/poses", *(f"{robot.name}/detections" for robot in robots)]
        self._awaited = located if wishes.wait_for_poses else []
        self._commands = [
            self.create_publisher(Twist, f"{robot.name}/cmd_vel", QoSProfile(depth=1)) for robot in robots
        ]
        for index, robot in enumerate(robots):
            self.create_subscription(
                PoseStamped, f"{robot.name}/ground_truth", partial(self._on_pose, index), QoSProfile(depth=1)
            )

    def _on_pose(self, robot: int, message: PoseStamped) -> None:
        self._driving = self._driving or self._all_there()
        if not self._driving:
            return
        place, turn = message.pose.position, message.pose.orientation
        pose = np.array([place.x, place.y, 2.0 * math.atan2(turn.z, turn.w)])
        if not np.isfinite(pose).all():
            self.get_logger().warning("dropped a pose that is not finite", throttle_duration_sec=10.0)
            return
        stamp_ns = Time.from_msg(message.header.stamp).nanoseconds
        command = Twist()
        command.linear.x, command.angular.z = self._steering.command(robot, stamp_ns, pose)
        self._commands[robot].publish(command)

    def _all_there(self) -> bool:
        """Whether the eight can begin."""
        drivers = all(one.get_subscription_count() for one in self._commands)
        return drivers and all(self.count_publishers(topic) for topic in self._awaited)


def main() -> int:
    """Run until SIGINT or SIGTERM; 1 when a parameter cannot be used."""
    return run_node("eight_steering_node", EightSteeringNode, spin)


if __name__ == "__main__":
    sys.exit(main())
