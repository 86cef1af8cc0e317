"""Nodes that steer robots by ground truth, so that paths do not depend on the accuracy of localization.

    ./run swarm_loc_drivers eight_steering_node --ros-args -p swarm_file:=swarm.yaml -p speed:=0.06
    ./run swarm_loc_drivers droplet_steering_node --ros-args -p swarm_file:=swarm.yaml

They steer by `<robot>/ground_truth` (geometry_msgs/PoseStamped, motion capture or simulation) and publish
`<robot>/cmd_vel` at the poses' rate. The eight of the e-puck paper begins when all robots have sent odometry,
and with `wait_for_poses` when all who locate them are there. Droplets wander around their starts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data

from swarm_loc_drivers.common.robot_driver import Velocity
from swarm_loc_drivers.sim.scenarios.droplets import Wander
from swarm_loc_drivers.sim.scenarios.eight import EightSteering
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.node import ConfiguredNode, run_node
from swarm_loc_estimator.common.parameters import ParameterError, flag, number, text
from swarm_loc_estimator.swarm.swarm_file import load_swarm

Steer = Callable[[int, int, FloatArray], Velocity]
"""Robot's index, stamp [ns], true pose (3,) in map -> its velocity."""
_THROTTLE_S = 10.0


class TruthSteering:
    """Turns `<robot>/ground_truth` into `<robot>/cmd_vel` once all robots have sent odometry.

    A driver may subscribe before its robot is connected; the target would then move on without that robot.
    `steer` computes the commands; awaited topics must have publishers before the robots drive.
    """

    def __init__(self, node: Node, names: Sequence[str], steer: Steer, awaited: Sequence[str] = ()) -> None:
        self._node, self._steer, self._awaited = node, steer, awaited
        self._driving = False
        self._silent = set(names)
        qos = QoSProfile(depth=1)
        self._commands = [node.create_publisher(Twist, f"{name}/cmd_vel", qos) for name in names]
        for index, name in enumerate(names):
            node.create_subscription(PoseStamped, f"{name}/ground_truth", partial(self._on_pose, index), qos)
            node.create_subscription(
                Odometry, f"{name}/odom", partial(self._on_odometry, name), qos_profile_sensor_data, raw=True
            )

    def _on_pose(self, robot: int, message: PoseStamped) -> None:
        self._driving = self._driving or self._all_there()
        if not self._driving:
            return
        place, turn = message.pose.position, message.pose.orientation
        pose = np.array([place.x, place.y, 2.0 * math.atan2(turn.z, turn.w)])
        stamp_ns = nanoseconds(message.header.stamp)
        if stamp_ns < 0 or not np.isfinite(pose).all():
            self._node.get_logger().warning(
                "dropped a pose that is not finite or is from before zero", throttle_duration_sec=_THROTTLE_S
            )
            return
        forward, left, rate = self._steer(robot, stamp_ns, pose)
        self._commands[robot].publish(Twist(linear=Vector3(x=forward, y=left), angular=Vector3(z=rate)))

    def _on_odometry(self, name: str, _message: bytes) -> None:
        self._silent.discard(name)

    def _all_there(self) -> bool:
        """Whether all robots are connected and all awaited topics have publishers."""
        drivers = all(one.get_subscription_count() for one in self._commands)
        return (
            not self._silent
            and drivers
            and all(self._node.count_publishers(topic) for topic in self._awaited)
        )


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


run_eight_steering = partial(run_node, "eight_steering_node", EightSteeringNode)


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


run_droplet_steering = partial(run_node, "droplet_steering_node", DropletSteeringNode)
