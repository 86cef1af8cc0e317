"""Calibration of an infrared board from a recording with ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.gains import Exchanges
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.solution import IrOutcome
from swarm_loc_estimator.offline.calibration.infrared.board_fit import (
    BoardModel,
    BoardReadings,
    fit_board,
    turned,
)
from swarm_loc_estimator.offline.calibration.infrared.dead_elements import ElementVerdicts, find_dead_elements
from swarm_loc_estimator.offline.calibration.infrared.gains import exchanges_of
from swarm_loc_estimator.offline.calibration.recording import CalibrationError, Recording
from swarm_loc_estimator.offline.recorded_bag import Progress
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform, PairGains, RobotIr
from swarm_loc_estimator.swarm.swarm import Swarm

MAX_RANGE = 0.3  # Maximum distance of exchanges that are used [m]; farther readings are mostly noise
_BODIES = 2.0
"""Maximum distance of an occluding robot from the line of sight between two others [robot radii]."""
_TRUTH_GAP_NS = 200_000_000


@dataclass(frozen=True)
class BoardRecording:
    """Exchanges of a recording with one kind of board."""

    platform: IrPlatform  # The initial model of the board
    robots: tuple[int, ...]  # Their indices in the swarm, in ascending order
    data: BoardReadings  # All exchanges with ground truth; robots by place in `robots`
    clear: BoolArray  # (k,) True where no other robot is known to occlude the line of sight

    @property
    def to_fit(self) -> BoardReadings:
        """The exchanges to which a board is fitted."""
        return self.data.select(self.clear & (self.data.poses[:, 0] < MAX_RANGE))


def read_board(recording: Recording, swarm: Swarm) -> BoardRecording:
    """The exchanges with ground truth of the first kind of board of a swarm.

    Raises:
        CalibrationError: There are none.
    """
    group, stamp_ns = exchanges_of(recording, swarm)
    known = np.isfinite(group.exchanges.poses[:, 0])
    if not known.any():
        raise CalibrationError(
            f"recording '{recording.name}' holds no exchange between robots whose ground truth is known then;"
            " a board cannot be calibrated without <robot>/ground_truth."
        )
    one = group.exchanges
    data = BoardReadings(one.receiver, one.transmitter, one.readings[:, 0], one.poses, stamp_ns).select(known)
    clear = _clear(recording, swarm, group.robots, data, _BODIES * group.platform.radius)
    return BoardRecording(group.platform, group.robots, data, clear)


def calibrate_from(
    recording: Recording, swarm: Swarm, progress: Progress
) -> tuple[BoardRecording, BoardCalibration]:
    """Calibrate the board of a recording.

    Raises:
        CalibrationError: There is too little ground truth.
    """
    progress(0.0, "exchanges")
    board = read_board(recording, swarm)
    progress(0.1, "fitting, and validating on blocks of time")
    return board, calibrate_board(board.platform, board.to_fit, len(board.robots))


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
        found = RobotIr(
            ir.id,
            done.model.platform,
            str(path.resolve()),
            ir.estimator,
            gains,
            *done.elements.numbers(place),
        )
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
    clear = np.ones(len(rows), dtype=np.bool_)
    for k, others in enumerate(places):
        beside = _distance_to_line(others, begin, end)
        third = (of_swarm[data.receiver] != k) & (of_swarm[data.transmitter] != k)
        clear &= ~(third & (beside < width))
    return clear


def _distance_to_line(points: FloatArray, begin: FloatArray, end: FloatArray) -> FloatArray:
    """Distances (k,) from points to line segments; all arguments (k, 2)."""
    way = end - begin
    share = np.sum((points - begin) * way, axis=1) / np.maximum(np.sum(way**2, axis=1), 1e-12)
    return np.asarray(np.linalg.norm(points - begin - np.clip(share, 0.0, 1.0)[:, None] * way, axis=1))


GAIN_SIGMA = 0.05
"""Relative standard deviation of calibrated gains.

Set by hand: a jackknife over blocks of time gives .03 to .17 on the recordings of 2016, where some sensors
are sometimes dark, and yields worse results on other recordings: 10.6 instead of 10.4 deg of heading.
"""
MIN_EXCHANGES = 100  # Minimum number of exchanges with ground truth
BLOCKS = 3
_STRAY = (0.0, 0.01, 0.02, 0.03, 0.04, 0.06)  # Candidate values of stray light
_MISFIT = 3.0
"""Maximum RMS residual of the initial platform; beyond it its curves are considered wrong [sigma]."""
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
    """Calibrate a board.

    Args:
        start: Initial platform, which defines the arrangement and the saturation count.
        data: Exchanges with known poses.
        robots: Number of robots.

    Raises:
        CalibrationError: There are too few exchanges.
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
    stray = min(validated, key=lambda one: validated[one][True].badness)
    tried = validated[stray]
    ranges = {known: one.medians[0] / max(one.solved_share, 0.01) for known, one in tried.items()}
    gains = bool(ranges[True] < ranges[False])
    model, held = fit_board(start, alive, robots) if elements.dead.any() else first, tried[gains]
    # the platform also serves robots with unknown gains
    scales = [np.quantile(one.nees, _TAIL_SHARE) / _TAIL_BOUND for one in tried.values() if one.nees.size]
    scale = round(float(np.clip(max(scales, default=1.0), 1.0, _MAX_SCALE)), 2)
    platform = replace(model.platform, stray_noise=stray, covariance_scale=scale)
    held = replace(held, nees=held.nees / scale)
    brightest = np.nanmax(np.nan_to_num(data.readings), axis=(0, 2))
    sigma = stock_residual(start, alive)
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
    solved = np.linalg.solve(solutions.covariances[found], errors[..., None])[..., 0]
    return HeldOut(errors, np.asarray(np.sum(errors * solved, axis=1)), len(found))


def stock_residual(platform: IrPlatform, data: BoardReadings) -> float:
    """RMS residual of unsaturated readings at the true poses [sigma]."""
    bright = expected_brightness(replace(platform, amplitudes=platform.amplitudes[:1]), data.poses)[:, 0]
    usable = (
        np.isfinite(data.readings) & (data.readings < platform.saturation) & (bright < platform.saturation)
    )
    sigma = np.hypot(platform.noise, platform.relative * bright)
    return (
        float(np.sqrt(np.mean(((data.readings - bright) / sigma)[usable] ** 2))) if usable.any() else np.inf
    )


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


def _cross_validated(start: IrPlatform, data: BoardReadings, robots: int) -> dict[float, dict[bool, HeldOut]]:
    """Cross-validated errors by stray light and by whether gains are used."""
    parts: dict[float, dict[bool, list[HeldOut]]] = {stray: {True: [], False: []} for stray in _STRAY}
    blocks = _blocks(data)
    for block in range(BLOCKS):
        held = blocks == block
        model, others = fit_board(start, data.select(~held), robots), data.select(held)
        for stray, by_gains in parts.items():
            strayed = replace(model, platform=replace(model.platform, stray_noise=stray))
            for known, found in by_gains.items():
                found.append(errors_of(strayed, others, known=known))
    return {
        stray: {known: _joined(found) for known, found in by_gains.items()}
        for stray, by_gains in parts.items()
    }


def _blocks(data: BoardReadings) -> NDArray[np.int64]:
    """Block of time (k,) of each exchange; blocks divide the exchanges of each receiver evenly."""
    blocks = np.zeros(len(data.receiver), dtype=np.int64)
    for receiver in np.unique(data.receiver).tolist():
        rows = np.flatnonzero(data.receiver == receiver)
        in_order = rows[np.argsort(data.stamp_ns[rows], kind="stable")]
        for number, part in enumerate(np.array_split(in_order, BLOCKS)):
            blocks[part] = number
    return blocks


def _joined(parts: list[HeldOut]) -> HeldOut:
    """Concatenate the errors of several blocks."""
    return HeldOut(
        np.concatenate([part.errors for part in parts]),
        np.concatenate([part.nees for part in parts]),
        sum(part.asked for part in parts),
    )
