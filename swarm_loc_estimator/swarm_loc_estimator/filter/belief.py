"""The arrays of a `SwarmState` as compiled code reads and writes them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.se2_scalar import composed, moved_by_twist, wrap
from swarm_loc_estimator.swarm.calibration_states import PARAMETERS, ParameterTable

NEVER_NS = np.iinfo(np.int64).min


class IntegrityArrays(NamedTuple):
    """What the newest measurements say of the belief; see `integrity/`.

    A source is what a robot measures: the robot of that index, or landmark l as N + l.

    Attributes:
        source: (N, S) the sources that each robot has measured last; -1: none.
        source_ns: (N, S) when.
        counted_ns: (N, S) when a look of the pair was last counted as evidence.
        outlier: (N, S) whether the last one was an outlier.
        unexplained: (N, S) whether a wrong description could not explain it.
        trending: (N, S) whether the last few had a trend.
        evidence: (N, S) evidence against the pair.
        whitened: (N, S, 2) sum of the whitened innovations since the last look for a trend.
        squares: (N, S) sum of their squares.
        looks: (N, S) their number.
        fault_score: (N + L,) of each robot and landmark.
        confirmations: (N,) sightings that agreed with where the robot was initialized.
        confirmed_ns: (N,) when such a sighting was counted last.
        gated_in_a_row: (N,) times that another source was gated since the last accepted measurement.
        gated_source: (N,) the source that was gated last.
        gated_ns: (N,) when.
        gated_fixes: (N,) absolute fixes that were gated since the last accepted one or the last landmark.
        gated_fix_ns: (N,) when such a fix was counted last.
        noise_inflation: (N,) units by which each robot's measurements scatter more than described, see
            `integrity/noise_inflation.py`.
    """

    source: IntArray
    source_ns: IntArray
    counted_ns: IntArray
    outlier: BoolArray
    unexplained: BoolArray
    trending: BoolArray
    evidence: FloatArray
    whitened: FloatArray
    squares: FloatArray
    looks: IntArray
    fault_score: FloatArray
    confirmations: IntArray
    confirmed_ns: IntArray
    gated_in_a_row: IntArray
    gated_source: IntArray
    gated_ns: IntArray
    gated_fixes: IntArray
    gated_fix_ns: IntArray
    noise_inflation: FloatArray


class BeliefArrays(NamedTuple):
    """The arrays of a `SwarmState`, as compiled code reads and writes them; see there and `JointFilter`."""

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
    """The covariance, to be changed in place, in which `own_columns` are those of a robot."""
    if belief.is_dense:
        return belief.covariance
    own: FloatArray = belief.marginal[robot]
    return own


@inlined_njit
def own_column(belief: BeliefArrays, robot: int, which: int) -> int:
    """A column of `own_covariance`: of the robot's pose, or, from 3 on, of its parameters; -1: has none."""
    column: int = 3 * robot + which if which < 3 else belief.table.column[robot, which - 3]
    if not belief.is_dense and column >= 0:
        column = which
    return column


@inlined_njit
def covariance_within(belief: BeliefArrays, column: int, i: int, j: int) -> float:
    """A number of the covariance (3, 3) of the body whose first column is given."""
    whole, own = belief.covariance, belief.marginal
    within: float = whole[column + i, column + j] if belief.is_dense else own[column // 3, i, j]
    return within


@inlined_njit
def own_within(belief: BeliefArrays, robot: int, i: int, j: int) -> float:
    """A number of the covariance of a robot's pose and parameters, by `own_column`."""
    whole, own = belief.covariance, belief.marginal
    if belief.is_dense:
        within: float = whole[own_column(belief, robot, i), own_column(belief, robot, j)]
        return within
    alone: float = own[robot, i, j]
    return alone


@inlined_njit
def to_map(belief: BeliefArrays, robot: int, pose: FloatArray) -> None:
    """Change a pose (3,) on the robot's track to its pose in `map`, in place."""
    t = belief.transform[robot]
    pose[0], pose[1], theta = composed(t[0], t[1], t[2], pose[0], pose[1], pose[2])
    pose[2] = wrap(theta)


@cached_njit
def correct(belief: BeliefArrays, correction: FloatArray) -> None:
    """Apply a filter's correction (n,) to transforms and parameters of robots located, and to landmarks."""
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
