"""Prediction of one robot along its odometry track.

A robot's pose is X = T O with the track O. Between two instants, process noise is added to T, and T drifts
with the parameters z of the robot's motion (`swarm/calibration_states.py`):

    T <- T exp((D2 - D1) z) = exp(A z) T,    P <- F P F^T + Ad(T) (G2 - G1) Ad(T)^T,    A = Ad(T) (D2 - D1).

The right-invariant error does not depend on z, only on the error of z: xi <- xi + Ad(exp(A z / 2)) A dz,
which is F. So a common motion of all robots and landmarks stays unobservable. The bias of the turn rate is a
first-order Gauss-Markov process: it decays, and between the two instants its mean over this interval is
used. So may be the yaw of a camera, which does not act on the motion.

The noise of wheels is the less known the longer nothing has measured a robot. So the reported covariance has
more of it than the filter: in all Q (1 + g t), where t is the time since the robot was measured. Poses and
gates do not depend on it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common import numerics
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.filter.state import BeliefArrays, covariance_within, own_column, own_covariance
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.swarm.calibration_states import CAMERA_YAW, DRIVES, TURN_BIAS

GROWTH = 0.1  # g [1/s], tuned on MRCLAM sets 2, 3, 6 and 7; 0.5 hides errors


class _Drift(NamedTuple):
    """Drift of a robot's pose by its parameters, from the instant of the belief to another one."""

    twist: FloatArray  # (3,) T changes to exp(twist) T
    drive: FloatArray  # (3, DRIVES) Jacobian of the final pose error by the initial errors of the parameters
    left: float  # Remaining share of the turn bias
    gained: float  # Process noise variance of the mean turn bias, in squared units of its column of `drive`
    shared: float  # Process noise covariance of the mean and the final turn bias, in those units


@cached_njit
def new_scratch() -> FloatArray:
    """Allocate buffers (3, 3, 3) for `predict`, to be reused."""
    return np.empty((3, 3, 3))


@inlined_njit
def predict(belief: BeliefArrays, robot: int, to: Preintegrated, scratch: FloatArray) -> None:
    """Predict a robot, in place, to an instant; `scratch` is from `new_scratch`."""
    if not _new_noise(belief, robot, to.covariance, scratch):
        return
    if _has_drives(belief, robot):
        _drive(belief, robot, to)
    if belief.table.column[robot, CAMERA_YAW] >= 0 and math.isfinite(belief.table.time_s[robot, CAMERA_YAW]):
        _sway(belief, robot, to.stamp_ns)
    whole, own, first = belief.covariance, belief.marginal, 3 * robot
    for i in range(3):
        for j in range(3):
            if belief.is_dense:
                whole[first + i, first + j] += scratch[0, i, j]
            else:
                own[robot, i, j] += scratch[0, i, j]
    numerics.add_scaled(belief.sources.excess[robot], scratch[0], _growth(belief, robot, to.stamp_ns))
    numerics.assign_matrix(belief.preintegrated_covariance[robot], to.covariance)
    numerics.assign_matrix(belief.preintegrated_jacobian[robot], to.jacobian)
    belief.predicted_to_ns[robot] = max(to.stamp_ns, belief.predicted_to_ns[robot])


@inlined_njit
def write_predicted(
    belief: BeliefArrays,
    robot: int,
    to: Preintegrated,
    scratch: FloatArray,
    transform: FloatArray,
    covariance: FloatArray,
) -> None:
    """Write the predicted T (3,) and the reported covariance (3, 3) of its error; keep the belief."""
    numerics.assign(transform, belief.transform[robot])
    for i in range(3):
        for j in range(3):
            covariance[i, j] = covariance_within(belief, 3 * robot, i, j)
    if _new_noise(belief, robot, to.covariance, scratch):
        if _has_drives(belief, robot):
            _write_drifted(belief, robot, to, transform, covariance)
        numerics.add_scaled(covariance, scratch[0], 1.0 + _growth(belief, robot, to.stamp_ns))
    numerics.add_scaled(covariance, belief.sources.excess[robot], 1.0)


@inlined_njit
def _growth(belief: BeliefArrays, robot: int, stamp_ns: int) -> float:
    """Mean of g t over a prediction to an instant."""
    begin_ns, last_ns = belief.predicted_to_ns[robot], belief.sources.measured_ns[robot]
    middle_s = (0.5 * (begin_ns - last_ns) + 0.5 * (stamp_ns - last_ns)) * 1e-9
    growth: float = GROWTH * max(0.0, middle_s)
    return growth if belief.table.drives[robot] else 0.0


@cached_njit
def _write_drifted(
    belief: BeliefArrays, robot: int, to: Preintegrated, transform: FloatArray, covariance: FloatArray
) -> None:
    """Apply the drift to T (3,), and write the covariance (3, 3) of its error."""
    drift = _new_drift(belief, robot, to)
    _move(drift.twist, transform)
    _write_block(belief, robot, drift, covariance)


@inlined_njit
def _new_noise(belief: BeliefArrays, robot: int, noise: FloatArray, scratch: FloatArray) -> bool:
    """Write Ad(T) (G2 - G1) Ad(T)^T to `scratch[0]`, and return whether it is positive semidefinite.

    It is not if odometry from beyond the horizon arrives after a larger dropout noise was assumed.
    """
    before, difference, work = belief.preintegrated_covariance[robot], scratch[1], scratch[2]
    rounding = 1e-12
    for i in range(3):
        rounding += 1e-9 * abs(noise[i, i] - before[i, i])
    for i in range(3):
        for j in range(3):
            difference[i, j] = noise[i, j] - before[i, j]
            work[i, j] = difference[i, j] + (rounding if i == j else 0.0)
    first, _, second, _, _, third = numerics.factor_numbers(work)
    if not math.isfinite(first + second + third):
        return False
    numerics.carry(belief.transform[robot], difference, scratch[0])
    return True


@inlined_njit
def _has_drives(belief: BeliefArrays, robot: int) -> bool:
    """Whether any parameter of the robot's motion is estimated."""
    estimated = False
    for m in range(DRIVES):
        estimated = estimated or belief.table.column[robot, m] >= 0
    return estimated


@cached_njit
def _new_drift(belief: BeliefArrays, robot: int, to: Preintegrated) -> _Drift:
    """Compute the drift of the pose until an instant."""
    x = max(0, to.stamp_ns - belief.predicted_to_ns[robot]) * 1e-9 / belief.table.time_s[robot, TURN_BIAS]
    left, variance = math.exp(-x), belief.table.sigma[robot, TURN_BIAS] ** 2
    reach = -math.expm1(-x)  # integral of the decaying bias, in units of its time constant
    # process noise; a series for small x, where the closed form cancels
    spread = 2.0 * x - 3.0 + 4.0 * left - left * left if x > 1e-2 else x**3 * (2.0 / 3.0 - 0.5 * x)
    gained, shared = spread / max(reach, 1e-12) ** 2, (1.0 - left) ** 2 / max(reach, 1e-12)
    out = _Drift(np.zeros(3), np.zeros((3, DRIVES)), left, variance * gained, variance * shared)
    adjoint, before = numerics.adjoint_of(belief.transform[robot]), belief.preintegrated_jacobian[robot]
    for m in range(DRIVES):
        mean = reach / x if m == TURN_BIAS and x > 1e-9 else 1.0
        for i in range(3):
            for a in range(3):
                out.drive[i, m] += adjoint[i][a] * (to.jacobian[a, m] - before[a, m]) * mean
            out.twist[i] += out.drive[i, m] * belief.parameter[robot, m]
    pose, column = np.zeros(3), np.empty(3)
    _move(0.5 * out.twist, pose)
    half = numerics.adjoint_of(pose)
    for m in range(DRIVES):
        for i in range(3):
            column[i] = out.drive[i, m]
        for i in range(3):
            out.drive[i, m] = half[i][0] * column[0] + half[i][1] * column[1] + half[i][2] * column[2]
    return out


@cached_njit
def _write_block(
    belief: BeliefArrays, robot: int, drift: _Drift, out: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Write the covariance (3, 3) of the pose's error after the drift; return source columns and weights."""
    columns, weight, count = np.empty(3 + DRIVES, dtype=np.int64), np.empty((3, 3 + DRIVES)), 0
    for m in range(3 + DRIVES):
        column = own_column(belief, robot, m)
        if column >= 0:
            columns[count] = column
            for i in range(3):
                weight[i, count] = drift.drive[i, m - 3] if m >= 3 else (1.0 if i == m else 0.0)
            count += 1
    p = own_covariance(belief, robot)
    for i in range(3):
        for j in range(i + 1):
            total = drift.gained * drift.drive[i, TURN_BIAS] * drift.drive[j, TURN_BIAS]
            for a in range(count):
                for b in range(count):
                    total += weight[i, a] * p[columns[a], columns[b]] * weight[j, b]
            out[i, j] = out[j, i] = total
    return columns[:count], weight


@cached_njit
def _drive(belief: BeliefArrays, robot: int, to: Preintegrated) -> None:
    """Apply the drift to T, to its covariances with all states and to the turn bias."""
    # Mean: T drifts by the parameters.
    drift = _new_drift(belief, robot, to)
    _move(drift.twist, belief.transform[robot])
    first, p = own_column(belief, robot, 0), own_covariance(belief, robot)
    size = p.shape[0]
    rows, block = np.zeros((3, size)), np.empty((3, 3))
    # Covariances of the pose with all states, F P, and of the pose, F P F^T.
    columns, weight = _write_block(belief, robot, drift, block)
    for i in range(3):
        for a in range(columns.size):
            for j in range(size):
                rows[i, j] += weight[i, a] * p[columns[a], j]
    # The transition, for cross-covariances of a sparse filter.
    for m in range(0 if belief.is_dense else DRIVES):
        if belief.table.column[robot, m] >= 0:
            for i in range(3):
                belief.transition[robot, i, m] += drift.drive[i, m] * belief.transition[robot, 3, m]
    # The turn bias decays, and gains process noise.
    bias = own_column(belief, robot, 3 + TURN_BIAS)
    if bias >= 0:
        if not belief.is_dense:
            belief.transition[robot, 3, TURN_BIAS] *= drift.left
        belief.parameter[robot, TURN_BIAS] *= drift.left
        for j in range(size):
            p[bias, j] *= drift.left
            p[j, bias] *= drift.left
        p[bias, bias] += belief.table.sigma[robot, TURN_BIAS] ** 2 * (1.0 - drift.left**2)
        for i in range(3):
            rows[i, bias] = drift.left * rows[i, bias] + drift.shared * drift.drive[i, TURN_BIAS]
    for i in range(3):
        for j in range(size):
            p[first + i, j] = p[j, first + i] = rows[i, j]
    for i in range(3):
        for j in range(3):
            p[first + i, first + j] = block[i, j]


@cached_njit
def _sway(belief: BeliefArrays, robot: int, stamp_ns: int) -> None:
    """Predict the yaw of a camera that sways (a first-order Gauss-Markov process)."""
    since_s = max(0, stamp_ns - belief.predicted_to_ns[robot]) * 1e-9
    left = math.exp(-since_s / belief.table.time_s[robot, CAMERA_YAW])
    column, p = own_column(belief, robot, 3 + CAMERA_YAW), own_covariance(belief, robot)
    belief.parameter[robot, CAMERA_YAW] *= left
    for j in range(p.shape[0]):
        p[column, j] *= left
        p[j, column] *= left
    p[column, column] += belief.table.sigma[robot, CAMERA_YAW] ** 2 * (1.0 - left**2)
    if not belief.is_dense:
        belief.transition[robot, 3 + CAMERA_YAW // DRIVES, CAMERA_YAW % DRIVES] *= left


@cached_njit
def _move(twist: FloatArray, transform: FloatArray) -> None:
    """Left-multiply a transform (3,) by exp(twist), in place."""
    x, y, theta = numerics.moved_by_twist(
        twist[0], twist[1], twist[2], transform[0], transform[1], transform[2]
    )
    transform[0], transform[1], transform[2] = x, y, theta
