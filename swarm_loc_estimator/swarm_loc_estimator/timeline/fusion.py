"""Steps of the joint EKF: initialize and deinitialize robots, fuse measurements in order or in batches."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.filter import sequential_update
from swarm_loc_estimator.filter.batch_update import (
    assess_all,
    confirm_all,
    count_all_gated,
    evaluate_all,
    predict_all,
    related_columns,
)
from swarm_loc_estimator.filter.belief import correct
from swarm_loc_estimator.filter.correlated_noise import (
    at_initialization,
    record_constraint,
    record_pair,
    without_repeats,
)
from swarm_loc_estimator.filter.innovation import InnovationBatch, new_batch
from swarm_loc_estimator.filter.integrity import WELL_CONFIRMED, LossLimits, is_kidnapped
from swarm_loc_estimator.filter.joint_filter import JointFilter, Robots, update_one
from swarm_loc_estimator.filter.measurement_model import (
    MODELS,
    POLAR,
    Command,
    Kind,
    MeasurementArray,
    MeasurementColumns,
    locates_alone,
)
from swarm_loc_estimator.filter.model_evaluation import evaluate_by_records
from swarm_loc_estimator.filter.prediction import learn_all
from swarm_loc_estimator.filter.sequential_update import update_in_order
from swarm_loc_estimator.filter.sparse.sparse_filter import SparseFilter
from swarm_loc_estimator.filter.state import IN_MAP, InitialPose, Meetings, SwarmState
from swarm_loc_estimator.identification.assignment import AMBIGUOUS
from swarm_loc_estimator.initialization.initializer import ConfiguredStarts, Initializer, Keep, LocalFrame
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.sensor import chosen
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.aerial_images import PictureFusion, as_fixes, relieve_seen
from swarm_loc_estimator.timeline.map_scans import MapScans, Sweeps
from swarm_loc_estimator.timeline.settings import Settings, middle_of_period, parts_by_way
from swarm_loc_estimator.timeline.verdicts import Verdict

_SURER_AT_FIRST = 1.5
"""`lost_heading_sigma` over the maximum standard deviation of the heading at initialization."""
_PAIRS_PER_ROBOT = 32
"""Maximum number of observed robots per robot with a stored mean of infrared measurements."""
_CONTRADICTED_DESCRIPTION, _CONTRADICTED_WITHIN_NS = 2, 60_000_000_000
"""All parameters are re-estimated if this number of robots and landmarks is contradicted in this time."""


class Fusion:
    """Filter steps for one swarm.

    Args:
        swarm: Robots and landmarks.
        settings: Fusion period and thresholds.
        tracks: Odometry of the robots.
        sweeps: Sweeps of lidars by robot and stamp.

    Attributes:
        is_sparse: True for a large swarm: only covariances of neighbours are kept.
        starts: Initializes robots at their configured starts.
    """

    def __init__(self, swarm: Swarm, settings: Settings, tracks: OdometryTracks, sweeps: Sweeps) -> None:
        self._tracks = tracks
        self._policy = settings.policy
        self._limits = LossLimits(
            settings.lost_sigma, settings.lost_heading_sigma, settings.lost_after, settings.max_fault_score
        )
        self._period_ns = round(settings.fusion_period_s * 1e9)
        self.is_sparse = settings.is_sparse(swarm)
        self._is_large = len(swarm.robots) >= self._policy.large_from
        self.starts = ConfiguredStarts(swarm, tracks)
        surer = settings.lost_heading_sigma / _SURER_AT_FIRST
        self._initializer = Initializer(tracks, settings.fix_window_s, surer)
        self._local = LocalFrame(swarm, tracks, self._initializer, settings.origin_after_s)
        self._pictures = PictureFusion(swarm, settings, tracks)
        self._scans = MapScans(swarm, settings, tracks, sweeps)
        self._table = ParameterTable.of(swarm.robots, swarm.surveyed, in_blocks=self.is_sparse)
        self._pairs = _PAIRS_PER_ROBOT if any(robot.ir is not None for robot in swarm.robots) else 0

    def new_state(self) -> SwarmState:
        """Create the initial state, without localized robots."""
        joint: JointFilter | None = SparseFilter(self._table) if self.is_sparse else None
        return SwarmState(self._table, self._pairs, joint)

    def step(
        self, state: SwarmState, measurements: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse measurements into the state.

        Few measurements are fused sequentially, each at its exact stamp. Many within `fusion_period_s` are
        fused as one batch: each uses the poses at its own stamp, but the process noise at the middle of the
        period.

        Args:
            state: Updated in place.
            measurements: (m,) sorted by stamp.
            verdicts: (m,) written, of `Verdict`.
            nis: (m,) normalized innovation squared, written; NaN if not evaluated.
        """
        nis[:] = np.nan
        ways = {int(Kind.ANONYMOUS): self._fuse_image, int(Kind.SCAN): self._fuse_scan}
        for part in parts_by_way(measurements):
            fuse = ways.get(int(measurements["kind"][part.start]), self._fuse)
            fuse(state, measurements[part], verdicts[part], nis[part])

    def _fuse(
        self, state: SwarmState, measurements: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse measurements of identified robots, in `map` or in a local frame."""
        for part, is_absolute in self._local.parts(state, measurements):
            some = measurements[part]
            if not is_absolute:
                self._fuse_in_frame(state, some, verdicts[part], nis[part])
            elif some["command"][0] != Command.NONE:
                verdicts[part] = self._apply_command(state, some)
            else:
                verdicts[part] = self._note(state, some, self._local.collect)

    def _fuse_in_frame(
        self, state: SwarmState, measurements: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse measurements, all of them in the frame of the poses."""
        measured = measurements["command"] == Command.NONE
        if state.filter.is_dense:
            many = self._is_large and measurements.size >= self._policy.batch_from
            if self._period_ns and many and measured.all():
                self._fuse_together(state, measurements, verdicts, nis)
            else:
                self._fuse_in_order(state, measurements, verdicts, nis)
            return
        edges = [0, *(np.flatnonzero(np.diff(measured)) + 1).tolist(), measurements.size]
        for begin, end in itertools.pairwise(edges):
            part = slice(begin, end)
            if measured[begin]:
                self._fuse_together(state, measurements[part], verdicts[part], nis[part])
            else:
                self._fuse_in_order(state, measurements[part], verdicts[part], nis[part])

    def _fuse_image(
        self, state: SwarmState, image: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse the anonymous detections of an aerial image."""
        if state.origin != IN_MAP:  # images are in `map`, where they identify robots by their motion
            state.frame_moves += 1
            self._local.leave(state)
        state.meetings = Meetings()
        self.starts.initialize_pending(state, int(image["stamp_ns"][0]))
        assignment = self._pictures.assigned(state, image)
        known = assignment.robot >= 0
        if known.any():
            fixes, fates = as_fixes(image[known], assignment.robot[known]), verdicts[known]
            squares = nis[known]
            self._fuse(state, fixes, fates, squares)
            verdicts[known], nis[known] = fates, squares
            relieve_seen(state, assignment.robot[known][fates == Verdict.USED])
        unknown = (
            Verdict.CONSTRAINT if self._pictures.identify(state, image, assignment) else Verdict.UNASSIGNED
        )
        unclear = assignment.robot[~known] == AMBIGUOUS
        verdicts[~known] = np.where(unclear, Verdict.AMBIGUOUS, unknown)

    def _fuse_scan(
        self, state: SwarmState, one: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse the scan (1,) of a lidar."""
        self.starts.initialize_measured(state, one)
        fix, verdicts[:] = self._scans.fix_of(state, one)
        if fix is not None:
            self._fuse(state, fix, verdicts, nis)

    def _fuse_in_order(
        self, state: SwarmState, measurements: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        columns = MeasurementColumns.of(measurements)
        k = 0
        while True:
            k, reason, robot = update_in_order(
                columns, k, self._tracks.arrays, state.arrays(), self._limits, verdicts, nis
            )
            if reason == sequential_update.FINISHED:
                return
            if reason == sequential_update.LOST:
                state.deinitialize(robot)
                continue
            if reason == sequential_update.CONTRADICTED:
                self._augment(state, robot, int(measurements["stamp_ns"][k]))
                continue
            one = measurements[k : k + 1]
            if one["command"][0] != Command.NONE:
                verdicts[k] = self._apply_command(state, one)
            elif self.starts.initialize_measured(state, one):
                continue
            elif state.is_known(one["observer"][0]) and state.is_known(one["target"][0]):
                verdict = self._fuse_by_record(state, one, nis[k : k + 1])
                if verdict == Verdict.OPEN:
                    continue
                verdicts[k] = verdict
            else:
                verdicts[k] = self._note(state, one)
            k += 1

    def _fuse_by_record(self, state: SwarmState, one: MeasurementArray, nis: FloatArray) -> Verdict:
        """Fuse a measurement (1,) of a model without a kernel; OPEN if one of its robots was lost.

        Args:
            state: Updated in place; its filter is dense.
            one: Measurement (1,) between localized robots.
            nis: (1,) normalized innovation squared, written.
        """
        fields = MeasurementColumns.of(one)
        batch, lost = self._predict(state, fields, int(one["stamp_ns"][0]))
        if lost.any():
            return Verdict.OPEN
        belief, accepted = state.arrays(), batch.accepted
        evaluate_by_records(one, self._tracks.arrays, belief, state.filter, batch)
        assess_all(fields, belief, self._limits, batch)
        nis[:] = batch.nis
        gone = confirm_all(fields, belief, accepted)
        if accepted[0]:
            evaluated = batch.columns[0], batch.jacobian[0], batch.innovation[0], batch.noise[0]
            correct(belief, update_one(belief.covariance, *evaluated)[0])
            learn_all(fields, belief, batch.pose)
        gone |= count_all_gated(fields, belief, accepted, self._limits)
        for robot in np.flatnonzero(gone).tolist():
            state.deinitialize(robot)
        return Verdict.USED if accepted[0] else Verdict.GATED

    def _fuse_together(
        self, state: SwarmState, measurements: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        for part in without_repeats(measurements):
            self._fuse_part(state, measurements[part], verdicts[part], nis[part])

    def _fuse_part(
        self, state: SwarmState, measurements: MeasurementArray, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse measurements (m,) as one batch, linearized about one belief."""
        self.starts.initialize_measured(state, measurements)
        known = np.append(state.tracked, True)  # index NOBODY (-1) selects the last element
        tied = known[measurements["observer"]] & known[measurements["target"]]
        if tied.any():
            rows = measurements if tied.all() else measurements[tied]
            fields = MeasurementColumns.of(rows)
            middle_ns = middle_of_period(int(fields.stamp_ns[0]), self._period_ns)
            batch, lost = self._predict(state, fields, middle_ns)
            good = ~(lost[fields.observer] | lost[fields.target])
            if not good.all():
                rows, fields, batch = rows[good], chosen(fields, good), chosen(batch, good)
                tied[tied] = good
            if good.any():
                verdicts[tied], nis[tied] = self._update(state, rows, fields, batch)
        untied = np.flatnonzero(~tied)
        sides = zip(measurements["observer"][untied], measurements["target"][untied], strict=True)
        for k, (observer, target) in zip(untied.tolist(), sides, strict=True):
            # the common case before a swarm is localized; the loop itself may initialize robots
            if state.is_known(observer) == state.is_known(target):
                verdicts[k] = Verdict.NOT_LOCALIZED
            else:
                verdicts[k] = self._note(state, measurements[k : k + 1])

    def _predict(
        self, state: SwarmState, fields: MeasurementColumns, stamp_ns: int
    ) -> tuple[InnovationBatch, BoolArray]:
        """Predict the involved robots to an instant; deinitialize those that are too uncertain.

        Returns:
            A batch (m,) with poses and motion, and (N + 1,) True for lost robots; the last element is NOBODY.
        """
        batch, lost = new_batch(fields.stamp_ns.size), np.zeros(state.tracked.size + 1, dtype=bool)
        predict_all(fields, stamp_ns, self._tracks.arrays, state.arrays(), self._limits, batch, lost[:-1])
        for robot in np.flatnonzero(lost):
            state.deinitialize(int(robot))
        return batch, lost

    def _update(
        self, state: SwarmState, rows: MeasurementArray, fields: MeasurementColumns, batch: InnovationBatch
    ) -> tuple[NDArray[np.uint8], FloatArray]:
        """Gate measurements (m,) and update with the accepted ones; return verdicts and NIS (m,).

        Args:
            state: Updated in place; the involved robots are predicted.
            rows: (m,) measurements between localized robots.
            fields: (m,) the same measurements as columns.
            batch: (m,) with poses and motion.
        """
        belief, accepted, newest_ns = state.arrays(), batch.accepted, int(fields.stamp_ns[-1])
        state.filter.prepare_update(
            related_columns(fields, belief),
            Robots(self._poses(state, newest_ns)[:, :2], state.tracked.copy()),
            batch.cross_covariance,
        )
        evaluate_all(fields, belief, batch)
        evaluate_by_records(rows, self._tracks.arrays, belief, state.filter, batch)
        contradicted = assess_all(fields, belief, self._limits, batch)
        lost = confirm_all(fields, belief, accepted)
        systematic = (fields.systematic_share > 0.0).any(axis=1) & (fields.kind <= POLAR)
        for k in np.flatnonzero(accepted & systematic).tolist():
            record_pair(fields, k, belief, batch.pair[k])
        if accepted.any():
            used = slice(None) if accepted.all() else accepted
            evaluated = (batch.jacobian[used], batch.innovation[used], batch.noise[used])
            correction = state.filter.update(batch.columns[used], *evaluated)
            belief = state.arrays()  # the update may have reallocated them
            correct(belief, correction)
            learn_all(fields, belief, batch.pose)
        lost |= count_all_gated(fields, belief, accepted, self._limits)
        for robot in np.flatnonzero(lost):
            state.deinitialize(int(robot))
        for source in np.flatnonzero(contradicted).tolist():
            self._augment(state, source, newest_ns)
        verdicts = np.where(accepted, Verdict.USED, Verdict.GATED).astype(np.uint8)
        for k in np.flatnonzero(~accepted & lost[fields.target]).tolist():
            if locates_alone(fields, k) and not state.tracked[fields.target[k]]:
                verdicts[k] = self._note(state, rows[k : k + 1])
        return verdicts, batch.nis

    def _poses(self, state: SwarmState, stamp_ns: int) -> FloatArray:
        """Poses (N, 3) of all robots in `map` at an instant."""
        robots = np.arange(state.tracked.size)
        return se2.compose(state.transform, self._tracks.at(robots, np.full(robots.size, stamp_ns)).pose)

    def _note(self, state: SwarmState, one: MeasurementArray, keep: Keep | None = None) -> Verdict:
        """Store a measurement (1,) as a constraint if it can initialize a robot, or what `keep` does."""
        model, keep = MODELS[int(one["kind"][0])], keep or self._initializer.note
        if model.constraint is None and model.degrees_of_freedom > 1:
            return Verdict.NOT_LOCALIZED
        noted = one if model.constraint is None else at_initialization(model.constraint(one))
        if not keep(state, noted):
            return Verdict.NOT_LOCALIZED
        sides = np.array([one["observer"][0], one["target"][0]])
        if self._pairs and (sides >= 0).all() and one["kind"][0] <= POLAR:
            tracks = self._tracks.at(sides, np.repeat(one["stamp_ns"], 2))
            record_constraint(MeasurementColumns.of(one), 0, state.arrays(), tracks)
        return Verdict.CONSTRAINT

    def _augment(self, state: SwarmState, source: int, stamp_ns: int) -> None:
        """Re-estimate the parameters of a contradicted robot or landmark; deinitialize a kidnapped robot."""
        robots = state.tracked.size
        if source < robots and is_kidnapped(state.integrity, source):
            state.deinitialize(source)
            return
        poses = self._poses(state, stamp_ns)
        state.contradicted_ns[source] = stamp_ns
        lately = np.sum(state.contradicted_ns > stamp_ns - _CONTRADICTED_WITHIN_NS)
        if (
            lately < _CONTRADICTED_DESCRIPTION
            or state.all_augmented
            or robots > self._policy.reopen_all_up_to
        ):
            state.augment(source, poses[min(source, robots - 1)])
        else:
            state.augment_all(poses)

    def _apply_command(self, state: SwarmState, command: MeasurementArray) -> Verdict:
        """Execute a command (1,): set the pose of a robot or deinitialize it."""
        robot, stamp_ns = int(command["target"][0]), int(command["stamp_ns"][0])
        if command["command"][0] == Command.FORGET:
            state.deinitialize(robot)
            return Verdict.USED
        if not self._tracks.has_started(robot, stamp_ns):
            return Verdict.NOT_LOCALIZED
        track = self._tracks.at(command["target"], command["stamp_ns"])
        pose, covariance = command["value"][0], command["covariance"][0]
        transform = se2.compose(pose, se2.inverse(track.pose[0]))
        at = Preintegrated(stamp_ns, track.covariance[0], track.jacobian[0])
        initial = InitialPose(transform, se2.error_covariance(pose, covariance))
        if state.origin == IN_MAP:
            state.initialize(robot, initial, at, WELL_CONFIRMED)
        else:
            self._local.move_to_map(state, robot, initial, at)
        return Verdict.USED
