"""Innovations: measurements linearized about the belief and gated."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.small_matrix import assign, assign_matrix
from swarm_loc_estimator.filter.belief import BeliefArrays, covariance_within, own_within
from swarm_loc_estimator.filter.correlated_noise import PAIR_ROWS, inflate_fix, use_mean
from swarm_loc_estimator.filter.gating import (
    NO_HEADING,
    POSE_GATE,
    is_misread,
    position_distance,
    soften_heading,
    squared_distance,
)
from swarm_loc_estimator.filter.integrity import (
    add_noise_inflation,
    cause_of,
    noise_of_frequent_looks,
    small_variances,
    stamp_variance,
)
from swarm_loc_estimator.filter.measurement_model import MeasurementColumns, predict_one, write_innovation
from swarm_loc_estimator.odometry.track_arrays import TrackArrays, rate_at
from swarm_loc_estimator.swarm.calibration_states import CAMERA_SCALE, CAMERA_YAW

DEPENDS_ON = 8
"""Filter columns per measurement: three of the observer, three of the target, camera yaw and camera scale."""


class Scratch(NamedTuple):
    """Buffers for one evaluation, reused to avoid allocation."""

    predicted: FloatArray  # (3,) value
    other: FloatArray  # (3,) innovation of the alternative
    value_jacobian: FloatArray  # (3, 5) Jacobian of the value, see `measurement_model.predict`
    relative_covariance: FloatArray  # (3, 3) covariance of xi_target - xi_observer
    innovation_covariance: FloatArray  # (3, 3) covariance of the innovation
    variances: FloatArray  # (3,) of the predicted value


class InnovationBatch(NamedTuple):
    """Measurements (m,) evaluated at one belief."""

    # (m, 2, 3) observers and targets in `map` at the stamps; of a landmark, its pose correction
    pose: FloatArray
    # (m, 3) rate of change of xi_target - xi_observer by driving [1/s], see `relative_motion`
    motion: FloatArray
    # (m, 3, 5) of the observer's error with the target's, and of the target's with yaw and scale of the
    # observer's camera
    cross_covariance: FloatArray
    columns: IntArray  # (m, DEPENDS_ON) filter columns
    jacobian: FloatArray  # (m, 3, DEPENDS_ON) Jacobian of the innovation
    innovation: FloatArray  # (m, 3) measured minus predicted
    noise: FloatArray  # (m, 3, 3) measurement covariances for the update
    pair: FloatArray  # (m, PAIR_ROWS, 3) new mean of the pair, stored if used, see `correlated_noise`
    distance: FloatArray  # (m,) squared Mahalanobis distance of the position, small errors left out
    whitened: FloatArray  # (m, 2) position innovation over its standard deviation, without small errors
    cause: IntArray  # (m,) possible cause of the innovation, see `integrity.cause_of`
    accepted: BoolArray  # (m,) True if the innovation passes the gate
    nis: FloatArray  # (m,) normalized innovation squared


@cached_njit
def new_batch(count: int) -> InnovationBatch:
    """Allocate a batch of `count` measurements."""
    return InnovationBatch(
        np.zeros((count, 2, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 3, 5)),
        np.zeros((count, DEPENDS_ON), dtype=np.int64),
        np.zeros((count, 3, DEPENDS_ON)),
        np.zeros((count, 3)),
        np.zeros((count, 3, 3)),
        np.zeros((count, PAIR_ROWS, 3)),
        np.zeros(count),
        np.zeros((count, 2)),
        np.zeros(count, dtype=np.int64),
        np.zeros(count, dtype=np.bool_),
        np.zeros(count),
    )


@cached_njit
def new_scratch() -> Scratch:
    """Allocate buffers for `evaluate`."""
    return Scratch(
        np.zeros(3), np.zeros(3), np.zeros((3, 5)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    )


@inlined_njit
def evaluate(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    batch: InnovationBatch,
    row: int,
    scratch: Scratch,
) -> None:
    """Linearize measurement k about the belief and gate it; of two planar solutions, use the likelier one.

    Args:
        measurements: (m,).
        k: Index of the measurement.
        belief: Not changed.
        batch: Input: `pose`, `motion` and, for a sparse filter, `cross_covariance`. Output: all other
            fields.
        row: Row of the batch.
        scratch: Buffers.
    """
    columns, jacobian, innovation = batch.columns[row], batch.jacobian[row], batch.innovation[row]
    pose, motion, noise = batch.pose[row], batch.motion[row], batch.noise[row]
    bodies = body_columns(measurements, k, belief)
    camera, camera_columns = _camera(belief, measurements.observer[k])
    predicted, value_jacobian, s, variances = (
        scratch.predicted,
        scratch.value_jacobian,
        scratch.innovation_covariance,
        scratch.variances,
    )
    predict_one(measurements, k, pose[0], pose[1], camera, predicted, value_jacobian)
    _write_jacobian(value_jacobian, bodies, camera_columns, columns, jacobian)
    assign_matrix(noise, measurements.covariance[k])
    add_noise_inflation(measurements, k, belief, noise)
    of_stamp = stamp_variance(measurements, k, belief)
    if of_stamp > 0.0:
        _add_stamp_noise(value_jacobian, motion, of_stamp, noise)
    assign_matrix(s, noise)
    if belief.is_dense:
        _read_cross_covariance(belief.covariance, bodies, camera_columns, batch.cross_covariance[row])
    _add_uncertainty(
        belief,
        bodies,
        camera_columns,
        value_jacobian,
        batch.cross_covariance[row],
        scratch.relative_covariance,
        s,
    )
    for i in range(3):
        variances[i] = s[i, i] - noise[i, i]
    write_innovation(measurements, k, measurements.value[k], predicted, innovation)
    if measurements.has_alternative[k]:
        other = scratch.other
        write_innovation(measurements, k, measurements.alternative[k], predicted, other)
        if squared_distance(other, s) < squared_distance(innovation, s):
            assign(innovation, other)
    batch.accepted[row] = position_distance(innovation, s) <= measurements.gate[k]
    small = small_variances(measurements.kind[k], predicted)
    batch.distance[row] = position_distance(innovation, s, small)
    for i in range(2):
        batch.whitened[row, i] = innovation[i] / math.sqrt(s[i, i] + small[i])
    batch.cause[row] = cause_of(measurements.kind[k], innovation, predicted)
    if measurements.observer[k] < 0 and measurements.systematic_share[k, 0] > 0.0:
        batch.nis[row] = squared_distance(innovation, s)
        batch.accepted[row] = batch.nis[row] <= POSE_GATE
        for i in range(3):
            for j in range(3):
                s[i, j] -= noise[i, j]
        inflate_fix(measurements.systematic_share[k], s, noise)
        return
    if measurements.has_heading[k]:
        before = (noise[0, 2], noise[1, 2], noise[2, 2])
        if measurements.observer[k] < 0 and is_misread(innovation[2], s[2, 2], measurements.gate[k]):
            noise[0, 2] = noise[1, 2] = noise[2, 0] = noise[2, 1] = 0.0
            noise[2, 2] = NO_HEADING
        else:
            soften_heading(innovation, s, noise)
        for i in range(3):
            s[i, 2] += noise[i, 2] - before[i]
            if i < 2:
                s[2, i] = s[i, 2]
    batch.nis[row] = squared_distance(innovation, s)
    scale = noise_of_frequent_looks(measurements, k, belief)
    for i in range(3):
        for j in range(3):
            noise[i, j] *= scale
    use_mean(measurements, k, belief, pose, predicted, variances, innovation, noise, batch.pair[row])


@inlined_njit
def relative_motion(
    measurements: MeasurementColumns,
    k: int,
    tracks: TrackArrays,
    belief: BeliefArrays,
    pose: FloatArray,
    motion: FloatArray,
) -> None:
    """Write the rate of change of xi_target - xi_observer (3,) of measurement k by driving [1/s].

    Zero for an exact stamp, where the rate is not needed.

    Args:
        measurements: (m,).
        k: Index of the measurement.
        tracks: Odometry.
        belief: Not changed.
        pose: (2, 3) of observer and target in `map`.
        motion: Written.
    """
    motion.fill(0.0)
    if stamp_variance(measurements, k, belief) == 0.0:
        return
    sides = (measurements.observer[k], measurements.target[k])
    for i in range(2):
        if sides[i] >= 0:
            rate = rate_at(tracks, sides[i], measurements.stamp_ns[k])
            cos, sin, sign = np.cos(pose[i, 2]), np.sin(pose[i, 2]), 2.0 * i - 1.0
            # the body's own velocity, seen from the origin of map
            motion[0] += sign * (cos * rate[0] - sin * rate[1] + rate[2] * pose[i, 1])
            motion[1] += sign * (sin * rate[0] + cos * rate[1] - rate[2] * pose[i, 0])
            motion[2] += sign * rate[2]


@inlined_njit
def _camera(belief: BeliefArrays, observer: int) -> tuple[tuple[float, float], tuple[int, int]]:
    """Yaw and scale of an observer's camera, and their filter columns; -1: not estimated."""
    if observer < 0:
        return (0.0, 0.0), (-1, -1)
    parameter, column = belief.parameter, belief.table.column
    return (
        (parameter[observer, CAMERA_YAW], parameter[observer, CAMERA_SCALE]),
        (column[observer, CAMERA_YAW], column[observer, CAMERA_SCALE]),
    )


@inlined_njit
def _write_jacobian(
    value_jacobian: FloatArray,
    bodies: tuple[int, int],
    camera_columns: tuple[int, int],
    columns: IntArray,
    jacobian: FloatArray,
) -> None:
    """Write the Jacobian of an innovation (3, DEPENDS_ON) and its filter columns (DEPENDS_ON,).

    Missing columns are arbitrary: their Jacobian is zero.
    """
    for j in range(3):
        columns[j], columns[3 + j] = max(bodies[0], 0) + j, max(bodies[1], 0) + j
        for i in range(3):
            jacobian[i, j] = -value_jacobian[i, j] if bodies[0] >= 0 else 0.0
            jacobian[i, 3 + j] = value_jacobian[i, j] if bodies[1] >= 0 else 0.0
    for j in range(2):
        columns[6 + j] = max(camera_columns[j], 0)
        for i in range(3):
            jacobian[i, 6 + j] = value_jacobian[i, 3 + j] if camera_columns[j] >= 0 else 0.0


@inlined_njit
def _add_stamp_noise(
    value_jacobian: FloatArray, motion: FloatArray, variance: float, noise: FloatArray
) -> None:
    """Add the covariance due to the stamp's variance [s^2] at the rate `motion` (3,) to `noise` (3, 3)."""
    change = (
        _along(value_jacobian, 0, motion),
        _along(value_jacobian, 1, motion),
        _along(value_jacobian, 2, motion),
    )
    for i in range(3):
        for j in range(3):
            noise[i, j] += variance * change[i] * change[j]


@inlined_njit
def _along(value_jacobian: FloatArray, row: int, motion: FloatArray) -> float:
    """Rate of change of one component of the value."""
    speed: float = (
        value_jacobian[row, 0] * motion[0]
        + value_jacobian[row, 1] * motion[1]
        + value_jacobian[row, 2] * motion[2]
    )
    return speed


@inlined_njit
def body_columns(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> tuple[int, int]:
    """First filter columns of the observer and the target of measurement k; -1: none."""
    observer, target = measurements.observer[k], measurements.target[k]
    first = 3 * target if target >= 0 else -1
    if measurements.landmark[k] > 0:
        first = belief.table.survey_column[measurements.landmark[k] - 1]
    return (3 * observer if observer >= 0 else -1), first


@inlined_njit
def _read_cross_covariance(
    p: FloatArray, bodies: tuple[int, int], camera: tuple[int, int], out: FloatArray
) -> None:
    """Write `cross_covariance` (3, 5) of one measurement; undefined if a side is missing."""
    o, t = max(bodies[0], 0), max(bodies[1], 0)
    for i in range(3):
        for j in range(3):
            out[i, j] = p[o + i, t + j]
        for k in range(2):
            out[i, 3 + k] = p[t + i, max(camera[k], 0)]


@inlined_njit
def _add_uncertainty(
    belief: BeliefArrays,
    bodies: tuple[int, int],
    camera: tuple[int, int],
    value_jacobian: FloatArray,
    cross_covariance: FloatArray,
    relative: FloatArray,
    s: FloatArray,
) -> None:
    """Add H P H^T (3, 3), eq. (13) of the e-puck paper, where H is `value_jacobian`.

    The covariance of xi_target - xi_observer is computed first, which saves two thirds of the work.

    Args:
        belief: Not changed.
        bodies: First columns of the observer and of the target; -1: none.
        camera: Columns of the camera's parameters; -1: none.
        value_jacobian: (3, 5).
        cross_covariance: (3, 5) of the observer, the target and the camera, see `InnovationBatch`.
        relative: (3, 3) buffer.
        s: (3, 3) sum to add to.
    """
    o, t = max(bodies[0], 0), max(bodies[1], 0)
    of_observer, of_target = 1.0 if bodies[0] >= 0 else 0.0, 1.0 if bodies[1] >= 0 else 0.0
    for i in range(3):
        for j in range(3):
            both = of_target * of_observer * (cross_covariance[j, i] + cross_covariance[i, j])
            of_t, of_o = covariance_within(belief, t, i, j), covariance_within(belief, o, i, j)
            relative[i, j] = of_target * of_t + of_observer * of_o - both
    for i in range(3):
        x, y, z = _turned(value_jacobian, i, relative)
        for j in range(3):
            s[i, j] = s[i, j] + x * value_jacobian[j, 0] + y * value_jacobian[j, 1] + z * value_jacobian[j, 2]
    for k in range(2):
        if camera[k] >= 0:
            for a in range(3):
                own = own_within(belief, o // 3, a, 3 + CAMERA_YAW + k)
                relative[a, 0] = of_target * cross_covariance[a, 3 + k] - of_observer * own
            for i in range(3):
                beside = value_jacobian[i, 0] * relative[0, 0] + value_jacobian[i, 1] * relative[1, 0]
                beside += value_jacobian[i, 2] * relative[2, 0]
                for other in range(2):  # its own variance, and its covariance with the other parameter
                    if camera[other] >= 0:
                        both = own_within(belief, o // 3, 3 + CAMERA_YAW + other, 3 + CAMERA_YAW + k)
                        beside += 0.5 * value_jacobian[i, 3 + other] * both
                for j in range(3):
                    s[i, j] += beside * value_jacobian[j, 3 + k]
                    s[j, i] += beside * value_jacobian[j, 3 + k]


@inlined_njit
def _turned(value_jacobian: FloatArray, row: int, matrix: FloatArray) -> tuple[float, float, float]:
    """The product of the first three columns of a row of `value_jacobian` and a matrix (3, 3)."""
    a, b, c = value_jacobian[row, 0], value_jacobian[row, 1], value_jacobian[row, 2]
    return (
        a * matrix[0, 0] + b * matrix[1, 0] + c * matrix[2, 0],
        a * matrix[0, 1] + b * matrix[1, 1] + c * matrix[2, 1],
        a * matrix[0, 2] + b * matrix[1, 2] + c * matrix[2, 2],
    )
