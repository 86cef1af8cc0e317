"""Poses, landmarks and parameters of a recording by robust batch least squares over SE(2).

A robot's pose is X(t) = T(t) O(t) with the odometry track O, see `odometry/tracks.py`. Where wheels do not
slip, T is constant, so it is estimated only at a few instants per second. A sighting in between uses the
nearest of them; what the wheels may have slipped since then is added to its noise.

The first places are maps of single robots in the frames of their tracks, joined by what they share.

Errors are right-invariant, X = exp(xi) X_hat, as in the filter, whose measurement models and odometry noise
are used. Weights of Geman and McClure of whole sightings limit the influence of wrong ids; they are wide at
first, when places are far off (graduated non-convexity). Steps are those of Levenberg and Marquardt, with
sparse LU (SuperLU) of the normal equations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.filter.measurements import Measurements, select
from swarm_loc_estimator.filter.models import POLAR, is_compiled, predict
from swarm_loc_estimator.mapping.pose_graph import NormalFactor
from swarm_loc_estimator.odometry.track_arrays import OdometrySample
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.sensors.camera import CONTENT_POSE, CONTENT_POSE_TWO, SightingConverter
from swarm_loc_estimator.swarm.swarm import Landmark, Swarm

STEP_NS = 100_000_000  # Shortest time between two instants at which the transform of a track is estimated
MAX_KNOTS = 12_000
"""Maximum number of these instants, of all robots; those of long recordings are farther apart."""
_WITH_POSE = (CONTENT_POSE, CONTENT_POSE_TWO)
MIN_SIGHTINGS = 5  # Minimum number of sightings of a marker that is to be a landmark


@dataclass(frozen=True)
class Knots:
    """Instants at which transforms of tracks are estimated (k,), by robot and stamp."""

    robot: IntArray  # (k,) index of the robot
    stamp_ns: IntArray  # (k,) the instants
    sample: OdometrySample  # (k,) the tracks there

    def nearest(self, robots: IntArray, stamps_ns: IntArray) -> IntArray:
        """The nearest knots (m,) of robots at instants (m,); -1 for a robot without any, or none (-1)."""
        found = np.full(robots.size, -1)
        for robot in np.unique(robots[robots >= 0]).tolist():
            own = np.flatnonzero(self.robot == robot)
            rows = np.flatnonzero(robots == robot)
            if own.size:
                edges = (self.stamp_ns[own][1:] + self.stamp_ns[own][:-1]) // 2
                found[rows] = own[np.searchsorted(edges, stamps_ns[rows])]
        return found


@dataclass(frozen=True)
class SurveyProblem:
    """What is to be solved."""

    # The description with a landmark for each marker that belongs to nobody, at the origin where its place is
    # not known
    swarm: Swarm
    is_known: BoolArray  # (L,) whether the place of a landmark is described
    knots: Knots  # Instants at which transforms are estimated
    # (m,) measurements of cameras; markers of landmarks are in the landmark's own frame
    sightings: Measurements
    sides: IntArray  # (m, 2) knots of observer and target; -1: a landmark
    tracks: FloatArray  # (2, m, 3) poses of observer and target on their tracks
    slip: FloatArray  # (2, m, 3, 3) covariance of their slip since the knot, in the frame of the track
    odometry: OdometryTracks  # The tracks
    rare: dict[int, int]  # Number of sightings by id, of markers that were seen too rarely

    @property
    def is_polar(self) -> BoolArray:
        """Whether sightings (m,) are range and bearing."""
        return np.asarray(self.sightings.model == POLAR)


def problem_of(recording: Recording, swarm: Swarm) -> SurveyProblem:
    """Set up the problem of a recording; landmarks in the description are known places."""
    described, rare = _with_landmarks(recording, swarm)
    tracks = OdometryTracks(swarm.robots)
    rows, turns = recording.odometry, recording.turn_rates
    tracks.extend_turns(turns.robot, turns.stamp_ns, turns.rate)
    tracks.extend(rows.robot, rows.stamp_ns, rows.pose, rows.twist)
    seen = select(recording.detections, ~np.isin(recording.detections.detection["id"], list(rare)))
    at_origin = [
        replace(one, x=0.0, y=0.0, yaw=None if one.yaw is None else 0.0) for one in described.landmarks
    ]
    converter = SightingConverter(replace(described, landmarks=tuple(at_origin)))
    sightings = converter.convert(seen)
    # not directions alone, and not what fixed cameras see
    sightings = select(sightings, is_compiled(sightings.model) & (sightings.observer >= 0))
    knots = _knots(tracks, recording)
    robots = np.stack([sightings.observer, sightings.target])
    sides = np.stack([knots.nearest(one, sightings.stamp_ns) for one in robots])
    started = np.array([tracks.has_started(np.maximum(one, 0), sightings.stamp_ns) for one in robots])
    kept: BoolArray = np.asarray(((robots < 0) | (started & (sides >= 0))).all(axis=0))
    sightings, robots, sides = select(sightings, kept), robots[:, kept], sides[:, kept]
    known = {mark.id for mark in swarm.landmarks}
    poses, slip = np.zeros((2, sightings.size, 3)), np.zeros((2, sightings.size, 3, 3))
    for side in range(2):
        moves = sides[side] >= 0
        at = tracks.at(robots[side][moves], sightings.stamp_ns[moves])
        poses[side, moves] = at.pose
        since = at.covariance - knots.sample.covariance[sides[side][moves]]
        slip[side, moves] = since * np.sign(np.trace(since, axis1=1, axis2=2))[:, None, None]
    is_known = np.array([mark.id in known for mark in described.landmarks], dtype=bool)
    return SurveyProblem(described, is_known, knots, sightings, sides.T, poses, slip, tracks, rare)


def _with_landmarks(recording: Recording, swarm: Swarm) -> tuple[Swarm, dict[int, int]]:
    """The swarm with a landmark for each marker that belongs to nobody; and those that were seen rarely."""
    detections = recording.detections.detection
    ids, counts = np.unique(detections["id"], return_counts=True)
    unknown = {int(i): int(n) for i, n in zip(ids, counts, strict=True) if int(i) not in swarm.owner_of}
    rare = {marker_id: count for marker_id, count in unknown.items() if count < MIN_SIGHTINGS}
    with_heading = set(np.unique(detections["id"][np.isin(detections["content"], _WITH_POSE)]).tolist())
    new = [
        Landmark(marker_id, yaw=0.0 if marker_id in with_heading else None)
        for marker_id in unknown
        if marker_id not in rare
    ]
    return replace(swarm, landmarks=(*swarm.landmarks, *new)), rare


def _knots(tracks: OdometryTracks, recording: Recording) -> Knots:
    rows, robots, stamps = recording.odometry, [], []
    spans = {}
    for robot in np.unique(rows.robot).tolist():
        own = rows.stamp_ns[rows.robot == robot]
        spans[robot] = (int(own.min()), int(own.max()))
    whole_ns = sum(end - begin for begin, end in spans.values())
    step_ns = max(STEP_NS, whole_ns // MAX_KNOTS)
    for robot, (begin_ns, end_ns) in spans.items():
        at_ns = np.arange(begin_ns, end_ns + step_ns, step_ns)
        robots.append(np.full(at_ns.size, robot))
        stamps.append(np.minimum(at_ns, end_ns))
    robot, stamp_ns = np.concatenate(robots), np.concatenate(stamps)
    return Knots(robot, stamp_ns, tracks.at(robot, stamp_ns))


_AGREES_M = 0.15
"""Landmarks closer than this, or than a tenth of the distance between them, agree on an alignment."""


@dataclass
class Start:
    """Where all begin."""

    transform: FloatArray  # (N, 3) from the common frame to the track of each robot; NaN: not connected
    landmark: FloatArray  # (L, 3) poses; NaN: not connected


def start_of(problem: SurveyProblem) -> Start:
    """Join the maps of all robots that share landmarks or see each other.

    Begins with described landmarks and starts, else with the robot that has seen most landmarks, whose first
    pose is then the origin.
    """
    swarm = problem.swarm
    maps = [_map_of(problem, robot) for robot in range(len(swarm.robots))]
    start = Start(np.full((len(swarm.robots), 3), np.nan), np.full((len(swarm.landmarks), 3), np.nan))
    for index in np.flatnonzero(problem.is_known).tolist():
        mark = swarm.landmarks[index]
        start.landmark[index] = (mark.x, mark.y, mark.yaw or 0.0)
    for index, robot in enumerate(swarm.robots):
        if robot.start is not None and (problem.knots.robot == index).any():
            _place(problem, start, maps, index, _at_first(problem, index, np.array(robot.start)))
    if np.isnan(start.transform).all() and not problem.is_known.any():
        seen = [int(np.isfinite(one).all(axis=1).sum()) for one in maps]
        root = int(np.argmax(seen))
        _place(problem, start, maps, root, _at_first(problem, root, np.zeros(3)))
    while True:
        waiting = np.flatnonzero(np.isnan(start.transform[:, 0])).tolist()
        found = [(robot, *_alignment(problem, start, maps, robot)) for robot in waiting]
        found = [one for one in found if one[2] > 0.0]
        if not found:
            return start
        robot, transform, _ = max(found, key=lambda one: one[2])
        _place(problem, start, maps, robot, transform)


def _at_first(problem: SurveyProblem, robot: int, pose: FloatArray) -> FloatArray:
    """The transform of a robot's track with a pose (3,) at its first knot."""
    first = int(np.flatnonzero(problem.knots.robot == robot)[0])
    return se2.compose(pose, se2.inverse(problem.knots.sample.pose[first]))


def _map_of(problem: SurveyProblem, robot: int) -> FloatArray:
    """Poses (L, 3) of the landmarks that a robot has seen, in the frame of its track; NaN: not seen."""
    sightings, places = problem.sightings, np.full((len(problem.swarm.landmarks), 3), np.nan)
    rows = np.flatnonzero((sightings.observer == robot) & (sightings.landmark >= 0))
    seen = _seen_at(problem, rows, problem.tracks[0, rows])
    for index in np.unique(sightings.landmark[rows]).tolist():
        own = seen[sightings.landmark[rows] == index]
        x, y = np.median(own[:, :2], axis=0)
        heading = own[np.isfinite(own[:, 2]), 2]
        places[index] = (x, y, _median_angle(heading) if heading.size else 0.0)
    return places


def _seen_at(problem: SurveyProblem, rows: IntArray, observer: FloatArray) -> FloatArray:
    """Poses (k, 3) of the markers of sightings by robots at poses (k, 3); heading NaN: not seen."""
    some, is_polar = select(problem.sightings, rows), problem.is_polar[rows]
    value = some.value.copy()
    distance, bearing = value[is_polar, 0].copy(), value[is_polar, 1].copy()
    value[is_polar, 0], value[is_polar, 1] = distance * np.cos(bearing), distance * np.sin(bearing)
    seen = se2.compose(se2.compose(observer, some.sensor), value)
    seen[~some.has_heading, 2] = np.nan
    return seen


def _median_angle(angles: FloatArray) -> float:
    """The angle whose distance to all others is least in sum."""
    some = angles[:: max(1, angles.size // 200)]
    return float(some[np.argmin(np.abs(se2.wrap_angle(some[:, None] - angles)).sum(axis=1))])


def _place(
    problem: SurveyProblem, start: Start, maps: list[FloatArray], robot: int, transform: FloatArray
) -> None:
    """Place a robot's track, and the landmarks that nobody has placed before."""
    start.transform[robot] = transform
    new = np.isnan(start.landmark[:, 0]) & np.isfinite(maps[robot][:, 0]) & ~problem.is_known
    start.landmark[new] = se2.compose(transform, maps[robot][new])


def _alignment(
    problem: SurveyProblem, start: Start, maps: list[FloatArray], robot: int
) -> tuple[FloatArray, float]:
    """The transform of a robot's track on which most landmarks and robots agree, and how many do so."""
    own = maps[robot]
    both = np.flatnonzero(np.isfinite(own[:, 0]) & np.isfinite(start.landmark[:, 0]))
    candidates = [
        se2.rigid_fit(own[[i, j], :2], start.landmark[[i, j], :2])
        for i in both.tolist()
        for j in both.tolist()
        if i < j
    ]
    by_robots = _by_robots(problem, start, robot)
    candidates += by_robots[:: max(1, len(by_robots) // 50)]
    best, most = np.zeros(3), 0.0
    for candidate in candidates:
        moved = se2.transform_points(candidate, own[both, :2])
        size = 0.1 * np.linalg.norm(np.ptp(start.landmark[both, :2], axis=0)) if both.size else 0.0
        off = np.linalg.norm(moved - start.landmark[both, :2], axis=1)
        votes = float(np.sum(off < max(_AGREES_M, size))) - 1.0
        if len(by_robots):
            others = np.array(by_robots)
            near = np.linalg.norm(others[:, :2] - candidate[:2], axis=1) < 3.0 * _AGREES_M
            near &= np.abs(se2.wrap_angle(others[:, 2] - candidate[2])) < 0.5
            votes += 2.0 * float(near.mean())
        if votes > most:
            best, most = candidate, votes
    return best, most


def _by_robots(problem: SurveyProblem, start: Start, robot: int) -> list[FloatArray]:
    """Transforms of a robot's track by sightings with heading, between it and placed robots."""
    sightings = problem.sightings
    placed = np.isfinite(start.transform[:, 0])
    seen_by = np.flatnonzero((sightings.target == robot) & placed[sightings.observer] & sightings.has_heading)
    observers = se2.compose(start.transform[sightings.observer[seen_by]], problem.tracks[0, seen_by])
    markers = _seen_at(problem, seen_by, observers)
    bodies = se2.compose(markers, se2.inverse(sightings.marker[seen_by]))
    found = [*se2.compose(bodies, se2.inverse(problem.tracks[1, seen_by]))]
    sees = np.flatnonzero(
        (sightings.observer == robot)
        & (sightings.target >= 0)
        & placed[np.maximum(sightings.target, 0)]
        & sightings.has_heading
    )
    if sees.size:
        targets = se2.compose(start.transform[sightings.target[sees]], problem.tracks[1, sees])
        markers = se2.compose(targets, sightings.marker[sees])
        relative = _seen_at(problem, sees, problem.tracks[0, sees])
        found += [*se2.compose(markers, se2.inverse(relative))]
    return found


PRIORS: FloatArray = np.array([0.01, 0.03, 0.05, 0.05, 0.02])
"""Standard deviations of turn bias [rad/s], scales of path and of turn, camera yaw [rad] and camera scale."""
# The steps are checked by test_survey.py and make bench-commissioning, also with wrong scales of wheels.
_SCALES = (50.0, 20.0, 10.0, 5.0)
"""Residuals at which the weight of a sighting is a quarter [sigma], one after the other."""
_ITERATIONS, _CONVERGED, _NEARLY = 15, 1e-2, 1e-3
"""Most steps of each scale, and the decrease of the cost that ends them: of the last scale and, as a share of
the cost, of the others."""
_RISES = 2  # Most steps in a row that may raise the cost
_ORIGIN_SIGMA = 1e-5
_YAW_SIGMA = 1.0  # Of the heading of a landmark without one, which nothing determines [rad]
_DAMPING = (1e-14, 1e-2)
_LEAST_VARIANCE = 1e-10
"""Added to the variances of a step, so that the covariance of a standing robot is regular [m^2, rad^2]."""

Progress = Callable[[float, str], None]


@dataclass
class Solution:
    """Estimates with the covariance of their right-invariant errors."""

    knot: FloatArray  # (k, 3) transforms of the tracks at the knots
    landmark: FloatArray  # (L, 3) poses
    parameter: FloatArray  # (N, 5) errors of turn bias, path scale, turn scale, camera yaw and camera scale
    parameter_sigma: FloatArray  # (N, 5) their standard deviations
    landmark_covariance: FloatArray  # (L, 3, 3) of x, y, yaw
    frame_covariance: FloatArray  # (3, 3) of a knot in the middle: what is common to all is as uncertain
    weight: FloatArray  # (m,) of the sightings, from 0 for wrong ones to 1
    used: BoolArray  # (m,) whether both sides of the sighting are connected with the origin
    variance_ratio: float  # Mean squared residual of sightings by the described noise; 1 is ideal


class Solver:
    """Solves one problem; what is not connected at the start is left out."""

    def __init__(self, problem: SurveyProblem, start: Start) -> None:
        self._problem, knots = problem, problem.knots
        robots, landmarks = len(problem.swarm.robots), len(problem.swarm.landmarks)
        self._knot, self._landmark = start.transform[knots.robot], start.landmark.copy()
        self._parameter = np.zeros((robots, PRIORS.size))
        is_placed = np.isfinite(self._knot[:, 0])
        self._mark = problem.sightings.landmark
        targets = np.where(self._mark >= 0, np.isfinite(self._landmark[self._mark, 0]), True)
        for side in range(2):
            targets &= (problem.sides[:, side] < 0) | is_placed[problem.sides[:, side]]
        self.used: BoolArray = np.asarray(targets)
        self._rows = np.flatnonzero(self.used)
        # exactly described landmarks have no columns
        is_exact = np.array([not mark.is_estimated for mark in problem.swarm.landmarks], dtype=bool)
        free = np.isfinite(self._landmark[:, 0]) & ~(problem.is_known & is_exact)
        self._knot_column, next_column = _numbered(is_placed, 0)
        self._landmark_column, next_column = _numbered(free, next_column)
        self._parameter_column = next_column + np.arange(robots * PRIORS.size).reshape(robots, -1)
        self._size = next_column + robots * PRIORS.size
        self._pairs = _steps(problem, is_placed)
        self._weight, self._is_rigid = np.ones(self._rows.size), True
        self._robots, self._landmarks = robots, landmarks
        self._origin: FloatArray | None = None

    def solve(self, progress: Progress) -> Solution:
        """Solve, and compute covariances."""
        # first with exact odometry: all knots of a robot have the columns of its first one
        first = np.searchsorted(self._problem.knots.robot, self._problem.knots.robot)
        flexible, self._knot_column = self._knot_column, self._knot_column[first]
        self._descend(_SCALES[0])
        self._knot_column, self._is_rigid = flexible, False
        for k, scale in enumerate(_SCALES):
            progress(k / len(_SCALES), "solving")
            self._descend(scale)
        matrix, _, _ = self._normal(_SCALES[-1])
        return self._solution(matrix)

    def _descend(self, scale: float) -> None:
        """Minimize the cost at one scale of the weights.

        Large turns of the odometry frames leave errors of second order, which noise of steps makes expensive.
        The next steps remove them, so some of these may follow before a step is taken back.
        """
        damping, rises = _DAMPING[0], 0
        matrix, gradient, least = self._normal(scale)
        best = self._knot, self._landmark, self._parameter, matrix, gradient
        for _ in range(_ITERATIONS):
            self._apply(_factor(matrix, damping).solve(gradient))
            matrix, gradient, cost = self._normal(scale)
            if cost <= least:
                enough = _CONVERGED if scale == _SCALES[-1] else _NEARLY * least
                has_converged, least, rises = least - cost < enough, cost, 0
                best = self._knot, self._landmark, self._parameter, matrix, gradient
                damping = max(_DAMPING[0], 0.01 * damping)
                if has_converged:
                    return
            elif rises < _RISES:
                rises += 1
            else:
                self._knot, self._landmark, self._parameter, matrix, gradient = best
                damping, rises = 100.0 * damping, 0
                if damping > _DAMPING[1]:
                    return
        self._knot, self._landmark, self._parameter, *_ = best

    def _apply(self, step: FloatArray) -> None:
        """Move all estimates by a step (n,)."""
        self._knot, self._landmark = self._knot.copy(), self._landmark.copy()
        for pose, column in ((self._knot, self._knot_column), (self._landmark, self._landmark_column)):
            rows = np.flatnonzero(column >= 0)
            twist = step[column[rows][:, None] + np.arange(3)]
            pose[rows] = se2.compose(se2.exp(twist), pose[rows])
        self._parameter = self._parameter + step[self._parameter_column]

    def _normal(self, scale: float) -> tuple[csc_matrix, FloatArray, float]:
        """Normal matrix, right-hand side and robust cost, linearized at the estimates."""
        blocks = _Blocks()
        cost = self._add_priors(blocks) + (0.0 if self._is_rigid else self._add_odometry(blocks))
        residual, jacobian, columns = self._sightings()
        square = np.sum(residual**2, axis=1)
        self._weight = 1.0 / np.square(1.0 + square / scale**2)
        root = np.sqrt(self._weight)
        blocks.add(jacobian * root[:, None, None], columns, residual * root[:, None])
        cost += float(np.sum(square / (1.0 + square / scale**2)))
        return *blocks.normal(self._size), cost

    def _add_odometry(self, blocks: _Blocks) -> float:
        """Steps between consecutive knots: r = log(T_b T_a^-1) - Ad(T_a) D p."""
        a, b, root, response = self._pairs
        drift = se2.log(se2.compose(self._knot[b], se2.inverse(self._knot[a])))
        robot = self._problem.knots.robot[a]
        moved = np.einsum("kij,kj->ki", response, self._parameter[robot, :3])
        back = se2.adjoint(se2.inverse(self._knot[a]))  # to the frame of the track, where the noise is given
        residual = np.einsum("kij,kj->ki", root, np.einsum("kij,kj->ki", back, drift) - moved)
        by_pose = np.einsum("kij,kjl->kil", root, back)
        by_parameter = -np.einsum("kij,kjl->kil", root, response)
        jacobian = np.concatenate([-by_pose, by_pose, by_parameter], axis=2)
        columns = np.concatenate(
            [
                self._knot_column[a][:, None] + np.arange(3),
                self._knot_column[b][:, None] + np.arange(3),
                self._parameter_column[robot][:, :3],
            ],
            axis=1,
        )
        blocks.add(jacobian, columns, residual)
        return float(np.sum(residual**2))

    def _add_priors(self, blocks: _Blocks) -> float:
        """Priors of parameters, described landmarks, starts and the origin."""
        scaled = self._parameter / PRIORS
        diagonal = np.tile(np.diag(1.0 / PRIORS), (self._robots, 1, 1))
        blocks.add(diagonal, self._parameter_column, scaled)
        cost = float(np.sum(scaled**2))
        for column, pose, prior, sigma in self._anchors():
            # the error of the pose in map, linearized: xi = log(X X_prior^-1)
            residual = se2.log(se2.compose(pose, se2.inverse(prior)))
            root = np.linalg.inv(np.linalg.cholesky(se2.error_covariance(prior, np.diag(sigma**2))))
            blocks.add(root[None], (column + np.arange(3))[None], (root @ residual)[None])
            cost += float(np.sum((root @ residual) ** 2))
        return cost

    def _anchors(self) -> list[tuple[int, FloatArray, FloatArray, FloatArray]]:
        """Columns, poses, described poses and standard deviations of what is described."""
        problem, found = self._problem, []
        for index, mark in enumerate(problem.swarm.landmarks):
            column = int(self._landmark_column[index])
            if column < 0:
                continue
            described = np.array([mark.x, mark.y, mark.yaw or 0.0])
            if problem.is_known[index]:
                sigma = np.array([mark.position_sigma, mark.position_sigma, mark.yaw_sigma])
                if mark.yaw is None:
                    sigma[2] = _YAW_SIGMA
                found.append((column, self._landmark[index], described, np.maximum(sigma, _ORIGIN_SIGMA)))
            elif mark.yaw is None:
                pose = self._landmark[index]
                found.append((column, pose, pose * [1.0, 1.0, 0.0], np.array([1e3, 1e3, _YAW_SIGMA])))
        has_frame = bool(problem.is_known.any())
        for index, robot in enumerate(problem.swarm.robots):
            own = np.flatnonzero((problem.knots.robot == index) & (self._knot_column >= 0))
            if not own.size or robot.start is None:
                continue
            has_frame = True
            spread = robot.start_sigma
            sigma = np.array([spread.x, spread.y, spread.theta])
            found.append(self._first_pose(int(own[0]), np.array(robot.start), sigma))
        if not has_frame:
            first = int(np.flatnonzero(self._knot_column >= 0)[0])
            track = problem.knots.sample.pose[first]
            origin = se2.compose(self._knot[first], track) if self._origin is None else self._origin
            self._origin = origin
            found.append(self._first_pose(first, origin, np.full(3, _ORIGIN_SIGMA)))
        return found

    def _first_pose(
        self, knot: int, pose: FloatArray, sigma: FloatArray
    ) -> tuple[int, FloatArray, FloatArray, FloatArray]:
        # the error of X = T O is that of T
        track = self._problem.knots.sample.pose[knot]
        return int(self._knot_column[knot]), se2.compose(self._knot[knot], track), pose, sigma

    def _sightings(self) -> tuple[FloatArray, FloatArray, IntArray]:
        """Whitened residuals (u, 3), Jacobians (u, 3, 8) and columns (u, 8) of the used sightings."""
        problem, rows = self._problem, self._rows
        some, (observer, target) = select(problem.sightings, rows), problem.sides[rows].T
        mark, robot = self._mark[rows], problem.sightings.observer[rows]
        poses = [se2.compose(self._knot[observer], problem.tracks[0, rows])]
        moved = se2.compose(self._knot[target], problem.tracks[1, rows])
        poses.append(np.where((target >= 0)[:, None], moved, self._landmark[mark]))
        camera = np.pad(self._parameter[robot, 3:], ((0, 0), (0, 1)))  # ranges have no offset
        value, jacobian = predict(some, poses[0], poses[1], camera)
        by_pose = jacobian[:, :, :3]
        noise = some.covariance.copy()
        for side, knot in enumerate((observer, target)):
            carried = np.where((knot >= 0)[:, None, None], by_pose @ se2.adjoint(self._knot[knot]), 0.0)
            noise += carried @ problem.slip[side, rows] @ carried.transpose(0, 2, 1)
        innovation = _innovation(some.value, value, problem.is_polar[rows], some.has_heading > 0)
        root = np.linalg.inv(np.linalg.cholesky(noise))
        residual = -np.einsum("kij,kj->ki", root, innovation)
        other = _innovation(some.second, value, problem.is_polar[rows], some.has_heading > 0)
        mirrored = -np.einsum("kij,kj->ki", root, other)
        better = (some.has_second > 0) & (np.sum(mirrored**2, axis=1) < np.sum(residual**2, axis=1))
        residual[better] = mirrored[better]
        whole = np.concatenate([-by_pose, by_pose, jacobian[:, :, 3:5]], axis=2)
        columns = np.full((rows.size, 8), -1)
        columns[:, :3] = self._knot_column[observer][:, None] + np.arange(3)
        first = np.where(target >= 0, self._knot_column[target], self._landmark_column[mark])
        columns[:, 3:6] = np.where(first[:, None] >= 0, first[:, None] + np.arange(3), -1)
        columns[:, 6:] = self._parameter_column[robot][:, 3:]
        return residual, np.einsum("kij,kjl->kil", root, whole), columns

    def _solution(self, matrix: csc_matrix) -> Solution:
        residual, _, _ = self._sightings()
        good = self._weight > 0.5
        degrees = 2.0 + self._problem.sightings.has_heading[self._rows]
        ratio = float(np.sum(residual[good] ** 2) / max(1.0, np.sum(degrees[good])))
        factor = NormalFactor(_factor(matrix, 0.0), np.arange(self._size))
        covariance = np.zeros((self._landmarks, 3, 3))
        for index in np.flatnonzero(self._landmark_column >= 0).tolist():
            error = factor.covariance(self._landmark_column[index] + np.arange(3))
            covariance[index] = se2.pose_covariance(self._landmark[index], error)
        sigma = np.array([np.sqrt(np.diag(factor.covariance(one))) for one in self._parameter_column])
        placed = self._knot_column[self._knot_column >= 0]
        frame = factor.covariance(placed[placed.size // 2] + np.arange(3))
        weight = np.zeros(self.used.size)
        weight[self._rows] = self._weight
        return Solution(
            self._knot, self._landmark, self._parameter, sigma, covariance, frame, weight, self.used, ratio
        )


class _Blocks:
    """Rows of a sparse Jacobian and residuals, collected."""

    def __init__(self) -> None:
        self._rows = 0
        self._entries: list[tuple[FloatArray, IntArray, IntArray]] = []
        self._residual: list[FloatArray] = []

    def add(self, jacobian: FloatArray, columns: IntArray, residual: FloatArray) -> None:
        """Add residuals (k, r) with Jacobians (k, r, c) by columns (k, c); -1: fixed."""
        count, size, _ = jacobian.shape
        rows = self._rows + np.arange(count * size).reshape(count, size)
        row = np.broadcast_to(rows[:, :, None], jacobian.shape)
        column = np.broadcast_to(columns[:, None, :], jacobian.shape)
        kept = column >= 0
        self._entries.append((jacobian[kept], row[kept], column[kept]))
        self._residual.append(residual.reshape(-1))
        self._rows += count * size

    def normal(self, size: int) -> tuple[csc_matrix, FloatArray]:
        """J^T J (n, n) and -J^T r (n,)."""
        value, row, column = (np.concatenate(part) for part in zip(*self._entries, strict=True))
        jacobian = coo_matrix((value, (row, column)), (self._rows, size)).tocsr()
        return csc_matrix(jacobian.T @ jacobian), -(jacobian.T @ np.concatenate(self._residual))


def _numbered(wanted: BoolArray, first: int) -> tuple[IntArray, int]:
    """First columns (k,) of bodies of three columns, -1 where not wanted; and the next free column."""
    columns = np.where(wanted, first + 3 * (np.cumsum(wanted) - 1), -1)
    return columns, first + 3 * int(wanted.sum())


def _steps(problem: SurveyProblem, is_placed: BoolArray) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Pairs of consecutive knots (p,), whitening of their steps, and Jacobians by parameters."""
    knots = problem.knots
    same = (knots.robot[1:] == knots.robot[:-1]) & is_placed[1:]
    a = np.flatnonzero(same)
    covariance = knots.sample.covariance[a + 1] - knots.sample.covariance[a]
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1)) + np.eye(3) * _LEAST_VARIANCE
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    return a, a + 1, root, knots.sample.jacobian[a + 1] - knots.sample.jacobian[a]


def _innovation(
    measured: FloatArray, predicted: FloatArray, is_polar: BoolArray, has_heading: BoolArray
) -> FloatArray:
    """Measured minus predicted (k, 3), angles wrapped, zero for a heading that was not measured."""
    found = measured - predicted
    found[:, 2] = np.where(has_heading, se2.wrap_angle(found[:, 2]), 0.0)
    found[is_polar, 1] = se2.wrap_angle(found[is_polar, 1])
    return found


def _factor(matrix: csc_matrix, damping: float) -> SuperLU:
    diagonal = matrix.diagonal()
    damped = matrix.copy()
    # without any information, as of knots that are tied to others, columns stay as they are
    damped.setdiag(np.where(diagonal > 0.0, diagonal * (1.0 + damping), 1.0))
    return splu(damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
