"""What is estimated of a robot besides its pose: errors that last, of its odometry and of its camera.

The first three act through the motion: the further a robot drives, the more they move its pose. The last
two turn and stretch what its camera sees. Only those whose sigma is not zero are estimated; each has a
column of the filter behind those of all poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.swarm import Robot

TURN_BIAS = 0
"""A turn rate besides the one reported, while moving [rad/s]; it changes slowly."""
DISTANCE_SCALE = 1
"""Relative error of the path."""
TURN_SCALE = 2
"""Relative error of the turn."""
CAMERA_YAW = 3
"""The camera is turned to the left by so much more [rad]."""
CAMERA_SCALE = 4
"""Distances are seen too large by this share."""

DRIVES = 3
"""So many, the first, act through the motion."""
PARAMETERS = 5


class ParameterTable(NamedTuple):
    """Which parameters of which robot are estimated, as compiled code reads it.

    Attributes:
        column: (N, PARAMETERS) column of the filter; -1: not estimated, its value stays 0.
        sigma: (N, PARAMETERS) standard deviation before any data.
        turn_bias_time_s: (N,) time constant of TURN_BIAS; the others do not change.
    """

    column: NDArray[np.int64]
    sigma: FloatArray
    turn_bias_time_s: FloatArray

    @classmethod
    def of(cls, robots: Sequence[Robot]) -> ParameterTable:
        """What the robots' descriptions ask for."""
        sigma = np.zeros((len(robots), PARAMETERS))
        for i, robot in enumerate(robots):
            odometry = robot.odometry
            sigma[i, TURN_BIAS] = odometry.turn_bias_sigma
            sigma[i, DISTANCE_SCALE] = odometry.distance_scale_sigma
            sigma[i, TURN_SCALE] = odometry.turn_scale_sigma
            if robot.camera is not None:
                sigma[i, CAMERA_YAW] = robot.camera.yaw_sigma
                sigma[i, CAMERA_SCALE] = robot.sensor.distance_scale_sigma
        wanted = sigma > 0.0
        column = np.full(sigma.shape, -1)
        column[wanted] = 3 * len(robots) + np.arange(wanted.sum())
        times = np.array([robot.odometry.turn_bias_time_s for robot in robots], dtype=float)
        return cls(column, sigma, times)

    @property
    def filter_size(self) -> int:
        """How many columns the filter has: three per pose and one per parameter estimated."""
        return int(3 * self.column.shape[0] + np.sum(self.column >= 0))
