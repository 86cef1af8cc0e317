"""The pose graph: stops as nodes, wheel slip as a state, solved by Gauss-Newton.

A stop has the unknowns x, y, theta (on arrival) and ratio (true turn over turn by odometry). One slip
per robot follows the unknowns of all stops. Residuals are estimates minus measurements.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import compose, wrap_angle
from swarm_loc_estimator.mapping.matching import Scans, agreement, match_pairs
from swarm_loc_estimator.mapping.scans import Beams, Lines, Scan, fit_lines, no_beams, no_lines, set_beams
from swarm_loc_estimator.mapping.settings import MapperSettings

STOP_UNKNOWNS = 4


class Linearised(NamedTuple):
    """Constraints (m,) with e residuals each on c unknowns each."""

    unknowns: IntArray  # (m, c) indices of the unknowns
    jacobian: FloatArray  # (m, e, c)
    residual: FloatArray  # (m, e)
    weight: FloatArray  # (m, e) inverse variance


def odometry(states: FloatArray, begin: IntArray, end: IntArray, given: FloatArray) -> Linearised:
    """Residuals of odometry (m, 7) from stop to stop, along and across the motion.

    `given` has the turn by odometry at the stop of departure [rad], the pose on arrival (3,) in the frame at
    departure, and sigmas (3,) along the motion [m], across it [m] and of the heading [rad].
    """
    turn, motion = given[:, 0], given[:, 1:4]
    course = np.arctan2(motion[:, 1], motion[:, 0])
    index, jacobian, residual = _relative(states, begin, end, turn, turn + motion[:, 2], course)
    residual[:, 0] -= np.hypot(motion[:, 0], motion[:, 1])
    residual[:, 2] = wrap_angle(residual[:, 2])
    return Linearised(index, jacobian, residual, given[:, 4:] ** -2.0)


def ties(states: FloatArray, begin: IntArray, end: IntArray, given: FloatArray) -> Linearised:
    """Residuals of relative poses of stops from scan matching.

    `given` (m, 12) has poses (3,) in the frame of `begin`, and square roots (9,) of their information.
    """
    index, jacobian, pose = _relative(states, begin, end, *np.zeros((3, len(begin))))
    root, residual = given[:, 3:].reshape(-1, 3, 3), pose - given[:, :3]
    residual[:, 2] = wrap_angle(residual[:, 2])
    residual = np.einsum("mab,mb->ma", root, residual)
    return Linearised(index, root @ jacobian, residual, np.ones_like(residual))


def _relative(
    states: FloatArray,
    begin: IntArray,
    end: IntArray,
    turn: FloatArray,
    swing: FloatArray,
    course: FloatArray,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Unknowns (m, 7), Jacobian (m, 3, 7) and poses (m, 3) of stops in the frames of others after a turn.

    The frame is off by the course, and headings count from that after `swing`; turns are by odometry [rad].
    """
    here, there = states[begin], states[end]
    heading = here[:, 2] + here[:, 3] * turn + course
    cos, sin = np.cos(heading), np.sin(heading)
    dx, dy = there[:, 0] - here[:, 0], there[:, 1] - here[:, 1]
    along, across = cos * dx + sin * dy, -sin * dx + cos * dy
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    jacobian = np.stack(
        [
            np.stack([-cos, -sin, across, across * turn, cos, sin, zero], -1),
            np.stack([sin, -cos, -along, -along * turn, -sin, cos, zero], -1),
            np.stack([zero, zero, -one, -swing, zero, zero, one], -1),
        ],
        1,
    )
    pose = np.stack([along, across, there[:, 2] - here[:, 2] - here[:, 3] * swing], -1)
    return np.hstack([_unknowns(begin, 4), _unknowns(end, 3)]), jacobian, pose


def bearings(states: FloatArray, begin: IntArray, end: IntArray, given: FloatArray) -> Linearised:
    """Residuals of bearings of lights of robots at other stops, with a robust loss.

    `given` (m, 3) has the turn by odometry at which each was seen, the bearing in the robot's frame then, and
    its sigma [rad].
    """
    turn, bearing, sigma = given.T
    here, there = states[begin], states[end]
    dx, dy = there[:, 0] - here[:, 0], there[:, 1] - here[:, 1]
    square = dx * dx + dy * dy
    residual = wrap_angle(np.arctan2(dy, dx) - here[:, 2] - here[:, 3] * turn - bearing)
    one = np.ones_like(dx)
    jacobian = np.stack([dy / square, -dx / square, -one, -turn, -dy / square, dx / square], -1)
    robust = 1.0 + (residual / sigma) ** 2 / 9.0
    index = np.hstack([_unknowns(begin, 4), _unknowns(end, 2)])
    return Linearised(index, jacobian[:, None, :], residual[:, None], (sigma * robust)[:, None] ** -2.0)


def priors(states: FloatArray, stop: IntArray, _: IntArray, given: FloatArray) -> Linearised:
    """Residuals of priors on poses of stops (m,); `given` (m, 6) has poses and standard deviations."""
    residual = states[stop, :3] - given[:, :3]
    residual[:, 2] = wrap_angle(residual[:, 2])
    jacobian = np.broadcast_to(np.eye(3), (len(stop), 3, 3))
    return Linearised(_unknowns(stop, 3), jacobian, residual, given[:, 3:] ** -2.0)


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
    return STOP_UNKNOWNS * stop[:, None] + np.arange(count)


_DAMPING = 1e-6


class NormalEquations:
    """Accumulates normal equations over the free ones of u unknowns.

    Args:
        free: (u,) True for free unknowns.

    Attributes:
        squares: Sum of the squared residuals of constraints, in variances.
    """

    def __init__(self, free: BoolArray) -> None:
        self._place: IntArray = np.where(free, np.cumsum(free) - 1, -1)
        self._size = int(free.sum())
        self._free = free
        self.squares = 0.0
        self._gradient = np.zeros(self._size)
        self._values: list[FloatArray] = []
        self._rows: list[IntArray] = []
        self._columns: list[IntArray] = []

    def add(self, constraints: Sequence[Linearised]) -> None:
        """Add constraints."""
        for one in constraints:
            self.squares += float((one.weight * one.residual**2).sum())
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

    def solve(self) -> tuple[FloatArray, NormalFactor, float]:
        """The step (u,), zero for fixed unknowns, the factor for covariances, and the fall of `squares`."""
        diagonal, gradient = np.arange(self._size), self._gradient
        values = np.concatenate([*self._values, np.full(self._size, _DAMPING)])
        rows, columns = (np.concatenate([*one, diagonal]) for one in (self._rows, self._columns))
        matrix = csc_matrix((values, (rows, columns)), shape=(self._size, self._size))
        options = {"SymmetricMode": True}
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        step, free = np.zeros(len(self._free)), factor.solve(gradient)
        step[self._free] = free
        return step, NormalFactor(factor, self._place), float(free @ gradient)


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
        rows = np.eye(len(index)) if directions is None else directions
        columns = np.zeros((self._factor.shape[0], len(rows)))
        for number, direction in enumerate(rows):
            np.add.at(columns[:, number], self._place[index], direction)
        covariance: NDArray[np.float64] = columns.T @ self._factor.solve(columns)
        return np.asarray(0.5 * (covariance + covariance.T))


class PairRows:
    """Constraints of one kind in order of insertion: two stops, and numbers.

    Args:
        width: How many numbers each has.
    """

    def __init__(self, width: int) -> None:
        self._stops: IntArray = np.zeros((64, 2), dtype=np.int64)
        self._values = np.zeros((64, width))
        self.count = 0

    def add(self, begin: int, end: int, *values: FloatArray | float) -> None:
        """Add one."""
        if self.count == len(self._stops):
            self._stops, self._values = doubled(self._stops), doubled(self._values)
        self._stops[self.count] = begin, end
        self._values[self.count] = np.concatenate([np.ravel(one) for one in values])
        self.count += 1

    def remove(self, gone: BoolArray) -> None:
        """Remove those (m,)."""
        self.count = int((~gone).sum())
        for rows in (self._stops, self._values):
            rows[: self.count] = rows[: len(gone)][~gone]

    @property
    def columns(self) -> tuple[IntArray, IntArray, FloatArray]:
        """First stop (m,), second (m,), and numbers (m, width)."""
        begin, end = self._stops[: self.count].T
        return begin, end, self._values[: self.count]


class ConstraintLists:
    """Constraints of each kind; their numbers are those of the functions above.

    Attributes:
        priors: On poses of stops, with each stop twice.
        departures: Odometry from stop to stop.
        ties: Relative poses.
        bearings: Of lights.
    """

    def __init__(self) -> None:
        self.priors, self.departures, self.ties, self.bearings = map(PairRows, (6, 7, 12, 3))

    def remove_stop(self, stop: int) -> None:
        """Remove all constraints on a stop."""
        for rows in (self.priors, self.departures, self.ties, self.bearings):
            begin, end, _ = rows.columns
            rows.remove((begin == stop) | (end == stop))

    def linearised(self, states: FloatArray) -> list[Linearised]:
        """Linearize all constraints at states (k, 4)."""
        return [
            priors(states, *self.priors.columns),
            odometry(states, *self.departures.columns),
            ties(states, *self.ties.columns),
            bearings(states, *self.bearings.columns),
        ]


_REFIT_RATIO = 0.0006  # Threshold of the change of the turn ratio above which lines are refitted
_MIN_RATIO_SIGMA = 0.0013  # Minimum standard deviation of a turn ratio; checked by `make bench-pushbot`
_MATCH_WEIGHT, _START_WEIGHT = 0.3, 1.5
"""Total weight of the matches of a stop; beams of a pair share the errors of one scan."""
_SMALL_STEP = (1e-3, 1e-3, 5e-4)
MATCH_GATE = 0.03  # Maximum distance of a matched beam from its line in the final solution [m]
_OVERLAP_STRIDE = 6  # Every sixth beam decides on the overlap of stops
_MIN_SEEN_BINS = 15  # Directions with a usable line, one degree each, from which a stop sees walls


class PoseGraph:
    """Stops with beams and lines, and constraints; optimized by Gauss-Newton over all or some stops.

    Attributes:
        settings: Settings of the mapper.
        count: Number of stops.
        states: (capacity, 4) x [m], y [m], theta on arrival [rad], true turn over turn by odometry.
        robot: (capacity,) number of the robot of each stop.
        place: (capacity,) first stop at the same place; parts of a first scan share one.
        turned: (capacity,) turn by odometry at the stop so far [rad].
        slip: (R,) share of turns lost to wheel slip, per robot.
        constraints: All constraints except beam matches.
        targets: Stop -> stops against whose lines its beams are matched.
        starts: Stops of first scans.
        known_slips: Robots whose slip is known from scans.
    """

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.count = 0
        self.states = np.zeros((64, 4))
        self.robot: IntArray = np.zeros(64, dtype=np.int64)
        self.place: IntArray = np.zeros(64, dtype=np.int64)
        self.turned = np.zeros(64)
        self.slip = np.zeros(0)
        self.constraints = ConstraintLists()
        self.targets: dict[int, list[int]] = {}
        self.starts: set[int] = set()
        self.known_slips: set[int] = set()
        self._turned_all = np.zeros(64)
        self._fitted_ratio = np.ones(64)
        self._beams, self._lines = no_beams(64), no_lines(64)
        self._factor: NormalFactor
        self._factored = -1

    @property
    def scans(self) -> Scans:
        """The stops as input of scan matching."""
        return Scans(self.states, self._beams, self._lines)

    @property
    def poses(self) -> FloatArray:
        """(count, 3) of all stops on arrival, in map."""
        return self.states[: self.count, :3]

    @property
    def sees_walls(self) -> BoolArray:
        """(count,) whether walls that scans can be matched with were seen from each stop."""
        return np.asarray(self._lines.usable[: self.count].sum(axis=1) >= _MIN_SEEN_BINS)

    def add_robot(self) -> int:
        """Add a robot; returns its number."""
        self.slip = np.append(self.slip, self.settings.usual_slip)
        self._factored = -1
        return len(self.slip) - 1

    def add_stop(self, robot: int, pose: FloatArray, sigma: float) -> int:
        """Add a stop; returns its number.

        Args:
            robot: Number of the robot.
            pose: (3,) in map.
            sigma: Standard deviation of its inverse distances [1/m].
        """
        if self.count == len(self.states):
            self._grow()
        k = self.count
        self.count += 1
        self.states[k] = (*pose[:3], 1.0 - self.slip[robot])
        self.robot[k], self.place[k] = robot, k
        self._beams.sigma[k], self._beams.reach[k] = sigma, self.settings.max_range
        return k

    def reuse_stop(self, stop: int, pose: FloatArray, sigma: float) -> None:
        """Replace a stop by a new one of the same robot under the same number; see `add_stop`."""
        self._disconnect(stop)
        self.states[stop] = (*pose[:3], 1.0 - self.slip[self.robot[stop]])
        self._beams.sigma[stop] = sigma

    def drop_stop(self, stop: int) -> None:
        """Take back all that a stop tells; its number and its place stay."""
        self._disconnect(stop)
        self.constraints.priors.add(stop, stop, self.states[stop, :3], np.ones(3))
        self.turned[stop] = self._turned_all[stop] = self._beams.counts[stop] = 0
        self.fit(stop)

    def _disconnect(self, stop: int) -> None:
        """Remove all constraints and matches of a stop."""
        self.constraints.remove_stop(stop)
        self.targets = {
            one: [other for other in others if other != stop]
            for one, others in self.targets.items()
            if one != stop
        }
        self.starts.discard(stop)
        self._factored = -1

    def set_scan(self, stop: int, scan: Scan) -> None:
        """Set the beams of a stop; the next drive begins at the last one."""
        set_beams(self._beams, stop, scan)
        self.turned[stop] = scan.turn[-1]
        self._turned_all[stop] = np.abs(scan.turn).max()
        self.fit(stop)

    def slip_sigma(self, robot: int) -> float:
        """Standard deviation of the slip of a robot."""
        variance = self._factor_of_all().covariance(np.array([STOP_UNKNOWNS * self.count + robot]))
        return math.sqrt(max(float(variance[0, 0]), 0.0))

    def change_slip(self, robot: int, change: float, stops: Iterable[int] | None = None) -> None:
        """Change the slip of a robot at some or all of its stops, which move as by odometry."""
        moved = set(np.flatnonzero(self.robot[: self.count] == robot).tolist() if stops is None else stops)
        self.states[list(moved), 3] -= change
        for begin, end, row in zip(*self.constraints.departures.columns, strict=True):
            if begin in moved and end in moved:
                x, y, theta, ratio = self.states[begin]
                self.states[end, :3] = compose(np.array([x, y, theta + ratio * row[0]]), row[1:4])
                self.states[end, 2] = theta + ratio * (row[0] + row[3])
        for stop in moved:
            self.fit(stop)

    def heading_at_departure(self, stop: int) -> float:
        """The heading after all turns at a stop [rad]."""
        return float(self.states[stop, 2] + self.states[stop, 3] * self.turned[stop])

    def fit(self, stop: int) -> None:
        """Fit the lines of a stop with its current turn ratio."""
        ratio = self._fitted_ratio[stop] = self.states[stop, 3]
        fit_lines(stop, ratio, self._beams.reach[stop], self._beams, self._lines)

    def distances(self, stop: int) -> FloatArray:
        """Distances (count,) of all stops from one stop [m]."""
        off = self.states[: self.count, :2] - self.states[stop, :2]
        return np.hypot(off[:, 0], off[:, 1])

    def neighbours(self, stop: int, limit: int, least: float) -> list[int]:
        """The nearest stops in range whose lines overlap at least the share `least` of a stop's beams."""
        away = np.where(self._beams.counts[: self.count] > 0, self.distances(stop), np.inf)
        found: list[int] = []
        for other in np.argsort(away, kind="stable"):
            if away[other] > 0.88 * self._beams.reach[stop] or len(found) == limit:
                break
            matched, tried, _ = agreement(self.scans, stop, other, 0.0, _OVERLAP_STRIDE)
            if other != stop and matched > least * max(1, tried):
                found.append(int(other))
        return found

    def match_both_ways(self, stop: int, limit: int = 10) -> None:
        """Match the targets of a stop against it, too."""
        for other in self.targets[stop]:
            back = self.targets.setdefault(other, [])
            if stop not in back and len(back) < limit:
                back.append(stop)

    def solve(
        self, iterations: int, free: Iterable[int] | None = None, gate: float = MATCH_GATE, stride: int = 2
    ) -> float:
        """Gauss-Newton optimization of all or some stops; slips are always free.

        Args:
            iterations: Maximum number of steps.
            free: Stops that may move; None: all.
            gate: See `beam_residual` [m].
            stride: Every `stride`-th beam is used.

        Returns:
            Change of the sum of the squared residuals of constraints, in variances.
        """
        count = self.count
        moves = np.ones(count, dtype=bool)
        if free is not None:
            moves[:] = False
            moves[list(free)] = True
        unknowns = np.concatenate([np.repeat(moves, STOP_UNKNOWNS), np.ones(len(self.slip), dtype=bool)])
        before = after = math.nan
        for _ in range(iterations):
            equations = self.equations(unknowns, gate, stride)
            step, factor, fall = equations.solve()
            before, after = equations.squares if math.isnan(before) else before, equations.squares - fall
            if free is None:
                self._factor, self._factored = factor, count
            if self._apply(step):
                break
        for stop in np.flatnonzero(moves):
            changed = abs(self.states[stop, 3] - self._fitted_ratio[stop]) > _REFIT_RATIO
            if changed and self._beams.counts[stop]:
                self.fit(int(stop))
        return after - before

    def equations(self, free: BoolArray, gate: float = MATCH_GATE, stride: int = 2) -> NormalEquations:
        """The normal equations at the present states.

        Args:
            free: (u,) free unknowns, those of all stops and then the slips.
            gate: See `beam_residual` [m].
            stride: Every `stride`-th beam is used.
        """
        equations = NormalEquations(free)
        states, robot = self.states[: self.count], self.robot[: self.count]
        turns = np.maximum(self._turned_all[: self.count], 1.0) / (2.0 * math.pi)
        sigma = np.maximum(self.settings.turn_noise / np.sqrt(turns), _MIN_RATIO_SIGMA)
        equations.add(self.constraints.linearised(states))
        equations.add([ratios(states, self.slip, robot, sigma)])
        equations.add([slips(self.count, self.slip, self.settings.usual_slip, self.settings.slip_sigma)])
        self._add_matches(equations, free[: STOP_UNKNOWNS * self.count : STOP_UNKNOWNS], gate, stride)
        return equations

    def covariance(self, stop: int) -> FloatArray:
        """Covariance (3, 3) of the pose of a stop."""
        return self._factor_of_all().covariance(STOP_UNKNOWNS * stop + np.arange(3))

    def relative_sigma(self, stop: int, other: int) -> tuple[float, float]:
        """Standard deviations of a stop's position [m] and heading [rad] relative to another."""
        index = np.concatenate([STOP_UNKNOWNS * one + np.arange(3) for one in (stop, other)])
        cov = self._factor_of_all().covariance(index, np.hstack([np.eye(3), -np.eye(3)]))
        variances = np.maximum(np.diag(cov), 0.0)
        return math.sqrt(max(variances[:2])), math.sqrt(variances[2])

    def _factor_of_all(self) -> NormalFactor:
        if self._factored != self.count:
            self.solve(1)
        return self._factor

    def _apply(self, step: FloatArray) -> bool:
        """Apply a step; returns whether it is below `_SMALL_STEP` for all stops."""
        count = self.count
        change = step[: STOP_UNKNOWNS * count].reshape(-1, STOP_UNKNOWNS)
        self.states[:count] += change
        self.slip = self.slip + step[STOP_UNKNOWNS * count :]
        return bool((np.abs(change[:, :3]).max(axis=0, initial=0.0) < _SMALL_STEP).all())

    def _add_matches(self, equations: NormalEquations, moves: BoolArray, gate: float, stride: int) -> None:
        pairs, weights = [], []
        for stop, targets in self.targets.items():
            for other in targets:
                if moves[stop] or moves[other]:
                    start = stop in self.starts or other in self.starts
                    pairs.append((stop, other))
                    weights.append(min(1.0, (_START_WEIGHT if start else _MATCH_WEIGHT) / len(targets)))
        if pairs:
            index = np.array(pairs, dtype=np.int64)
            at = np.sort(self.place[index], axis=1)
            _, places = np.unique(at[:, 0] * self.count + at[:, 1], return_inverse=True)
            places[[not self.starts.intersection(pair) for pair in pairs]] = -1
            squares, gradient = match_pairs(self.scans, index, places, np.array(weights), gate, stride)
            unknowns = STOP_UNKNOWNS * index[:, :, None] + np.arange(STOP_UNKNOWNS)
            equations.add_blocks(unknowns.reshape(-1, 8), squares, gradient)

    def _grow(self) -> None:
        self.states, self.robot, self.place = map(doubled, (self.states, self.robot, self.place))
        self.turned, self._turned_all = doubled(self.turned), doubled(self._turned_all)
        self._fitted_ratio = doubled(self._fitted_ratio)
        self._beams = Beams(*(doubled(one) for one in self._beams))
        self._lines = Lines(*(doubled(one) for one in self._lines))


def doubled(array: Any) -> Any:
    """The array with twice the length, padded with zeros."""
    return np.concatenate([array, np.zeros_like(array)])
