"""What a person asks for with the service `set_robot_pose`, made planar and checked."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovariance

from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.swarm import StartSigma
from swarm_loc_estimator.io.planar import PLANE, yaw_of

REFUSALS = {
    "absurd": "the pose must lie within 1000 km of the origin.",
    "bad_covariance": "the covariance of x, y and yaw must be positive definite, with variances of 1e-14 to"
    " 1e14, or zero for the default.",
    "untied": "the robot has sent no odometry yet.",
}
"""What the estimator's reasons not to seat a robot mean, each a sentence."""


class SeatRequestError(ValueError):
    """A pose that a robot cannot be set to; the message is one sentence."""


def planar_seat(pose: PoseWithCovariance, start_sigma: StartSigma) -> tuple[FloatArray, FloatArray]:
    """The pose (3,) x [m], y [m], theta [rad] and its covariance (3, 3).

    Args:
        pose: In map.
        start_sigma: Taken when the covariance was left at zero.

    Raises:
        SeatRequestError: Numbers that are not finite, or no quaternion.
    """
    position, q = pose.pose.position, pose.pose.orientation
    planar = np.array([position.x, position.y, yaw_of(q.x, q.y, q.z, q.w)])
    covariance = np.array(pose.covariance, dtype=float).reshape(6, 6)[PLANE]
    if not (np.isfinite(planar).all() and np.isfinite(covariance).all()):
        raise SeatRequestError("pose and covariance must be finite numbers, and the quaternion not zero.")
    if not covariance.any():
        covariance = np.diag([start_sigma.x**2, start_sigma.y**2, start_sigma.theta**2])
    return planar, 0.5 * (covariance + covariance.T)
