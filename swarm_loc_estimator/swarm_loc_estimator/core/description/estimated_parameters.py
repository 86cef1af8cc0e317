"""Self-calibration states: systematic errors of odometry, cameras and the map, estimated besides the poses.

Of a robot's parameters the first three act through the motion: the further it drives, the more they move its
pose. The last two turn and stretch what its camera sees. A landmark whose survey is not exact is a body that
stands: like a robot's pose it has a right-invariant error, here of the identity, which moves the marker from
where the survey has it. What has a sigma in the description is estimated from the start; what has none only
once it is contradicted, with the sigmas that stand here. The columns of the filter are behind those of all
poses, in the order in which they were opened.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.description.swarm import Landmark, Robot
from swarm_loc_estimator.numerics.arrays import FloatArray
from swarm_loc_estimator.numerics.se2 import error_covariance

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

_DOUBTED_SIGMA = (0.0, 0.05, 0.1, 0.03, 0.03)
"""Standard deviations of parameters that were taken to be exact, once they are contradicted."""
_DOUBTED_SURVEY_SIGMA = (0.02, 0.03)
"""Likewise of a landmark's place [m] and yaw [rad]."""

_MIN_SURVEY_SIGMA = 1e-4
"""Of a landmark of which one of position and yaw is exact [m], [rad]: the filter inverts its covariance."""


class ParameterTable(NamedTuple):
    """What is estimated of which robot and landmark, as compiled code reads it.

    Attributes:
        column: (N, PARAMETERS) column of the filter; -1: not estimated, its value stays 0.
        sigma: (N, PARAMETERS) standard deviation when it is opened; 0: never estimated.
        turn_bias_time_s: (N,) time constant of TURN_BIAS; the others do not change.
        survey_column: (L,) of each landmark the first of its three columns; -1: not estimated.
        survey: (L, 3, 3) covariance of its right-invariant error when it is opened.
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
        doubted = np.where(wanted, sigma, _DOUBTED_SIGMA)
        doubted[[robot.camera is None for robot in robots], DRIVES:] = 0.0
        times = np.array([robot.odometry.turn_bias_time_s for robot in robots], dtype=float)
        surveyed = np.array([mark.is_estimated for mark in landmarks], dtype=bool)
        survey_column = np.full(len(landmarks), -1)
        survey_column[surveyed] = 3 * len(robots) + wanted.sum() + 3 * np.arange(surveyed.sum())
        surveys = np.array([_survey(mark) for mark in landmarks]).reshape(-1, 3, 3)
        return cls(column, doubted, times, survey_column, surveys)

    @property
    def filter_size(self) -> int:
        """How many columns the filter has: three per pose, one per parameter and three per landmark."""
        return int(3 * self.column.shape[0] + np.sum(self.column >= 0) + 3 * np.sum(self.survey_column >= 0))

    def with_robot(self, robot: int) -> ParameterTable:
        """The table with all parameters of a robot estimated that may be."""
        column, new = self.column.copy(), (self.column[robot] < 0) & (self.sigma[robot] > 0.0)
        column[robot, new] = self.filter_size + np.arange(new.sum())
        return self._replace(column=column)

    def with_landmark(self, landmark: int) -> ParameterTable:
        """The table with a landmark estimated."""
        survey_column = self.survey_column.copy()
        if survey_column[landmark] < 0:
            survey_column[landmark] = self.filter_size
        return self._replace(survey_column=survey_column)


def _survey(mark: Landmark) -> FloatArray:
    """Covariance (3, 3) of the right-invariant error of a landmark's survey when it is opened."""
    position, yaw = (mark.position_sigma, mark.yaw_sigma) if mark.is_estimated else _DOUBTED_SURVEY_SIGMA
    sigma = np.maximum([position, position, yaw], _MIN_SURVEY_SIGMA)
    return error_covariance([mark.x, mark.y, mark.yaw or 0.0], np.diag(sigma**2))
