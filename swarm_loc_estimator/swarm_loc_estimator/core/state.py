"""What the estimator believes at one instant: enough to go on from there, so a copy is a checkpoint."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.dense_filter import DenseFilter, IndexArray
from swarm_loc_estimator.core.parameters import PARAMETERS, ParameterTable
from swarm_loc_estimator.core.se2 import FloatArray

NEVER_NS = np.iinfo(np.int64).min

_ALONE: IndexArray = np.zeros(0, dtype=np.int64)
_NO_SHARES: FloatArray = np.zeros((0, 3, 3))


class BeliefArrays(NamedTuple):
    """The arrays of a `SwarmState`, as compiled code reads and writes them; see there."""

    transform: FloatArray
    covariance: FloatArray
    parameter: FloatArray
    landmark: FloatArray
    table: ParameterTable
    accounted: FloatArray
    accounted_ns: NDArray[np.int64]
    tracked: NDArray[np.bool_]
    last_fix_ns: NDArray[np.int64]
    gated_in_a_row: NDArray[np.int64]
    heard_robot: NDArray[np.int64]
    heard_ns: NDArray[np.int64]
    heard: FloatArray


class SwarmState:
    """Joint belief over all robots.

    Args:
        table: Which parameters are estimated besides the poses.
        places: Of how many others each robot remembers what it has heard.

    Attributes:
        transform: (N, 3) T, from `map` to the frame of the robot's odometry track.
        parameter: (N, PARAMETERS) see `core/parameters.py`.
        landmark: (L, 3) by what each landmark that is estimated is moved from its surveyed place, in `map`.
        filter: Covariance of the errors: robot i has columns 3i..3i+2 for its pose, right-invariant, and
            those of the table for its parameters; landmarks have those of the table.
        accounted: (N, 2, 3, 3) what the track had gathered where the belief stands.
        accounted_ns: (N,) the instant at which it stands.
        tracked: (N,) whether the robot is part of the estimate.
        fresh: (N,) whether the robot may still enter at its configured start.
        last_fix_ns: (N,) newest accepted measurement tied to a landmark or an absolute fix.
        gated_in_a_row: (N,) gated measurements since the last accepted one.
        heard_robot: (N, places) whom each has heard; -1: nobody.
        heard_ns: (N, places) when last.
        heard: (N, places, 3, 3) what was told, see `core/repetition.py`.
        clues: Per robot that is not tracked, sightings which may locate it (see `core/fix.py`).
        next_attempt_ns: (N,) before this instant nothing more is made of its clues.
    """

    def __init__(self, table: ParameterTable, places: int = 0) -> None:
        robots = table.column.shape[0]
        self._table = table
        self.transform: FloatArray = np.zeros((robots, 3))
        self.parameter: FloatArray = np.zeros((robots, PARAMETERS))
        self.landmark: FloatArray = np.zeros((table.survey_column.size, 3))
        self.filter = DenseFilter(table.filter_size)
        for first, survey in zip(table.survey_column, table.survey, strict=True):
            self.filter.place(first + np.arange(3), survey)
        self.accounted: FloatArray = np.zeros((robots, 2, 3, 3))
        self.accounted_ns: NDArray[np.int64] = np.zeros(robots, dtype=np.int64)
        self.tracked: NDArray[np.bool_] = np.zeros(robots, dtype=bool)
        self.fresh: NDArray[np.bool_] = np.ones(robots, dtype=bool)
        self.last_fix_ns: NDArray[np.int64] = np.full(robots, NEVER_NS)
        self.gated_in_a_row: NDArray[np.int64] = np.zeros(robots, dtype=np.int64)
        self.heard_robot: NDArray[np.int64] = np.full((robots, places), -1)
        self.heard_ns: NDArray[np.int64] = np.full((robots, places), NEVER_NS)
        self.heard: FloatArray = np.zeros((robots, places, 3, 3))
        self.clues: dict[int, NDArray[np.void]] = {}
        self.next_attempt_ns: NDArray[np.int64] = np.full(robots, NEVER_NS)

    def copy(self) -> SwarmState:
        """An independent copy."""
        other = SwarmState.__new__(SwarmState)
        for name, value in vars(self).items():
            # the table never changes; the arrays inside `clues` are replaced, never written to
            setattr(other, name, value if name == "_table" else value.copy())
        return other

    def arrays(self) -> BeliefArrays:
        """Views for compiled code."""
        return BeliefArrays(
            self.transform,
            self.filter.covariance,
            self.parameter,
            self.landmark,
            self._table,
            self.accounted,
            self.accounted_ns,
            self.tracked,
            self.last_fix_ns,
            self.gated_in_a_row,
            self.heard_robot,
            self.heard_ns,
            self.heard,
        )

    def enter(
        self,
        robot: int,
        transform: FloatArray,
        covariance: FloatArray,
        gathered: FloatArray,
        stamp_ns: int,
        columns: IndexArray = _ALONE,
        shares: FloatArray = _NO_SHARES,
    ) -> None:
        """Take the robot into the estimate, its parameters as before any data.

        Its error is one of its own, and a share of those of what it was located by.

        Args:
            robot: Its index.
            transform: (3,) T.
            covariance: (3, 3) of the part of its right-invariant error that is its own.
            gathered: (2, 3, 3) what its track has gathered at the instant of entering.
            stamp_ns: That instant.
            columns: (s,) first filter columns of the others' errors.
            shares: (s, 3, 3) how they enter its own.
        """
        if self.tracked[robot]:
            self._forget_heard(robot)
        self.transform[robot] = transform
        self._isolate(robot, covariance)
        others = (columns[:, None] + np.arange(3)).reshape(-1)
        mapping = shares.transpose(1, 0, 2).reshape(3, -1)
        self.filter.relate(robot_columns(np.array([robot]))[0], others, mapping)
        self.accounted[robot] = gathered
        self.accounted_ns[robot] = stamp_ns
        self.tracked[robot] = True
        self.fresh[robot] = False
        self.gated_in_a_row[robot] = 0
        self.clues.pop(robot, None)

    def lose(self, robot: int) -> None:
        """Take the robot out of the estimate; it waits for a fix."""
        self._isolate(robot, np.eye(3))
        self._forget_heard(robot)
        self.tracked[robot] = False
        self.fresh[robot] = False
        self.gated_in_a_row[robot] = 0

    def _forget_heard(self, robot: int) -> None:
        """Let go of what the robot has heard, and others of it: its errors now are others."""
        for gone in (self.heard_robot == robot, np.s_[robot]):
            self.heard_robot[gone], self.heard_ns[gone] = -1, NEVER_NS

    def _isolate(self, robot: int, covariance: FloatArray) -> None:
        """Give the pose this covariance (3, 3) and the parameters theirs at the beginning."""
        self.filter.place(robot_columns(np.array([robot]))[0], covariance)
        estimated = np.flatnonzero(self._table.column[robot] >= 0)
        sigma = self._table.sigma[robot, estimated]
        self.filter.place(self._table.column[robot, estimated], np.diag(sigma**2))
        self.parameter[robot] = 0.0

    def parameter_sigma(self, robot: int) -> FloatArray:
        """Standard deviations (PARAMETERS,) of a robot's parameters; zero of those not estimated."""
        column = self._table.column[robot]
        variance = np.where(column >= 0, np.diag(self.filter.covariance)[column], 0.0)
        sigma: FloatArray = np.sqrt(variance)
        return sigma

    def landmark_covariance(self, landmark: int) -> FloatArray:
        """Covariance (3, 3) of the right-invariant error of a landmark that is estimated."""
        own = self.landmark_column(landmark) + np.arange(3)
        covariance: FloatArray = self.filter.covariance[np.ix_(own, own)]
        return covariance

    def landmark_column(self, landmark: int) -> int:
        """First filter column of the error of a landmark that is estimated."""
        return int(self._table.survey_column[landmark])


def robot_columns(robots: NDArray[np.int64]) -> IndexArray:
    """Filter columns (k, 3) of robots (k,)."""
    columns: IndexArray = 3 * robots[:, None] + np.arange(3)
    return columns
