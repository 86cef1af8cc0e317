"""Steps of the joint EKF: initialize and deinitialize robots, fuse measurements in order or in batches."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.filter import correlated_noise, models, sources, update
from swarm_loc_estimator.filter.joint_filter import JointFilter, Robots
from swarm_loc_estimator.filter.measurements import (
    NOBODY,
    Command,
    CommandKind,
    LossReason,
    Measurements,
    Verdict,
    select,
)
from swarm_loc_estimator.filter.sparse.sparse_filter import SparseFilter
from swarm_loc_estimator.filter.state import (
    IN_MAP,
    InitialPose,
    Innovations,
    Meetings,
    SwarmState,
    correct,
    new_innovations,
)
from swarm_loc_estimator.identification.picture import AMBIGUOUS
from swarm_loc_estimator.initialization.initializer import ConfiguredStarts, Initializer, Keep, LocalFrame
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.swarm.calibration_states import ParameterTable
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.aerial_images import PictureFusion, as_fixes, relieve_seen
from swarm_loc_estimator.timeline.map_scans import FoundPlace, MapScans, Sweeps
from swarm_loc_estimator.timeline.map_search import MapSearch, described_map
from swarm_loc_estimator.timeline.robots_in_scans import RobotsInScans
from swarm_loc_estimator.timeline.settings import Settings

_SURER_AT_FIRST = 1.5  # `lost_heading_sigma` over the greatest sigma of the heading at initialization
_PAIRS_PER_ROBOT = 32  # Maximum number of observed robots per robot with a mean of infrared measurements
_SETTLING_NS = 10_000_000_000  # A camera that is contradicted again so soon is suspended
_AT_ONCE_NS, _MANY = 60_000_000_000, 3
"""If so many exact landmarks are contradicted within this time, the description is wrong as a whole."""
_NO: Any = np.False_


class Fusion:
    """Filter steps for one swarm, with its odometry and the sweeps of its lidars by robot and stamp."""

    def __init__(self, swarm: Swarm, settings: Settings, tracks: OdometryTracks, sweeps: Sweeps) -> None:
        self._tracks = tracks
        self._policy = settings.policy
        self._limits = sources.LossLimits(
            settings.lost_sigma, settings.lost_heading_sigma, settings.lost_after, settings.max_fault_score
        )
        self._period_ns = round(settings.fusion_period_s * 1e9)
        self.is_sparse = settings.is_sparse(swarm)  # Whether only covariances of neighbours are kept
        self._is_large = len(swarm.robots) >= self._policy.large_from
        self.starts = ConfiguredStarts(swarm, tracks)
        surer = settings.lost_heading_sigma / _SURER_AT_FIRST
        self._initializer = Initializer(tracks, settings.fix_window_s, surer)
        self._local = LocalFrame(swarm, tracks, self._initializer, settings.origin_after_s)
        self._pictures = PictureFusion(swarm, settings, tracks)
        self._scans = MapScans(swarm, settings, tracks, sweeps)
        # The known map of states from the beginning; None: there is none
        self._search, self.map = MapSearch(self._scans, swarm), described_map(swarm)
        self._sees_robots = [robot.lidar.sees_robots for robot in swarm.robots]
        self._others = RobotsInScans(swarm, settings, self._scans) if any(self._sees_robots) else None
        robots, surveyed = len(swarm.robots), len(swarm.surveyed)
        self._sides = robots, 3 * robots + surveyed
        self._first_mount, self._first_direction = surveyed - len(swarm.cameras), 2 * robots + surveyed
        self._sees = [robot.camera is not None for robot in swarm.robots]
        self._table = ParameterTable.of(
            swarm.robots, swarm.surveyed, swarm.map_error, in_blocks=self.is_sparse
        )
        self._pairs = _PAIRS_PER_ROBOT if any(robot.ir is not None for robot in swarm.robots) else 0

    def new_state(self) -> SwarmState:
        """Create the initial state, without localized robots."""
        joint: JointFilter | None = SparseFilter(self._table) if self.is_sparse else None
        state = SwarmState(self._table, self._pairs, joint)
        state.map = self.map
        return state

    def step(
        self,
        state: SwarmState,
        measurements: Measurements,
        commands: Sequence[Command],
        verdicts: NDArray[np.uint8],
        nis: FloatArray,
    ) -> None:
        """Fuse measurements (m,) into the state, and execute commands at their stamps; all sorted by stamp.

        Few measurements are fused sequentially, each at its exact stamp. Many within `fusion_period_s` are
        fused as one batch: each uses the poses at its own stamp, but the process noise of a robot until its
        first measurement of the period. Verdicts (m,) and normalized innovations squared (m,), NaN if not
        evaluated, are written.
        """
        nis[:] = np.nan
        begin = 0
        for command in commands:
            end = int(measurements.stamp_ns.searchsorted(command.stamp_ns, side="right"))
            self._fuse_all(state, measurements, slice(begin, end), verdicts, nis)
            self._execute(state, command)
            begin = end
        self._fuse_all(state, measurements, slice(begin, measurements.size), verdicts, nis)

    def _fuse_all(
        self,
        state: SwarmState,
        measurements: Measurements,
        rows: slice,
        verdicts: NDArray[np.uint8],
        nis: FloatArray,
    ) -> None:
        """Fuse rows of measurements; scans and images become fixes before."""
        some, verdicts, nis = select(measurements, rows), verdicts[rows], nis[rows]
        for part in _parts(some):
            model = int(some.model[part.start]) if some.size else models.CARTESIAN
            way = {models.ANONYMOUS: self._fuse_image, models.SCAN: self._fuse_scan}.get(model, self._fuse)
            way(state, select(some, part), verdicts[part], nis[part])

    def _fuse(
        self, state: SwarmState, measurements: Measurements, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse measurements of identified robots, in `map` or in a local frame."""
        for part, is_absolute in self._local.parts(state, measurements):
            some = select(measurements, part)
            if is_absolute:
                verdicts[part] = self._note(state, some.row(0), self._local.collect)
            elif state.filter.is_dense and not (
                self._period_ns and self._is_large and some.size >= self._policy.batch_from
            ):
                self._fuse_in_order(state, some, verdicts[part], nis[part])
            else:
                for one in correlated_noise.without_repeats(some):
                    self._fuse_together(state, select(some, one), verdicts[part][one], nis[part][one])

    def _fuse_image(
        self, state: SwarmState, image: Measurements, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse the anonymous detections of an aerial image."""
        stamp_ns = int(image.stamp_ns[0])
        if state.origin != IN_MAP:  # images are in `map`, where they identify robots by their motion
            state.frame_moves += 1
            self._local.leave(state, stamp_ns)
        state.meetings = Meetings()
        self.starts.initialize_pending(state, stamp_ns)
        # Detections of located robots become fixes.
        assignment = self._pictures.assigned(state, image)
        known = assignment.robot >= 0
        if known.any():
            fixes, outcome = as_fixes(select(image, known), assignment.robot[known]), verdicts[known]
            own_nis = nis[known]
            self._fuse(state, fixes, outcome, own_nis)
            verdicts[known], nis[known] = outcome, own_nis
            relieve_seen(state, assignment.robot[known][outcome == Verdict.USED])
        # The others may be robots that are not located.
        are_searched = self._pictures.identify(state, image, assignment)
        unknown = Verdict.CONSTRAINT if are_searched else Verdict.UNASSIGNED
        unclear = assignment.robot[~known] == AMBIGUOUS
        verdicts[~known] = np.where(unclear, Verdict.AMBIGUOUS, unknown)

    def _fuse_scan(
        self, state: SwarmState, one: Measurements, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse the scan (1,) of a lidar: the robots that it sees, then its place in the map."""
        self.starts.initialize_measured(state, one)
        robot, stamp_ns = int(one.target[0]), int(one.stamp_ns[0])
        if state.map is not None and (state.origin != IN_MAP or not state.tracked[robot]):
            found, verdicts[:] = self._search.place_of(state, one.row(0))
            if found is not None:
                self._set_pose(state, robot, stamp_ns, found.pose, found.covariance)
            return
        state.places.pop(robot, None)
        sweep, verdicts[:] = self._scans.sweep_of(one.row(0)), Verdict.NOT_LOCALIZED
        if sweep is None or not state.tracked[robot]:
            return
        if self._others is not None and self._sees_robots[robot]:
            self.starts.initialize_pending(state, stamp_ns)  # they may never measure anything themselves
            sweep, sighted = self._others.seen(state, one.row(0), sweep)
            if sighted.size:
                own = np.zeros(sighted.size, dtype=np.uint8), np.zeros(sighted.size)
                self._fuse(state, sighted, *own)
                verdicts[:] = Verdict.USED if (own[0] == Verdict.USED).any() else Verdict.UNASSIGNED
        if state.map is None or not state.tracked[robot]:
            return
        fix, verdicts[:], confirms = self._scans.fix_of(state, one.row(0), sweep, self._search.around)
        if isinstance(fix, FoundPlace):
            # where one scan does not tell its place alone, others must agree before it is tracked
            confirmations = sources.CONFIRMED + float(confirms)
            self._set_pose(state, robot, stamp_ns, fix.pose, fix.covariance, confirmations)
        elif fix is not None:
            known, before = state.sources.confirmations, state.sources.confirmations.copy()
            self._fuse(state, fix, verdicts, nis)
            if not confirms:
                np.minimum(known, before, out=known)

    def _fuse_in_order(
        self, state: SwarmState, measurements: Measurements, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse measurements one by one, each linearized about the newest belief; the filter is dense."""
        k, stage, tracks, limits = 0, update.PREDICT, self._tracks.arrays, self._limits
        while True:
            belief = state.arrays()
            if stage == update.PREDICT:
                work = new_innovations(1, *self._sides)
            k, why, source, loss = update.fuse(
                measurements, k, stage, False, tracks, belief, limits, work, verdicts, nis
            )
            stage = update.PREDICT
            if why == update.FINISHED:
                return
            if why == update.IS_LINK:
                update.evaluate_link(measurements.row(k), 0, tracks, belief, state.filter, work)
                stage = update.ATTRIBUTE
            elif why == update.LOST:
                state.deinitialize(source, LossReason(loss), int(measurements.stamp_ns[k]))
                # one that was not evaluated is fused again, as is a fix that locates the lost robot alone
                if loss != LossReason.UNCERTAIN and (
                    verdicts[k] == Verdict.USED or not models.locates_alone(measurements, k)
                ):
                    k += 1
            elif why == update.CONTRADICTED:
                self._augment(state, source, int(measurements.stamp_ns[k]))
            elif not self.starts.initialize_measured(state, select(measurements, slice(k, k + 1))):
                verdicts[k] = self._note(state, measurements.row(k))
                k += 1

    def _fuse_together(
        self, state: SwarmState, measurements: Measurements, verdicts: NDArray[np.uint8], nis: FloatArray
    ) -> None:
        """Fuse measurements (m,) as one batch, linearized about one belief."""
        self.starts.initialize_measured(state, measurements)
        known = np.append(state.tracked, True)  # index NOBODY (-1) selects the last element
        tied = known[measurements.observer] & known[measurements.target]
        if tied.any():
            some = measurements if tied.all() else select(measurements, tied)
            verdicts[tied], nis[tied] = self._update(state, some)
            # robots that the prediction lost may be located again
            tied[tied] = verdicts[tied] != Verdict.OPEN
        untied = np.flatnonzero(~tied)
        sides = zip(measurements.observer[untied], measurements.target[untied], strict=True)
        for k, (observer, target) in zip(untied.tolist(), sides, strict=True):
            # the common case before a swarm is localized; the loop itself may initialize robots
            if state.is_known(observer) == state.is_known(target):
                verdicts[k] = Verdict.NOT_LOCALIZED
            else:
                verdicts[k] = self._note(state, measurements.row(k))

    def _update(self, state: SwarmState, rows: Measurements) -> tuple[NDArray[np.uint8], FloatArray]:
        """Fuse measurements (m,) between localized robots together; return verdicts and NIS (m,).

        Verdicts of measurements of robots that are lost by the prediction are OPEN.
        """
        verdicts, nis = np.zeros(rows.size, dtype=np.uint8), np.full(rows.size, np.nan)
        tracks, limits, newest_ns = self._tracks.arrays, self._limits, int(rows.stamp_ns[-1])
        # Predict; measurements of robots that are too uncertain now are left out.
        work = new_innovations(rows.size, *self._sides)
        update.fuse(rows, 0, update.PREDICT, True, tracks, state.arrays(), limits, work, verdicts, nis)
        lost = work.lost > 0
        self._deinitialize(state, work, newest_ns)
        good = ~(lost[rows.observer] | lost[rows.target])
        if not good.any():
            return verdicts, nis
        if not good.all():
            rows, before = select(rows, good), work
            work = new_innovations(rows.size, *self._sides)
            work.pose[:], work.motion[:] = before.pose[good], before.motion[good]
        outcome, own_nis = verdicts[good], nis[good]
        # Evaluate, links by their records, and attribute.
        belief = state.arrays()
        places = Robots(
            self._poses(state, np.full(state.tracked.size, newest_ns))[:, :2], state.tracked.copy()
        )
        state.filter.prepare_update(update.related_columns(rows, belief), places, work.cross_covariance)
        stage, why, links = update.EVALUATE, update.IS_LINK, np.flatnonzero(~models.is_compiled(rows.model))
        while why == update.IS_LINK:
            returned = update.fuse(rows, 0, stage, True, tracks, belief, limits, work, outcome, own_nis)
            stage, why = update.ATTRIBUTE, returned[1]
            for k in links.tolist() if why == update.IS_LINK else ():
                update.evaluate_link(rows.row(k), k, tracks, belief, state.filter, work)
        # Correct and count.
        if work.accepted.any():
            used = slice(None) if work.accepted.all() else work.accepted
            evaluated = (work.jacobian[used], work.innovation[used], work.noise[used])
            covariances = state.pose_covariances()
            correction = state.filter.update(work.columns[used], *evaluated)
            belief = state.arrays()  # the update may have reallocated them
            correct(belief, correction)
            correlated_noise.note_batch(rows, belief, covariances, work)
        update.fuse(rows, 0, update.SETTLE, True, tracks, belief, limits, work, outcome, own_nis)
        lost = work.lost > 0
        self._deinitialize(state, work, newest_ns)
        for source in np.flatnonzero(work.contradicted).tolist():
            self._augment(state, source, newest_ns)
        for k in np.flatnonzero(~work.accepted & lost[rows.target]).tolist():
            if models.locates_alone(rows, k) and not state.tracked[rows.target[k]]:
                outcome[k] = self._note(state, rows.row(k))
        verdicts[good], nis[good] = outcome, own_nis
        return verdicts, nis

    @staticmethod
    def _deinitialize(state: SwarmState, work: Innovations, stamp_ns: int) -> None:
        """Deinitialize the robots that are marked as lost, and unmark them."""
        for robot in np.flatnonzero(work.lost).tolist():
            state.deinitialize(robot, LossReason(int(work.lost[robot])), stamp_ns)
        work.lost[:] = 0

    def _poses(self, state: SwarmState, stamps_ns: IntArray) -> FloatArray:
        """Poses (N, 3) of all robots in `map` at instants (N,)."""
        robots = np.arange(state.tracked.size)
        return se2.compose(state.transform, self._tracks.at(robots, stamps_ns).pose)

    def _note(self, state: SwarmState, one: Measurements, keep: Keep | None = None) -> Verdict:
        """Store a row of measurements as a constraint if it can initialize a robot, or what `keep` does."""
        initializes, keep = models.MODELS[int(one.model)].initializes, keep or self._initializer.note
        alone = initializes == "alone"
        if self._is_suspended(state, one):
            return Verdict.GATED
        direction = self._first_direction + int(one.target)
        if one.observer == NOBODY and state.sources.score[direction] >= self._limits.max_fault_score:
            one = one._replace(has_heading=_NO, has_second=_NO)
        if not initializes or not keep(state, correlated_noise.at_initialization(one) if alone else one):
            return Verdict.NOT_LOCALIZED
        sides = np.array([one.observer, one.target])
        if self._pairs and (sides >= 0).all() and alone:
            tracks = self._tracks.at(sides, np.repeat(one.stamp_ns, 2))
            correlated_noise.record_constraint(one, state.arrays(), tracks)
        return Verdict.CONSTRAINT

    def _is_suspended(self, state: SwarmState, one: Measurements) -> bool:
        """Whether the camera or fixes of a row are suspended; those of a lost robot recover."""
        if one.observer != NOBODY or int(one.model) not in models.COMPILED:
            return False
        robots, score, limit = state.tracked.size, state.sources.score, self._limits.max_fault_score
        robot, last_ns = int(one.target), state.sources.measured_ns
        source = self._first_direction - robots + robot if one.mount == NOBODY else robots + int(one.mount)
        if score[source] >= limit and one.stamp_ns - last_ns[robot] >= sources.CORRELATION_NS:
            last_ns[robot], score[source] = one.stamp_ns, score[source] - sources.RELIEF
        return bool(score[source] >= limit)

    def _augment(self, state: SwarmState, source: int, stamp_ns: int) -> None:
        """Open a contradicted source: parameters of a robot, or the place of a landmark or camera.

        A kidnapped robot is deinitialized. So is one without a camera, whose marker may be turned. A camera
        that is contradicted again is suspended.
        """
        robots, limit = state.tracked.size, self._limits.max_fault_score
        if source < robots and (sources.is_kidnapped(state.sources, source) or not self._sees[source]):
            links, score = state.sources.source[source], state.sources.score
            suspect = (score[links[(links >= robots) & (links < score.size)]] >= sources.SUSPECT).any()
            if not self._sees[source] and not suspect:
                direction = self._first_direction + source
                score[direction] = max(score[direction], limit + 1.0)
            state.deinitialize(source, LossReason.KIDNAPPED, stamp_ns)
            return
        # where they are predicted to: other poses change with later odometry, and nothing is fused again
        poses = self._poses(state, state.predicted_to_ns)
        again_ns = state.contradicted_ns[source] + _SETTLING_NS
        state.contradicted_ns[source] = stamp_ns
        if source >= robots + self._first_mount:
            state.augment(source, poses[0])
            state.sources.score[source] = 2.0 * limit if stamp_ns < again_ns else 0.0
            return
        exact, contradicted_ns = self._table.survey_column < 0, state.contradicted_ns[robots:]
        are_many = np.sum(exact & (contradicted_ns > stamp_ns - _AT_ONCE_NS)) >= _MANY
        is_wrong = are_many or sources.bad_share(state.sources, stamp_ns) >= sources.DOUBTED_SHARE
        if is_wrong and not state.is_doubted and robots <= self._policy.reopen_all_up_to:
            state.augment_all(poses)
        else:
            state.augment(source, poses[min(source, robots - 1)])

    def _execute(self, state: SwarmState, command: Command) -> None:
        """Set the pose of a robot, or deinitialize it, or change the map."""
        robot, stamp_ns = command.robot, command.stamp_ns
        if command.kind == CommandKind.NEW_MAP:
            state.map = command.map
            state.places.clear()
            return
        if command.kind == CommandKind.FORGET:
            state.deinitialize(robot, LossReason.COMMAND, stamp_ns)
            if state.origin != IN_MAP and not state.tracked.any():
                self._local.leave(state, stamp_ns)
            return
        if self._tracks.has_started(robot, stamp_ns):
            self._set_pose(state, robot, stamp_ns, command.pose, command.covariance)

    def _set_pose(
        self,
        state: SwarmState,
        robot: int,
        stamp_ns: int,
        pose: FloatArray,
        covariance: FloatArray,
        confirmations: float = sources.WELL_CONFIRMED,
    ) -> None:
        """Set a robot to a pose (3,) in `map` with covariance (3, 3)."""
        track = self._tracks.at(np.array([robot]), np.array([stamp_ns]))
        transform = se2.compose(pose, se2.inverse(track.pose[0]))
        at = Preintegrated(stamp_ns, track.covariance[0], track.jacobian[0])
        initial = InitialPose(transform, se2.error_covariance(pose, covariance))
        if state.origin == IN_MAP:
            state.initialize(robot, initial, at, confirmations)
        else:
            self._local.move_to_map(state, robot, initial, at)


_NO_IMAGE_NS = np.iinfo(np.int64).min


def _parts(measurements: Measurements) -> list[slice]:
    """Parts of measurements (m,) in order that are fused in one way: an aerial image, a scan, or others."""
    anonymous, scan = (measurements.model == model for model in (models.ANONYMOUS, models.SCAN))
    if not (anonymous.any() or scan.any()):
        return [slice(0, measurements.size)]
    image_ns = np.where(anonymous, measurements.stamp_ns, _NO_IMAGE_NS)
    changes = (np.diff(image_ns) != 0) | scan[1:] | scan[:-1]
    edges = [0, *(np.flatnonzero(changes) + 1).tolist(), measurements.size]
    return [slice(begin, end) for begin, end in itertools.pairwise(edges)]
