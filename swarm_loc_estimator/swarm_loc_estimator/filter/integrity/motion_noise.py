"""Adaptive process noise: the scale of a robot's odometry noise is learned from what measurements correct.

Over a window, measurements move the transform T from `map` to a robot's odometry track by the drift of its
odometry. In a consistent filter this correction is normal with variance s Q + P_begin - P_end, where Q is the
described process noise of the window, P the variance of the pose, and s the scale of the noise, which is 1 as
described. A robot that slips drifts by much more. Each window gives a likelihood of s; they are multiplied
for a grid of scales and forgotten with a time constant. The scale that is used is never below 1: a minute on
a good floor says little of the next metre.

Two windows run in parallel: the short one reacts fast, the long one sees slow drifts. While nothing measures
a robot, its scale stays. Robots whose scales of distance or turn are estimated by description keep scale 1:
their parameters explain a drift.
"""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2_scalar import between, carry, composed, wrap
from swarm_loc_estimator.common.small_matrix import assign, assign_matrix
from swarm_loc_estimator.filter.belief import BeliefArrays, covariance_within
from swarm_loc_estimator.filter.measurement_model import MeasurementColumns

WINDOWS = 2
_WINDOW_NS = (2_000_000_000, 8_000_000_000)
_LONGEST = 4.0  # A window that no measurement has ended after this many of its lengths says nothing
LOG_SCALES = math.log(2.0) * np.arange(-1.0, 7.5, 0.5)
"""Logarithms of the scales of the process noise, from one half to 128.

Those below 1 take up what chance adds: without them, the mean of a robot as described would exceed 1.
"""
_PRIOR = 3.0  # Decrease of the log-likelihood per factor of e from scale 1
_MEMORY_S = 30.0  # Time constant with which likelihoods are forgotten
_POSE_SHARE = 0.25
"""Share of the variance of the pose by which corrections scatter beyond a consistent filter's."""
_STATIONARY_M2 = 1e-8  # Position noise of a window below which the robot has not moved [m^2]


@cached_njit
def learn_all(measurements: MeasurementColumns, belief: BeliefArrays, poses: FloatArray) -> None:
    """Learn the scales of all robots that measurements (m,) involve, after their update.

    Args:
        measurements: (m,) sorted by stamp.
        belief: Its integrity is changed.
        poses: (m, 2, 3) observers and targets in `map` at the stamps.
    """
    for k in range(measurements.stamp_ns.size):
        learn(belief, measurements.observer[k], poses[k, 0], measurements.stamp_ns[k])
        learn(belief, measurements.target[k], poses[k, 1], measurements.stamp_ns[k])


@cached_njit
def learn(belief: BeliefArrays, robot: int, pose: FloatArray, stamp_ns: int) -> None:
    """Learn the scale of a robot from the windows that end, and begin the next ones.

    Args:
        belief: Just updated; its integrity is changed.
        robot: Index of the robot; -1: none.
        pose: (3,) its pose in `map`; before the update is exact enough.
        stamp_ns: Stamp of the measurement.
    """
    if robot < 0 or not belief.tracked[robot]:
        return
    state = belief.integrity
    if state.motion_explained[robot]:
        return
    for window in range(WINDOWS):
        since_ns = stamp_ns - state.drift_ns[robot, window]
        if 0 <= since_ns < _WINDOW_NS[window]:
            continue
        if 0 <= since_ns < _LONGEST * _WINDOW_NS[window]:
            _add_evidence(belief, robot, window, pose, since_ns * 1e-9)
        state.drift_ns[robot, window] = stamp_ns
        assign(state.drift_transform[robot, window], belief.transform[robot])
        assign_matrix(state.drift_noise[robot, window], belief.preintegrated_covariance[robot])
        for i in range(3):
            for j in range(3):
                state.drift_covariance[robot, window, i, j] = covariance_within(belief, 3 * robot, i, j)


@cached_njit
def _add_evidence(
    belief: BeliefArrays,
    robot: int,
    window: int,
    pose: FloatArray,
    since_s: float,
) -> None:
    """Add the likelihood of a window that ends at a pose (3,) to those before."""
    state = belief.integrity
    now, begin = belief.transform[robot], state.drift_transform[robot, window]
    difference, noise = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            before = state.drift_noise[robot, window, i, j]
            difference[i, j] = belief.preintegrated_covariance[robot, i, j] - before
    carry(now, difference, noise)
    of_position, of_heading = _at(noise, pose)
    if not of_position > _STATIONARY_M2 or not of_heading > 0.0:
        return
    back = between(begin[0], begin[1], begin[2], 0.0, 0.0, 0.0)
    moved = composed(now[0], now[1], now[2], back[0], back[1], back[2])
    x, y, theta = between(moved[0], moved[1], moved[2], pose[0], pose[1], pose[2])
    squared = ((pose[0] - x) ** 2 + (pose[1] - y) ** 2, wrap(pose[2] - theta) ** 2)
    # where the window ends, an uncertain heading at its begin moves the robot sideways
    was_position, was_heading = _at(state.drift_covariance[robot, window], pose)
    position, heading = _variances(belief, robot, pose)
    rest = (
        max(was_position - position, 0.0) + _POSE_SHARE * position,
        max(was_heading - heading, 0.0) + _POSE_SHARE * heading,
    )
    kept, likelihood = math.exp(-since_s / _MEMORY_S), state.motion_likelihood[robot]
    total, mean, best = 0.0, 0.0, -math.inf
    for k in range(likelihood.size):
        scale = math.exp(LOG_SCALES[k])
        along = 0.5 * (scale * of_position + rest[0])
        turned = scale * of_heading + rest[1]
        likelihood[k] *= kept
        likelihood[k] -= math.log(along) + 0.5 * squared[0] / along
        likelihood[k] -= 0.5 * math.log(turned) + 0.5 * squared[1] / turned
        best = max(best, likelihood[k] - _PRIOR * abs(LOG_SCALES[k]))
    for k in range(likelihood.size):
        weight = math.exp(likelihood[k] - _PRIOR * abs(LOG_SCALES[k]) - best)
        total += weight
        mean += weight * LOG_SCALES[k]
    state.motion_scale[robot] = max(1.0, math.exp(mean / total))


@cached_njit
def _variances(belief: BeliefArrays, robot: int, pose: FloatArray) -> tuple[float, float]:
    """Variances of position (the sum of both axes) and heading of a robot at a pose (3,)."""
    covariance = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            covariance[i, j] = covariance_within(belief, 3 * robot, i, j)
    return _at(covariance, pose)


@cached_njit
def _at(covariance: FloatArray, pose: FloatArray) -> tuple[float, float]:
    """Variances of position (the sum of both axes) and heading at a pose (3,), of a right-invariant error."""
    turned = covariance[2, 2]
    x = covariance[0, 0] - 2.0 * pose[1] * covariance[0, 2] + pose[1] * pose[1] * turned
    y = covariance[1, 1] + 2.0 * pose[0] * covariance[1, 2] + pose[0] * pose[0] * turned
    return x + y, turned
