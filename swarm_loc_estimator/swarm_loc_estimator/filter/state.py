"""Complete filter state at one instant, whose copy is a checkpoint, and its arrays for compiled code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.numerics import composed, moved_by_twist, wrap
from swarm_loc_estimator.common.se2 import error_covariance
from swarm_loc_estimator.filter.joint_filter import DenseFilter, JointFilter
from swarm_loc_estimator.filter.measurements import NOBODY, LossReason
from swarm_loc_estimator.identification.memory import IdentityMemory
from swarm_loc_estimator.odometry.preintegration import Preintegrated
from swarm_loc_estimator.swarm.calibration_states import PARAMETERS, ParameterTable

NEVER_NS = np.iinfo(np.int64).min
PAIR_ROWS = 10  # Rows of three numbers stored per pair, see `correlated_noise.py`
DEPENDS_ON = 9
"""Filter columns per measurement: three of the observer, three of the target, three of the observer's camera,
of which those of a range are the biases of both radios."""
_LINKS = 16  # Most recent links of a robot that are remembered
_DOUBTED_POSE_SIGMA = (0.02, 0.02, 0.03)  # Added to the pose of a contradicted robot [m, m, rad]
_REOPENED_POSE_SIGMA = (0.06, 0.06, 0.12)
"""Standard deviation of poses after all parameters are reset to their priors [m], [m], [rad]."""
_ALONE: IntArray = np.zeros(0, dtype=np.int64)
_NO_SHARES: FloatArray = np.zeros((0, 3, 3))


class SourceArrays(NamedTuple):
    """What is known of sources (S,) and of links of robots (N, K), see `sources.py`."""

    source: IntArray  # (N, K) source that each robot has a link with; -1: none
    seen_ns: IntArray  # (N, K) stamp of the newest measurement of the link
    finding: IntArray  # (N, K) what it says: AGREES, DRIFTS, DEVIATES or ELSEWHERE
    evidence: FloatArray  # (N, K) evidence against the link
    # (N, K, 2) mean of the last whitened innovations; of a radio, the second is the share of repeated values
    drift: FloatArray
    # (N, K, 10) x, y of the target as seen last [m], and `learned` of the robot then. Of two radios the
    # range, what counts of their ranges from here, x, y of both antennas by odometry [m], the newest whitened
    # innovation, the variance of what does not repeat [m^2], the innovation of the range [m], and the
    # variance of the predicted range after it was used [m^2]
    last_look: FloatArray
    score: FloatArray  # (S,) fault score
    confirmations: FloatArray  # (N,) number of measurements that agree with the robot's initial pose
    gated: FloatArray  # (N,) number of gated measurements since the last accepted one
    measured_ns: IntArray  # (N,) stamp of the newest accepted measurement
    learned: FloatArray  # (N,) sum of the logarithms by which updates have reduced the variance
    excess: FloatArray  # (N, 3, 3) covariance of each robot's error beyond that of the filter


class BeliefArrays(NamedTuple):
    """Views of the arrays of a `SwarmState` and its `JointFilter`, which describe them."""

    transform: FloatArray
    covariance: FloatArray
    marginal: FloatArray
    transition: FloatArray
    parameter: FloatArray
    landmark: FloatArray
    table: ParameterTable
    predicted_to_ns: IntArray
    preintegrated_covariance: FloatArray
    preintegrated_jacobian: FloatArray
    tracked: BoolArray
    last_fix_ns: IntArray
    sources: SourceArrays
    pair_robot: IntArray
    pair_stamp_ns: IntArray
    pair_history: FloatArray
    is_dense: bool


class Innovations(NamedTuple):
    """Measurements (m,) evaluated at one belief, and reused buffers for one evaluation."""

    # (m, 2, 3) observers and targets in `map` at the stamps; of a landmark, its pose correction
    pose: FloatArray
    # (m, 3) rate of change of xi_target - xi_observer by driving [1/s], see `relative_motion`
    motion: FloatArray
    # (m, 3, 6) of the observer's error with the target's, and of the target's with the parameters of the
    # observer's camera
    cross_covariance: FloatArray
    columns: IntArray  # (m, DEPENDS_ON) filter columns
    jacobian: FloatArray  # (m, 3, DEPENDS_ON) Jacobian of the innovation
    innovation: FloatArray  # (m, 3) measured minus predicted
    noise: FloatArray  # (m, 3, 3) measurement covariances for the update
    pair: FloatArray  # (m, PAIR_ROWS, 3) new mean of the pair, stored if used, see `correlated_noise`
    # (m,) squared, Mahalanobis, that is gated; of a marker's position without small errors
    distance: FloatArray
    whitened: FloatArray  # (m, 2) innovation of the position over its deviation, as for `distance`
    place: FloatArray  # (m, 2) where the observer sees the target, predicted [m]; of a range, the range
    share: FloatArray  # (m,) by how much it counts, see `sources.share_of`
    elsewhere: BoolArray  # (m,) whether no wrong description explains the innovation
    misread: BoolArray  # (m,) whether the direction of a marker is read turned by a quarter or more
    accepted: BoolArray  # (m,) True if the innovation passes the gate
    nis: FloatArray  # (m,) normalized innovation squared
    lost: IntArray  # (N + 1,) why a robot is lost (`LossReason`), 0: it is not; the last element is NOBODY
    contradicted: BoolArray  # (N + L,) True for robots and landmarks that are contradicted
    predicted: FloatArray  # (3,) value
    other: FloatArray  # (3,) innovation of the second solution
    value_jacobian: FloatArray  # (3, 6) Jacobian of the value, see `models.predict`
    relative_covariance: FloatArray  # (3, 3) covariance of xi_target - xi_observer
    innovation_covariance: FloatArray  # (3, 3) covariance of the innovation
    variances: FloatArray  # (3,) of the predicted value


@cached_njit
def new_innovations(count: int, robots: int, sources: int) -> Innovations:
    """Allocate innovations of `count` measurements; `sources` are robots and landmarks."""
    motion, innovation = np.zeros((2, count, 3))
    whitened, place = np.zeros((2, count, 2))
    distance, share, nis = np.zeros((3, count))
    elsewhere, misread, accepted = np.zeros((3, count), dtype=np.bool_)
    predicted, other, variances = np.zeros((3, 3))
    linear = np.zeros((count, DEPENDS_ON), dtype=np.int64), np.zeros((count, 3, DEPENDS_ON)), innovation
    update = np.zeros((count, 3, 3)), np.zeros((count, PAIR_ROWS, 3)), distance, whitened, place, share
    lost = np.zeros(robots + 1, dtype=np.int64), np.zeros(sources, dtype=np.bool_)
    buffers = predicted, other, np.zeros((3, 6)), np.zeros((3, 3)), np.zeros((3, 3)), variances
    sides = np.zeros((count, 2, 3)), motion, np.zeros((count, 3, 6))
    return Innovations(*sides, *linear, *update, elsewhere, misread, accepted, nis, *lost, *buffers)


@cached_njit
def own_covariance(belief: BeliefArrays, robot: int) -> FloatArray:
    """Writable covariance matrix that `own_column` indexes: joint, or the robot's marginal."""
    if belief.is_dense:
        return belief.covariance
    own: FloatArray = belief.marginal[robot]
    return own


@inlined_njit
def own_column(belief: BeliefArrays, robot: int, which: int) -> int:
    """Column of `own_covariance`: `which` 0 to 2 for the pose, from 3 on for parameters; -1: none."""
    column: int = 3 * robot + which if which < 3 else belief.table.column[robot, which - 3]
    if not belief.is_dense and column >= 0:
        column = which
    return column


@inlined_njit
def covariance_within(belief: BeliefArrays, column: int, i: int, j: int) -> float:
    """Element (i, j) of the covariance (3, 3) of the body with this first column."""
    whole, own = belief.covariance, belief.marginal
    within: float = whole[column + i, column + j] if belief.is_dense else own[column // 3, i, j]
    return within


@inlined_njit
def own_within(belief: BeliefArrays, robot: int, i: int, j: int) -> float:
    """Element of the covariance of a robot's pose and parameters, indexed as by `own_column`."""
    whole, own = belief.covariance, belief.marginal
    if belief.is_dense:
        return float(whole[own_column(belief, robot, i), own_column(belief, robot, j)])
    return float(own[robot, i, j])


@inlined_njit
def to_map(belief: BeliefArrays, robot: int, pose: FloatArray) -> None:
    """Transform a pose (3,) from the robot's track to `map`, in place."""
    t = belief.transform[robot]
    pose[0], pose[1], theta = composed(t[0], t[1], t[2], pose[0], pose[1], pose[2])
    pose[2] = wrap(theta)


@cached_njit
def correct(belief: BeliefArrays, correction: FloatArray) -> None:
    """Apply a filter's correction (n,) to localized robots, their parameters and landmarks."""
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
        if first >= 0:
            mark, c = belief.landmark[i], correction[first : first + 3]
            if belief.table.first_anchor <= i < belief.table.first_camera:
                mark += c
                continue
            mark[0], mark[1], mark[2] = moved_by_twist(c[0], c[1], c[2], mark[0], mark[1], mark[2])


def new_sources(robots: int, surveyed: int) -> SourceArrays:
    """All fault scores zero, no link known."""
    links = (robots, _LINKS)
    return SourceArrays(
        source=np.full(links, -1),
        seen_ns=np.full(links, NEVER_NS // 2),
        finding=np.zeros(links, dtype=np.int64),
        evidence=np.zeros(links),
        drift=np.zeros((*links, 2)),
        last_look=np.full((*links, 10), np.nan),
        score=np.zeros(3 * robots + surveyed),
        confirmations=np.zeros(robots),
        gated=np.zeros(robots),
        measured_ns=np.zeros(robots, dtype=np.int64),
        learned=np.zeros(robots),
        excess=np.zeros((robots, 3, 3)),
    )


IN_MAP = -1  # Origin of poses in `map`


class Meetings(NamedTuple):
    """Pairs of robots that have seen each other while nobody was located, and when the first did."""

    first_ns: int = NEVER_NS
    pairs: frozenset[tuple[int, int]] = frozenset()


class InitialPose(NamedTuple):
    """Pose of an odometry track, to initialize a robot.

    The error is the sum of an independent part and of mapped errors of other bodies.
    """

    transform: FloatArray  # (3,) T, from `map` to the track's frame
    covariance: FloatArray  # (3, 3) of the independent part of the right-invariant error
    columns: IntArray = _ALONE  # (s,) first filter columns of the other bodies
    shares: FloatArray = _NO_SHARES  # (s, 3, 3) Jacobians of the error with respect to theirs

    def whole_covariance(self, shared: Mapping[int, FloatArray]) -> FloatArray:
        """Covariance (3, 3) of the error, from those of the other bodies by their columns."""
        covariance: FloatArray = self.covariance.copy()
        for column, share in zip(self.columns.tolist(), self.shares, strict=True):
            covariance += share @ shared[column] @ share.T
        return covariance


class Starts(NamedTuple):
    """Initial poses of the tracks of robots (k,), with independent errors."""

    transform: FloatArray  # (k, 3) T, from `map` to the tracks' frames
    covariance: FloatArray  # (k, 3, 3) of the right-invariant errors
    stamp_ns: IntArray  # (k,) instants of initialization
    preintegrated_covariance: FloatArray  # (k, 3, 3) of the tracks at these instants
    preintegrated_jacobian: FloatArray  # (k, 3, 3) of the tracks at these instants


class SwarmState:
    """Joint belief over all robots.

    Args:
        table: Parameters estimated besides the poses.
        pairs: Maximum number of observed robots per robot with a stored mean.
        joint: A new filter of the table's size; dense by default.
    """

    def __init__(self, table: ParameterTable, pairs: int = 0, joint: JointFilter | None = None) -> None:
        robots, landmarks = table.column.shape[0], table.survey_column.size
        self._table = table
        # (N, 3) T, from `map` to the frame of the robot's odometry track
        self.transform: FloatArray = np.zeros((robots, 3))
        self.parameter: FloatArray = np.zeros((robots, PARAMETERS))  # see `swarm/calibration_states.py`
        self.landmark: FloatArray = np.zeros((landmarks, 3))  # Correction of each surveyed pose, in `map`
        # Covariance of the errors: columns 3i..3i+2 for the right-invariant pose error of robot i, columns of
        # the table for its parameters and for landmarks
        self.filter: JointFilter = DenseFilter(table.filter_size) if joint is None else joint
        self._set_described_priors()
        # (N,) instant to which the robot is predicted, and what its track has preintegrated then (N, 3, 3)
        self.predicted_to_ns: IntArray = np.zeros(robots, dtype=np.int64)
        self.preintegrated_covariance: FloatArray = np.zeros((robots, 3, 3))
        self.preintegrated_jacobian: FloatArray = np.zeros((robots, 3, 3))
        # (N,) whether the robot is part of the estimate, or may still begin at its configured start
        self.tracked: BoolArray = np.zeros(robots, dtype=bool)
        self.start_pending: BoolArray = np.ones(robots, dtype=bool)
        # (N,) stamp of the newest accepted landmark sighting or absolute fix
        self.last_fix_ns: IntArray = np.full(robots, NEVER_NS)
        self.sources = new_sources(robots, landmarks)
        # (N + L,) last contradiction of each robot and landmark, or of the whole description, see
        # `augment_all`
        self.contradicted_ns: IntArray = np.full(robots + landmarks, NEVER_NS)
        self.is_doubted = False
        # (N, pairs) robots observed by each one, -1: none, when, and the mean, see `correlated_noise.py`
        self.pair_robot: IntArray = np.full((robots, pairs), -1)
        self.pair_stamp_ns: IntArray = np.full((robots, pairs), NEVER_NS)
        self.pair_history: FloatArray = np.zeros((robots, pairs, PAIR_ROWS, 3))
        # Measurements (of `window.Window`) by robot that is not tracked, and whether they are of one degree
        # of freedom, see `initializer.py`; (N, 2) earliest instant of the next attempt to initialize it with
        # them
        self.windows: dict[tuple[int, bool], Any] = {}
        self.next_attempt_ns: IntArray = np.full((robots, 2), NEVER_NS)
        self.images: IdentityMemory | None = None  # None before the first aerial image
        self.delays: dict[tuple[int, int], Any] = {}  # `mapping.messages.DelayBelief` by robot and lidar
        self.map: Any = None  # Of lidars, of `map_search.SearchMap`; None: there is none yet
        # Where robots with lidars that are not located may be in it, of `map_search.PossiblePlaces`
        self.places: dict[int, Any] = {}
        # Robot whose pose was the origin when a local frame began, see `initializer.py`, how often all poses
        # have moved from one to `map`, and who has met while nobody was located
        self.origin, self.frame_moves, self.meetings = IN_MAP, 0, Meetings()
        # (N,) why the robot was deinitialized last (0: it never was), by what stamp, and how often by reason
        self.lost_why: IntArray = np.zeros(robots, dtype=np.int64)
        self.lost_ns: IntArray = np.full(robots, NEVER_NS)
        self.losses: IntArray = np.zeros(len(LossReason) + 1, dtype=np.int64)

    def copy(self) -> SwarmState:
        """Return an independent copy."""
        other = SwarmState.__new__(SwarmState)
        for name, value in vars(self).items():
            # arrays in dictionaries are replaced, never written to
            is_immutable = value is None or isinstance(value, tuple | int)
            setattr(other, name, value if is_immutable else value.copy())
        other.sources = SourceArrays(*(column.copy() for column in self.sources))
        return other

    def arrays(self) -> BeliefArrays:
        """Views for compiled code."""
        return BeliefArrays(
            self.transform,
            self.filter.covariance,
            self.filter.marginal,
            self.filter.transition,
            self.parameter,
            self.landmark,
            self._table,
            self.predicted_to_ns,
            self.preintegrated_covariance,
            self.preintegrated_jacobian,
            self.tracked,
            self.last_fix_ns,
            self.sources,
            self.pair_robot,
            self.pair_stamp_ns,
            self.pair_history,
            self.filter.is_dense,
        )

    def is_known(self, side: int) -> bool:
        """Whether a side of a measurement is localized: a tracked robot, or NOBODY for `map` itself."""
        return side == NOBODY or bool(self.tracked[side])

    def initialize(
        self, robot: int, initial: InitialPose, at: Preintegrated, confirmations: float = 0.0
    ) -> None:
        """Add a robot to the estimate, with a pose of its track at an instant that sightings confirm."""
        alone = (initial.transform, initial.covariance, at.stamp_ns, at.covariance, at.jacobian)
        self.start(np.array([robot]), Starts(*(np.array([one]) for one in alone)), confirmations)
        others = (initial.columns[:, None] + np.arange(3)).reshape(-1)
        mapping = initial.shares.transpose(1, 0, 2).reshape(3, -1)
        self.filter.correlate(robot_columns(np.array([robot]))[0], others, mapping)

    def start(self, robots: IntArray, starts: Starts, confirmations: float = 0.0) -> None:
        """Add robots (k,) with independent errors to the estimate, see `initialize`."""
        for robot in robots[self.tracked[robots]].tolist():
            self._forget_pairs(robot)
        self.transform[robots] = starts.transform
        self._decorrelate(robots, starts.covariance)
        self.predicted_to_ns[robots] = starts.stamp_ns
        self.preintegrated_covariance[robots] = starts.preintegrated_covariance
        self.preintegrated_jacobian[robots] = starts.preintegrated_jacobian
        self.tracked[robots] = True
        self.start_pending[robots] = False
        self._trust(robots, confirmations, starts.stamp_ns)
        for robot in robots.tolist():
            self.windows.pop((robot, False), None)
            self.windows.pop((robot, True), None)

    def move(self, robot: int, initial: InitialPose) -> None:
        """Move all poses rigidly such that one robot, predicted to the same instant, is at an initial pose.

        Its errors e are then those of the initial pose, which all others share: with the error xi_i of
        robot i before and Ad of the motion, e_i = e + Ad (xi_i - xi_robot). The filter must be dense.
        """
        motion = se2.compose(initial.transform, se2.inverse(self.transform[robot]))
        tracked = np.flatnonzero(self.tracked)
        self.transform[tracked] = se2.compose(motion, self.transform[tracked])
        columns, own = robot_columns(tracked), robot_columns(np.array([robot]))[0]
        mapping = np.eye(self.filter.covariance.shape[0])
        for one in columns:
            mapping[np.ix_(one, one)] = se2.adjoint(motion)
            mapping[np.ix_(one, own)] -= se2.adjoint(motion)
        covariance = mapping @ self.filter.covariance @ mapping.T
        others = (initial.columns[:, None] + np.arange(3)).reshape(-1)
        shares = initial.shares.transpose(1, 0, 2).reshape(3, -1)
        shared = initial.covariance + shares @ covariance[np.ix_(others, others)] @ shares.T
        rows = columns.reshape(-1)
        covariance[np.ix_(rows, rows)] += np.tile(shared, (len(columns), len(columns)))
        if others.size:
            cross = np.tile(shares @ covariance[others], (len(columns), 1))
            covariance[rows] += cross
            covariance[:, rows] += cross.T
        self.filter.covariance[:] = 0.5 * (covariance + covariance.T)
        self.windows.clear()
        self.sources.excess[:] = 0.0

    def deinitialize(self, robot: int, why: LossReason, stamp_ns: int) -> None:
        """Remove the robot from the estimate until a fix initializes it; a stamp shows why."""
        if self.tracked[robot]:
            self.lost_why[robot], self.lost_ns[robot] = why, stamp_ns
            self.losses[why] += 1
        self._decorrelate(np.array([robot]), np.eye(3)[None])
        self._forget_pairs(robot)
        self.tracked[robot] = False
        self.start_pending[robot] = False
        self._trust(np.array([robot]), 0.0, np.array([stamp_ns]))

    def augment(self, source: int, pose: FloatArray) -> None:
        """Estimate, or re-estimate, the parameters of a contradicted robot, or landmark (N plus its index).

        The covariance of the robot, at a pose (3,) in `map`, is widened.
        """
        robots = self.tracked.size
        self.sources.score[source] = 0.0
        self.sources.evidence[self.sources.source == source] = 0.0
        if source < robots:
            self.sources.evidence[source] = 0.0
        if source >= robots:
            landmark = source - robots
            is_new = self.landmark_column(landmark) < 0
            self._use_table(self._table.with_landmark(landmark))
            change = self.filter.set_prior if is_new else self.filter.add
            change(self.landmark_column(landmark) + np.arange(3), self._table.reopened[landmark])
            self._doubt_all_that_rest_on(source)
            return
        before = self._table.column[source]
        self._use_table(self._table.with_robot(source))
        columns, variances = self._table.column[source], self._table.sigma[source] ** 2
        again, new = before >= 0, (before < 0) & (columns >= 0)
        self.filter.add(columns[again], np.diag(variances[again]))
        self.filter.set_prior(columns[new], np.diag(variances[new]))
        doubt = error_covariance(pose, np.diag(np.square(_DOUBTED_POSE_SIGMA)))
        self.filter.add(robot_columns(np.array([source]))[0], doubt)

    def augment_all(self, poses: FloatArray) -> None:
        """Reset all parameters to their priors and re-estimate them; poses (N, 3) in `map` are kept."""
        robots, landmarks = self.tracked.size, self.landmark.shape[0]
        self.is_doubted = True
        table = self._table
        for robot in range(robots):
            table = table.with_robot(robot)
        for landmark in range(landmarks):
            table = table.with_landmark(landmark)
        self._use_table(table)
        self.parameter[:], self.landmark[:] = 0.0, 0.0
        sigma = np.diag(np.square(_REOPENED_POSE_SIGMA))
        covariances = np.where(self.tracked[:, None, None], error_covariance(poses, sigma), np.eye(3))
        self.filter.set_body_priors(np.arange(robots), covariances)
        self._set_described_priors()
        self.sources.score[: robots + landmarks], self.sources.evidence[:] = 0.0, 0.0

    def _use_table(self, table: ParameterTable) -> None:
        """Extend the filter to the columns of a larger table."""
        self.filter.append_columns(table)
        self._table = table

    def _doubt_all_that_rest_on(self, source: int) -> None:
        """Let robots with links to one source alone share the error of its place: they move with it."""
        links = self.sources.source
        only = ((links == source) | (links < 0)).all(axis=1) & (links == source).any(axis=1) & self.tracked
        if only.any() and self.filter.is_dense:
            landmark = source - self.tracked.size
            own = robot_columns(np.flatnonzero(only)).reshape(-1)
            columns = np.concatenate([own, self.landmark_column(landmark) + np.arange(3)])
            bodies = columns.size // 3
            self.filter.add(columns, np.tile(self._table.reopened[landmark], (bodies, bodies)))

    def _set_described_priors(self) -> None:
        """Set the described priors of all parameters and landmarks."""
        estimated = self._table.column >= 0
        self.filter.set_prior(self._table.column[estimated], np.diag(self._table.sigma[estimated] ** 2))
        for first, survey in zip(self._table.survey_column, self._table.survey, strict=True):
            if first >= 0:
                self.filter.set_prior(first + np.arange(3), survey)
        known = np.flatnonzero((self._table.survey_column >= 0) & self._table.shared.any(axis=(1, 2)))
        if known.size and self.filter.is_dense:
            shared = self._table.shared[known].reshape(3 * known.size, -1)
            apart = np.kron(1.0 - np.eye(known.size), np.ones((3, 3)))  # each one's own is in its survey
            columns = (self._table.survey_column[known][:, None] + np.arange(3)).ravel()
            self.filter.add(columns, apart * (shared @ shared.T))

    def _trust(self, robots: IntArray, confirmations: float, stamp_ns: IntArray) -> None:
        """Forget the links of robots (k,), and what was known of their errors."""
        state = self.sources
        state.gated[robots], state.score[robots], state.excess[robots] = 0.0, 0.0, 0.0
        state.confirmations[robots], state.measured_ns[robots] = confirmations, stamp_ns
        state.source[robots] = -1
        state.evidence[np.isin(state.source % state.score.size, robots)] = 0.0

    def _forget_pairs(self, robot: int) -> None:
        """Clear the stored means of all pairs of the robot: its new errors are independent of them."""
        for gone in (self.pair_robot == robot, np.s_[robot]):
            self.pair_robot[gone], self.pair_stamp_ns[gone] = -1, NEVER_NS

    def _decorrelate(self, robots: IntArray, covariances: FloatArray) -> None:
        """Set independent covariances (k, 3, 3) of poses (k,); keep the variances of parameters."""
        known = robots[self.tracked[robots]]  # parameters of other robots are uncorrelated already
        for robot in known[(self._table.column[known] >= 0).any(axis=1)].tolist():
            columns = self._table.column[robot, self._table.column[robot] >= 0]
            self.filter.set_prior(columns, np.diag(np.diag(self.filter.block(columns))))
        self.filter.set_body_priors(robots, covariances)

    def pose_covariances(self) -> FloatArray:
        """Covariances (N, 3, 3) of the pose errors of all robots."""
        if not self.filter.is_dense:
            return np.array(self.filter.marginal[: self.tracked.size, :3, :3])
        columns = robot_columns(np.arange(self.tracked.size))
        return np.asarray(self.filter.covariance[columns[:, :, None], columns[:, None, :]])

    def parameter_sigma(self, robot: int) -> FloatArray:
        """Standard deviations (PARAMETERS,) of a robot's parameters; zero if not estimated."""
        column = self._table.column[robot]
        sigma, estimated = np.zeros(column.size), column >= 0
        sigma[estimated] = np.sqrt(np.diag(self.filter.block(column[estimated])))
        return sigma

    def landmark_covariance(self, landmark: int) -> FloatArray:
        """Covariance (3, 3) of the right-invariant error of an estimated landmark."""
        return self.filter.block(self.landmark_column(landmark) + np.arange(3))

    def landmark_column(self, landmark: int) -> int:
        """First filter column of an estimated landmark."""
        return int(self._table.survey_column[landmark])


def robot_columns(robots: IntArray) -> IntArray:
    """Filter columns (k, 3) of robots (k,)."""
    columns: IntArray = 3 * robots[:, None] + np.arange(3)
    return columns
