"""Drives robots to the goals of a mapper and scans there, as a ROS 2 node.

    ./run swarm_loc_drivers exploration_node --ros-args -p swarm_file:=swarm.yaml

It takes `<robot>/goal` and `<robot>/fix` of `mapper_node`, `<robot>/odom` of the robots' drivers and
`<robot>/laser` of their event trackers, and publishes `<robot>/cmd_vel` and `/diagnostics`. Parameters: see
`doc/exploration_node.md`.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovarianceStamped, Twist, Vector3
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile

from swarm_loc_drivers.pushbot.parameters import ExplorationParameters, driven_robots
from swarm_loc_drivers.pushbot.stop_and_go import MapGoal, StopAndGo, StopAndGoSettings
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.health import Report, drop_values, listed
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.poses import yaw_of
from swarm_loc_estimator.common.node import ConfiguredNode, run_node
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_msgs.msg import LaserDistance

_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_QOS = QoSProfile(depth=10)


class _Robot:
    """One robot and its latest messages."""

    def __init__(self, settings: StopAndGoSettings) -> None:
        self.motion = StopAndGo(settings)
        self.drives = False
        self.fix: tuple[int, FloatArray] | None = None
        self.goal: tuple[int, FloatArray] | None = None

    def on_laser(self, message: LaserDistance) -> None:
        self.motion.take_distance(message.distance)


class ExplorationNode(ConfiguredNode[ExplorationParameters]):
    """Turns goals and odometry into velocities."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("exploration", ExplorationParameters, **node_arguments)
        params = self.params
        self._names = driven_robots(params, load_swarm(Path(params.swarm_file)))
        self._robots = [_Robot(params.settings) for _ in self._names]
        self._commands = [self.create_publisher(Twist, f"{name}/cmd_vel", 1) for name in self._names]
        for index, name in enumerate(self._names):
            self.create_subscription(Odometry, f"{name}/odom", partial(self._on_odometry, index), _QOS)
            self.create_subscription(LaserDistance, f"{name}/laser", self._robots[index].on_laser, _QOS)
            self.create_subscription(
                PoseWithCovarianceStamped, f"{name}/fix", partial(self._on_fix, index), _QOS
            )
            self.create_subscription(PoseStamped, f"{name}/goal", partial(self._on_goal, index), _LATCHED)
        self.start_diagnostics(self._on_diagnostics)
        self.get_logger().info(f"ready: {len(self._names)} robots of '{params.swarm_file}'")

    def destroy_node(self) -> None:
        """Stop the robots first."""
        for command in self._commands:
            command.publish(Twist())
        super().destroy_node()

    def _on_odometry(self, index: int, message: Odometry) -> None:
        robot, name = self._robots[index], self._names[index]
        # all nodes that produce and use a robot's distances must run, so that none is lost
        awaited = [f"{name}/laser", f"{name}/goal", f"{name}/fix"]
        awaited += ["swarm/poses"] if self.params.wait_for_poses else []
        robot.drives = robot.drives or (
            min(self.count_subscribers(f"{name}/{topic}") for topic in ("laser", "odom")) > 1
            and all(self.count_publishers(topic) for topic in awaited)
        )
        stamp_ns, pose = nanoseconds(message.header.stamp), _planar(message.pose.pose)
        if not robot.drives:
            return
        if stamp_ns < 0 or not np.isfinite(pose).all():
            self.health.drop("bad_odometry")
            return
        forward, _, rate = robot.motion.command(stamp_ns, pose)
        self._commands[index].publish(Twist(linear=Vector3(x=forward), angular=Vector3(z=rate)))

    def _on_fix(self, index: int, message: PoseWithCovarianceStamped) -> None:
        self._robots[index].fix = (nanoseconds(message.header.stamp), _planar(message.pose.pose))
        self._go(self._robots[index])

    def _on_goal(self, index: int, message: PoseStamped) -> None:
        self._robots[index].goal = (nanoseconds(message.header.stamp), _planar(message.pose)[:2])
        self._go(self._robots[index])

    def _go(self, robot: _Robot) -> None:
        """Send a robot to its goal once the fix with the same stamp has arrived."""
        if robot.goal is None or robot.fix is None or robot.goal[0] != robot.fix[0]:
            return
        stamp_ns, position = robot.goal
        pose, robot.goal = robot.fix[1], None
        if not (np.isfinite(pose).all() and np.isfinite(position).all()):
            self.health.drop("bad_goal")
        elif not robot.motion.take_goal(MapGoal(stamp_ns, pose, position)):
            self.health.drop("goal_of_another_time")

    def _on_diagnostics(self) -> None:
        self.health.warn_of_drops()
        waiting = [name for name, robot in zip(self._names, self._robots, strict=True) if not robot.drives]
        motions = [robot.motion for robot in self._robots]
        values: dict[str, object] = {
            "goals": sum(one.goals for one in motions),
            "halts": sum(one.halts for one in motions),
            "odometry_restarts": sum(one.restarts for one in motions),
            **drop_values(self.health.drops),
        }
        message = f"waiting for all that map with {listed(waiting)}" if waiting else "driving"
        self.publish_reports(Report(self.get_name(), message, values=values))


def _planar(pose: Pose) -> FloatArray:
    """x, y and yaw (3,) of a pose."""
    turned = pose.orientation
    return np.array([pose.position.x, pose.position.y, yaw_of(turned.x, turned.y, turned.z, turned.w)])


main = partial(run_node, "exploration_node", ExplorationNode)
