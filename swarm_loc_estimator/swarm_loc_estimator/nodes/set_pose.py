"""Set the poses of robots by the service `set_robot_pose` and the topics `<robot>/initialpose`."""

from __future__ import annotations

from functools import partial

import numpy as np
from geometry_msgs.msg import PoseWithCovariance, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.poses import PLANE, yaw_of
from swarm_loc_estimator.swarm.swarm import StartSigma, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_msgs.srv import SetRobotPose

NO_CLOCK = "use_sim_time is true but no messages received on /clock"

REFUSALS = {
    "absurd": "the pose must lie within 1000 km of the origin.",
    "bad_covariance": "the covariance of x, y and yaw must be positive definite, with variances of 1e-14 to"
    " 1e14, or zero for the default.",
    "not_localized": "the robot has sent no odometry yet.",
}
"""Reason of the estimator not to set a pose -> sentence for the user."""


class SetPoseError(ValueError):
    """A pose that cannot be set; the message is one sentence."""


def planar_pose(pose: PoseWithCovariance, start_sigma: StartSigma) -> tuple[FloatArray, FloatArray]:
    """The pose (3,) x [m], y [m], theta [rad] and its covariance (3, 3).

    Args:
        pose: In map.
        start_sigma: Used if the covariance is zero.

    Raises:
        SetPoseError: A number is not finite, or the quaternion is invalid.
    """
    position, q = pose.pose.position, pose.pose.orientation
    planar = np.array([position.x, position.y, yaw_of(q.x, q.y, q.z, q.w)])
    covariance = np.array(pose.covariance, dtype=float).reshape(6, 6)[PLANE]
    if not (np.isfinite(planar).all() and np.isfinite(covariance).all()):
        raise SetPoseError("pose and covariance must be finite numbers, and the quaternion not zero.")
    if not covariance.any():
        covariance = np.diag([start_sigma.x**2, start_sigma.y**2, start_sigma.theta**2])
    return planar, 0.5 * (covariance + covariance.T)


class PoseCommands:
    """Sets the pose of a robot, or deinitializes it until the next fix, at the user's request.

    Args:
        node: Owns the subscriptions.
        swarm: The robots.
        estimator: Executes the commands.
        map_frame: Required frame of the poses.
        by_topics: Whether to subscribe to a topic for each robot, too.
    """

    def __init__(
        self, node: Node, swarm: Swarm, estimator: Estimator, map_frame: str, *, by_topics: bool
    ) -> None:
        self._node = node
        self._swarm = swarm
        self._estimator = estimator
        self._map_frame = map_frame
        for index, robot in enumerate(swarm.robots if by_topics else ()):
            on_pose = partial(self._on_initial_pose, index)
            node.create_subscription(
                PoseWithCovarianceStamped, f"{robot.name}/initialpose", on_pose, QoSProfile(depth=10)
            )

    def on_request(
        self, request: SetRobotPose.Request, response: SetRobotPose.Response
    ) -> SetRobotPose.Response:
        """Execute a request of the service; the response says what was done, or why not."""
        try:
            response.message = self._obey(request)
            response.success = True
            self._node.get_logger().info(f"by service: {response.message}")
        except SetPoseError as error:
            response.success, response.message = False, f"Nothing was changed: {error}"
        return response

    def _obey(self, request: SetRobotPose.Request) -> str:
        """Execute the request and log it."""
        robot = self._swarm.index_of.get(request.robot)
        if robot is None:
            raise SetPoseError(f"there is no robot '{request.robot}' in the swarm description.")
        if request.forget:
            self._estimator.forget(robot, self._now_ns())
            return f"Robot '{request.robot}' waits for a fix."
        return self._set_pose(robot, request.pose)

    def _on_initial_pose(self, robot: int, message: PoseWithCovarianceStamped) -> None:
        name, frame = self._swarm.robots[robot].name, message.header.frame_id
        try:
            self._check_message(frame, message.pose)
            self._node.get_logger().info(f"by {name}/initialpose: {self._set_pose(robot, message.pose)}")
        except SetPoseError as error:
            self._node.get_logger().warning(f"by {name}/initialpose nothing was changed: {error}")

    def _check_message(self, frame: str, pose: PoseWithCovariance) -> None:
        if not np.any(pose.covariance):
            self._estimator.drop("bad_covariance")
            raise SetPoseError("the covariance is zero.")
        if frame != self._map_frame:
            raise SetPoseError(f"the pose is in frame '{frame}' but must be in '{self._map_frame}'.")

    def _set_pose(self, robot: int, wanted: PoseWithCovariance) -> str:
        """Set the present pose of a robot and log it."""
        pose, covariance = planar_pose(wanted, self._swarm.robots[robot].start_sigma)
        fault = self._estimator.set_pose(robot, self._now_ns(), pose, covariance)
        if fault:
            raise SetPoseError(REFUSALS[fault])
        x, y, theta = pose
        name = self._swarm.robots[robot].name
        return f"Robot '{name}' is at x {x:.3f} m, y {y:.3f} m, theta {theta:.3f} rad."

    def _now_ns(self) -> int:
        """The node's time; raises SetPoseError before the first /clock."""
        now_ns: int = self._node.get_clock().now().nanoseconds
        if not now_ns:
            raise SetPoseError(f"{NO_CLOCK}.")
        return now_ns
