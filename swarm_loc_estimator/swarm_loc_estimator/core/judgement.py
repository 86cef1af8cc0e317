"""The compiled inner loop of the filter: predict two robots, judge one measurement, correct all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.compiled import assign, assign_matrix, compiled, composed, moved_by_twist, wrap
from swarm_loc_estimator.core.dense_filter import IndexArray, update_one
from swarm_loc_estimator.core.gate import position_distance, soften_heading, squared_distance
from swarm_loc_estimator.core.measurements import MeasurementColumns, innovation, predict_one
from swarm_loc_estimator.core.motion import TrackArrays, look_up
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.state import BeliefArrays, advance

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
    pose, noise, raw = np.empty((2, 3)), np.empty((2, 3, 3)), np.empty(3)
    columns, jacobian = np.empty(6, dtype=np.int64), np.empty((3, 6))
    difference, r = np.empty(3), np.empty((3, 3))
    for k in range(begin, measurements.stamp_ns.size):
        sides = (measurements.observer[k], measurements.target[k])
        for side in sides:
            if measurements.kind[k] > 1 or (side >= 0 and not belief.tracked[side]):
                return k, UNTIED, -1
        for i in range(2):
            if sides[i] >= 0:
                look_up(tracks, sides[i], measurements.stamp_ns[k], pose[i], raw, noise[i])
                advance(belief, sides[i], noise[i])
                to_map(belief, sides[i], pose[i])
                if is_unsure(belief, sides[i], pose[i], limits[0], limits[1]):
                    return k, LOST, sides[i]
        passed, nis[k] = judge(measurements, k, belief, pose, columns, jacobian, difference, r)
        verdicts[k] = USED if passed else GATED
        if passed:
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
    unsure: NDArray[np.bool_],
) -> None:
    """Predict every robot involved to the mean of its measurements.

    Args:
        measurements: (m,) between robots that are located.
        tracks: Odometry.
        belief: Changed in place.
        limits: See `fuse_in_order`.
        pose: (m, 2, 3) written: observers and targets in `map` at the stamps; nobody's is not written.
        unsure: (N,) written: robots involved that no longer know where they are.
    """
    robots = belief.tracked.size
    noise, times = np.zeros((robots, 3, 3)), np.zeros(robots)
    newest, raw, one = np.zeros((robots, 3)), np.empty(3), np.empty((3, 3))
    for k in range(measurements.stamp_ns.size):
        sides = (measurements.observer[k], measurements.target[k])
        for i in range(2):
            robot = sides[i]
            if robot >= 0:
                look_up(tracks, robot, measurements.stamp_ns[k], pose[k, i], raw, one)
                to_map(belief, robot, pose[k, i])
                assign(newest[robot], pose[k, i])
                times[robot] += 1.0
                for a in range(3):
                    for b in range(3):
                        noise[robot, a, b] += one[a, b]
    for robot in range(robots):
        if times[robot] > 0.0:
            for a in range(3):
                for b in range(3):
                    one[a, b] = noise[robot, a, b] / times[robot]
            advance(belief, robot, one)
            unsure[robot] = is_unsure(belief, robot, newest[robot], limits[0], limits[1])


@compiled
def judge_all(
    measurements: MeasurementColumns,
    belief: BeliefArrays,
    pose: FloatArray,
    columns: IndexArray,
    jacobian: FloatArray,
    difference: FloatArray,
    noise: FloatArray,
    passed: NDArray[np.bool_],
    nis: FloatArray,
) -> None:
    """Judge all measurements (m,) against one belief.

    Args:
        measurements: (m,).
        belief: Not changed.
        pose: (m, 2, 3) of observer and target in `map`.
        columns: (m, 6) written: what each depends on.
        jacobian: (m, 3, 6) written.
        difference: (m, 3) written: the innovations.
        noise: (m, 3, 3) written: covariances of the measurements.
        passed: (m,) written: whether the gate lets it through.
        nis: (m,) written.
    """
    for k in range(measurements.stamp_ns.size):
        passed[k], nis[k] = judge(
            measurements, k, belief, pose[k], columns[k], jacobian[k], difference[k], noise[k]
        )


@compiled
def judge(
    measurements: MeasurementColumns,
    k: int,
    belief: BeliefArrays,
    pose: FloatArray,
    columns: IndexArray,
    jacobian: FloatArray,
    difference: FloatArray,
    noise: FloatArray,
) -> tuple[bool, float]:
    """Linearise measurement k and decide on it; return whether it passes, and its NIS.

    Of a planar marker's two solutions the likelier counts. Arguments as of `judge_all`, for one.
    """
    predicted, chain = np.empty(3), np.empty((3, 3))
    predict_one(measurements, k, pose[0], pose[1], predicted, chain)
    observer, target = measurements.observer[k], measurements.target[k]
    for j in range(3):
        columns[j] = 3 * max(observer, 0) + j  # nobody's columns do not matter: their Jacobian is zero
        columns[3 + j] = 3 * max(target, 0) + j
        for i in range(3):
            jacobian[i, j] = -chain[i, j] if observer >= 0 else 0.0
            jacobian[i, 3 + j] = chain[i, j] if target >= 0 else 0.0
    s = np.empty((3, 3))
    assign_matrix(noise, measurements.covariance[k])
    assign_matrix(s, noise)
    for a in range(6):
        for b in range(6):
            p = belief.covariance[columns[a], columns[b]]
            for i in range(3):
                for j in range(3):
                    s[i, j] += jacobian[i, a] * p * jacobian[j, b]
    innovation(measurements, k, measurements.value[k], predicted, difference)
    if measurements.has_alternative[k]:
        other = np.empty(3)
        innovation(measurements, k, measurements.alternative[k], predicted, other)
        if squared_distance(other, s) < squared_distance(difference, s):
            assign(difference, other)
    passed = position_distance(difference, s) <= measurements.gate[k]
    if measurements.has_heading[k]:
        soften_heading(difference, s, noise)
        for i in range(3):
            s[i, 2] += noise[i, 2] - measurements.covariance[k, i, 2]
            if i < 2:
                s[2, i] = s[i, 2]
    return passed, squared_distance(difference, s)


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
    """Apply a filter's correction (3N,) to the transforms of the robots located."""
    for i in range(belief.tracked.size):
        if belief.tracked[i]:
            t, c = belief.transform[i], correction[3 * i : 3 * i + 3]
            t[0], t[1], t[2] = moved_by_twist(c[0], c[1], c[2], t[0], t[1], t[2])


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
