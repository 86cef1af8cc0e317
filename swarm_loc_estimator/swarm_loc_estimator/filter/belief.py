"""Arrays of a `SwarmState` for compiled code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.se2_scalar import composed, moved_by_twist, wrap
from swarm_loc_estimator.swarm.calibration_states import PARAMETERS, ParameterTable

NEVER_NS = np.iinfo(np.int64).min


class IntegrityArrays(NamedTuple):
    """Statistics of recent innovations for fault detection; see `integrity.py`.

    A source is a measured object: robot i has index i, landmark l has index N + l. Measurements of models
    without a kernel have sources of their own, with indices that are larger by N + L.
    """

    source: IntArray  # (N, S) sources measured most recently by each robot; -1: none
    source_ns: IntArray  # (N, S) stamp of the last measurement of the pair
    counted_ns: IntArray  # (N, S) stamp of the last measurement counted as evidence
    outlier: BoolArray  # (N, S) True if the last measurement was an outlier
    unexplained: BoolArray  # (N, S) True if no parameter error could explain it
    trending: BoolArray  # (N, S) True if the last innovations had a trend
    evidence: FloatArray  # (N, S) evidence against the pair
    whitened: FloatArray  # (N, S, 2) sum of whitened innovations since the last test for a trend
    squares: FloatArray  # (N, S) sum of their squares
    looks: IntArray  # (N, S) number of these innovations
    fault_score: FloatArray  # (N + L,) of each robot and landmark
    confirmations: IntArray  # (N,) number of sightings that agree with the robot's initial pose
    confirmed_ns: IntArray  # (N,) stamp of the last counted confirmation
    gated_in_a_row: IntArray  # (N,) counted gated measurements since the last accepted one; not quick repeats
    gated_source: IntArray  # (N,) source of the last gated measurement
    gated_ns: IntArray  # (N,) stamp of the last gated measurement
    gated_fixes: IntArray  # (N,) absolute fixes gated since the last accepted fix or landmark sighting
    gated_fix_ns: IntArray  # (N,) stamp of the last counted gated fix
    # (N,) level of noise inflation of each robot's measurements, see `filter/integrity.py`
    noise_inflation: FloatArray
    # (N, W) begin of each window in which the drift of odometry is observed, see `filter/prediction.py`
    drift_ns: IntArray
    drift_transform: FloatArray  # (N, W, 3) T at that time
    drift_noise: FloatArray  # (N, W, 3, 3) preintegrated covariance of the track at that time
    drift_covariance: FloatArray  # (N, W, 3, 3) of the error of T at that time
    motion_likelihood: FloatArray  # (N, scales) log-likelihood of each scale of the process noise
    motion_scale: FloatArray  # (N,) scale of the process noise of each robot
    # (N,) True if it stays 1, as scales of the robot's motion are described as estimated
    motion_explained: BoolArray
    # (N, 3, 3) covariance of each robot's error beyond that of the filter, see `filter/correlated_noise.py`
    excess: FloatArray
    # (N, S, 2, 3, 3) covariance of the errors of observer and target with the repeated error of their pair
    repeated: FloatArray
    repeated_at: FloatArray  # (N, S, 2) place of the target, as the observer saw it last [m]


class BeliefArrays(NamedTuple):
    """Views of the arrays of a `SwarmState` and its `JointFilter`, which describe them."""

    transform: FloatArray
    covariance: FloatArray
    marginal: FloatArray
    transition: FloatArray
    parameter: FloatArray
    landmark: FloatArray
    table: ParameterTable
    predicted_to_ns: IntArray
    preintegrated_covariance: FloatArray
    preintegrated_jacobian: FloatArray
    tracked: BoolArray
    last_fix_ns: IntArray
    integrity: IntegrityArrays
    pair_robot: IntArray
    pair_stamp_ns: IntArray
    pair_history: FloatArray
    is_dense: bool


@cached_njit
def own_covariance(belief: BeliefArrays, robot: int) -> FloatArray:
    """Writable covariance matrix that `own_column` indexes: joint, or the robot's marginal."""
    if belief.is_dense:
        return belief.covariance
    own: FloatArray = belief.marginal[robot]
    return own


@inlined_njit
def own_column(belief: BeliefArrays, robot: int, which: int) -> int:
    """Column of `own_covariance`: `which` 0 to 2 for the pose, from 3 on for parameters; -1: none."""
    column: int = 3 * robot + which if which < 3 else belief.table.column[robot, which - 3]
    if not belief.is_dense and column >= 0:
        column = which
    return column


@inlined_njit
def covariance_within(belief: BeliefArrays, column: int, i: int, j: int) -> float:
    """Element (i, j) of the covariance (3, 3) of the body with this first column."""
    whole, own = belief.covariance, belief.marginal
    within: float = whole[column + i, column + j] if belief.is_dense else own[column // 3, i, j]
    return within


@inlined_njit
def own_within(belief: BeliefArrays, robot: int, i: int, j: int) -> float:
    """Element of the covariance of a robot's pose and parameters, indexed as by `own_column`."""
    whole, own = belief.covariance, belief.marginal
    if belief.is_dense:
        within: float = whole[own_column(belief, robot, i), own_column(belief, robot, j)]
        return within
    alone: float = own[robot, i, j]
    return alone


@inlined_njit
def to_map(belief: BeliefArrays, robot: int, pose: FloatArray) -> None:
    """Transform a pose (3,) from the robot's track to `map`, in place."""
    t = belief.transform[robot]
    pose[0], pose[1], theta = composed(t[0], t[1], t[2], pose[0], pose[1], pose[2])
    pose[2] = wrap(theta)


@cached_njit
def correct(belief: BeliefArrays, correction: FloatArray) -> None:
    """Apply a filter's correction (n,) to localized robots, their parameters and landmarks."""
    for i in range(belief.tracked.size):
        if belief.tracked[i]:
            t, c = belief.transform[i], correction[3 * i : 3 * i + 3]
            t[0], t[1], t[2] = moved_by_twist(c[0], c[1], c[2], t[0], t[1], t[2])
            for m in range(PARAMETERS):
                column = belief.table.column[i, m]
                if column >= 0:
                    belief.parameter[i, m] += correction[column]
    for i in range(belief.table.survey_column.size):
        first = belief.table.survey_column[i]
        if first >= 0:
            mark, c = belief.landmark[i], correction[first : first + 3]
            mark[0], mark[1], mark[2] = moved_by_twist(c[0], c[1], c[2], mark[0], mark[1], mark[2])
