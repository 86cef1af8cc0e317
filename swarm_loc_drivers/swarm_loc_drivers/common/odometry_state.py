"""Odometry of a robot at an instant: pose, twist and their covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray


@dataclass(frozen=True)
class OdometryState:
    """Odometry at an instant.

    Attributes:
        stamp_ns: Acquisition [ns].
        pose: (3,) x [m], y [m], theta [rad] of base_link in odom.
        covariance: (3, 3) of the pose.
        twist: (3,) forward [m/s], to the left [m/s], turn rate [rad/s] since the state before.
        twist_covariance: (3, 3).
    """

    stamp_ns: int
    pose: FloatArray
    covariance: FloatArray
    twist: FloatArray
    twist_covariance: FloatArray


def carried_on(covariance: FloatArray, dx: float, dy: float) -> FloatArray:
    """The covariance (3, 3) of a pose after a way (dx, dy): an error of the heading leads aside on it."""
    transition = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    carried: FloatArray = transition @ covariance @ transition.T
    return carried
