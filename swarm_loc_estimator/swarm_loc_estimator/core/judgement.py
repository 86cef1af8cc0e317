"""The compiled inner loop of the filter: predict two robots, judge one measurement, correct all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.compiled import assign, assign_matrix, compiled, composed, moved_by_twist, wrap
from swarm_loc_estimator.core.dense_filter import IndexArray, update_one
from swarm_loc_estimator.core.gate import position_distance, soften_heading, squared_distance
from swarm_loc_estimator.core.measurements import SEAT, MeasurementColumns, innovation, predict_one
from swarm_loc_estimator.core.motion import TrackArrays, look_up, rate_at
from swarm_loc_estimator.core.parameters import CAMERA_SCALE, CAMERA_YAW, PARAMETERS
from swarm_loc_estimator.core.prediction import advance
from swarm_loc_estimator.core.repetition import remember, widen
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.state import BeliefArrays
from swarm_loc_estimator.core.uncertainty import add_uncertainty

DEPENDS_ON = 8
"""Filter columns that a measurement depends on: both bodies, observer first, yaw and scale of the camera."""

OPEN, USED, GATED = 0, 1, 2
"""Verdicts that the inner loop gives, see `fusion.Verdict`."""

FINISHED, UNTIED, LOST = 0, 1, 2
"""Why `fuse_in_order` came back: all done, a measurement not between robots located, a robot given up."""


@compiled
def fuse_in_order(
    measurements: MeasurementColumns,
    begin: int,
    tracks: TrackArrays,
    belief: BeliefArrays,
    limits: tuple[float, float, int],
    verdicts: NDArray[np.uint8],
    nis: FloatArray,
) -> tuple[int, int, int]:
    """Fuse measurements one after the other, each at its exact stamp, linearised at the newest belief.

    Args:
        measurements: (m,) in order of their stamps.
        begin: The first one to fuse.
        tracks: Odometry.
        belief: Changed in place.
        limits: Largest standard deviation of a position [m] and heading [rad], and gated measurements in a
            row, with which a robot still counts as located.
        verdicts: (m,) written.
        nis: (m,) normalised innovations squared, written.

    Returns:
        The first measurement not dealt with, why (FINISHED, UNTIED, LOST), and the robot that was lost.
    """
    pose, gathered, raw = np.empty((2, 3)), np.empty((2, 3, 3)), np.empty(3)
    columns, jacobian = np.empty(DEPENDS_ON, dtype=np.int64), np.empty((3, DEPENDS_ON))
    difference, r, predicted, motion = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    for k in range(begin, measurements.stamp_ns.size):
        sides = (measurements.observer[k], measurements.target[k])
        for side in sides:
            if measurements.kind[k] >= SEAT or (side >= 0 and not belief.tracked[side]):
                return k, UNTIED, -1
        for i in range(2):
            if sides[i] >= 0:
                look_up(tracks, sides[i], measurements.stamp_ns[k], pose[i], raw, gathered)
                advance(belief, sides[i], gathered, measurements.stamp_ns[k])
                to_map(belief, sides[i], pose[i])
                if is_unsure(belief, sides[i], pose[i], limits[0], limits[1]):
                    return k, LOST, sides[i]
        if measurements.landmark[k] > 0:
            assign(pose[1], belief.landmark[measurements.landmark[k] - 1])
        relative_motion(measurements, k, tracks, pose, motion)
        passed, nis[k] = judge(
            measurements, k, belief, pose, motion, columns, jacobian, difference, r, predicted
        )
        verdicts[k] = USED if passed else GATED
        if passed:
            remember(measurements, k, belief, predicted, r)
            correct(belief, update_one(belief.covariance, columns, jacobian, difference, r))
        lost = count(measurements, k, belief, passed, limits[2])
        if lost >= 0:
            return k + 1, LOST, lost
    return measurements.stamp_ns.size, FINISHED, -1


@compiled
def advance_all(
    measurements: MeasurementColumns,
    tracks: TrackArrays,
    belief: BeliefArrays,
    limits: tuple[float, float, int],
    pose: FloatArray,
    motion: FloatArray,
    unsure: NDArray[np.bool_],
) -> None:
    """Predict every robot involved to the mean of its measurements.

    Args:
        measurements: (m,) between robots that are located.
        tracks: Odometry.
        belief: Changed in place.
        limits: See `fuse_in_order`.
        pose: (m, 2, 3) written: observers and targets in `map` at the stamps, or by what a landmark is moved;
            nobody's is not written.
        motion: (m, 3) written, see `relative_motion`.
        unsure: (N,) written: robots involved that no longer know where they are.
    """
    robots = belief.tracked.size
    gathered, times, stamps = np.zeros((robots, 2, 3, 3)), np.zeros(robots), np.zeros(robots)
    raw, one = np.empty(3), np.empty((2, 3, 3))
    for k in range(measurements.stamp_ns.size):
        sides = (measurements.observer[k], measurements.target[k])
        for i in range(2):
            robot = sides[i]
            if robot >= 0:
                look_up(tracks, robot, measurements.stamp_ns[k], pose[k, i], raw, one)
                times[robot] += 1.0
                stamps[robot] += measurements.stamp_ns[k] - measurements.stamp_ns[0]
                add_scaled(gathered[robot], one, 1.0)
    for robot in range(robots):
        if times[robot] > 0.0:
            one.fill(0.0)
            add_scaled(one, gathered[robot], 1.0 / times[robot])
            advance(belief, robot, one, measurements.stamp_ns[0] + round(stamps[robot] / times[robot]))
    for k in range(measurements.stamp_ns.size):
        sides = (measurements.observer[k], measurements.target[k])
        for i in range(2):
            robot = sides[i]
            if robot >= 0:
                to_map(belief, robot, pose[k, i])
                unsure[robot] |= is_unsure(belief, robot, pose[k, i], limits[0], limits[1])
        if measurements.landmark[k] > 0:
            assign(pose[k, 1], belief.landmark[measurements.landmark[k] - 1])
        relative_motion(measurements, k, tracks, pose[k], motion[k])


@compiled
def relative_motion(
    measurements: MeasurementColumns, k: int, tracks: TrackArrays, pose: FloatArray, motion: FloatArray
) -> None:
    """Write how fast xi_target - xi_observer (3,) of measurement k changes by both robots' driving [1/s].

    Zero where the stamp is exact, and it does not matter.

    Args:
        measurements: (m,).
        k: Which one.
        tracks: Odometry.
        pose: (2, 3) of observer and target in `map`.
        motion: Written.
    """
    motion.fill(0.0)
    if measurements.stamp_variance[k] == 0.0:
        return
    rate, sides = np.empty(3), (measurements.observer[k], measurements.target[k])
    for i in range(2):
        if sides[i] >= 0:
            rate_at(tracks, sides[i], measurements.stamp_ns[k], rate)
            cos, sin, sign = np.cos(pose[i, 2]), np.sin(pose[i, 2]), 2.0 * i - 1.0
            # the body's own velocity, seen from the origin of map
            motion[0] += sign * (cos * rate[0] - sin * rate[1] + rate[2] * pose[i, 1])
            motion[1] += sign * (sin * rate[0] + cos * rate[1] - rate[2] * pose[i, 0])
            motion[2] += sign * rate[2]


@compiled
def add_scaled(total: FloatArray, one: FloatArray, factor: float) -> None:
    """Add `factor` times what a track has gathered (2, 3, 3)."""
    for k in range(2):
        for i in range(3):
            for j in range(3):
                total[k, i, j] += factor * one[k, i, j]


@compiled
def judge_all(
    measurements: MeasurementColumns,
    belief: BeliefArrays,
    pose: FloatArray,
    motion: FloatArray,
    columns: IndexArray,
    jacobian: FloatArray,
    difference: FloatArray,
    noise: FloatArray,
    predicted: FloatArray,
    passed: NDArray[np.bool_],
    nis: FloatArray,
) -> None:
    """Judge all measurements (m,) against one belief.

    Args:
        measurements: (m,).
        belief: Not changed.
        pose: (m, 2, 3) as `advance_all` writes it.
        motion: (m, 3) likewise.
        columns: (m, DEPENDS_ON) written: what each depends on.
        jacobian: (m, 3, DEPENDS_ON) written.
        difference: (m, 3) written: the innovations.
        noise: (m, 3, 3) written: covariances of the measurements.
        predicted: (m, 3) written: variances of what was to be expected.
        passed: (m,) written: whether the gate lets it through.
        nis: (m,) written.
    """
    for k in range(measurements.stamp_ns.size):
        passed[k], nis[k] = judge(
            measurements,
            k,
            belief,
            pose[k],
            motion[k],
            columns[k],
            jacobian[k],
            difference[k],
            noise[k],
            predicted[k],
        )


@compiled
def judge(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    pose: FloatArray,
    motion: FloatArray,
    columns: IndexArray,
    jacobian: FloatArray,
    difference: FloatArray,
    noise: FloatArray,
    variances: FloatArray,
) -> tuple[bool, float]:
    """Linearise measurement k and decide on it; return whether it passes, and its NIS.

    Of a planar marker's two solutions the likelier counts. Arguments as of `judge_all`, for one.
    """
    bodies = _body_columns(measurements, k, belief)
    camera, camera_columns = _camera(belief, measurements.observer[k])
    predicted, chain = np.empty(3), np.empty((3, 5))
    predict_one(measurements, k, pose[0], pose[1], camera, predicted, chain)
    _write_jacobian(chain, bodies, camera_columns, columns, jacobian)
    s = np.empty((3, 3))
    assign_matrix(noise, measurements.covariance[k])
    if measurements.stamp_variance[k] > 0.0:
        _add_stamp_noise(chain, motion, measurements.stamp_variance[k], noise)
    assign_matrix(s, noise)
    add_uncertainty(belief.covariance, bodies, camera_columns, chain, s)
    for i in range(3):
        variances[i] = s[i, i] - noise[i, i]
    innovation(measurements, k, measurements.value[k], predicted, difference)
    if measurements.has_alternative[k]:
        other = np.empty(3)
        innovation(measurements, k, measurements.alternative[k], predicted, other)
        if squared_distance(other, s) < squared_distance(difference, s):
            assign(difference, other)
    passed = position_distance(difference, s) <= measurements.gate[k]
    if measurements.has_heading[k]:
        before = noise[:, 2].copy()
        soften_heading(difference, s, noise)
        for i in range(3):
            s[i, 2] += noise[i, 2] - before[i]
            if i < 2:
                s[2, i] = s[i, 2]
    widen(measurements, k, belief, variances, noise)
    return passed, squared_distance(difference, s)


@compiled
def _camera(belief: BeliefArrays, observer: int) -> tuple[FloatArray, IndexArray]:
    """Yaw and scale (2,) of an observer's camera, and their columns (2,); -1: has none."""
    camera, columns = np.zeros(2), np.full(2, -1)
    if observer >= 0:
        camera[0] = belief.parameter[observer, CAMERA_YAW]
        camera[1] = belief.parameter[observer, CAMERA_SCALE]
        columns[0] = belief.table.column[observer, CAMERA_YAW]
        columns[1] = belief.table.column[observer, CAMERA_SCALE]
    return camera, columns


@compiled
def _write_jacobian(
    chain: FloatArray,
    bodies: tuple[int, int],
    camera_columns: IndexArray,
    columns: IndexArray,
    jacobian: FloatArray,
) -> None:
    """Write the Jacobian of an innovation (3, DEPENDS_ON) by the state's columns (DEPENDS_ON,).

    Columns of nobody do not matter: their Jacobian is zero.
    """
    for j in range(3):
        columns[j], columns[3 + j] = max(bodies[0], 0) + j, max(bodies[1], 0) + j
        for i in range(3):
            jacobian[i, j] = -chain[i, j] if bodies[0] >= 0 else 0.0
            jacobian[i, 3 + j] = chain[i, j] if bodies[1] >= 0 else 0.0
    for j in range(2):
        columns[6 + j] = max(camera_columns[j], 0)
        for i in range(3):
            jacobian[i, 6 + j] = chain[i, 3 + j] if camera_columns[j] >= 0 else 0.0


@compiled
def _add_stamp_noise(chain: FloatArray, motion: FloatArray, variance: float, noise: FloatArray) -> None:
    """Add to `noise` (3, 3) what a stamp of such variance does to a value that changes by `motion` (3,)."""
    change = np.zeros(3)
    for i in range(3):
        for j in range(3):
            change[i] += chain[i, j] * motion[j]
    for i in range(3):
        for j in range(3):
            noise[i, j] += variance * change[i] * change[j]


@compiled
def _body_columns(measurements: MeasurementColumns, k: int, belief: BeliefArrays) -> tuple[int, int]:
    """The first of the three columns of the observer and of the target of measurement k; -1: has none."""
    observer, target = measurements.observer[k], measurements.target[k]
    first = 3 * target if target >= 0 else -1
    if measurements.landmark[k] > 0:
        first = belief.table.survey_column[measurements.landmark[k] - 1]
    return (3 * observer if observer >= 0 else -1), first


@compiled
def to_map(belief: BeliefArrays, robot: int, pose: FloatArray) -> None:
    """Change a pose (3,) on the robot's track to its pose in `map`, in place."""
    t = belief.transform[robot]
    pose[0], pose[1], theta = composed(t[0], t[1], t[2], pose[0], pose[1], pose[2])
    pose[2] = wrap(theta)


@compiled
def is_unsure(belief: BeliefArrays, robot: int, pose: FloatArray, position: float, heading: float) -> bool:
    """Whether the standard deviation of the robot's position or heading at `pose` (3,) exceeds its limit."""
    p = belief.covariance[3 * robot : 3 * robot + 3, 3 * robot : 3 * robot + 3]
    x = p[0, 0] - 2.0 * pose[1] * p[0, 2] + pose[1] * pose[1] * p[2, 2]
    y = p[1, 1] + 2.0 * pose[0] * p[1, 2] + pose[0] * pose[0] * p[2, 2]
    unsure: bool = max(x, y) > position * position or p[2, 2] > heading * heading
    return unsure


@compiled
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
        mark, c = belief.landmark[i], correction[first : first + 3]
        mark[0], mark[1], mark[2] = moved_by_twist(c[0], c[1], c[2], mark[0], mark[1], mark[2])


@compiled
def count_all(
    measurements: MeasurementColumns, belief: BeliefArrays, passed: NDArray[np.bool_], most_gated: int
) -> NDArray[np.bool_]:
    """Count all measurements (m,); return whether each robot (N,) has locked out too many in a row."""
    lost = np.zeros(belief.tracked.size, dtype=np.bool_)
    for k in range(passed.size):
        robot = count(measurements, k, belief, passed[k], most_gated)
        if robot >= 0:
            lost[robot] = True
    return lost


@compiled
def count(
    measurements: MeasurementColumns, k: int, belief: BeliefArrays, passed: bool, most_gated: int
) -> int:
    """Note fixes and locked-out measurements; return a robot that has locked out too many in a row, or -1."""
    observer, target = measurements.observer[k], measurements.target[k]
    lost = -1
    for side in (observer, target):
        if side >= 0:
            belief.gated_in_a_row[side] = 0 if passed else belief.gated_in_a_row[side] + 1
            if belief.gated_in_a_row[side] >= most_gated:
                lost = side
    if passed and (observer < 0 or target < 0):
        fixed = max(observer, target)
        belief.last_fix_ns[fixed] = max(belief.last_fix_ns[fixed], measurements.stamp_ns[k])
    return lost
