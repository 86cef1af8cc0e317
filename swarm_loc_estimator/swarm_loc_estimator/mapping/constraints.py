"""Constraints of the pose graph and their normal equations.

A stop has the unknowns x, y, theta (on arrival) and ratio (true turn over turn by odometry). One slip
per robot follows the unknowns of all stops. Residuals are estimates minus measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle

STOP_UNKNOWNS = 4


class Linearised(NamedTuple):
    """Constraints (m,) with e residuals each on c unknowns each."""

    unknowns: IntArray  # (m, c) indices of the unknowns
    jacobian: FloatArray  # (m, e, c)
    residual: FloatArray  # (m, e)
    weight: FloatArray  # (m, e) inverse variance


class Departures(NamedTuple):
    """Odometry from stop to stop (m,)."""

    begin: IntArray  # (m,) stop of departure
    end: IntArray  # (m,) stop of arrival
    turn: FloatArray  # (m,) turn by odometry at the stop of departure [rad]
    motion: FloatArray  # (m, 3) pose on arrival in the frame at departure, by odometry
    sigma: FloatArray  # (m, 3) along the motion [m], across it [m], of the heading [rad]


class Ties(NamedTuple):
    """Relative poses (m,) of stops, from scan matching."""

    begin: IntArray  # (m,) reference stop
    end: IntArray  # (m,) stop whose pose in the frame of `begin` is given
    pose: FloatArray  # (m, 3)
    sigma: FloatArray  # (m, 3) [m, m, rad]


class Bearings(NamedTuple):
    """Bearings (m,) of lights of robots at other stops."""

    begin: IntArray  # (m,) stop from which the light was seen
    end: IntArray  # (m,) stop of the other robot
    turn: FloatArray  # (m,) turn by odometry at which it was seen [rad]
    bearing: FloatArray  # (m,) of the light in the robot's frame then [rad]
    sigma: FloatArray  # (m,) [rad]


def odometry(states: FloatArray, given: Departures) -> Linearised:
    """Residuals of odometry, along and across the motion."""
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
    """Residuals of relative poses of stops."""
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
    """Residuals of bearings of lights, with a robust loss."""
    begin, end = states[given.begin], states[given.end]
    dx, dy = end[:, 0] - begin[:, 0], end[:, 1] - begin[:, 1]
    square = dx * dx + dy * dy
    residual = wrap_angle(np.arctan2(dy, dx) - begin[:, 2] - begin[:, 3] * given.turn - given.bearing)
    one = np.ones_like(dx)
    jacobian = np.stack([dy / square, -dx / square, -one, -given.turn, -dy / square, dx / square], -1)
    robust = 1.0 + (residual / given.sigma) ** 2 / 9.0
    index = np.hstack([_unknowns(given.begin, 4), _unknowns(given.end, 2)])
    return Linearised(index, jacobian[:, None, :], residual[:, None], (given.sigma * robust)[:, None] ** -2.0)


def priors(states: FloatArray, stop: IntArray, pose: FloatArray, sigma: FloatArray) -> Linearised:
    """Residuals of priors on poses (m, 3) of stops (m,) with standard deviations (m, 3)."""
    residual = states[stop, :3] - pose
    residual[:, 2] = wrap_angle(residual[:, 2])
    jacobian = np.broadcast_to(np.eye(3), (len(stop), 3, 3))
    return Linearised(_unknowns(stop, 3), jacobian, residual, sigma**-2.0)


def ratios(states: FloatArray, slip: FloatArray, robot: IntArray, sigma: FloatArray) -> Linearised:
    """Residuals of each stop's ratio from one minus the slip of its robot, with sigmas (k,)."""
    count = len(states)
    residual = states[:, 3] - 1.0 + slip[robot]
    index = np.stack([STOP_UNKNOWNS * np.arange(count) + 3, STOP_UNKNOWNS * count + robot], -1)
    jacobian = np.ones((count, 1, 2))
    return Linearised(index, jacobian, residual[:, None], sigma[:, None] ** -2.0)


def slips(count: int, slip: FloatArray, usual: float, sigma: float) -> Linearised:
    """Residuals of the prior on the robots' slips (R,), which follow the unknowns of `count` stops."""
    robots = len(slip)
    index = STOP_UNKNOWNS * count + np.arange(robots)[:, None]
    weight = np.full((robots, 1), sigma**-2.0)
    return Linearised(index, np.ones((robots, 1, 1)), (slip - usual)[:, None], weight)


def _unknowns(stop: IntArray, count: int) -> IntArray:
    """Indices (m, count) of the first unknowns of stops (m,)."""
    index: IntArray = STOP_UNKNOWNS * stop[:, None] + np.arange(count)
    return index


_DAMPING = 1e-6


class NormalEquations:
    """Accumulates normal equations over the free ones of u unknowns.

    Args:
        free: (u,) True for free unknowns.
    """

    def __init__(self, free: BoolArray) -> None:
        self._place: IntArray = np.where(free, np.cumsum(free) - 1, -1)
        self._size = int(free.sum())
        self._free = free
        self._gradient = np.zeros(self._size)
        self._values: list[FloatArray] = []
        self._rows: list[IntArray] = []
        self._columns: list[IntArray] = []

    def add(self, constraints: Sequence[Linearised]) -> None:
        """Add constraints."""
        for one in constraints:
            weighted = one.jacobian * one.weight[:, :, None]
            squares = np.einsum("mea,meb->mab", weighted, one.jacobian)
            self.add_blocks(one.unknowns, squares, -np.einsum("mea,me->ma", weighted, one.residual))

    def add_blocks(self, index: IntArray, squares: FloatArray, gradient: FloatArray) -> None:
        """Add blocks (m, c, c) with right sides (m, c) on unknowns (m, c)."""
        place = self._place[index]
        kept = place >= 0
        np.add.at(self._gradient, place[kept], gradient[kept])
        rows = np.broadcast_to(place[:, :, None], squares.shape)
        columns = np.broadcast_to(place[:, None, :], squares.shape)
        both = kept[:, :, None] & kept[:, None, :]
        self._values.append(squares[both])
        self._rows.append(rows[both])
        self._columns.append(columns[both])

    def system(self) -> tuple[csc_matrix, FloatArray]:
        """The matrix (f, f) and right side (f,) of the free unknowns."""
        diagonal = np.arange(self._size)
        values = np.concatenate([*self._values, np.full(self._size, _DAMPING)])
        rows = np.concatenate([*self._rows, diagonal])
        columns = np.concatenate([*self._columns, diagonal])
        return csc_matrix((values, (rows, columns)), shape=(self._size, self._size)), self._gradient

    def solve(self) -> tuple[FloatArray, NormalFactor]:
        """The step (u,), zero for fixed unknowns, and the factor for covariances."""
        matrix, gradient = self.system()
        factor = splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        step = np.zeros(len(self._free))
        step[self._free] = factor.solve(gradient)
        return step, NormalFactor(factor, self._place)


class NormalFactor:
    """The factor of normal equations.

    Args:
        factor: LU factor of the sparse matrix.
        place: (u,) index of each unknown among the free ones, -1: fixed.
    """

    def __init__(self, factor: SuperLU, place: IntArray) -> None:
        self._factor = factor
        self._place = place

    def covariance(self, index: IntArray, directions: FloatArray | None = None) -> FloatArray:
        """Covariance (d, d) of free unknowns (c,), or of linear combinations (d, c) of them."""
        chosen = np.eye(len(index)) if directions is None else directions
        columns = np.zeros((self._factor.shape[0], len(chosen)))
        for number, direction in enumerate(chosen):
            np.add.at(columns[:, number], self._place[index], direction)
        covariance: NDArray[np.float64] = columns.T @ self._factor.solve(columns)
        symmetric: FloatArray = 0.5 * (covariance + covariance.T)
        return symmetric
