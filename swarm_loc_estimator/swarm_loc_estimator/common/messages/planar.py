"""Poses of the plane as ROS holds them: in three coordinates, a quaternion, and covariances over six."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit

POSE_DOUBLES = 7
"""Numbers of a geometry_msgs/Pose: position and quaternion."""
PLANE = np.ix_((0, 1, 5), (0, 1, 5))
"""Where x, y and yaw stand in a 6x6 covariance."""


@cached_njit
def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """The yaw [rad] of a quaternion, which need not be normalised; NaN of zeros."""
    sine, cosine = 2.0 * (w * z + x * y), w * w + x * x - y * y - z * z
    return math.atan2(sine, cosine) if sine != 0.0 or cosine != 0.0 else math.nan


def position_and_quaternion(poses: FloatArray) -> FloatArray:
    """(N, 7) x, y, z [m] and quaternion x, y, z, w of planar poses (N, 3)."""
    columns = np.zeros((len(poses), POSE_DOUBLES))
    columns[:, :2] = poses[:, :2]
    columns[:, 5] = np.sin(poses[:, 2] / 2.0)
    columns[:, 6] = np.cos(poses[:, 2] / 2.0)
    return columns


def planar_covariance(x: float, y: float, yaw: float) -> FloatArray:
    """6x6 covariance from three variances; what the plane fixes (z, roll, pitch) is all but certain."""
    return np.diag([x, y, 1e-9, 1e-9, 1e-9, yaw])
