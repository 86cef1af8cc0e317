"""Calibrate the gains of infrared boards from a recording, one fit for each kind of board."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.infrared.gains import Exchanges, GainsError, GainsFit, estimate_gains
from swarm_loc_estimator.offline.calibration.camera import DENSE_GAP_NS
from swarm_loc_estimator.offline.calibration.infrared.dead_elements import ElementVerdicts, find_dead_elements
from swarm_loc_estimator.offline.calibration.infrared.gain_validation import helpful_gains
from swarm_loc_estimator.offline.calibration.infrared.reading_limits import (
    ReadingLimits,
    contradictions,
    find_reading_limits,
)
from swarm_loc_estimator.offline.calibration.recording import CalibrationError, Recording
from swarm_loc_estimator.offline.recorded_bag import Progress
from swarm_loc_estimator.sensors.infrared import ExchangeKey, MatrixScreening, Readings
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

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
    """Calibrate the gains of all robots with infrared boards.

    Args:
        recording: With brightness matrices.
        swarm: The swarm of the recording; its gains are ignored.
        progress: Called with the share done and the name of the step.
        with_truth: Whether to use ground truth where available.

    Raises:
        CalibrationError: No exchange can be used, or no gains are determined.
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

    Raises:
        CalibrationError: No exchange can be used.
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
    count = len(group.exchanges.receiver)
    if count < MIN_EXCHANGES:
        raise CalibrationError(f"{count} exchanges are too few, {MIN_EXCHANGES} are the least.")
    progress("dead elements")
    elements = find_dead_elements(group.platform, len(group.robots), group.exchanges)
    alive = elements.without(group.exchanges)
    platform, robots = group.platform, len(group.robots)
    fit = estimate_gains(platform, robots, alive, progress)
    helps = helpful_gains(platform, robots, alive, progress)
    return BoardFit(group, fit, elements, limits, helps)


def _groups(
    recording: Recording, swarm: Swarm, *, with_truth: bool
) -> tuple[list[tuple[BoardGroup, IntArray]], Counter[str]]:
    """Exchanges by kind of board with their stamps, and the number of unusable matrices by reason.

    Raises:
        CalibrationError: No matrix can be used.
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
    for members in _alike(screening):
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


def _alike(screening: MatrixScreening) -> Iterator[list[int]]:
    """Robots with the same kind of board, in ascending order."""
    groups: dict[IrPlatform, list[int]] = {}
    for robot, board in screening.boards.items():
        groups.setdefault(board.platform, []).append(robot)
    yield from groups.values()


def _true_poses(recording: Recording, swarm: Swarm, columns: IntArray) -> FloatArray:
    """Range [m], bearing and heading [rad] (k, 3) of transmitters seen from receivers; NaN where not known.

    Args:
        recording: With ground truth.
        swarm: The swarm with the robots' names.
        columns: (3, k) stamp, receiver and transmitter.
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
            gains = board.fit.gains[place]
            changed[index] = _without_dead(robots[index], board.elements, place)
            if not board.of_robot(place)[0]:
                left.setdefault("In no exchange that could be used", []).append(robots[index].name)
            elif gains == IrGains.unknown(board.group.platform):
                why = "What they read contradicts itself or the ground truth"
                left.setdefault(why, []).append(robots[index].name)
            elif not board.helps[place]:
                why = "Gains do not help in exchanges that they were not estimated from"
                left.setdefault(why, []).append(robots[index].name)
            else:
                changed[index] = _with_gains(changed[index], gains)
    return tuple(changed), left


def _without_dead(robot: Robot, elements: ElementVerdicts, place: int) -> Robot:
    """The robot with its dead elements; an element described as dead stays so unless it certainly works."""
    if robot.ir is None:
        return robot
    described = (robot.ir.dead_sensors, robot.ir.dead_emitters)
    dead = [
        tuple(sorted({*found, *(k for k in before if not works[k])}))
        for found, before, works in zip(
            elements.numbers(place), described, elements.works[:, place], strict=True
        )
    ]
    return replace(robot, ir=replace(robot.ir, dead_sensors=dead[0], dead_emitters=dead[1]))


def _with_gains(robot: Robot, gains: IrGains) -> Robot:
    """The robot with gains, rounded to significant digits."""
    if robot.ir is None:
        return robot
    sensor, emitter = (tuple(round(v, _DECIMALS) for v in part) for part in (gains.sensor, gains.emitter))
    own, common = (round(sigma, _DECIMALS) for sigma in (gains.sigma, gains.common_sigma))
    return replace(robot, ir=replace(robot.ir, gains=IrGains(sensor, emitter, own, common)))


def _counts(dropped: Counter[str]) -> str:
    """Reasons with their counts."""
    return ", ".join(f"{count} {reason}" for reason, count in sorted(dropped.items()))
