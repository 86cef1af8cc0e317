"""Self-calibration states: systematic errors of odometry, cameras and the map, estimated with the poses.

Parameters of a robot are errors of its motion, whose effect on the pose grows with distance and turn, the yaw
offset, scale error and range offset of its camera (a range r is measured as (1 + scale) r + offset), and the
bias of its radio. The state of a landmark with an inexact survey and of a fixed camera is a correction of the
survey, with a right-invariant error about the identity; that of an anchor is a displacement and the bias of
its ranges. Errors that all places share correlate these states. Parameters with a standard deviation in the
description are estimated from the start, as is the path of the wheels of robots with radios, others only
after a contradiction, with the sigmas below. Their filter columns follow those of all poses, by addition.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import compose, error_covariance
from swarm_loc_estimator.swarm.swarm import (
    NO_MAP_ERROR,
    Anchor,
    FixedCamera,
    MapError,
    Robot,
    Surveyed,
)

TURN_BIAS = 0  # Bias of the turn rate while moving, or of the gyroscope [rad/s]; it changes slowly
DISTANCE_SCALE = 1  # Relative error of the distance driven
TURN_SCALE = 2  # Relative error of the turn
CAMERA_YAW = 3  # Yaw offset of the camera, positive to the left [rad]; constant, or it changes slowly
CAMERA_SCALE = 4  # Relative error of distances measured by the camera
CAMERA_OFFSET = 5  # Error of ranges of sightings without heading, the same at each range [m]
RADIO_BIAS = 6  # Error of ranges from or to its radio [m]

DRIVES = 3  # Number of leading parameters that act through the motion
PARAMETERS = 7
BLOCKS = -(-PARAMETERS // DRIVES)  # Of three columns for a robot's parameters: motion, camera, radio
_BLOCK, _SLOT = np.divmod(np.arange(PARAMETERS), DRIVES)  # Block of each parameter, and its index in it

_CONTRADICTED_SIGMA = (0.0, 0.05, 0.1, 0.03, 0.03, 0.0, 0.0)
"""Standard deviations of parameters that are exact in the description, after a contradiction."""
CONTRADICTED_SURVEY_SIGMA = (0.02, 0.03)  # Of a landmark's position [m] and yaw [rad] after a contradiction
_CONTRADICTED_CAMERA_SIGMA = (0.1, 0.05)  # The same of a fixed camera, which may have been pushed

_MIN_SURVEY_SIGMA = 1e-4  # Minimum of an estimated landmark [m, rad], so that its covariance is invertible


class ParameterTable(NamedTuple):
    """Table of estimated parameters of robots and landmarks, for compiled code."""

    column: IntArray  # (N, PARAMETERS) filter column; -1: not estimated, value 0
    sigma: FloatArray  # (N, PARAMETERS) prior standard deviation; 0: never estimated
    time_s: FloatArray  # (N, PARAMETERS) time constants of parameters that vary; infinite for constant ones
    # (L,) first of the three filter columns of each landmark; -1: not estimated
    survey_column: IntArray
    survey: FloatArray  # (L, 3, 3) prior covariance of its error
    shared: FloatArray  # (L, 3, 4) its error by one standard deviation of each error that all share
    reopened: FloatArray  # (L, 3, 3) covariance that is added after a contradiction
    drives: BoolArray  # (N,) whether the robot has odometry
    first_anchor: int  # Index of the first anchor among what was surveyed
    first_camera: int  # Index of the first fixed camera, after all anchors
    in_blocks: bool  # True if a robot's parameters have blocks of three columns, some of them unused

    @classmethod
    def of(
        cls,
        robots: Sequence[Robot],
        landmarks: Sequence[Surveyed] = (),
        map_error: MapError = NO_MAP_ERROR,
        *,
        in_blocks: bool = False,
    ) -> ParameterTable:
        """Table of the parameters that the descriptions of robots and landmarks estimate from the start."""
        sigma, time_s = np.zeros((len(robots), PARAMETERS)), np.zeros((len(robots), PARAMETERS))
        for i, robot in enumerate(robots):
            turns = robot.turn_sensor
            time_s[i, TURN_BIAS] = turns.turn_bias_time_s
            sigma[i, TURN_BIAS] = turns.turn_bias_sigma
            sigma[i, DISTANCE_SCALE] = robot.odometry.distance_scale_sigma
            sigma[i, TURN_SCALE] = turns.turn_scale_sigma
            if robot.camera is not None:
                sigma[i, CAMERA_YAW] = robot.camera.yaw_sigma
                sigma[i, CAMERA_SCALE] = robot.sensor.distance_scale_sigma
                sigma[i, CAMERA_OFFSET] = robot.sensor.range_offset_sigma
                time_s[i, CAMERA_YAW] = robot.camera.yaw_time_s
            if robot.uwb is not None:
                sigma[i, RADIO_BIAS] = robot.uwb.range_bias_sigma
                # what wheels say wrong is never contradicted by ranges, which bend the path instead
                path = robot.odometry.distance_scale_sigma or _CONTRADICTED_SIGMA[DISTANCE_SCALE]
                sigma[i, DISTANCE_SCALE] = 0.0 if robot.stands else path
        wanted = sigma > 0.0
        doubted = np.where(wanted, sigma, _CONTRADICTED_SIGMA)
        doubted[[robot.camera is None for robot in robots], DRIVES:RADIO_BIAS] = 0.0
        times = np.where(time_s > 0.0, time_s, np.inf)
        surveys = np.array([_survey(mark) for mark in landmarks]).reshape(-1, 3, 3)
        shared = np.array([_shared(mark, map_error) for mark in landmarks]).reshape(-1, 3, 4)
        drives = np.array([not robot.stands for robot in robots], dtype=bool)
        first_camera = sum(not isinstance(mark, FixedCamera) for mark in landmarks)
        first_anchor = first_camera - sum(isinstance(mark, Anchor) for mark in landmarks)
        reopened = [
            _error(mark, _CONTRADICTED_CAMERA_SIGMA) if isinstance(mark, FixedCamera) else _survey(mark)
            for mark in landmarks
        ]
        column, survey_column = np.full(sigma.shape, -1), np.full(len(landmarks), -1)
        table = cls(
            column,
            doubted,
            times,
            survey_column,
            surveys + shared @ shared.transpose(0, 2, 1),
            shared,
            np.array(reopened).reshape(-1, 3, 3),
            drives,
            first_anchor,
            first_camera,
            in_blocks,
        ).with_parameters(wanted)
        surveyed = np.array([mark.is_estimated for mark in landmarks], dtype=bool)
        survey_column[surveyed] = table.filter_size + 3 * np.arange(surveyed.sum())
        return table

    @property
    def filter_size(self) -> int:
        """Number of filter columns: three per pose, one per parameter and three per landmark."""
        parameters, landmarks = self.column.max(initial=-1) + 1, self.survey_column.max(initial=-3) + 3
        if self.in_blocks:
            parameters = -(-parameters // DRIVES) * DRIVES
        return int(max(3 * self.column.shape[0], parameters, landmarks))

    def with_robot(self, robot: int) -> ParameterTable:
        """Table in which all parameters of a robot with a standard deviation are estimated."""
        new = np.zeros(self.column.shape, dtype=bool)
        new[robot] = (self.column[robot] < 0) & (self.sigma[robot] > 0.0)
        return self.with_parameters(new)

    def with_parameters(self, new: BoolArray) -> ParameterTable:
        """Table in which more parameters (N, PARAMETERS) are estimated."""
        column = self.column.copy()
        if not self.in_blocks:
            column[new] = self.filter_size + np.arange(new.sum())
            return self._replace(column=column)
        first = self.block_columns
        begun = np.stack([new[:, k == _BLOCK].any(axis=1) for k in range(BLOCKS)], axis=1) & (first < 0)
        first[begun] = self.filter_size + DRIVES * np.arange(begun.sum())
        column[new] = (first[:, _BLOCK] + _SLOT)[new]
        return self._replace(column=column)

    @property
    def block_columns(self) -> IntArray:
        """First columns (N, BLOCKS) of the robots' blocks of parameters; -1: none."""
        first = np.where(self.column >= 0, self.column - _SLOT, -1)
        return np.stack([first[:, block == _BLOCK].max(axis=1) for block in range(BLOCKS)], axis=1)

    def with_landmark(self, landmark: int) -> ParameterTable:
        """Table in which a landmark is estimated."""
        survey_column = self.survey_column.copy()
        if survey_column[landmark] < 0:
            survey_column[landmark] = self.filter_size
        return self._replace(survey_column=survey_column)


def _survey(mark: Surveyed) -> FloatArray:
    """Prior covariance (3, 3) of the error of what was surveyed."""
    third = mark.range_bias_sigma if isinstance(mark, Anchor) else mark.yaw_sigma
    given = mark.position_sigma, third
    return _error(mark, given if mark.is_estimated else CONTRADICTED_SURVEY_SIGMA)


def _shared(mark: Surveyed, error: MapError) -> FloatArray:
    """Errors (3, 4) of a place by one standard deviation of the shared x, y, turn and scale."""
    if not mark.position_sigma > 0.0:
        return np.zeros((3, 4))
    sigma = (error.position_sigma, error.position_sigma, error.yaw_sigma, error.scale_sigma)
    away = mark.x - error.x, mark.y - error.y
    # of a place, the displacement; of a pose, the common motion of the whole map
    turned = (-away[1], away[0], 0.0) if isinstance(mark, Anchor) else (error.y, -error.x, 1.0)
    return np.column_stack([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), turned, (*away, 0.0)]) * sigma


def shared_error(place: FloatArray, covariance: FloatArray) -> tuple[MapError, FloatArray, FloatArray]:
    """What places share of their errors: scale, turn and shift of the similarity that fits these best.

    `place` (k, 2) are at least two places that differ [m], `covariance` (n, n) that of their right-invariant
    errors (3 k), and of any other errors. Returns the shared error, errors (k, 3, 4) of x, y, yaw of places
    by one standard deviation of it, the first ones by the scale, and other errors (n - 3 k, 4).
    """
    # scale, turn and shift of the fit, by errors of the places
    count, centre = len(place), place.mean(axis=0)
    away, turned = place - centre, (place - centre) @ [[0.0, 1.0], [-1.0, 0.0]]
    moves = np.tile(np.eye(3), (count, 1, 1))  # poses by errors
    moves[:, 0, 2], moves[:, 1, 2] = -place[:, 1], place[:, 0]
    square = float((away**2).sum())
    shifts = np.broadcast_to(np.eye(2)[:, None] / count, (2, count, 2))
    by_place = np.array([away / square, turned / square, *shifts])
    fit = np.zeros((4, len(covariance)))
    fit[:, : 3 * count] = np.einsum("fki,kij->fkj", by_place, moves[:, :2]).reshape(4, -1)
    # what all errors are expected to be, and the point about which turn and scale leave the least shift
    change = covariance @ fit.T
    spread = fit @ change
    whole = spread[0, 0] + spread[1, 1]
    off = np.array([spread[0, 2] + spread[1, 3], spread[0, 3] - spread[1, 2]]) / whole
    x, y = (centre - off).tolist()
    shift = 0.5 * max(float(spread[2, 2] + spread[3, 3] - whole * off @ off), 0.0)
    error = MapError(x, y, math.sqrt(shift), math.sqrt(spread[1, 1]), math.sqrt(spread[0, 0]))
    change = np.linalg.solve(np.linalg.cholesky(spread), change.T).T
    return error, moves @ change[: 3 * count].reshape(count, 3, 4), change[3 * count :]


_LEAST_VARIANCE = 1e-8  # Of a place beyond the error that it shares, which may be all of it [m^2, rad^2]


def moved_place(body: Surveyed, correction: FloatArray) -> FloatArray:
    """Where a body is (3,) with the shift (3,) of an anchor, or the pose correction (3,) of others.

    That is x, y and yaw, of an anchor the bias in place of the yaw.
    """
    if isinstance(body, Anchor):
        return np.add(correction, (body.x, body.y, body.range_bias), dtype=float)
    return compose(correction, [body.x, body.y, body.yaw or 0.0])


def found_at(body: Surveyed, place: FloatArray, covariance: FloatArray, shared: FloatArray) -> Any:
    """A body where it was found; what was exact of an anchor stays so.

    Args:
        body: As it is described.
        place: (3,) as by `moved_place`.
        covariance: (3, 3) of the place.
        shared: (3, 4) its errors by one standard deviation of what all places share.
    """
    variance = np.maximum(np.diag(covariance) - np.sum(shared**2, axis=1), _LEAST_VARIANCE)
    (x, y, third), sigma = place.tolist(), math.sqrt(0.5 * float(variance[0] + variance[1]))
    where: dict[str, Any] = {"x": x, "y": y, "position_sigma": sigma}
    if isinstance(body, Anchor):
        bias = {"range_bias": third, "range_bias_sigma": math.sqrt(variance[2])}
        where = where if body.position_sigma > 0.0 else {}
        return replace(body, **where, **(bias if body.range_bias_sigma > 0.0 else {}))
    turned = {} if body.yaw is None else {"yaw": third, "yaw_sigma": math.sqrt(variance[2])}
    return replace(body, **where, **turned)


def _error(mark: Surveyed, sigma: tuple[float, float]) -> FloatArray:
    """Covariance (3, 3) of the error with standard deviations of position [m], and yaw [rad] or bias [m]."""
    position, third = np.maximum(sigma, _MIN_SURVEY_SIGMA).tolist()
    own = np.diag([position**2, position**2, third**2])
    return own if isinstance(mark, Anchor) else error_covariance([mark.x, mark.y, mark.yaw or 0.0], own)
