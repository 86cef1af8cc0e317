"""Poses, landmarks and parameters of a recording by robust batch least squares over SE(2).

Errors are right-invariant, X = exp(xi) X_hat, as in the filter, whose measurement models and odometry noise
are used. Weights of Geman and McClure of whole sightings limit the influence of wrong ids; they are wide at
first, when places are far off (graduated non-convexity). Steps are those of Levenberg and Marquardt.
They begin as `start.py` says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.filter.models import predict_any
from swarm_loc_estimator.offline.batch.normal import ChainEquations, ChainFactor
from swarm_loc_estimator.offline.batch.problem import BatchProblem, Drift, innovation
from swarm_loc_estimator.offline.batch.start import Start
from swarm_loc_estimator.offline.recorded_bag import Progress
from swarm_loc_estimator.swarm.calibration_states import (
    ParameterTable,
    found_at,
    moved_place,
    shared_error,
)
from swarm_loc_estimator.swarm.swarm import (
    Anchor,
    FixedCamera,
    Landmark,
    MapError,
    Surveyed,
    Swarm,
)

# The steps are checked by test_survey.py and make bench-commissioning, also with wrong scales of wheels.
_SCALES = (50.0, 20.0, 10.0, 5.0)
"""Residuals at which the weight of a sighting is a quarter [sigma], one after the other."""
_ITERATIONS, _CONVERGED, _NEARLY = 15, 1e-2, 1e-3
"""Most steps of each scale, and the decrease of the cost that ends them: of the last scale and, as a share of
the cost, of the others."""
_RISES = 2  # Most steps in a row that may raise the cost
_ORIGIN_SIGMA = 1e-5
_TRUE_SIGMA: FloatArray = np.array([0.002, 0.002, 0.01])  # Of ground truth [m, m, rad]
_YAW_SIGMA = 1.0  # Of the heading of a landmark without one, which nothing determines [rad]
_DAMPING = (1e-14, 1e-2)
_LEAST_VARIANCE = 1e-10
"""Added to the variances of a step, so that the covariance of a standing robot is regular [m^2, rad^2]."""

_PATH_NS = 50_000_000  # Time between two poses of a path


@dataclass(frozen=True)
class Solution:
    """Estimates with the covariance of their right-invariant errors."""

    problem: BatchProblem  # What was solved
    knot: FloatArray  # (k, 3) transforms of the tracks at the knots; NaN: not connected
    # (S, 3) poses of landmarks, shifts and biases of anchors, corrections of cameras; NaN: not connected
    landmark: FloatArray
    parameter: FloatArray  # (N, p) changes of parameters of the description
    parameter_sigma: FloatArray  # (N, p) their standard deviations
    landmark_covariance: FloatArray  # (S, 3, 3) of `place`
    weight: FloatArray  # (m,) of the sightings, from 0 for wrong ones to 1
    used: BoolArray  # (m,) whether both sides of the sighting are connected with the origin
    variance_ratio: float  # Mean squared residual of sightings by the described noise; 1 is ideal
    factor: ChainFactor  # Of the normal equations
    column: IntArray  # (k,) first of the three unknowns of each knot; -1: not connected
    landmark_column: IntArray  # (L,) the same of each landmark; -1: exact, too
    parameter_column: IntArray  # (N, p) unknown of each parameter
    # Whitened residuals (u, 3) of used sightings, their Jacobians (u, 3, c) and unknowns (u, c), -1: none
    sightings: tuple[FloatArray, FloatArray, IntArray]

    @cached_property
    def place(self) -> FloatArray:
        """Places (S, 3) in `map` of what was surveyed, as by `moved_place`."""
        return _places(self.problem, self.landmark)

    def at(self, robots: IntArray, stamps_ns: IntArray) -> FloatArray:
        """Poses (k, 3) in `map` of robots (k,) at instants (k,); NaN: not known."""
        knots, poses = self.problem.knots, np.full((robots.size, 3), np.nan)
        for robot in np.unique(robots).tolist():
            own, rows = np.flatnonzero(knots.robot == robot), np.flatnonzero(robots == robot)
            if own.size < 2:
                continue
            stamps = knots.stamp_ns[own]
            rows = rows[(stamps_ns[rows] >= stamps[0]) & (stamps_ns[rows] <= stamps[-1])]
            rows = rows[self.problem.odometry.has_started(robots[rows], stamps_ns[rows])]
            before = own[np.clip(np.searchsorted(stamps, stamps_ns[rows], side="right") - 1, 0, own.size - 2)]
            first_ns, last_ns = knots.stamp_ns[before], knots.stamp_ns[before + 1]
            share = (stamps_ns[rows] - first_ns) / (last_ns - first_ns)
            step = se2.log(se2.compose(self.knot[before + 1], se2.inverse(self.knot[before])))
            transform = se2.compose(se2.exp(step * share[:, None]), self.knot[before])
            poses[rows] = se2.compose(transform, self.problem.odometry.at(robots[rows], stamps_ns[rows]).pose)
        return poses

    def paths(self) -> dict[str, Trajectory]:
        """Paths by the names of robots, every `_PATH_NS`, but where nothing is known of their motion."""
        found = {}
        for index, robot in enumerate(self.problem.swarm.robots):
            own = self.problem.knots.stamp_ns[(self.problem.knots.robot == index) & (self.column >= 0)]
            if own.size:
                stamps = np.arange(own[0], own[-1], _PATH_NS)
                after = np.searchsorted(own, stamps, side="right")
                stamps = stamps[own[after] - own[after - 1] <= 2 * self.problem.knots.step_ns]
                poses = self.at(np.full(stamps.size, index), stamps)
                known = np.isfinite(poses[:, 0])
                found[robot.name] = Trajectory(stamps[known], poses[known])
        return found

    def leverages(self, rows: IntArray) -> FloatArray:
        """Variances (c, 3) of predictions of used sightings (c,), in units of their noise."""
        _, jacobian, columns = self.sightings
        return self.factor.variances(jacobian[rows], columns[rows])

    def moved_variances(self, first: IntArray, last: IntArray) -> FloatArray:
        """Variances (c, 3) of motion from knots (c,) to later ones (c,), in the frame of the first."""
        poses = se2.compose(self.knot[first], self.problem.knots.sample.pose[first])
        to_body = se2.adjoint(se2.inverse(poses))
        columns = np.column_stack([_three(self.column[first]), _three(self.column[last])])
        return self.factor.variances(np.concatenate([-to_body, to_body], axis=2), columns)


def _places(problem: BatchProblem, landmark: FloatArray) -> FloatArray:
    """Places (S, 3) by poses of landmarks and corrections of anchors and cameras (S, 3)."""
    rows = zip(problem.swarm.surveyed, landmark, strict=True)
    found = [one if isinstance(body, Landmark) else moved_place(body, one) for body, one in rows]
    return np.array(found).reshape(-1, 3)


class SharedError(NamedTuple):
    """Error that all places share that were estimated, S of them."""

    error: MapError
    place: FloatArray  # (S, 3, 4) errors of x, y, yaw by one standard deviation, first of the scale
    parameter: FloatArray  # (N, p) those of parameters by the scale


def shared_by_places(solution: Solution) -> SharedError:
    """The error that all places share that were estimated, and what is correlated with their scale.

    Where too few were estimated to tell it, the described one stays.
    """
    column, parameters = solution.landmark_column, solution.parameter_column
    is_anchor = np.array([isinstance(one, Anchor) for one in solution.problem.swarm.surveyed], dtype=bool)
    free, anchors = np.flatnonzero((column >= 0) & ~is_anchor), np.flatnonzero((column >= 0) & is_anchor)
    place, by = solution.place[free, :2], np.zeros((column.size, 3, 4))
    if not free.size or not np.ptp(place, axis=0).any():
        return SharedError(solution.problem.swarm.map_error, by, np.zeros(parameters.shape))
    unknowns = [_three(column[free]).ravel(), _three(column[anchors]).ravel(), parameters.ravel()]
    covariance = max(1.0, solution.variance_ratio) * solution.factor.covariance(np.concatenate(unknowns))
    error, by[free], others = shared_error(place, covariance)
    by[anchors] = others[: 3 * anchors.size].reshape(-1, 3, 4)
    return SharedError(error, by, others[3 * anchors.size :, 0].reshape(parameters.shape))


def placed(solution: Solution, shared: SharedError) -> Swarm:
    """The description of a problem with all bodies that were estimated where they were found.

    Standard deviations are those of their own errors; landmarks that nothing connects are left out.
    """
    swarm, found = solution.problem.swarm, list[Surveyed]()
    covariance = max(1.0, solution.variance_ratio) * solution.landmark_covariance
    for index, body in enumerate(swarm.surveyed):
        if solution.landmark_column[index] >= 0:
            found.append(found_at(body, solution.place[index], covariance[index], shared.place[index]))
        elif np.isfinite(solution.place[index]).all():
            found.append(body)
    return replace(
        swarm,
        landmarks=tuple(one for one in found if isinstance(one, Landmark)),
        anchors=tuple(one for one in found if isinstance(one, Anchor)),
        cameras=tuple(one for one in found if isinstance(one, FixedCamera)),
        map_error=shared.error,
    )


class ParameterPrior(NamedTuple):
    """Prior of the changes of parameters."""

    mean: FloatArray  # (N, p)
    sigma: FloatArray  # (N, p) standard deviations


class Solver:
    """Solves one problem; what is not connected at the start is left out.

    Args:
        problem: To be solved.
        start: Where to begin.
        prior: Of the changes of parameters; by default about none, with the sigmas of the parameters.
    """

    def __init__(self, problem: BatchProblem, start: Start, prior: ParameterPrior | None = None) -> None:
        self._problem, knots = problem, problem.knots
        robots, places = len(problem.swarm.robots), problem.swarm.surveyed
        self._is_near, self._landmark = start.knot is not None, start.landmark.copy()
        self._knot = start.transform[knots.robot] if start.knot is None else start.knot.copy()
        wide = np.tile(np.array([one.sigma for one in problem.parameters]), (robots, 1))
        self._mean, self._prior = prior or ParameterPrior(np.zeros_like(wide), wide)
        self._parameter = (self._mean if start.parameter is None else start.parameter).copy()
        is_placed = np.isfinite(self._knot[:, 0])
        mark = problem.sightings.landmark
        # index -1, nobody, is that of a row after the last
        targets = np.append(np.isfinite(self._landmark[:, 0]), True)[mark]
        for side in range(2):
            targets &= np.append(is_placed, True)[problem.sides[:, side]]
        self.used: BoolArray = np.asarray(targets)
        self._rows = np.flatnonzero(self.used)
        # exactly described landmarks have no columns
        is_exact = np.array([not mark.is_estimated for mark in places], dtype=bool)
        self._is_shift = np.array([isinstance(mark, Anchor) for mark in places], dtype=bool)
        free = np.isfinite(self._landmark[:, 0]) & ~(problem.is_known & is_exact)
        self._pairs = _steps(problem, is_placed)
        in_time = np.lexsort((knots.robot, knots.stamp_ns))
        self._knot_column = np.full(knots.robot.size, -1)
        drifts = 0 if problem.drift is None else 2
        self._knot_column[in_time], self._band = _numbered(is_placed[in_time], 0, 3 + drifts)
        self._drift = np.zeros((knots.robot.size, drifts))
        self._drift_column = self._knot_column[:, None] + 3 + np.arange(drifts)
        self._landmark_column, next_column = _numbered(free, self._band)
        self._shared = ParameterTable.of((), places, problem.swarm.map_error).shared
        self._parameter_column = next_column + np.arange(self._prior.size).reshape(robots, -1)
        self._size = next_column + self._prior.size
        self._weight, self._is_rigid = np.ones(self._rows.size), True
        self._landmarks = len(places)
        self._origin: tuple[int, FloatArray] | None = None  # First knot of a robot that stays at this pose

    def solve(self, progress: Progress) -> Solution:
        """Solve, and compute covariances."""
        if not self._is_near:
            self._solve_rigid()
        self._is_rigid = False
        for k, scale in enumerate(_SCALES):
            progress(k / len(_SCALES), "solving")
            self._descend(scale)
        return self.with_noise_of(self._problem)

    def with_noise_of(self, problem: BatchProblem) -> Solution:
        """The same solution with the covariances of a problem with other noise of measurements."""
        self._problem = problem
        return self._solution(self._normal(_SCALES[-1])[0].factored(0.0))

    def _solve_rigid(self) -> None:
        """Solve with exact odometry: one transform of each robot's track, in the border."""
        columns, whole = (self._knot_column, self._landmark_column, self._parameter_column), self._size
        placed = np.unique(self._problem.knots.robot[self._knot_column >= 0])
        robot = np.searchsorted(placed, self._problem.knots.robot)
        self._knot_column = np.where(self._knot_column >= 0, 3 * robot, -1)
        shift = self._band - 3 * placed.size
        self._landmark_column = np.where(self._landmark_column >= 0, self._landmark_column - shift, -1)
        self._parameter_column = self._parameter_column - shift
        self._band, self._size, band = 0, self._size - shift, self._band
        self._descend(_SCALES[0])
        self._knot_column, self._landmark_column, self._parameter_column = columns
        self._band, self._size = band, whole

    def _descend(self, scale: float) -> None:
        """Minimize the cost at one scale of the weights.

        Large turns of the odometry frames leave errors of second order, which noise of steps makes expensive.
        The next steps remove them, so some of these may follow before a step is taken back.
        """
        damping, rises = _DAMPING[0], 0
        normal, least = self._normal(scale)
        best = self._knot, self._landmark, self._parameter, self._drift, normal
        for _ in range(_ITERATIONS):
            self._apply(normal.factored(damping).solve(normal.gradient))
            normal, cost = self._normal(scale)
            enough = _CONVERGED if scale == _SCALES[-1] else _NEARLY * least
            has_converged = abs(least - cost) < enough
            if cost <= least:
                least, rises = cost, 0
                best = self._knot, self._landmark, self._parameter, self._drift, normal
                damping = max(_DAMPING[0], 0.01 * damping)
            if has_converged:
                break
            if cost > least and rises < _RISES:
                rises += 1
            elif cost > least:
                self._knot, self._landmark, self._parameter, self._drift, normal = best
                damping, rises = 100.0 * damping, 0
                if damping > _DAMPING[1]:
                    return
        self._knot, self._landmark, self._parameter, self._drift, _ = best

    def _apply(self, step: FloatArray) -> None:
        self._knot, self._landmark = self._knot.copy(), self._landmark.copy()
        for pose, column in ((self._knot, self._knot_column), (self._landmark, self._landmark_column)):
            rows = np.flatnonzero(column >= 0)
            twist = step[_three(column[rows])]
            moved = se2.compose(se2.exp(twist), pose[rows])
            is_shift = self._is_shift[rows] if column is self._landmark_column else np.zeros(rows.size, bool)
            pose[rows] = np.where(is_shift[:, None], pose[rows] + twist, moved)
        self._parameter = self._parameter + step[self._parameter_column]
        placed = (self._knot_column >= 0)[:, None]
        self._drift = self._drift + np.where(placed, step[self._drift_column], 0.0)

    def _normal(self, scale: float) -> tuple[ChainEquations, float]:
        """Normal equations and robust cost, linearized at the estimates."""
        normal = ChainEquations(self._band, self._width(), self._size - self._band)
        cost = self._add_priors(normal) + (0.0 if self._is_rigid else self._add_odometry(normal))
        residual, jacobian, columns = self._sightings()
        square = np.sum(residual**2, axis=1)
        self._weight = 1.0 / np.square(1.0 + square / scale**2)
        root = np.sqrt(self._weight)
        normal.add(jacobian * root[:, None, None], columns, residual * root[:, None])
        return normal, cost + float(np.sum(square / (1.0 + square / scale**2)))

    def _width(self) -> int:
        """Largest distance of two columns of the band that share a residual."""
        if not self._band:
            return 0
        sides = self._problem.sides[self._rows]
        both = sides[(sides >= 0).all(axis=1)].T
        pairs = np.concatenate(
            [self._knot_column[both], self._knot_column[np.array(self._pairs[:2])]], axis=1
        )
        return int(np.abs(np.diff(pairs, axis=0)).max(initial=0)) + 2 + self._drift.shape[1]

    def _add_odometry(self, normal: ChainEquations) -> float:
        """Steps between consecutive knots: r = log(T_b T_a^-1) - Ad(T_a) D p."""
        a, b, root, response = self._pairs
        drift = se2.log(se2.compose(self._knot[b], se2.inverse(self._knot[a])))
        robot = self._problem.knots.robot[a]
        moved = np.einsum("kij,kj->ki", response, self._parameter[robot])
        back = se2.adjoint(se2.inverse(self._knot[a]))  # to the frame of the track, where the noise is given
        residual = np.einsum("kij,kj->ki", root, np.einsum("kij,kj->ki", back, drift) - moved)
        by_pose = np.einsum("kij,kjl->kil", root, back)
        by_parameter = -np.einsum("kij,kjl->kil", root, response)
        jacobian = np.concatenate([-by_pose, by_pose, by_parameter], axis=2)
        of_knots = _three(self._knot_column[a]), _three(self._knot_column[b])
        columns = np.column_stack([*of_knots, self._parameter_column[robot]])
        drifts = self._problem.drift
        if drifts is None:
            normal.add(jacobian, columns, residual)
            return float(np.sum(residual**2))
        by_rate = np.einsum("kij,kj->ki", root, drifts.turn[b] - drifts.turn[a])
        residual -= by_rate * self._drift[a, :1]
        jacobian = np.concatenate([jacobian, -by_rate[:, :, None]], axis=2)
        normal.add(jacobian, np.column_stack([columns, self._drift_column[a, 0]]), residual)
        return float(np.sum(residual**2)) + self._add_drift(normal, drifts)

    def _add_drift(self, normal: ChainEquations, drift: Drift) -> float:
        """Gauss-Markov chains of drifts: r = x_b - exp(-t / T) x_a, and their first values."""
        knots, (a, b) = self._problem.knots, self._pairs[:2]
        robot, duration_s = knots.robot[a], 1e-9 * (knots.stamp_ns[b] - knots.stamp_ns[a])
        kept = np.exp(-duration_s[:, None] / drift.time_s[robot])
        root = 1.0 / (drift.sigma[robot] * np.sqrt(1.0 - kept**2))
        first = np.setdiff1d(np.flatnonzero(self._knot_column >= 0), b)
        sigma, cost = drift.sigma[knots.robot[first]], 0.0
        for which in range(self._drift.shape[1]):
            value, column = self._drift[:, which], self._drift_column[:, which]
            change = (value[b] - kept[:, which] * value[a]) * root[:, which]
            by_both = np.stack([-kept[:, which] * root[:, which], root[:, which]], axis=1)
            normal.add(by_both[:, None], np.stack([column[a], column[b]], axis=1), change[:, None])
            begin = value[first] / sigma[:, which]
            normal.add(1.0 / sigma[:, which, None, None], column[first, None], begin[:, None])
            cost += float(np.sum(change**2) + np.sum(begin**2))
        return cost

    def _add_priors(self, normal: ChainEquations) -> float:
        """Priors of parameters, described landmarks, starts and the origin."""
        scaled = (self._parameter - self._mean) / self._prior
        normal.add(np.eye(scaled.shape[1]) / self._prior[:, :, None], self._parameter_column, scaled)
        cost = float(np.sum(scaled**2))
        cost += 0.0 if self._is_rigid else self._add_truth(normal)
        together = []
        of_places = dict(zip(self._landmark_column.tolist(), self._shared, strict=True))
        for column, pose, prior, sigma in self._anchors():
            # the error of the pose in map, linearized: xi = log(X X_prior^-1)
            residual = se2.log(se2.compose(pose, se2.inverse(prior)))
            covariance = se2.error_covariance(prior, np.diag(sigma**2))
            shared = of_places.get(column)
            if shared is None or not shared.any():
                cost += _add_prior(normal, column + np.arange(3), residual, covariance)
            else:
                together.append((column + np.arange(3), residual, covariance, shared))
        # places that share an error are one
        if together:
            columns, residuals, own, by = zip(*together, strict=True)
            whole = block_diag(*own) + np.concatenate(by) @ np.concatenate(by).T
            cost += _add_prior(normal, np.concatenate(columns), np.concatenate(residuals), whole)
        return cost

    def _add_truth(self, normal: ChainEquations) -> float:
        """Poses by ground truth, with noise in the frame of the robot."""
        rows = np.flatnonzero(self._knot_column[self._problem.true.knot] >= 0)
        knot, track, true = (column[rows] for column in self._problem.true)
        root = se2.adjoint(se2.inverse(true)) / _TRUE_SIGMA[:, None]
        pose = se2.compose(self._knot[knot], track)
        residual = np.einsum("kij,kj->ki", root, se2.log(se2.compose(pose, se2.inverse(true))))
        normal.add(root, _three(self._knot_column[knot]), residual)
        return float(np.sum(residual**2))

    def _anchors(self) -> list[tuple[int, FloatArray, FloatArray, FloatArray]]:
        """Columns, poses, described poses and standard deviations of what is described."""
        problem, found = self._problem, []
        places = _places(problem, self._landmark)
        for index, mark in enumerate(problem.swarm.surveyed):
            column, pose = int(self._landmark_column[index]), self._landmark[index]
            if column < 0:
                continue
            if isinstance(mark, Anchor):
                sigma = np.array([mark.position_sigma, mark.position_sigma, mark.range_bias_sigma])
                found.append((column, pose, np.zeros(3), np.maximum(sigma, _ORIGIN_SIGMA)))
                continue
            described = np.array([mark.x, mark.y, mark.yaw or 0.0])
            pose = places[index]
            if problem.is_known[index]:
                sigma = np.array([mark.position_sigma, mark.position_sigma, mark.yaw_sigma])
                if mark.yaw is None:
                    sigma[2] = _YAW_SIGMA
                found.append((column, pose, described, np.maximum(sigma, _ORIGIN_SIGMA)))
            elif mark.yaw is None:
                found.append((column, pose, pose * [1.0, 1.0, 0.0], np.array([1e3, 1e3, _YAW_SIGMA])))
        has_frame = bool(problem.is_known.any()) or bool(np.any(problem.sightings.observer < 0))
        for index, robot in enumerate(problem.swarm.robots):
            own = np.flatnonzero((problem.knots.robot == index) & (self._knot_column >= 0))
            if not own.size or robot.start is None:
                continue
            has_frame = True
            spread = robot.start_sigma
            sigma = np.array([spread.x, spread.y, spread.theta])
            found.append(self._first_pose(int(own[0]), np.array(robot.start), sigma))
        if not has_frame:
            if self._origin is None:
                _, first = np.unique(problem.knots.robot, return_index=True)
                pose = se2.compose(self._knot[first], problem.knots.sample.pose[first])
                nearest = int(np.nanargmin(np.linalg.norm(pose, axis=1)))
                self._origin = int(first[nearest]), pose[nearest]
            found.append(self._first_pose(*self._origin, np.full(3, _ORIGIN_SIGMA)))
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
        some, sides = select(problem.sightings, rows), problem.sides[rows].T
        robot, change, by = some.observer, self._parameter[some.observer], problem.by_parameter
        moved = se2.exp(np.einsum("skij,kj->ski", by.tracks[:, rows], change))
        track = se2.compose(moved, problem.tracks[:, rows])
        poses = problem.poses(rows, self._knot, self._landmark, track)
        correction = np.einsum("kij,kj->ki", by.value[rows], change)
        some = some._replace(value=some.value + correction, second=some.second + correction)
        camera = np.zeros((rows.size, 3))
        camera[:, 0] = np.where(sides[0] >= 0, self._drift[sides[0], 1], 0.0) if problem.drift else 0.0
        value, *by_pose, by_camera = predict_any(some, poses[0], poses[1], camera)
        noise = some.covariance.copy()
        by_track = []
        for side, knot in enumerate(sides):
            carried = np.where((knot >= 0)[:, None, None], by_pose[side] @ se2.adjoint(self._knot[knot]), 0.0)
            noise += carried @ problem.slip[side, rows] @ carried.transpose(0, 2, 1)
            by_track.append(carried)
        root = np.linalg.inv(np.linalg.cholesky(noise))
        is_polar = problem.is_polar[rows]
        apart, other = innovation(some, some.value, value), innovation(some, some.second, value)
        square, mirrored = (
            np.sum(np.square(np.einsum("kij,kj->ki", root, one)), axis=1) for one in (apart, other)
        )
        better = (some.has_second > 0) & (mirrored < square)
        apart[better] = other[better]
        # distances in units of the reading, lest all become small for their noise to be small
        growth, change_of = np.ones((rows.size, 3)), np.zeros((rows.size, 3, self._prior.shape[1]))
        for component in range(2):
            scaled = ~is_polar | (component == 0)
            change_of[scaled, component] = by.growth[rows][scaled]
        growth += np.einsum("kij,kj->ki", change_of, change)
        apart /= growth
        by_change = -by.value[rows]
        for side, carried in enumerate(by_track):
            by_change = by_change + carried @ by.tracks[side, rows]
        whole = np.concatenate([*by_pose, by_change], axis=2)
        columns = np.full((rows.size, 6 + self._prior.shape[1]), -1)
        for side, (knot, place) in enumerate(zip(sides, (some.mount, some.landmark), strict=True)):
            first = np.where(knot >= 0, self._knot_column[knot], np.append(self._landmark_column, -1)[place])
            own = slice(3 * side, 3 * side + 3)
            columns[:, own] = np.where((first >= 0)[:, None], _three(first), -1)
        columns[:, 6:] = self._parameter_column[robot]
        if problem.drift:
            by_yaw = np.where((sides[0] >= 0)[:, None], by_camera[:, :, 0], 0.0)
            whole = np.concatenate([whole, by_yaw[:, :, None]], axis=2)
            columns = np.column_stack([columns, np.where(sides[0] >= 0, self._drift_column[sides[0], 1], -1)])
        whole /= growth[:, :, None]
        whole[:, :, 6 : 6 + change.shape[1]] += (apart / growth)[:, :, None] * change_of
        return -np.einsum("kij,kj->ki", root, apart), root @ whole, columns

    def _solution(self, factor: ChainFactor) -> Solution:
        sightings = self._sightings()
        residual = sightings[0]
        good = self._weight > 0.5
        degrees = sightings[1].any(axis=2).sum(axis=1)
        ratio = float(np.sum(residual[good] ** 2) / max(1.0, np.sum(degrees[good])))
        covariance = np.zeros((self._landmarks, 3, 3))
        places = _places(self._problem, self._landmark)
        for index in np.flatnonzero(self._landmark_column >= 0).tolist():
            error = factor.covariance(self._landmark_column[index] + np.arange(3))
            is_shift = self._is_shift[index]
            covariance[index] = error if is_shift else se2.pose_covariance(places[index], error)
        sigma = np.array([np.sqrt(np.diag(factor.covariance(one))) for one in self._parameter_column])
        weight = np.zeros(self.used.size)
        weight[self._rows] = self._weight
        found = self._problem, self._knot, self._landmark, self._parameter
        columns = self._knot_column, self._landmark_column, self._parameter_column
        return Solution(*found, sigma, covariance, weight, self.used, ratio, factor, *columns, sightings)


def _add_prior(
    normal: ChainEquations, columns: IntArray, residual: FloatArray, covariance: FloatArray
) -> float:
    """Add a residual (r,) of unknowns (r,) with a covariance (r, r); its cost."""
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    normal.add(root[None], columns[None], (root @ residual)[None])
    return float(np.sum((root @ residual) ** 2))


def _three(first: IntArray) -> IntArray:
    """Columns (k, 3) of poses by their first ones (k,)."""
    return first[:, None] + np.arange(3)


def _numbered(wanted: BoolArray, first: int, size: int = 3) -> tuple[IntArray, int]:
    """First columns (k,) of bodies of `size` columns, -1 where not wanted; and the next free column."""
    columns = np.where(wanted, first + size * (np.cumsum(wanted) - 1), -1)
    return columns, first + size * int(wanted.sum())


def _steps(problem: BatchProblem, is_placed: BoolArray) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Pairs of consecutive knots (p,), whitening of their steps, and Jacobians by parameters."""
    knots = problem.knots
    same = (knots.robot[1:] == knots.robot[:-1]) & is_placed[1:]
    a = np.flatnonzero(same)
    covariance = knots.sample.covariance[a + 1] - knots.sample.covariance[a]
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1)) + np.eye(3) * _LEAST_VARIANCE
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    by = problem.by_parameter.knots
    return a, a + 1, root, by[a + 1] - by[a]
