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

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import error_covariance
from swarm_loc_estimator.swarm.swarm import Landmark, Robot

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
BLOCKS = -(-PARAMETERS // DRIVES)
"""A robot's parameters are so many blocks of as many columns as a pose has: of its motion, of its camera."""
_BLOCK, _SLOT = np.divmod(np.arange(PARAMETERS), DRIVES)
"""In which block each stands, and where there."""

_CONTRADICTED_SIGMA = (0.0, 0.05, 0.1, 0.03, 0.03)
"""Standard deviations of parameters that were taken to be exact, once they are contradicted."""
_CONTRADICTED_SURVEY_SIGMA = (0.02, 0.03)
"""Standard deviations of a landmark's place [m] and yaw [rad], once they are contradicted."""

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
        in_blocks: Whether a robot's parameters stand in blocks of three columns, some of them of nothing.
    """

    column: NDArray[np.int64]
    sigma: FloatArray
    turn_bias_time_s: FloatArray
    survey_column: NDArray[np.int64]
    survey: FloatArray
    in_blocks: bool

    @classmethod
    def of(
        cls, robots: Sequence[Robot], landmarks: Sequence[Landmark] = (), *, in_blocks: bool = False
    ) -> ParameterTable:
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
        doubted = np.where(wanted, sigma, _CONTRADICTED_SIGMA)
        doubted[[robot.camera is None for robot in robots], DRIVES:] = 0.0
        times = np.array([robot.odometry.turn_bias_time_s for robot in robots], dtype=float)
        surveys = np.array([_survey(mark) for mark in landmarks]).reshape(-1, 3, 3)
        column, survey_column = np.full(sigma.shape, -1), np.full(len(landmarks), -1)
        table = cls(column, doubted, times, survey_column, surveys, in_blocks).with_parameters(wanted)
        surveyed = np.array([mark.is_estimated for mark in landmarks], dtype=bool)
        survey_column[surveyed] = table.filter_size + 3 * np.arange(surveyed.sum())
        return table

    @property
    def filter_size(self) -> int:
        """How many columns the filter has: three per pose, one per parameter and three per landmark."""
        parameters, landmarks = self.column.max(initial=-1) + 1, self.survey_column.max(initial=-3) + 3
        if self.in_blocks:
            parameters = -(-parameters // DRIVES) * DRIVES
        return int(max(3 * self.column.shape[0], parameters, landmarks))

    def with_robot(self, robot: int) -> ParameterTable:
        """The table with all parameters of a robot estimated that may be."""
        new = np.zeros(self.column.shape, dtype=bool)
        new[robot] = (self.column[robot] < 0) & (self.sigma[robot] > 0.0)
        return self.with_parameters(new)

    def with_parameters(self, new: BoolArray) -> ParameterTable:
        """The table with more parameters (N, PARAMETERS) estimated."""
        column = self.column.copy()
        if not self.in_blocks:
            column[new] = self.filter_size + np.arange(new.sum())
            return self._replace(column=column)
        first = self.block_columns
        begun = np.stack([new[:, block == _BLOCK].any(axis=1) for block in range(BLOCKS)], axis=1) & (
            first < 0
        )
        first[begun] = self.filter_size + DRIVES * np.arange(begun.sum())
        column[new] = (first[:, _BLOCK] + _SLOT)[new]
        return self._replace(column=column)

    @property
    def block_columns(self) -> IntArray:
        """The first columns (N, BLOCKS) of the robots' blocks of parameters; -1: there is none."""
        first = np.where(self.column >= 0, self.column - _SLOT, -1)
        return np.stack([first[:, block == _BLOCK].max(axis=1) for block in range(BLOCKS)], axis=1)

    def with_landmark(self, landmark: int) -> ParameterTable:
        """The table with a landmark estimated."""
        survey_column = self.survey_column.copy()
        if survey_column[landmark] < 0:
            survey_column[landmark] = self.filter_size
        return self._replace(survey_column=survey_column)


def _survey(mark: Landmark) -> FloatArray:
    """Covariance (3, 3) of the right-invariant error of a landmark's survey when it is opened."""
    position, yaw = (mark.position_sigma, mark.yaw_sigma) if mark.is_estimated else _CONTRADICTED_SURVEY_SIGMA
    sigma = np.maximum([position, position, yaw], _MIN_SURVEY_SIGMA)
    return error_covariance([mark.x, mark.y, mark.yaw or 0.0], np.diag(sigma**2))
