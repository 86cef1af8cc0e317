"""Steps of the joint filter: robots enter and leave, measurements are fused in order or together."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core import judgement, se2
from swarm_loc_estimator.core.fix import ClueBook
from swarm_loc_estimator.core.measurements import Kind, MeasurementArray, MeasurementColumns
from swarm_loc_estimator.core.odometry import OdometryTracks
from swarm_loc_estimator.core.parameters import ParameterTable
from swarm_loc_estimator.core.repetition import remember, remember_clue
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.state import SwarmState
from swarm_loc_estimator.core.swarm import Swarm

_HEARD = 32
"""A robot remembers what so many others have told it by infrared."""
_MANY = 64
"""From so many measurements on, one update with all of them costs less than one each, at any swarm size."""


class Verdict(IntEnum):
    """What became of a measurement."""

    OPEN = judgement.OPEN  # not looked at yet
    USED = judgement.USED
    GATED = judgement.GATED  # its innovation is too unlikely
    CLUE = 3  # kept to locate a robot that waits
    UNTIED = 4  # neither side is located, or a robot has sent no odometry


class Fusion:
    """The steps of the filter over one swarm.

    Args:
        swarm: Who takes part.
        settings: Limits for giving a robot up.
        tracks: The robots' odometry.
    """

    def __init__(self, swarm: Swarm, settings: EstimatorSettings, tracks: OdometryTracks) -> None:
        self._tracks = tracks
        self._limits = (settings.lost_sigma, settings.lost_heading_sigma, settings.lost_after)
        self._together = settings.fusion_period_s > 0.0
        self._starts = {
            i: (
                np.array(r.start),
                np.diag(np.square([r.start_sigma.x, r.start_sigma.y, r.start_sigma.theta])),
            )
            for i, r in enumerate(swarm.robots)
            if r.start is not None
        }
        self._clues = ClueBook(tracks, settings.fix_window_s)
        self._table = ParameterTable.of(swarm.robots, swarm.landmarks)
        self._places = _HEARD if any(robot.ir is not None for robot in swarm.robots) else 0

    def new_state(self) -> SwarmState:
        """Nothing is known yet."""
        return SwarmState(self._table, self._places)

    def with_starts(self, state: SwarmState, stamp_ns: int) -> SwarmState:
        """The state, together with those robots at their starts about whom there was no measurement yet."""
        ready = [robot for robot in self._starts if self._may_enter(state, robot, stamp_ns)]
        if ready:
            state = state.copy()
            for robot in ready:
                self._enter_at_start(state, robot)
        return state

    def _may_enter(self, state: SwarmState, robot: int, stamp_ns: int) -> bool:
        """Whether the robot may enter at its configured start: its odometry has begun by `stamp_ns`."""
        return bool(state.fresh[robot]) and robot in self._starts and self._tracks.begun(robot, stamp_ns)

    def _enter_at_start(self, state: SwarmState, robot: int) -> None:
        start, covariance = self._starts[robot]
        transform = se2.compose(start, se2.inverse(self._tracks.arrays.begin_pose[robot]))
        begin_ns = int(self._tracks.arrays.begin_ns[robot])
        state.enter(robot, transform, se2.error_covariance(start, covariance), np.zeros((2, 3, 3)), begin_ns)

    def _enter_those_measured(self, state: SwarmState, measurements: MeasurementArray) -> bool:
        """Let robots enter at their starts with the first measurement (m,) about them; whether any did.

        Not before: only a measurement about a robot is computed again when its first odometry arrives late.
        """
        entered = False
        for side in ("observer", "target"):
            new = np.append(state.fresh, False)[measurements[side]]  # NOBODY (-1) finds the last
            for robot, stamp_ns in zip(measurements[side][new], measurements["stamp_ns"][new], strict=True):
                if self._may_enter(state, int(robot), int(stamp_ns)):
                    self._enter_at_start(state, int(robot))
                    entered = True
        return entered

    def step(
        self, state: SwarmState, measurements: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse measurements into the state.

        One after the other, each at its exact stamp; or, where many share a period of `fusion_period_s`,
        together: each is related to the poses at its own stamp, but the noise gathered between the stamps
        is taken at their mean per robot.

        Args:
            state: Changed in place.
            measurements: (m,) in order of their stamps.
            verdicts: (m,) written, of `Verdict`.
            nis: (m,) normalised innovations squared, written; NaN where there is none.
        """
        nis[:] = np.nan
        many = measurements.size >= _MANY
        if self._together and many and np.all(measurements["kind"] < Kind.SEAT):
            self._fuse_together(state, measurements, verdicts, nis)
        else:
            self._fuse_in_order(state, measurements, verdicts, nis)

    def _fuse_in_order(
        self, state: SwarmState, measurements: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        columns = MeasurementColumns.of(measurements)
        k = 0
        while True:
            k, reason, robot = judgement.fuse_in_order(
                columns, k, self._tracks.arrays, state.arrays(), self._limits, verdicts, nis
            )
            if reason == judgement.FINISHED:
                return
            if reason == judgement.LOST:
                state.lose(robot)
                continue
            one = measurements[k : k + 1]
            if one["kind"][0] >= Kind.SEAT:
                verdicts[k] = self._obey(state, one)
            elif self._enter_those_measured(state, one):
                continue
            else:
                verdicts[k] = self._note(state, one)
            k += 1

    def _fuse_together(
        self, state: SwarmState, measurements: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        self._enter_those_measured(state, measurements)
        known = np.append(state.tracked, True)  # NOBODY (-1) finds the last
        tied = known[measurements["observer"]] & known[measurements["target"]]
        rows = np.flatnonzero(tied)
        if rows.size:
            poses, motion, lost = self._advance(state, measurements[rows])
            good = ~(lost[measurements["observer"][rows]] | lost[measurements["target"][rows]])
            tied[rows[~good]] = False
            rows = rows[good]
            verdicts[rows], nis[rows] = self._update(state, measurements[rows], poses[good], motion[good])
        for k in np.flatnonzero(~tied):
            verdicts[k] = self._note(state, measurements[k : k + 1])

    def _advance(
        self, state: SwarmState, measurements: MeasurementArray
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Predict the robots involved to the mean of their measurements; those unsure where they are leave.

        Returns:
            Poses (m, 2, 3) of observers and targets at the stamps, their relative motion (m, 3), and (N + 1,)
            whether each robot, and nobody, was lost.
        """
        motion = np.zeros((measurements.size, 3))
        poses, lost = np.zeros((measurements.size, 2, 3)), np.zeros(state.tracked.size + 1, dtype=bool)
        columns = MeasurementColumns.of(measurements)
        judgement.advance_all(
            columns, self._tracks.arrays, state.arrays(), self._limits, poses, motion, lost[:-1]
        )
        for robot in np.flatnonzero(lost):
            state.lose(int(robot))
        return poses, motion, lost

    def _update(
        self, state: SwarmState, measurements: MeasurementArray, poses: FloatArray, motion: FloatArray
    ) -> tuple[NDArray[np.uint8], FloatArray]:
        """Judge measurements (m,) against one belief, use those that pass; return verdicts and their NIS."""
        m = measurements.size
        columns = np.empty((m, judgement.DEPENDS_ON), dtype=np.int64)
        jacobian = np.empty((m, 3, judgement.DEPENDS_ON))
        difference, noise, predicted = np.empty((m, 3)), np.empty((m, 3, 3)), np.empty((m, 3))
        passed, nis = np.empty(m, dtype=bool), np.empty(m)
        fields = MeasurementColumns.of(measurements)
        judgement.judge_all(
            fields,
            state.arrays(),
            poses,
            motion,
            columns,
            jacobian,
            difference,
            noise,
            predicted,
            passed,
            nis,
        )
        for k in np.flatnonzero(passed & (measurements["lasting"] > 0.0).any(axis=1)).tolist():
            remember(fields, k, state.arrays(), predicted[k], noise[k])
        if passed.any():
            correction = state.filter.update(
                columns[passed], jacobian[passed], difference[passed], noise[passed]
            )
            judgement.correct(state.arrays(), correction)
        for robot in np.flatnonzero(judgement.count_all(fields, state.arrays(), passed, self._limits[2])):
            state.lose(int(robot))
        return np.where(passed, Verdict.USED, Verdict.GATED).astype(np.uint8), nis

    def _note(self, state: SwarmState, one: MeasurementArray) -> Verdict:
        """Keep a measurement (1,) as a clue if it ties a waiting robot to something located."""
        if not self._clues.note(state, one):
            return Verdict.UNTIED
        remember_clue(MeasurementColumns.of(one), 0, state.arrays())
        return Verdict.CLUE

    def _obey(self, state: SwarmState, order: MeasurementArray) -> Verdict:
        """Seat a robot anew or forget it, as the order (1,) says."""
        robot = int(order["target"][0])
        if order["kind"][0] == Kind.FORGET:
            state.lose(robot)
            return Verdict.USED
        if not self._tracks.begun(robot, int(order["stamp_ns"][0])):
            return Verdict.UNTIED
        track = self._tracks.at(order["target"], order["stamp_ns"])
        pose, covariance = order["value"][0], order["covariance"][0]
        transform = se2.compose(pose, se2.inverse(track.pose[0]))
        stamp_ns = int(order["stamp_ns"][0])
        state.enter(robot, transform, se2.error_covariance(pose, covariance), track.gathered[0], stamp_ns)
        return Verdict.USED
