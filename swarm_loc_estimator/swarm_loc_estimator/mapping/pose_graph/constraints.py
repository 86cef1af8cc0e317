"""Constraints of the pose graph, linearised: residuals e, Jacobians J and weights, many of a kind at once.

A stop has the unknowns x, y, theta (on arrival) and ratio (true turn over turn by odometry); behind those of
all stops stands one slip per robot. Residuals are estimates minus measurements.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle

STOP_UNKNOWNS = 4


class Linearised(NamedTuple):
    """Constraints (m,) with e residuals each on c unknowns each.

    Attributes:
        unknowns: (m, c) their indices.
        jacobian: (m, e, c).
        residual: (m, e).
        weight: (m, e) one over the variance.
    """

    unknowns: IntArray
    jacobian: FloatArray
    residual: FloatArray
    weight: FloatArray


class Departures(NamedTuple):
    """Odometry from stop to stop (m,).

    Attributes:
        begin: (m,) stop that was left.
        end: (m,) stop that was reached.
        turn: (m,) turn by odometry at the stop that was left [rad].
        motion: (m, 3) pose on arrival in the frame at departure, by odometry.
        sigma: (m, 3) along the motion [m], across it [m], of the heading [rad].
    """

    begin: IntArray
    end: IntArray
    turn: FloatArray
    motion: FloatArray
    sigma: FloatArray


class Ties(NamedTuple):
    """Relative poses (m,) of stops, found by matching.

    Attributes:
        begin: (m,) stop in whose frame the pose is.
        end: (m,) stop whose pose it is.
        pose: (m, 3).
        sigma: (m, 3) [m, m, rad].
    """

    begin: IntArray
    end: IntArray
    pose: FloatArray
    sigma: FloatArray


class Bearings(NamedTuple):
    """Lights (m,) of robots at other stops.

    Attributes:
        begin: (m,) stop from which the light was seen.
        end: (m,) stop where the other robot stood.
        turn: (m,) turn by odometry at which the light would be straight ahead [rad].
        sigma: (m,) [rad].
    """

    begin: IntArray
    end: IntArray
    turn: FloatArray
    sigma: FloatArray


def odometry(states: FloatArray, given: Departures) -> Linearised:
    """Motion from stop to stop, in the frame at departure turned along the motion."""
    begin, end = states[given.begin], states[given.end]
    swing = given.turn + given.motion[:, 2]
    course = np.arctan2(given.motion[:, 1], given.motion[:, 0])
    heading = begin[:, 2] + begin[:, 3] * given.turn + course
    cos, sin = np.cos(heading), np.sin(heading)
    dx, dy = end[:, 0] - begin[:, 0], end[:, 1] - begin[:, 1]
    along, across = cos * dx + sin * dy, -sin * dx + cos * dy
    length = np.hypot(given.motion[:, 0], given.motion[:, 1])
    turned = wrap_angle(end[:, 2] - begin[:, 2] - begin[:, 3] * swing)
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    jacobian = np.stack(
        [
            np.stack([-cos, -sin, across, across * given.turn, cos, sin, zero], -1),
            np.stack([sin, -cos, -along, -along * given.turn, -sin, cos, zero], -1),
            np.stack([zero, zero, -one, -swing, zero, zero, one], -1),
        ],
        1,
    )
    index = np.hstack([_unknowns(given.begin, 4), _unknowns(given.end, 3)])
    residual = np.stack([along - length, across, turned], -1)
    return Linearised(index, jacobian, residual, given.sigma**-2.0)


def ties(states: FloatArray, given: Ties) -> Linearised:
    """Relative poses of stops."""
    begin, end = states[given.begin], states[given.end]
    cos, sin = np.cos(begin[:, 2]), np.sin(begin[:, 2])
    dx, dy = end[:, 0] - begin[:, 0], end[:, 1] - begin[:, 1]
    ahead, left = cos * dx + sin * dy, -sin * dx + cos * dy
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    jacobian = np.stack(
        [
            np.stack([-cos, -sin, left, cos, sin, zero], -1),
            np.stack([sin, -cos, -ahead, -sin, cos, zero], -1),
            np.stack([zero, zero, -one, zero, zero, one], -1),
        ],
        1,
    )
    residual = np.stack([ahead, left, end[:, 2] - begin[:, 2]], -1) - given.pose
    residual[:, 2] = wrap_angle(residual[:, 2])
    index = np.hstack([_unknowns(given.begin, 3), _unknowns(given.end, 3)])
    return Linearised(index, jacobian, residual, given.sigma**-2.0)


def bearings(states: FloatArray, given: Bearings) -> Linearised:
    """Directions of lights; those that do not fit weigh less."""
    begin, end = states[given.begin], states[given.end]
    dx, dy = end[:, 0] - begin[:, 0], end[:, 1] - begin[:, 1]
    square = dx * dx + dy * dy
    residual = wrap_angle(np.arctan2(dy, dx) - begin[:, 2] - begin[:, 3] * given.turn)
    one = np.ones_like(dx)
    jacobian = np.stack([dy / square, -dx / square, -one, -given.turn, -dy / square, dx / square], -1)
    robust = 1.0 + (residual / given.sigma) ** 2 / 9.0
    index = np.hstack([_unknowns(given.begin, 4), _unknowns(given.end, 2)])
    return Linearised(index, jacobian[:, None, :], residual[:, None], (given.sigma * robust)[:, None] ** -2.0)


def priors(states: FloatArray, stop: IntArray, pose: FloatArray, sigma: FloatArray) -> Linearised:
    """Poses (m, 3) with sigmas (m, 3) that stops (m,) are known to have."""
    residual = states[stop, :3] - pose
    residual[:, 2] = wrap_angle(residual[:, 2])
    jacobian = np.broadcast_to(np.eye(3), (len(stop), 3, 3))
    return Linearised(_unknowns(stop, 3), jacobian, residual, sigma**-2.0)


def ratios(states: FloatArray, slip: FloatArray, robot: IntArray, sigma: FloatArray) -> Linearised:
    """Each stop's ratio (k,) is one minus the slip of its robot, but for sigmas (k,)."""
    count = len(states)
    residual = states[:, 3] - 1.0 + slip[robot]
    index = np.stack([STOP_UNKNOWNS * np.arange(count) + 3, STOP_UNKNOWNS * count + robot], -1)
    jacobian = np.ones((count, 1, 2))
    return Linearised(index, jacobian, residual[:, None], sigma[:, None] ** -2.0)


def slips(count: int, slip: FloatArray, usual: float, sigma: float) -> Linearised:
    """What is known of the robots' slips (R,) beforehand; behind the unknowns of so many stops."""
    robots = len(slip)
    index = STOP_UNKNOWNS * count + np.arange(robots)[:, None]
    weight = np.full((robots, 1), sigma**-2.0)
    return Linearised(index, np.ones((robots, 1, 1)), (slip - usual)[:, None], weight)


def _unknowns(stop: IntArray, count: int) -> IntArray:
    """Indices (m, count) of the first unknowns of stops (m,)."""
    index: IntArray = STOP_UNKNOWNS * stop[:, None] + np.arange(count)
    return index
