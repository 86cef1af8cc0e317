"""What is estimated besides the robots' poses: errors that last, of odometry, of cameras and of the map.

Of a robot's parameters the first three act through the motion: the further it drives, the more they move its
pose. The last two turn and stretch what its camera sees. A landmark whose survey is not exact is a body that
stands: like a robot's pose it has a right-invariant error, here of the identity, which moves the marker from
where the survey has it. Only what has a sigma is estimated; its columns of the filter are behind those of
all poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.se2 import FloatArray, error_covariance
from swarm_loc_estimator.core.swarm import Landmark, Robot

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

_LEAST_SURVEY_SIGMA = 1e-4
"""Of a landmark of which one of position and yaw is exact [m], [rad]: the filter inverts its covariance."""


class ParameterTable(NamedTuple):
    """What is estimated of which robot and landmark, as compiled code reads it.

    Attributes:
        column: (N, PARAMETERS) column of the filter; -1: not estimated, its value stays 0.
        sigma: (N, PARAMETERS) standard deviation before any data.
        turn_bias_time_s: (N,) time constant of TURN_BIAS; the others do not change.
        survey_column: (L,) of each landmark that is estimated the first of its three columns.
        survey: (L, 3, 3) covariance of its right-invariant error before any data.
    """

    column: NDArray[np.int64]
    sigma: FloatArray
    turn_bias_time_s: FloatArray
    survey_column: NDArray[np.int64]
    survey: FloatArray

    @classmethod
    def of(cls, robots: Sequence[Robot], landmarks: Sequence[Landmark] = ()) -> ParameterTable:
        """What the descriptions of robots and landmarks ask for."""
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
        surveys = [_survey(mark) for mark in landmarks if mark.is_estimated]
        survey_column = 3 * len(robots) + wanted.sum() + 3 * np.arange(len(surveys))
        return cls(column, sigma, times, survey_column, np.array(surveys).reshape(-1, 3, 3))

    @property
    def filter_size(self) -> int:
        """How many columns the filter has: three per pose, one per parameter and three per landmark."""
        return int(3 * self.column.shape[0] + np.sum(self.column >= 0) + 3 * self.survey_column.size)


def _survey(mark: Landmark) -> FloatArray:
    """Covariance (3, 3) of the right-invariant error that a landmark's survey has."""
    sigma = np.maximum([mark.position_sigma, mark.position_sigma, mark.yaw_sigma], _LEAST_SURVEY_SIGMA)
    return error_covariance([mark.x, mark.y, mark.yaw or 0.0], np.diag(sigma**2))
