"""What the estimator believes at one instant: enough to go on from there, so a copy is a checkpoint."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core import se2
from swarm_loc_estimator.core.compiled import assign_matrix, compiled
from swarm_loc_estimator.core.dense_filter import DenseFilter, IndexArray, cholesky3
from swarm_loc_estimator.core.se2 import FloatArray

NEVER_NS = np.iinfo(np.int64).min


class BeliefArrays(NamedTuple):
    """The arrays of a `SwarmState`, as compiled code reads and writes them; see there."""

    transform: FloatArray
    covariance: FloatArray
    accounted: FloatArray
    tracked: NDArray[np.bool_]
    last_fix_ns: NDArray[np.int64]
    gated_in_a_row: NDArray[np.int64]


class SwarmState:
    """Joint belief over all robots.

    Attributes:
        transform: (N, 3) T, from `map` to the frame of the robot's odometry track.
        filter: Covariance of the right-invariant errors; robot i has columns 3i..3i+2.
        accounted: (N, 3, 3) the track noise that the covariance already contains.
        tracked: (N,) whether the robot is part of the estimate.
        fresh: (N,) whether the robot may still enter at its configured start.
        last_fix_ns: (N,) newest accepted measurement tied to a landmark or an absolute fix.
        gated_in_a_row: (N,) gated measurements since the last accepted one.
        losses: (N,) how often the robot left the estimate.
        clues: Per robot that is not tracked, sightings which may locate it (see `core/fix.py`).
    """

    def __init__(self, robots: int) -> None:
        self.transform: FloatArray = np.zeros((robots, 3))
        self.filter = DenseFilter(3 * robots)
        self.accounted: FloatArray = np.zeros((robots, 3, 3))
        self.tracked: NDArray[np.bool_] = np.zeros(robots, dtype=bool)
        self.fresh: NDArray[np.bool_] = np.ones(robots, dtype=bool)
        self.last_fix_ns: NDArray[np.int64] = np.full(robots, NEVER_NS)
        self.gated_in_a_row: NDArray[np.int64] = np.zeros(robots, dtype=np.int64)
        self.losses: NDArray[np.int64] = np.zeros(robots, dtype=np.int64)
        self.clues: dict[int, NDArray[np.void]] = {}

    def copy(self) -> SwarmState:
        """An independent copy."""
        other = SwarmState.__new__(SwarmState)
        for name, value in vars(self).items():
            setattr(other, name, value.copy())  # the arrays inside `clues` are replaced, never written to
        return other

    def arrays(self) -> BeliefArrays:
        """Views for compiled code."""
        return BeliefArrays(
            self.transform,
            self.filter.covariance,
            self.accounted,
            self.tracked,
            self.last_fix_ns,
            self.gated_in_a_row,
        )

    def enter(self, robot: int, transform: FloatArray, covariance: FloatArray, accounted: FloatArray) -> None:
        """Take the robot into the estimate, independent of all others.

        Args:
            robot: Its index.
            transform: (3,) T.
            covariance: (3, 3) of its right-invariant error.
            accounted: (3, 3) track noise at the instant of entering.
        """
        self.transform[robot] = transform
        self.filter.place(robot_columns(np.array([robot]))[0], covariance)
        self.accounted[robot] = accounted
        self.tracked[robot] = True
        self.fresh[robot] = False
        self.gated_in_a_row[robot] = 0
        self.clues.pop(robot, None)

    def lose(self, robot: int) -> None:
        """Take the robot out of the estimate; it waits for a fix."""
        self.filter.place(robot_columns(np.array([robot]))[0], np.eye(3))
        self.tracked[robot] = False
        self.fresh[robot] = False
        self.losses[robot] += 1
        self.gated_in_a_row[robot] = 0

    def map_noise(self, robots: NDArray[np.int64], noise: FloatArray) -> FloatArray:
        """The track noise (k, 3, 3) not accounted for yet, as covariance of the error in `map`."""
        added = np.zeros_like(noise)
        belief = self.arrays()
        for robot, gathered, one in zip(robots, noise, added, strict=True):
            new_noise(belief, robot, gathered, one)
        return added

    def correct(self, correction: FloatArray) -> None:
        """Apply a filter's correction (3N,) to the transforms."""
        moved = np.flatnonzero(self.tracked)
        twist = correction.reshape(-1, 3)[moved]
        self.transform[moved] = se2.compose(se2.exp(twist), self.transform[moved])


@compiled
def advance(belief: BeliefArrays, robot: int, noise: FloatArray) -> None:
    """Predict a robot to where its track gathered `noise` (3, 3): P += Ad(T) (G - G_accounted) Ad(T)^T."""
    added = np.zeros((3, 3))
    if new_noise(belief, robot, noise, added):
        first = 3 * robot
        for i in range(3):
            for j in range(3):
                belief.covariance[first + i, first + j] += added[i, j]
        assign_matrix(belief.accounted[robot], noise)


@compiled
def new_noise(belief: BeliefArrays, robot: int, noise: FloatArray, added: FloatArray) -> bool:
    """Write Ad(T) (G - G_accounted) Ad(T)^T (3, 3) and return True; or leave it when that is no covariance.

    The latter happens only when odometry comes so late that more was assumed of a silence beyond the horizon.
    """
    x, y, theta = belief.transform[robot, 0], belief.transform[robot, 1], belief.transform[robot, 2]
    cos, sin = math.cos(theta), math.sin(theta)
    adjoint = ((cos, -sin, y), (sin, cos, -x), (0.0, 0.0, 1.0))
    difference, rounded, rounding = np.empty((3, 3)), np.empty((3, 3)), 1e-12
    for i in range(3):
        rounding += 1e-9 * abs(noise[i, i] - belief.accounted[robot, i, i])
    for i in range(3):
        for j in range(3):
            difference[i, j] = noise[i, j] - belief.accounted[robot, i, j]
            rounded[i, j] = difference[i, j] + (rounding if i == j else 0.0)
    factor = cholesky3(rounded)
    if not math.isfinite(factor[0, 0] + factor[1, 1] + factor[2, 2]):
        return False
    for i in range(3):
        for j in range(3):
            added[i, j] = 0.0
            for a in range(3):
                for b in range(3):
                    added[i, j] += adjoint[i][a] * difference[a, b] * adjoint[j][b]
    return True


def robot_columns(robots: NDArray[np.int64]) -> IndexArray:
    """Filter columns (k, 3) of robots (k,)."""
    columns: IndexArray = 3 * robots[:, None] + np.arange(3)
    return columns
