"""A board's calibration from a recording: which exchanges count, and the swarm description that results."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.trajectory import interpolate
from swarm_loc_estimator.offline.calibration.infrared.board import (
    GAIN_SIGMA,
    BoardCalibration,
    calibrate_board,
)
from swarm_loc_estimator.offline.calibration.infrared.board_fit import BoardReadings
from swarm_loc_estimator.offline.calibration.infrared.gains import exchanges_of
from swarm_loc_estimator.offline.calibration.recording import CalibrationError, Recording
from swarm_loc_estimator.offline.recorded_bag import Progress
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform
from swarm_loc_estimator.swarm.robot_ir import RobotIr
from swarm_loc_estimator.swarm.swarm import Swarm

MAX_RANGE = 0.3
"""Robots farther away show little more than noise [m]."""
_BODIES = 2.0
"""A robot within so many radii of the line between two others may be in their way."""
_TRUTH_GAP_NS = 200_000_000


@dataclass(frozen=True)
class BoardRecording:
    """Exchanges of a recording with one kind of board.

    Attributes:
        platform: The board to begin with.
        robots: Their indices in the swarm, in ascending order.
        data: All exchanges whose poses are known; by place in `robots`.
        clear: (k,) whether no other robot is known to be in between.
    """

    platform: IrPlatform
    robots: tuple[int, ...]
    data: BoardReadings
    clear: BoolArray

    @property
    def to_fit(self) -> BoardReadings:
        """Those that a board is fitted to."""
        return self.data.chosen(self.clear & (self.data.poses[:, 0] < MAX_RANGE))


def read_board(recording: Recording, swarm: Swarm) -> BoardRecording:
    """The exchanges with ground truth of the first kind of board of a swarm.

    Raises:
        CalibrationError: There is none.
    """
    group, stamp_ns = exchanges_of(recording, swarm)
    known = np.isfinite(group.exchanges.poses[:, 0])
    if not known.any():
        raise CalibrationError(
            f"recording '{recording.name}' holds no exchange between robots whose ground truth is known then;"
            " a board cannot be calibrated without <robot>/ground_truth."
        )
    one = group.exchanges
    data = BoardReadings(one.receiver, one.transmitter, one.readings[:, 0], one.poses, stamp_ns).chosen(known)
    clear = _clear(recording, swarm, group.robots, data, _BODIES * group.platform.radius)
    return BoardRecording(group.platform, group.robots, data, clear)


def calibrate_from(
    recording: Recording, swarm: Swarm, progress: Progress
) -> tuple[BoardRecording, BoardCalibration]:
    """Find what the board of a recording is.

    Raises:
        CalibrationError: There is too little ground truth.
    """
    progress(0.0, "exchanges")
    board = read_board(recording, swarm)
    progress(0.1, "fitting, and validating on blocks of time")
    return board, calibrate_board(board.platform, board.to_fit, len(board.robots))


def with_board(swarm: Swarm, board: BoardRecording, done: BoardCalibration, path: Path) -> Swarm:
    """The swarm with the board that was found, in a file at `path`, and robots' gains and dead elements."""
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
    """(k,) whether no robot is known to be within `width` of the line between the two of an exchange."""
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
    """(k,) from points to the lines between two ends, all (k, 2)."""
    way = end - begin
    share = np.sum((points - begin) * way, axis=1) / np.maximum(np.sum(way**2, axis=1), 1e-12)
    return np.asarray(np.linalg.norm(points - begin - np.clip(share, 0.0, 1.0)[:, None] * way, axis=1))
