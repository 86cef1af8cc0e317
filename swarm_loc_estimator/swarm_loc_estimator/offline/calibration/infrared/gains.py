"""Calibrate the gains of infrared boards from a recording, one fit for each kind of board.

Gains are cross-validated: they are estimated with one block of time held out, and the likelihood of the
held-out exchanges is evaluated. They are accepted where it is higher than with unit gains and with unknown
gains. Errors of the curves are correlated over time, so the sum over all robots must exceed its scatter over
blocks. Single robots need only a positive sum, since some have few readings.

The relative pose of an exchange is unknown or uncertain, so the likelihood is marginalized over the pose by
importance sampling around the solutions with and without gains. All hypotheses on a pair's gains are compared
at the same poses. Any reading may be blocked or too bright, with the cost `_OUTLIER`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.infrared.brightness import expected_brightness
from swarm_loc_estimator.infrared.gains import POSE_SIGMA, Exchanges, GainsError, GainsFit, estimate_gains
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.infrared.search import DARKEST, IrSolutions
from swarm_loc_estimator.offline.calibration.infrared.elements import (
    ElementVerdicts,
    ReadingLimits,
    contradictions,
    find_dead_elements,
    find_reading_limits,
    stabilized,
)
from swarm_loc_estimator.offline.calibration.recording import DENSE_GAP_NS, CalibrationError, Recording
from swarm_loc_estimator.offline.recorded_bag import Progress
from swarm_loc_estimator.sensors.infrared import ExchangeKey, MatrixScreening, Readings
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform, PairGains
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

BLOCKS = 4
# Checked by test_ir_brightness.py.
_EVIDENCE = math.log(100.0)  # Minimum increase of the log likelihood of all exchanges
GAINS, ALIKE, UNKNOWN = range(3)
"""Hypotheses on a robot's gains: the estimate; unit gains with the same uncertainty; unknown gains with the
board's `element_sigma`."""
HYPOTHESES = 3
_POINTS = 48  # Number of poses sampled around each solution
_SEED = 1
_OUTLIER = 10.0  # Cost of a blocked or too bright reading


def helpful_gains(
    platform: IrPlatform, robots: int, exchanges: Exchanges, progress: Callable[[str], None] = lambda _: None
) -> BoolArray:
    """True (robots,) where gains by `estimate_gains` improve held-out exchanges, given in order of time."""
    count = len(exchanges.receiver)
    logs, blocks = np.full((count, HYPOTHESES, HYPOTHESES), np.nan), np.arange(count) * BLOCKS // count
    for block in range(BLOCKS):
        progress(f"held-out block {block + 1}")
        held = blocks == block
        try:
            fit = estimate_gains(platform, robots, select(exchanges, ~held))
        except GainsError:
            continue
        logs[held] = held_out_likelihoods(platform, fit.gains, select(exchanges, held))
    # remove the robot with the least improvement until each remaining one and their sum pass the test
    pairs = np.stack([exchanges.receiver, exchanges.transmitter])
    helps = np.ones(robots, dtype=np.bool_)
    while helps.any():
        own = np.full(robots, np.inf)
        for robot in np.flatnonzero(helps).tolist():
            alone = np.arange(robots) == robot
            own[robot] = min(by_block.sum() for by_block in _by_block(pairs, logs, blocks, helps, alone))
        # the margin by which each sum over blocks exceeds chance
        whole = _by_block(pairs, logs, blocks, helps, helps)
        sure = min(float(one.sum() - max(_EVIDENCE, np.linalg.norm(one))) for one in whole)
        if own.min() > 0.0 and sure > 0.0:
            break
        helps[own.argmin()] = False
    return helps


def _by_block(
    pairs: IntArray, logs: FloatArray, blocks: IntArray, helps: BoolArray, judged: BoolArray
) -> list[FloatArray]:
    """Log-likelihood ratios by block of the estimated gains to each other hypothesis."""
    receiver, transmitter = np.where(helps, GAINS, UNKNOWN)[pairs]
    rows, gains = np.arange(len(blocks)), []
    for hypothesis in (ALIKE, UNKNOWN):
        one, other = np.where(judged[pairs], hypothesis, (receiver, transmitter))
        gain = logs[rows, receiver, transmitter] - logs[rows, one, other]
        gains.append(np.bincount(blocks, np.nan_to_num(gain), BLOCKS).astype(np.float64))
    return gains


def held_out_likelihoods(
    platform: IrPlatform, gains: tuple[IrGains, ...], exchanges: Exchanges
) -> FloatArray:
    """Log likelihoods (k, H, H) of exchanges by the hypotheses on receiver and transmitter.

    A constant per exchange is omitted; NaN where no pose is found. The gains were estimated without them.
    """
    # gains of sensors and emitters by hypothesis, and the standard deviations of their logarithms
    factors = np.ones((2, HYPOTHESES, len(gains), platform.n))
    sigmas = np.full((HYPOTHESES, len(gains)), platform.element_sigma)
    factors[:, GAINS] = np.swapaxes([(one.sensor, one.emitter) for one in gains], 0, 1)
    sigmas[[GAINS, ALIKE]] = [math.hypot(one.sigma, one.common_sigma) for one in gains]
    found = np.full((len(exchanges.receiver), HYPOTHESES, HYPOTHESES), np.nan)
    for k, (poses, log_weights) in enumerate(_samples(platform, gains, exchanges)):
        if not len(poses):
            continue
        # readings, their noise, and the log density of outliers per count, since scales depend on hypotheses
        limits, brightest = exchanges.saturation[k, :, None, None], np.nan_to_num(exchanges.readings[k]).max()
        noise = math.hypot(platform.noise, platform.stray_noise * min(brightest, platform.saturation))
        measured = exchanges.readings[k] >= DARKEST * noise  # False for NaN
        readings = np.where(measured, np.minimum(exchanges.readings[k], limits), 0.0)
        outlier = -_OUTLIER - np.log(np.hypot(noise, platform.relative * readings))
        light = expected_brightness(platform, poses)
        one, other = exchanges.receiver[k], exchanges.transmitter[k]
        for a, b in np.ndindex(HYPOTHESES, HYPOTHESES):
            relative = math.sqrt(platform.relative**2 + sigmas[a, one] ** 2 + sigmas[b, other] ** 2)
            expected = light * np.outer(factors[0, a, one], factors[1, b, other])
            off = stabilized(readings, noise, relative) - stabilized(expected, noise, relative)
            off = np.where(readings >= limits, np.maximum(off, 0.0), off)
            density = np.maximum(-0.5 * off**2 - np.log(np.hypot(noise, relative * readings)), outlier)
            logs = np.sum(density * measured, axis=(1, 2, 3))
            found[k, a, b] = np.logaddexp.reduce(logs + log_weights)
    return found


def _samples(
    platform: IrPlatform, gains: tuple[IrGains, ...], exchanges: Exchanges
) -> list[tuple[FloatArray, FloatArray]]:
    """Sampled poses (P, 3) of each exchange and log weights (P,); empty where the solver finds no pose."""
    of_pair = [
        [gains[robot] for robot in side.tolist()] for side in (exchanges.receiver, exchanges.transmitter)
    ]
    estimator, count = MaximumLikelihood(platform), len(exchanges.receiver)
    solved = [
        estimator.solve(exchanges.readings, one, exchanges.saturation)
        for one in (platform.unknown_gains(count), PairGains.of(*of_pair))
    ]
    draws = np.random.default_rng(_SEED).standard_normal((2 * len(solved), _POINTS, 3))
    known: BoolArray = np.isfinite(exchanges.poses[:, 0])
    offsets = draws.reshape(-1, 3) * POSE_SIGMA
    return [
        (exchanges.poses[k] + offsets, np.zeros(len(offsets)))
        if known[k]
        else _about_found(solved, k, draws, platform.radius)
        for k in range(count)
    ]


def _about_found(
    solved: list[IrSolutions], k: int, draws: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray]:
    """Samples around the solutions of exchange k, with a uniform prior over the plane."""
    centres = np.array([pose[k] for one in solved for pose in (one.poses, one.alternatives)])
    spreads = np.array([one.covariances[k] for one in solved for _ in range(2)])
    there = np.isfinite(centres).all(axis=1)
    centres, roots = centres[there], np.linalg.cholesky(spreads[there])
    poses = (centres[:, None] + draws[there] @ np.swapaxes(roots, 1, 2)).reshape(-1, 3)
    poses = poses[poses[:, 0] > 2.0 * radius]
    apart = poses[:, None] - centres
    apart[..., 1:] = wrap_angle(apart[..., 1:])
    half = np.linalg.solve(roots, apart[..., None])[..., 0]
    drawn = -0.5 * np.sum(half**2, axis=-1) - np.log(np.einsum("maa->ma", roots)).sum(axis=-1)
    return poses, np.log(poses[:, 0]) - np.logaddexp.reduce(drawn, axis=1, initial=-np.inf)


MIN_EXCHANGES = 20  # Minimum number of exchanges between robots with one kind of board
_MAX_EXCHANGES = 10_000
_DECIMALS = 5


@dataclass(frozen=True)
class BoardGroup:
    """The robots with one kind of board, and their exchanges."""

    source: str  # Name or path of the platform
    platform: IrPlatform  # Model of the board
    robots: tuple[int, ...]  # Their indices in the swarm
    exchanges: Exchanges  # Exchanges in order of time; robots by place in `robots`


@dataclass(frozen=True)
class BoardFit:
    """The calibration of one kind of board."""

    group: BoardGroup  # Robots and exchanges
    fit: GainsFit  # Gains, by place in the group's `robots`
    elements: ElementVerdicts  # Dead or shaded elements, by place; they are not used
    limits: ReadingLimits  # Saturation and noise of sensors, by place
    helps: BoolArray  # (robots,) True where a robot's gains pass the cross-validation over blocks of time

    def of_robot(self, place: int) -> tuple[int, float, float]:
        """Number of exchanges of a robot used, and its RMS residuals before and after [sigma]."""
        exchanges = self.group.exchanges
        own = self.fit.used & ((exchanges.receiver == place) | (exchanges.transmitter == place))
        return int(own.sum()), rms(self.fit.before[own]), rms(self.fit.after[own])


@dataclass(frozen=True)
class InfraredCalibration:
    """Result of a calibration of infrared boards."""

    swarm: Swarm  # The swarm with calibrated gains and dead elements
    boards: tuple[BoardFit, ...]  # The fit of each kind of board
    remarks: tuple[str, ...]  # What could not be used or calibrated, one sentence each


def calibrate_infrared(
    recording: Recording, swarm: Swarm, progress: Progress, *, with_truth: bool = True
) -> InfraredCalibration:
    """Calibrate the gains of all robots with infrared boards; described gains are ignored.

    `with_truth`: whether to use ground truth where it is known. Raises CalibrationError if no exchange can be
    used, or no gains are determined.
    """
    groups, dropped = _groups(recording, swarm, with_truth=with_truth)
    remarks = [f"Matrices not used: {_counts(dropped)}."] if dropped else []
    boards: list[BoardFit] = []
    for number, (group, _) in enumerate(groups):
        limits = find_reading_limits(group.platform, len(group.robots), group.exchanges)
        names = [swarm.robots[index].name for index in group.robots]
        said = contradictions(group.platform, group.exchanges, limits, names)
        remarks += [f"Platform {group.source}: {sentence}" for sentence in said]
        try:
            boards.append(_fit(group, limits, _Share(progress, number, len(groups))))
        except (CalibrationError, GainsError) as error:
            remarks.append(f"Platform {group.source}: {error}")
    if not boards:
        raise CalibrationError(f"recording '{recording.name}': {' '.join(remarks)}")
    robots, left = _with_fits(swarm.robots, boards)
    remarks += [f"{why}, and as they were: {', '.join(names)}." for why, names in left.items()]
    if robots == swarm.robots:
        raise CalibrationError(f"recording '{recording.name}': {' '.join(remarks)}")
    return InfraredCalibration(replace(swarm, robots=robots), tuple(boards), tuple(remarks))


def exchanges_of(recording: Recording, swarm: Swarm) -> tuple[BoardGroup, IntArray]:
    """The exchanges of the robots with the first kind of board, and their stamps (k,).

    Raises CalibrationError if no exchange can be used.
    """
    (group, stamps_ns), *_ = _groups(recording, swarm, with_truth=True)[0]
    return group, stamps_ns


def rms(residuals: FloatArray) -> float:
    """Root mean square of the values that are not NaN; NaN if there are none."""
    known = residuals[np.isfinite(residuals)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


class _Share:
    """Progress of one of several fits with an unknown number of steps."""

    def __init__(self, progress: Progress, number: int, count: int) -> None:
        self._progress, self._begin, self._left = progress, number / count, 1.0 / count

    def __call__(self, what: str) -> None:
        self._progress(self._begin, what)
        self._begin, self._left = self._begin + 0.25 * self._left, 0.75 * self._left


def _fit(group: BoardGroup, limits: ReadingLimits, progress: _Share) -> BoardFit:
    """The gains and dead elements of one kind of board.

    Raises:
        CalibrationError: There are too few exchanges.
        GainsError: They do not determine gains.
    """
    count, platform, robots = len(group.exchanges.receiver), group.platform, len(group.robots)
    if count < MIN_EXCHANGES:
        raise CalibrationError(f"{count} exchanges are too few, {MIN_EXCHANGES} are the least.")
    progress("dead elements")
    elements = find_dead_elements(platform, robots, group.exchanges)
    alive = elements.without(group.exchanges)
    fit = estimate_gains(platform, robots, alive, progress)
    return BoardFit(group, fit, elements, limits, helpful_gains(platform, robots, alive, progress))


def _groups(
    recording: Recording, swarm: Swarm, *, with_truth: bool
) -> tuple[list[tuple[BoardGroup, IntArray]], Counter[str]]:
    """Exchanges by kind of board with their stamps, and the number of unusable matrices by reason.

    Raises CalibrationError if no matrix can be used.
    """
    screening = MatrixScreening(swarm)
    if not screening.boards:
        raise CalibrationError("no robot of the swarm description has an infrared board (section ir).")
    rows, exchanges = recording.brightness, dict[ExchangeKey, Readings]()
    for k in range(rows.robot.size):
        key = screening.key_of(rows, k)
        if key is not None:
            screening.add(rows, k, exchanges.setdefault(key, {}))
    if not exchanges:
        said = f": {_counts(screening.dropped)}" if screening.dropped else ""
        nothing = f"holds no <robot>/brightness of this swarm that can be used{said}."
        raise CalibrationError(" ".join([f"recording '{recording.name}' {nothing}", *recording.remarks]))
    keys = sorted(exchanges)
    groups = []
    alike: dict[IrPlatform, list[int]] = {}
    for robot, board in screening.boards.items():
        alike.setdefault(board.platform, []).append(robot)
    for members in alike.values():
        own = [key for key in keys if key.receiver in members]
        own = own[:: max(1, -(-len(own) // _MAX_EXCHANGES))]
        columns = np.array(own, dtype=np.int64).reshape(-1, 3).T
        place = np.searchsorted(members, columns[1:])
        poses = _true_poses(recording, swarm, columns) if with_truth else np.full((len(own), 3), np.nan)
        readings, saturation = screening.together(members[0], [exchanges[key] for key in own])
        board = screening.boards[members[0]]
        read = Exchanges(place[0], place[1], readings, saturation, poses)
        groups.append((BoardGroup(board.source, board.platform, tuple(members), read), columns[0]))
    return groups, screening.dropped


def _true_poses(recording: Recording, swarm: Swarm, columns: IntArray) -> FloatArray:
    """Range [m], bearing and heading [rad] (k, 3) of transmitters seen from receivers; NaN where not known.

    `columns` (3, k) are stamp, receiver and transmitter.
    """
    stamp_ns, *sides = columns
    places = np.full((2, stamp_ns.size, 3), np.nan)
    for place, robots in zip(places, sides, strict=True):
        for robot in np.unique(robots).tolist():
            truth = recording.truth.get(swarm.robots[robot].name)
            if truth is not None:
                rows = robots == robot
                place[rows], _ = interpolate(truth, stamp_ns[rows], DENSE_GAP_NS)
    x, y, heading = se2.between(places[0], places[1]).T
    return np.column_stack([np.hypot(x, y), np.arctan2(y, x), heading])


def _with_fits(
    robots: Sequence[Robot], boards: Iterable[BoardFit]
) -> tuple[tuple[Robot, ...], dict[str, list[str]]]:
    """The robots with calibrated gains, and the names of those without gains by reason."""
    changed, left = list(robots), dict[str, list[str]]()
    for board in boards:
        for place, index in enumerate(board.group.robots):
            gains, why = board.fit.gains[place], ""
            if not board.of_robot(place)[0]:
                why = "In no exchange that could be used"
            elif gains == IrGains.unknown(board.group.platform):
                why = "What they read contradicts itself or the ground truth"
            elif not board.helps[place]:
                why = "Gains do not help in exchanges that they were not estimated from"
            changed[index] = _with_fit(robots[index], board, place, with_gains=not why)
            if why:
                left.setdefault(why, []).append(robots[index].name)
    return tuple(changed), left


def _with_fit(robot: Robot, board: BoardFit, place: int, *, with_gains: bool) -> Robot:
    """The robot with gains and dead elements; one described as dead stays so unless it certainly works."""
    if robot.ir is None:
        return robot
    elements, gains = board.elements, board.fit.gains[place]
    described = (robot.ir.dead_sensors, robot.ir.dead_emitters)
    dead = [
        tuple(sorted({*found, *(k for k in before if not works[k])}))
        for found, before, works in zip(
            elements.numbers(place), described, elements.works[:, place], strict=True
        )
    ]
    alive = replace(robot.ir, dead_sensors=dead[0], dead_emitters=dead[1])
    sensor, emitter = (tuple(round(v, _DECIMALS) for v in part) for part in (gains.sensor, gains.emitter))
    own, common = (round(sigma, _DECIMALS) for sigma in (gains.sigma, gains.common_sigma))
    calibrated = replace(alive, gains=IrGains(sensor, emitter, own, common))
    return replace(robot, ir=calibrated if with_gains else alive)


def _counts(dropped: Counter[str]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in sorted(dropped.items()))
