"""Steering by ground truth: paths do not depend on the accuracy of localization."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseStamped, Twist, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data

from swarm_loc_drivers.common.velocity_command import Velocity
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import nanoseconds

Steer = Callable[[int, int, FloatArray], Velocity]
"""Robot's index, stamp [ns], true pose (3,) in map -> its velocity."""
_THROTTLE_S = 10.0


class TruthSteering:
    """Turns `<robot>/ground_truth` into `<robot>/cmd_vel` once all robots have sent odometry.

    A driver may subscribe before its robot is connected; the target would then move on without that robot.

    Args:
        node: Owner of the subscriptions.
        names: Of the robots.
        steer: Computes the commands.
        awaited: Topics that must have publishers before the robots drive.
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
