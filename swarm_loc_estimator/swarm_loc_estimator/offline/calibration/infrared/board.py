"""Fit the model of an infrared board to exchanges of robots with known relative poses.

The unknowns are the amplitude law, the symmetric curves of sensors and emitters as tables, and the offset of
each robot's heading in ground truth. Residuals are computed after a variance-stabilizing transform, with a
robust loss. Second differences of the log curves are regularized.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.search import IrOutcome
from swarm_loc_estimator.offline.calibration.infrared.elements import ElementVerdicts, find_dead_elements
from swarm_loc_estimator.offline.calibration.infrared.gains import exchanges_of
from swarm_loc_estimator.offline.calibration.recording import CalibrationError, Recording
from swarm_loc_estimator.offline.calibration.sightings import TO_SIGMA, spread
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.offline.recorded_bag import Progress
from swarm_loc_estimator.swarm.ir_board import (
    Amplitude,
    IrGains,
    IrPlatform,
    PairGains,
    RobotIr,
    TabulatedCurve,
)
from swarm_loc_estimator.swarm.swarm import Swarm

_KNOTS = np.radians([0, 15, 30, 40, 50, 60, 70, 80, 90, 110, 135, 180])
_TABLE = np.radians(np.arange(0, 181, 10))
_FALLS_FROM = 5  # Index of the first knot from which curves must decrease
# Weights and limits are checked by test_ir_boards.py; on recordings of 2016: `a084869b:bench/droplet/real`.
_STEEPNESS, _BEND = 5.0, 0.8  # Weights of increases beyond that knot, and of second differences
_YAW_SIGMA = np.radians(4.0)
_OFFSET, _OFFSET_SIGMA, _EXPONENT, _EXPONENT_SIGMA = 0.05, 0.05, 2.5, 1.0  # Prior of the law, [m] and 1
_PRIOR = 3.0
_STEP = 1e-5
_GAIN_SIGMA, _MIN_SPREAD = 0.25, 0.01
_MIN_MEASURED = 100  # Minimum number of exchanges of a receiver for sensor gains
_LIMIT = 2.0  # Maximum residual after the robust loss [sigma]
_DIM = 3.0  # Maximum distance from the median of readings that tell the noise [sigma]; most show no light
_LIT = 8.0  # Minimum expectation of readings that determine the error of the curves [sigma]
_OUTLIER = 3.0  # Residuals beyond it are of blocked or too bright readings [sigma]
_MIN_SHARE, _MAX_SHARE = 0.02, 0.3
_ROUNDS = 2
_MAX_EVALUATIONS = 10


class BoardReadings(NamedTuple):
    """Exchanges of robots with one kind of board at full power."""

    receiver: IntArray  # (k,) index of the robot that measured
    transmitter: IntArray  # (k,) index of the robot that lit its emitters
    readings: FloatArray  # (k, n, n) [count], [sensor, emitter], NaN where not measured or dead
    poses: FloatArray  # (k, 3) of the transmitter seen from the receiver, range [m], bearing, heading [rad]
    stamp_ns: IntArray  # (k,)


@dataclass(frozen=True)
class BoardModel:
    """A fitted board."""

    platform: IrPlatform  # The board
    sensor_gains: FloatArray  # (robots, n) gains of the receivers' sensors; 1 where not estimated
    # (robots,) True where estimated; their spread is the platform's `element_sigma`
    gains_sought: BoolArray
    truth_yaw: FloatArray  # (robots,) heading of each robot minus that of its ground truth [rad]
    scatter: FloatArray  # (k, n, n) residuals of the fitted readings [sigma]
    angles: FloatArray  # (2, k, n, n) angles of the paths at sensors and emitters [rad]


def fit_board(start: IrPlatform, data: BoardReadings, robots: int) -> BoardModel:
    """Fit a board to exchanges with finite poses, starting from an approximate platform.

    The platform defines arrangement, saturation and initial noise. Gains of sensors with enough exchanges are
    estimated, too.
    """
    # robust standard deviation of dark readings [count], by the differences of one element's in successive
    # exchanges of a receiver, so that offset and drift of the amplifier cancel
    middle = float(np.nanmedian(data.readings))
    limit = _DIM * max(TO_SIGMA * float(np.nanmedian(np.abs(data.readings - middle))), 0.5)
    steps = []
    for receiver in np.unique(data.receiver).tolist():
        rows = np.flatnonzero(data.receiver == receiver)
        own = data.readings[rows[np.argsort(data.stamp_ns[rows], kind="stable")]]
        dark = np.abs(own - middle) < limit
        steps.append(np.diff(own, axis=0)[dark[1:] & dark[:-1]])
    found = np.concatenate(steps)
    noise = round(float(max(spread(found) / np.sqrt(2.0), 0.5)) if found.size else 0.5, 2)
    # curves, law, gains and yaw with this noise, then the noise that is relative to readings
    platform = replace(start, noise=noise, curve_sigma=0.3, relative_noise=0.0, element_sigma=0.0)
    unknowns = _Problem(platform, data, robots).first_unknowns()
    for _ in range(_ROUNDS):
        problem = _Problem(platform, data, robots)
        unknowns = least_squares(
            problem.residuals, unknowns, problem.slopes, x_scale="jac", max_nfev=_MAX_EVALUATIONS
        ).x
        platform = _with_noise(problem.platform_of(unknowns), problem, unknowns)
    scatter = problem.scatter(unknowns)
    yaw = problem.parts(unknowns)[3]
    logs, sought = problem.log_gains(unknowns), problem.gains_sought
    if sought.any():
        size = float(np.sqrt(np.mean(logs[sought] ** 2)))
        platform = replace(platform, element_sigma=round(min(max(size, _MIN_SPREAD), 1.0), 3))
    return BoardModel(platform, np.exp(logs), sought, yaw, scatter, problem.angles(yaw)[1])


def turned(poses: FloatArray, receiver_yaw: FloatArray, transmitter_yaw: FloatArray) -> FloatArray:
    """Relative poses (k, 3) after adding yaw offsets (k,) to the true headings [rad]."""
    moved: FloatArray = poses.copy()
    moved[:, 1] = wrap_angle(poses[:, 1] - receiver_yaw)
    moved[:, 2] = wrap_angle(poses[:, 2] + transmitter_yaw - receiver_yaw)
    return moved


class _Problem:
    """The least-squares problem for a platform with fixed noise."""

    def __init__(self, platform: IrPlatform, data: BoardReadings, robots: int) -> None:
        self._platform, self._data, self._robots = platform, data, robots
        self.gains_sought: BoolArray = np.bincount(data.receiver, minlength=robots) >= _MIN_MEASURED
        self._often = np.flatnonzero(self.gains_sought)
        count = len(_KNOTS)
        flat = ((1, np.zeros(count)), (1, np.zeros(count)))
        self._spline = CubicSpline(_KNOTS, np.eye(count), bc_type=flat)
        self._bend = np.diff(np.eye(count), 2, axis=0) / _BEND
        self._known = np.isfinite(data.readings)
        self._saturated = data.readings >= platform.saturation
        self._read = self._stable(np.clip(np.nan_to_num(data.readings), None, platform.saturation))
        self._units = np.stack([np.cos(platform.angles), np.sin(platform.angles)], axis=-1)

    def first_unknowns(self) -> FloatArray:
        """Initial values: cosine-like curves, and the amplitude of most of the brightest readings."""
        data = self._data
        shape = np.log(np.interp(_KNOTS[1:], np.radians([0, 40, 90, 180]), [1.0, 0.8, 0.05, 0.01]))
        gap = data.poses[:, 0] - 2.0 * self._platform.radius + _OFFSET
        brightest = np.maximum(np.nan_to_num(data.readings).max(axis=(1, 2)), 1.0)
        scale = np.median(np.log(brightest) + _EXPONENT * np.log(np.maximum(gap, 1e-3)))
        zeros = np.zeros(self._robots + self._often.size * self._platform.n)
        return np.concatenate([[scale, _OFFSET, _EXPONENT], shape, shape, zeros])

    def parts(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Law (log scale, offset, exponent), log curves of sensors and emitters at the knots, yaw."""
        count = len(_KNOTS) - 1
        law, sensor, emitter, rest = np.split(unknowns, [3, 3 + count, 3 + 2 * count])
        return law, np.r_[0.0, sensor], np.r_[0.0, emitter], rest[: self._robots]

    def log_gains(self, unknowns: FloatArray) -> FloatArray:
        """Log-gains (robots, n) of sensors."""
        n = self._platform.n
        logs = np.zeros((self._robots, n))
        logs[self._often] = unknowns[unknowns.size - self._often.size * n :].reshape(-1, n)
        return logs

    def angles(self, yaw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances (k, n, n) [m], and angles (2, k, n, n) at sensors and emitters [rad]."""
        data = self._data
        return self._angles(turned(data.poses, yaw[data.receiver], yaw[data.transmitter]))

    def _angles(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances and angles, as `angles` returns them, at relative poses (k, 3)."""
        rho, ahead = self._platform.radius, np.array(self._platform.angles)
        distance, bearing, heading = poses.T
        at = ahead + heading[:, None]
        emitters = rho * np.stack([np.cos(at), np.sin(at)], axis=-1)
        centre = distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
        way = (centre[:, None] + emitters)[:, None] - rho * self._units[None, :, None]
        along = np.arctan2(way[..., 1], way[..., 0])
        sensor = np.abs(wrap_angle(along - ahead[None, :, None]))
        emitter = np.abs(wrap_angle(along + np.pi - at[:, None]))
        return np.hypot(way[..., 0], way[..., 1]), np.stack([sensor, emitter])

    def expected(self, unknowns: FloatArray) -> FloatArray:
        """Expected readings (k, n, n) [count]."""
        law, sensor, emitter, yaw = self.parts(unknowns)
        distance, (alpha, beta) = self.angles(yaw)
        logs = law[0] - law[2] * np.log(np.maximum(distance + law[1], 1e-3))
        logs += self.log_gains(unknowns)[self._data.receiver, :, None]
        readings: FloatArray = np.exp(logs + self._spline(alpha) @ sensor + self._spline(beta) @ emitter)
        return readings

    def scatter(self, unknowns: FloatArray) -> FloatArray:
        """Residuals (k, n, n) of readings [sigma]; NaN where there is no reading."""
        more = self._read - self._stable(self.expected(unknowns))
        more = np.where(self._saturated, np.maximum(more, 0.0), more)
        return np.where(self._known, more, np.nan)

    def residuals(self, unknowns: FloatArray) -> FloatArray:
        """Residuals of readings after the robust loss, and of the regularization."""
        limited = _limited(np.nan_to_num(self.scatter(unknowns)))[0]
        return np.concatenate([limited.ravel(), self._held(unknowns)])

    def slopes(self, unknowns: FloatArray) -> FloatArray:
        data, count, n = self._data, len(_KNOTS) - 1, self._platform.n
        law, sensor, emitter, yaw = self.parts(unknowns)
        distance, (alpha, beta) = self.angles(yaw)
        bright = self.expected(unknowns)
        scatter = self.scatter(unknowns)
        by_log = -bright / np.hypot(self._platform.noise, self._platform.relative * bright)
        by_log = np.nan_to_num(np.where(scatter == 0.0, 0.0, by_log) * _limited(np.nan_to_num(scatter))[1])
        by_log[~self._known] = 0.0
        away = np.maximum(distance + law[1], 1e-3)
        columns = np.zeros((unknowns.size, *bright.shape))
        columns[0], columns[1], columns[2] = by_log, -by_log * law[2] / away, -by_log * np.log(away)
        columns[3 : 3 + count] = np.moveaxis(self._spline(alpha)[..., 1:], -1, 0) * by_log
        columns[3 + count : 3 + 2 * count] = np.moveaxis(self._spline(beta)[..., 1:], -1, 0) * by_log
        first = 3 + 2 * count
        for side, robots in ((0, data.receiver), (1, data.transmitter)):
            turn = np.zeros((2, len(robots)))
            turn[side] = _STEP
            distance_there, (alpha_there, beta_there) = self._angles(
                turned(data.poses, yaw[data.receiver] + turn[0], yaw[data.transmitter] + turn[1])
            )
            change = -law[2] * np.log(np.maximum(distance_there + law[1], 1e-3) / away)
            change += (self._spline(alpha_there) - self._spline(alpha)) @ sensor
            change += (self._spline(beta_there) - self._spline(beta)) @ emitter
            columns[first + robots, np.arange(len(robots))] += by_log * change / _STEP
        for place, robot in enumerate(self._often.tolist()):
            rows = np.flatnonzero(data.receiver == robot)
            for i in range(n):
                columns[first + self._robots + place * n + i, rows, i] = by_log[rows, i]
        # the regularization by finite differences, which are cheap here
        here, ahead = self._held(unknowns), unknowns + _STEP * np.eye(unknowns.size)
        slopes = np.stack([(self._held(one) - here) / _STEP for one in ahead], axis=1)
        return np.concatenate([columns.reshape(unknowns.size, -1).T, slopes])

    def _held(self, unknowns: FloatArray) -> FloatArray:
        law, sensor, emitter, yaw = self.parts(unknowns)
        held = [self._bend @ sensor, self._bend @ emitter, yaw / _YAW_SIGMA]
        held += [
            _STEEPNESS * np.maximum(np.diff(curve)[_FALLS_FROM - 1 :], 0.0) for curve in (sensor, emitter)
        ]
        held.append(self.log_gains(unknowns)[self._often].ravel() / _GAIN_SIGMA)
        held.append((law[1:] - [_OFFSET, _EXPONENT]) / [_OFFSET_SIGMA, _EXPONENT_SIGMA])
        return _PRIOR * np.concatenate(held)

    def platform_of(self, unknowns: FloatArray) -> IrPlatform:
        """The platform with the law and curves of these unknowns."""
        law, sensor, emitter, _ = self.parts(unknowns)
        nearest = 0.0 if law[1] > 0.0 else 0.005 - law[1]  # least distance at which this law is valid [m]
        amplitude = Amplitude(float(np.exp(law[0])), float(law[1]), float(law[2]), nearest=nearest)
        return replace(
            self._platform,
            sensor=self._curve(sensor),
            emitter=self._curve(emitter),
            amplitudes=(amplitude, *self._platform.amplitudes[1:]),
        )

    def _curve(self, logs: FloatArray) -> TabulatedCurve:
        """A symmetric table that decreases beyond its maximum."""
        values = np.exp(self._spline(_TABLE) @ logs)
        top = int(values.argmax())
        values[top:] = np.minimum.accumulate(values[top:])
        both = np.concatenate([values[:0:-1], values]).round(4)
        angles = np.concatenate([-_TABLE[:0:-1], _TABLE]).round(5)
        return TabulatedCurve(tuple(angles.tolist()), tuple(both.tolist()))

    def _stable(self, values: FloatArray) -> FloatArray:
        """Variance-stabilizing transform of brightness [sigma]."""
        relative, noise = self._platform.relative, self._platform.noise
        return np.asarray(np.arcsinh(relative * values / noise) / relative)


def _limited(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals after the robust loss, and their derivatives by the residuals."""
    part = np.exp(-(values**2) / (2.0 * _LIMIT**2))
    size = np.sqrt(2.0 * _LIMIT**2 * (1.0 - part))
    slope = np.where(size > 1e-6, np.abs(values) * part / np.maximum(size, 1e-12), 1.0)
    return np.sign(values) * size, slope


def _with_noise(platform: IrPlatform, problem: _Problem, unknowns: FloatArray) -> IrPlatform:
    expected, scatter = problem.expected(unknowns), problem.scatter(unknowns)
    known = np.isfinite(scatter)
    lit = known & (expected > _LIT * platform.noise) & (expected < platform.saturation)
    relative = platform.relative * (spread(scatter[lit]) if lit.any() else 1.0)
    blocked = float(np.mean(scatter[lit] < -_OUTLIER)) if lit.any() else 0.0
    bright = float(np.mean(scatter[known & ~lit] > _OUTLIER))
    return replace(
        platform,
        curve_sigma=round(min(max(relative, 0.01), 1.0), 3),
        blocked_share=round(min(max(blocked, _MIN_SHARE), _MAX_SHARE), 3),
        bright_share=round(min(max(bright, _MIN_SHARE), _MAX_SHARE), 3),
    )


MAX_RANGE = 0.3  # Maximum distance of exchanges that are used [m]; farther readings are mostly noise
_BODIES = 2.0  # Maximum distance of an occluding robot from the line between two others [robot radii]
_TRUTH_GAP_NS = 200_000_000


@dataclass(frozen=True)
class BoardRecording:
    """Exchanges of a recording with one kind of board."""

    platform: IrPlatform  # The initial model of the board
    robots: tuple[int, ...]  # Their indices in the swarm, in ascending order
    data: BoardReadings  # All exchanges with ground truth; robots by place in `robots`
    clear: BoolArray  # (k,) True where no other robot is known to occlude the line of sight


def read_board(recording: Recording, swarm: Swarm) -> BoardRecording:
    """The exchanges with ground truth of the first kind of board of a swarm.

    Raises CalibrationError if there are none.
    """
    group, stamp_ns = exchanges_of(recording, swarm)
    known = np.isfinite(group.exchanges.poses[:, 0])
    if not known.any():
        raise CalibrationError(
            f"recording '{recording.name}' holds no exchange between robots whose ground truth is known then;"
            " a board cannot be calibrated without <robot>/ground_truth."
        )
    one = group.exchanges
    data = BoardReadings(one.receiver, one.transmitter, one.readings[:, 0], one.poses, stamp_ns)
    data = select(data, known)
    clear = _clear(recording, swarm, group.robots, data, _BODIES * group.platform.radius)
    return BoardRecording(group.platform, group.robots, data, clear)


def calibrate_from(
    recording: Recording, swarm: Swarm, progress: Progress
) -> tuple[BoardRecording, BoardCalibration]:
    """Calibrate the board of a recording; raises CalibrationError if there is too little ground truth."""
    progress(0.0, "exchanges")
    board = read_board(recording, swarm)
    progress(0.1, "fitting, and validating on blocks of time")
    to_fit = select(board.data, board.clear & (board.data.poses[:, 0] < MAX_RANGE))
    return board, calibrate_board(board.platform, to_fit, len(board.robots))


def with_board(swarm: Swarm, board: BoardRecording, done: BoardCalibration, path: Path) -> Swarm:
    """The swarm with the calibrated board, written to `path`, and the robots' gains and dead elements."""
    robots = list(swarm.robots)
    for place, index in enumerate(board.robots):
        ir = robots[index].ir
        if ir is None:
            continue
        gains, factors = None, done.model.sensor_gains[place]
        if done.with_gains and np.any(factors != 1.0):
            ones = (1.0,) * board.platform.n
            gains = IrGains(tuple(np.clip(factors, 0.05, 20.0).round(4).tolist()), ones, GAIN_SIGMA)
        found = RobotIr(ir.id, done.model.platform, str(path.resolve()), gains, *done.elements.numbers(place))
        robots[index] = replace(robots[index], ir=replace(found, gate_probability=ir.gate_probability))
    return replace(swarm, robots=tuple(robots))


def _clear(
    recording: Recording, swarm: Swarm, robots: tuple[int, ...], data: BoardReadings, width: float
) -> BoolArray:
    """(k,) True where no other robot is known to be within `width` of the line of sight of an exchange."""
    places = np.full((len(swarm.robots), len(data.stamp_ns), 2), np.nan)
    for k, robot in enumerate(swarm.robots):
        if robot.name in recording.truth:
            places[k] = interpolate(recording.truth[robot.name], data.stamp_ns, _TRUTH_GAP_NS)[0][:, :2]
    rows, of_swarm = np.arange(len(data.stamp_ns)), np.array(robots)
    begin, end = (places[of_swarm[side], rows] for side in (data.receiver, data.transmitter))
    way, clear = end - begin, np.ones(len(rows), dtype=np.bool_)
    for k, others in enumerate(places):
        # distance (k,) of this robot from the lines of sight
        share = np.sum((others - begin) * way, axis=1) / np.maximum(np.sum(way**2, axis=1), 1e-12)
        away = np.linalg.norm(others - begin - np.clip(share, 0.0, 1.0)[:, None] * way, axis=1)
        third = (of_swarm[data.receiver] != k) & (of_swarm[data.transmitter] != k)
        clear &= ~(third & (away < width))
    return clear


GAIN_SIGMA = 0.05
"""Relative standard deviation of calibrated gains.

Set by hand: a jackknife over blocks of time gives .03 to .17 on the recordings of 2016, where some sensors
are sometimes dark, and yields worse results on other recordings: 10.6 instead of 10.4 deg of heading.
"""
MIN_EXCHANGES = 100  # Minimum number of exchanges with ground truth
BLOCKS = 3
_STRAY = (0.0, 0.01, 0.02, 0.03, 0.04, 0.06)  # Candidate values of stray light
_MISFIT = 3.0  # Maximum RMS residual of the initial platform [sigma]; beyond, its curves are wrong
_TAIL_SHARE, _TAIL_BOUND = 0.97, 11.345
"""Share of errors that must lie within the 99 % bound of the normal distribution; covariances are scaled."""
_MAX_SCALE = 30.0


@dataclass(frozen=True)
class HeldOut:
    """Errors in blocks of time held out of the fit."""

    errors: FloatArray  # (s, 3) range [m], bearing, heading [rad] of the solved exchanges
    nees: FloatArray  # (s,) normalised estimation errors squared
    asked: int  # Number of exchanges

    @property
    def solved_share(self) -> float:
        """Share of the exchanges with a pose."""
        return len(self.errors) / max(self.asked, 1)

    @property
    def badness(self) -> float:
        """Mean log of the medians and 90 % quantiles of the errors, minus the log of the share solved."""
        if len(self.errors) < 2:
            return np.inf
        sizes = np.quantile(np.abs(self.errors), (0.5, 0.9), axis=0)
        return float(np.mean(np.log(sizes)) - np.log(self.solved_share))

    @property
    def medians(self) -> FloatArray:
        """Medians (3,) of the absolute errors [m, rad, rad]."""
        return np.median(np.abs(self.errors), axis=0) if len(self.errors) else np.full(3, np.nan)


@dataclass(frozen=True)
class BoardCalibration:
    """A calibrated board."""

    model: BoardModel  # Model fitted to all exchanges
    stock_sigma: float  # RMS residual of the initial platform at the true poses [sigma]
    held_out: HeldOut  # Errors in blocks held out of the fit (cross-validation)
    with_gains: bool  # Whether sensor gains reduced these errors and are kept
    elements: ElementVerdicts  # Dead or shaded elements, according to the fitted board
    saturation: FloatArray  # (n,) maximum count of each sensor

    @property
    def curves_wrong(self) -> bool:
        """Whether the initial platform fits too badly to attribute residuals to single robots."""
        return self.stock_sigma > _MISFIT


def calibrate_board(start: IrPlatform, data: BoardReadings, robots: int) -> BoardCalibration:
    """Calibrate a board by exchanges with known poses.

    The initial platform defines the arrangement and the saturation count. Raises CalibrationError if there
    are too few exchanges.
    """
    if len(data.receiver) < MIN_EXCHANGES:
        raise CalibrationError(
            f"{len(data.receiver)} exchanges with ground truth are too few for a board,"
            f" {MIN_EXCHANGES} are the least."
        )
    # the initial curves may be wrong, and the robust loss limits outliers
    first = fit_board(start, data, robots)
    elements, alive = without_dead(first.platform, data, robots)
    validated = _cross_validated(start, alive, robots)
    stray = min(_STRAY, key=lambda one: validated[one, True].badness)
    tried = {known: validated[stray, known] for known in (True, False)}
    ranges = {known: one.medians[0] / max(one.solved_share, 0.01) for known, one in tried.items()}
    gains = bool(ranges[True] < ranges[False])
    model, held = fit_board(start, alive, robots) if elements.dead.any() else first, tried[gains]
    # the platform also serves robots with unknown gains
    scales = [np.quantile(one.nees, _TAIL_SHARE) / _TAIL_BOUND for one in tried.values() if one.nees.size]
    scale = round(float(np.clip(max(scales, default=1.0), 1.0, _MAX_SCALE)), 2)
    platform = replace(model.platform, stray_noise=stray, covariance_scale=scale)
    held = replace(held, nees=held.nees / scale)
    brightest = np.nanmax(np.nan_to_num(data.readings), axis=(0, 2))
    # RMS residual of unsaturated readings of the initial platform at the true poses [sigma]
    bright = expected_brightness(replace(start, amplitudes=start.amplitudes[:1]), alive.poses)[:, 0]
    usable = (alive.readings < start.saturation) & (bright < start.saturation)  # False for NaN
    off = (alive.readings - bright) / np.hypot(start.noise, start.relative * bright)
    sigma = float(np.sqrt(np.mean(off[usable] ** 2))) if usable.any() else np.inf
    return BoardCalibration(replace(model, platform=platform), sigma, held, gains, elements, brightest)


def pair_gains(model: BoardModel, data: BoardReadings, *, known: bool = True) -> PairGains:
    """Gains of the exchanges' pairs; unknown gains have the standard deviation `element_sigma`."""
    sensor, count = model.sensor_gains[data.receiver], len(data.receiver)
    if not known:
        return model.platform.unknown_gains(count)
    sigma = np.zeros((count, 4))
    sigma[:, 0] = np.where(model.gains_sought[data.receiver], GAIN_SIGMA, model.platform.element_sigma)
    sigma[:, 2] = model.platform.element_sigma
    return PairGains(sensor, np.ones_like(sensor), sigma)


def errors_of(model: BoardModel, data: BoardReadings, *, known: bool = True) -> HeldOut:
    """Errors of a board on exchanges with known poses, with or without the calibrated gains."""
    solutions = MaximumLikelihood(model.platform).solve(
        data.readings[:, None], pair_gains(model, data, known=known)
    )
    yaw = model.truth_yaw
    truth = turned(data.poses, yaw[data.receiver], yaw[data.transmitter])
    found = solutions.outcomes == IrOutcome.FOUND
    errors = solutions.poses[found] - truth[found]
    errors[:, 1:] = wrap_angle(errors[:, 1:])
    return HeldOut(errors, nees(errors, solutions.covariances[found]), len(found))


def without_dead(
    platform: IrPlatform, data: BoardReadings, robots: int
) -> tuple[ElementVerdicts, BoardReadings]:
    """Detect dead or shaded elements without known poses; returns them and the exchanges without them.

    The share of blocked readings is at least that of the initial platform, since the board is fitted to
    exchanges without occlusion.
    """
    count = len(data.receiver)
    limits, unknown = np.full((count, 1), platform.saturation), np.full((count, 3), np.nan)
    exchanges = Exchanges(data.receiver, data.transmitter, data.readings[:, None], limits, unknown)
    elements = find_dead_elements(platform, robots, exchanges)
    return elements, data._replace(readings=elements.without(exchanges).readings[:, 0])


def _cross_validated(
    start: IrPlatform, data: BoardReadings, robots: int
) -> dict[tuple[float, bool], HeldOut]:
    """Cross-validated errors by stray light and by whether gains are used."""
    parts: dict[tuple[float, bool], list[HeldOut]] = {one: [] for one in product(_STRAY, (True, False))}
    blocks = _blocks(data)
    for block in range(BLOCKS):
        held = blocks == block
        model, others = fit_board(start, select(data, ~held), robots), select(data, held)
        for (stray, known), found in parts.items():
            strayed = replace(model, platform=replace(model.platform, stray_noise=stray))
            found.append(errors_of(strayed, others, known=known))
    return {one: _joined(found) for one, found in parts.items()}


def _blocks(data: BoardReadings) -> IntArray:
    """Block of time (k,) of each exchange; blocks divide the exchanges of each receiver evenly."""
    blocks = np.zeros(len(data.receiver), dtype=np.int64)
    for receiver in np.unique(data.receiver).tolist():
        rows = np.flatnonzero(data.receiver == receiver)
        in_order = rows[np.argsort(data.stamp_ns[rows], kind="stable")]
        for number, part in enumerate(np.array_split(in_order, BLOCKS)):
            blocks[part] = number
    return blocks


def _joined(parts: list[HeldOut]) -> HeldOut:
    errors, normed = (np.concatenate([getattr(one, name) for one in parts]) for name in ("errors", "nees"))
    return HeldOut(errors, normed, sum(part.asked for part in parts))
