"""Initialization from measurements of one degree of freedom, such as ranges: a window of them and odometry.

One range leaves a circle, two leave two points, and none shows a heading: only motion decides. The transform
from `map` to the track of a waiting robot is fitted to a window of its measurements by least squares, from
many starts. Each minimum is a hypothesis. The best one is accepted when its covariance is small, most
measurements agree with it, and every other hypothesis is much worse, also without any one of the links. So a
mirrored pose, which fits as well until the robot turns, is not taken before.

Of the models, only predictions and innovations are used.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.filter.measurements import NO_MEASUREMENTS, Measurements, concatenate, select
from swarm_loc_estimator.filter.models import MODELS
from swarm_loc_estimator.filter.state import InitialPose, SwarmState
from swarm_loc_estimator.swarm.calibration_states import RADIO_BIAS


class Window(NamedTuple):
    """Measurements (k,) of a waiting robot, in order of time, with the tracks of both sides."""

    measured: Measurements  # (k,) between it and localized sides
    track: FloatArray  # (k, 3) pose on the track of the waiting robot
    noise: FloatArray  # (k, 3, 3) preintegrated covariance of this track
    other_track: FloatArray  # (k, 3) the same of the robot on the other side, zero if it is none
    other_noise: FloatArray  # (k, 3, 3)

    @property
    def size(self) -> int:
        """Number of measurements."""
        return self.measured.size

    def some(self, rows: BoolArray | IntArray) -> Window:
        """Select rows."""
        return Window(select(self.measured, rows), *(column[rows] for column in self[1:]))

    def with_newest(self, row: Window) -> Window:
        """Append a row (1,)."""
        columns = (np.concatenate(both) for both in zip(self[1:], row[1:], strict=True))
        return Window(concatenate([self.measured, row.measured]), *columns)


NO_WINDOW = Window(NO_MEASUREMENTS, *(np.zeros((0, *shape)) for shape in ((3,), (3, 3), (3,), (3, 3))))

_INDEPENDENT_NS = 100_000_000  # Measurements of one link within this time are redundant
_LINK = ("observer", "target", "landmark", "reading")  # Equal for measurements between the same bodies
_MIN_ROWS = 8
_FIRST_ROWS = 16  # Number of rows from which the first fits are made
_HEADINGS = 8
_MAX_HYPOTHESES = 8
_FIRST_STEPS, _STEPS = 10, 15
_ROBUST = 2.0  # Residual in standard deviations from which measurements are down-weighted (Cauchy)
_TRUNCATED = 9.0  # Squared residual, in variances, from which a measurement disagrees and costs no more
_MIN_SHARE = 0.65  # Share of the measurements that must agree
_MIN_LINKS, _FEW_SHARE, _FEW_NS = 3, 0.85, 8_000_000_000
"""With fewer links, more must agree for longer: two too long ranges can agree with each other."""
_MARGIN, _MARGIN_WITHOUT = 30.0, 6.0
"""Least difference of cost to any other hypothesis, of all measurements and of those without one link."""
_MAX_EXCESS = 2.0  # Largest mean squared residual of the measurements that agree
_POSITION_SIGMA = 0.15
_APART_M, _APART_RAD = 0.1, 0.1
_MIN_SPREAD_M = 1.0


def with_row(window: Window, row: Window, window_ns: int, most: int) -> Window:
    """Window (k,) and a newer row (1,), without those that are too old; of too many, the most redundant goes.

    It is the row that leaves the smallest gap between rows of its link, for its age.
    """
    stamp_ns, now_ns = window.measured.stamp_ns, int(row.measured.stamp_ns[0])
    out = window.some(stamp_ns >= now_ns - window_ns).with_newest(row)
    if out.size <= most:
        return out
    stamp_ns, link = out.measured.stamp_ns, links(out)
    least, gone = np.inf, 0
    for one in np.unique(link).tolist():
        (places,) = np.nonzero(link == one)
        if places.size > 2:
            age_ns = np.maximum(now_ns - stamp_ns[places[1:-1]], 1)
            gap = (stamp_ns[places[2:]] - stamp_ns[places[:-2]]) / age_ns
            k = int(np.argmin(gap))
            if gap[k] < least:
                least, gone = float(gap[k]), int(places[k + 1])
    return out.some(np.delete(np.arange(out.size), gone))


def links(window: Window) -> IntArray:
    """Number of the link of each row (k,): equal for rows between the same bodies."""
    sides = np.stack([getattr(window.measured, name) for name in _LINK])
    return np.unique(sides, axis=1, return_inverse=True)[1].reshape(-1)


def is_redundant(window: Window, row: Window) -> bool:
    """Whether a newer row (1,) follows another one of its link in the window (k,) too closely."""
    same = [getattr(window.measured, name) == getattr(row.measured, name) for name in _LINK]
    stamp_ns = window.measured.stamp_ns[np.logical_and.reduce(same)]
    return bool(stamp_ns.size) and int(row.measured.stamp_ns[0] - stamp_ns[-1]) < _INDEPENDENT_NS


class _Fit(NamedTuple):
    """Rows (m,) linearized about a transform."""

    residual: FloatArray  # (m,) measured minus predicted
    jacobian: FloatArray  # (m, 3) of the prediction, by the right-invariant error of the transform
    other_jacobian: FloatArray  # (m, 3) by that of the other side
    variance: FloatArray  # (m,) of the residuals, all errors included

    @property
    def squared(self) -> FloatArray:
        """Squared residuals (m,) in units of their variances."""
        return np.asarray(np.square(self.residual) / self.variance)

    @property
    def cost(self) -> FloatArray:
        """The same, truncated."""
        return np.minimum(self.squared, _TRUNCATED)


class _Hypothesis(NamedTuple):
    """A minimum."""

    transform: FloatArray  # (3,) of the track
    fit: _Fit  # The rows there

    @property
    def cost(self) -> float:
        """Sum of the truncated costs."""
        return float(self.fit.cost.sum())


class Problem:
    """Least squares for the transform of a waiting robot's track, by rows (m,) with localized sides in order.

    `noise` (3, 3) is the preintegrated covariance of its track until now.
    """

    def __init__(self, state: SwarmState, robot: int, window: Window, noise: FloatArray) -> None:
        one = window.measured
        self._window = window
        self._sees: BoolArray = one.observer == robot
        self._other: IntArray = np.where(self._sees, one.target, one.observer)
        others, marks = np.maximum(self._other, 0), one.landmark
        self._other_pose = se2.compose(state.transform[others], window.other_track)
        by_mark = marks >= 0
        self._other_pose[by_mark] = state.landmark[marks[by_mark]]
        self._other_pose[(self._other < 0) & ~by_mark] = 0.0
        self._column = np.where(self._other >= 0, 3 * self._other, -1)
        self._column[by_mark] = [state.landmark_column(mark) for mark in marks[by_mark].tolist()]
        self._drift = noise - window.noise
        self._drift[np.linalg.eigvalsh(self._drift)[:, 0] < -1e-12] = 0.0  # late odometry has replaced noise
        self._bias, self._bias_covariance = self._radios(state, robot)
        self._link = links(window)
        self.centre = window.track.mean(axis=0)
        self._shared = {
            column: state.filter.block(column + np.arange(3))
            for column in np.unique(self._column[self._column >= 0]).tolist()
        }
        # how much another robot's track has drifted since: independent of what is known of it now
        moved = others[self._other >= 0]
        self._other_drift = np.zeros((window.size, 3, 3))
        drift = state.preintegrated_covariance[moved] - window.other_noise[self._other >= 0]
        towards = se2.adjoint(state.transform[moved])
        later = np.where(np.trace(drift, axis1=1, axis2=2) > 0.0, 1.0, -1.0)[:, None, None]
        self._other_drift[self._other >= 0] = later * towards @ drift @ np.swapaxes(towards, 1, 2)

    def _radios(self, state: SwarmState, robot: int) -> tuple[FloatArray, FloatArray]:
        """What the biases of robots' radios add to the rows (m,), and their covariance (m, m)."""
        weights = np.array([MODELS[model].radios for model in self._window.measured.model.tolist()])
        bias, covariance = np.zeros(self._window.size), np.zeros((self._window.size, self._window.size))
        for one in [robot, *np.unique(self._other[self._other >= 0]).tolist()]:
            sees = self._sees if one == robot else ~self._sees
            own = np.where(sees, weights[:, 0], weights[:, 1]) * ((self._other == one) | (one == robot))
            bias += own * state.parameter[one, RADIO_BIAS]
            covariance += np.outer(own, own) * state.parameter_sigma(one)[RADIO_BIAS] ** 2
        return bias, covariance

    def starts(self) -> FloatArray:
        """Transforms (h, 3) to begin with: around the other sides, in all directions."""
        one = self._window.measured
        far = np.where(self._sees[:, None], one.marker, one.sensor)
        far[:, 2] = 0.0
        place = se2.compose(self._other_pose, far)[:, :2]
        middle = place.mean(axis=0)
        spread = max(_MIN_SPREAD_M, float(np.hypot(*(place - middle).T).max()))
        ring = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
        headings = 2.0 * np.pi * np.arange(_HEADINGS) / _HEADINGS
        poses = [(*(middle + spread * np.array(at)), heading) for at in ring for heading in headings]
        local = se2.inverse([*self.centre[:2], 0.0])
        return se2.compose(np.array(poses), local)

    def fit(self, transform: FloatArray) -> _Fit:
        """Linearize all rows about a transform (3,)."""
        count = self._window.size
        poses = se2.compose(transform, self._window.track)
        residual, jacobians = np.zeros(count), np.zeros((2, count, 3))
        for k in range(count):
            one, sees = self._window.measured.row(k), bool(self._sees[k])
            model = MODELS[int(one.model)]
            sides = (poses[k], self._other_pose[k]) if sees else (self._other_pose[k], poses[k])
            predicted = model.predicted(one, *sides)
            residual[k] = model.innovation(one.value, predicted.value + self._bias[k])[0]
            jacobians[0 if sees else 1, k] = predicted.observer_jacobian[0]
            jacobians[1 if sees else 0, k] = predicted.target_jacobian[0]
        own, other = jacobians
        lost = ~(np.isfinite(residual) & np.isfinite(own).all(axis=1) & np.isfinite(other).all(axis=1))
        residual[lost], own[lost], other[lost] = np.inf, 0.0, 0.0
        variance = self._window.measured.covariance[:, 0, 0] + _within(other, self._other_drift)
        variance = variance + np.diag(self._bias_covariance)
        on_track = own @ se2.adjoint(transform)
        variance = variance + np.maximum(_within(on_track, self._drift), 0.0)
        for column, covariance in self._shared.items():
            seen = self._column == column
            variance[seen] += _within(other[seen], covariance)
        return _Fit(residual, own, other, variance)

    def descend(self, transform: FloatArray, steps: int) -> _Hypothesis:
        """Robust Levenberg-Marquardt from a transform (3,)."""
        damping, fit = 1e-2, self.fit(transform)
        cost = _robust_cost(fit)
        for _ in range(steps):
            # right-invariant errors of moves of the centre of the track and of turns about it
            x, y = se2.transform_points(transform, self.centre[:2])
            turn = np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [0.0, 0.0, 1.0]])
            jacobian = fit.jacobian @ turn
            weight = 1.0 / (fit.variance * (1.0 + fit.squared / _ROBUST**2))
            weight[~np.isfinite(fit.residual)] = 0.0
            information = (jacobian.T * weight) @ jacobian
            gradient = (jacobian.T * weight) @ np.nan_to_num(fit.residual, posinf=0.0)
            ridge = np.diag(damping * np.diag(information) + 1e-9)
            step = turn @ np.linalg.solve(information + ridge, gradient)
            moved = se2.compose(se2.exp(step), transform)
            there = self.fit(moved)
            new_cost = _robust_cost(there)
            if new_cost < cost:
                is_done = cost - new_cost < 1e-4 * (1.0 + cost)
                transform, fit, cost, damping = moved, there, new_cost, 0.2 * damping
                if is_done:
                    break
            else:
                damping *= 8.0
                if damping > 1e6:
                    break
        return _Hypothesis(transform, fit)

    def apart(self, one: FloatArray, other: FloatArray) -> bool:
        """Whether two transforms (3,) are different hypotheses."""
        away = se2.transform_points(one, self.centre[:2]) - se2.transform_points(other, self.centre[:2])
        turn = abs(float(se2.wrap_angle(one[2] - other[2])))
        return bool(np.hypot(*away) > _APART_M or turn > _APART_RAD)

    def is_beaten(self, best: _Fit, rival: _Fit) -> bool:
        """Whether a rival hypothesis is much worse than the best one, also without any one of the links."""
        more = rival.cost - best.cost
        by_link = np.bincount(self._link, weights=more)
        total, most = float(more.sum()), float(by_link.max())
        return total > _MARGIN and (by_link.size < _MIN_LINKS or total - most > _MARGIN_WITHOUT)

    def solution(self, transform: FloatArray) -> InitialPose | None:
        """Generalized least squares with the rows that agree with a transform (3,); None: singular.

        Rows share the drift of the track since the later one of them, and the errors of their other sides.
        """
        for _ in range(3):
            fit = self.fit(transform)
            good = fit.squared < _TRUNCATED
            own, other, column = fit.jacobian[good], fit.other_jacobian[good], self._column[good]
            on_track = own @ se2.adjoint(transform)
            own_variance = self._window.measured.covariance[good, 0, 0]
            alone = np.diag(own_variance + _within(other, self._other_drift[good]))
            upper = np.triu(np.einsum("ka,lab,lb->kl", on_track, self._drift[good], on_track))
            alone = alone + upper + np.triu(upper, 1).T + self._bias_covariance[np.ix_(good, good)]
            common = np.zeros_like(alone)
            for one, covariance in self._shared.items():
                of_one = other * (column == one)[:, None]
                common += of_one @ covariance @ of_one.T
            weighted = np.linalg.solve(alone + common, own)
            information = own.T @ weighted
            if not np.linalg.cond(information) < 1e12:
                return None
            gain = np.linalg.solve(information, weighted.T)
            transform = se2.compose(se2.exp(gain @ fit.residual[good]), transform)
        columns = np.array([one for one in self._shared if (column == one).any()], dtype=np.int64)
        shares = [-gain[:, column == one] @ other[column == one] for one in columns.tolist()]
        excess = max(1.0, float(fit.squared[good].sum()) / max(1, int(good.sum()) - 3))
        covariance = excess * gain @ alone @ gain.T
        covariance = 0.5 * (covariance + covariance.T) + 1e-12 * np.eye(3)
        return InitialPose(transform, covariance, columns, np.array(shares).reshape(-1, 3, 3))

    def covariance(self, initial: InitialPose) -> FloatArray:
        """Covariance (3, 3) of x, y and heading of the newest pose on the track."""
        pose = se2.compose(initial.transform, self._window.track[-1])
        return se2.pose_covariance(pose, initial.whole_covariance(self._shared))


def locate(
    state: SwarmState, robot: int, window: Window, noise: FloatArray, heading_sigma: float
) -> InitialPose | None:
    """The transform of a waiting robot's track by its measurements (m,); None while ambiguous or uncertain.

    `noise` (3, 3) is the preintegrated covariance of the track until now, `heading_sigma` the largest
    standard deviation of the heading [rad].
    """
    rows = window.measured
    known = np.append(state.tracked, True)  # index NOBODY (-1) selects the last element
    window = window.some(known[np.where(rows.observer == robot, rows.target, rows.observer)])
    if window.size < _MIN_ROWS:
        return None
    whole = Problem(state, robot, window, noise)
    by_link = np.lexsort((window.measured.stamp_ns, links(window)))
    some = np.sort(by_link[:: -(-window.size // _FIRST_ROWS)])
    first = Problem(state, robot, window.some(some), noise)
    begun = [first.descend(start, _FIRST_STEPS) for start in first.starts()]
    found: list[_Hypothesis] = []
    for rough in _distinct(whole, begun):
        found.append(whole.descend(rough.transform, _STEPS))
        weighted = found[0].fit.jacobian / np.sqrt(found[0].fit.variance)[:, None]
        if not np.linalg.cond(weighted.T @ weighted) < 1e12:  # not observed, as while a robot stands
            return None
    best, *rivals = _distinct(whole, found)
    # Does enough of the window agree, as well as its noise allows?
    squared, has_many_links = best.fit.squared, np.unique(links(window)).size >= _MIN_LINKS
    least = max(_MIN_ROWS, (_MIN_SHARE if has_many_links else _FEW_SHARE) * window.size)
    is_long = has_many_links or np.ptp(window.measured.stamp_ns) >= _FEW_NS
    agreeing = squared[squared < _TRUNCATED]
    if not (is_long and agreeing.size >= least and agreeing.mean() <= _MAX_EXCESS):
        return None
    if not all(whole.is_beaten(best.fit, rival.fit) for rival in rivals):
        return None
    initial = whole.solution(best.transform)
    if initial is None:
        return None
    x, y, heading = np.sqrt(np.diag(whole.covariance(initial))).tolist()
    is_sure = max(x, y) < _POSITION_SIGMA and heading < heading_sigma
    return initial if is_sure else None


def _distinct(problem: Problem, found: list[_Hypothesis]) -> list[_Hypothesis]:
    """The best ones of those that differ, in order of their cost."""
    chosen: list[_Hypothesis] = []
    for one in sorted(found, key=lambda hypothesis: hypothesis.cost):
        if all(problem.apart(one.transform, other.transform) for other in chosen):
            chosen.append(one)
        if len(chosen) == _MAX_HYPOTHESES:
            break
    return chosen


def _robust_cost(fit: _Fit) -> float:
    """Sum of Cauchy costs."""
    squared = np.minimum(fit.squared, 1e12)
    return float(_ROBUST**2 * np.log1p(squared / _ROBUST**2).sum())


def _within(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Variances (m,) of a component with Jacobians (m, 3) and covariances (m, 3, 3) or (3, 3)."""
    each = np.broadcast_to(covariance, (len(jacobian), 3, 3))
    return np.asarray(np.einsum("ma,mab,mb->m", jacobian, each, jacobian))
