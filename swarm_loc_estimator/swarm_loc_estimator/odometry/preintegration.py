"""Preintegration of odometry: calibrated poses along a track, with their covariance and Jacobian."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.se2_scalar import wrap
from swarm_loc_estimator.common.small_matrix import add_scaled, assign, assign_matrix
from swarm_loc_estimator.odometry.process_noise import (
    OdometryStep,
    add_dropout_noise,
    add_step_jacobian,
    add_step_noise,
)
from swarm_loc_estimator.swarm.swarm import OdometryModel

UNCHANGED_NS = np.iinfo(np.int64).max
BEFORE_ALL_NS = np.iinfo(np.int64).min

_CONTRADICTORY_NS = 1_000_000_000
"""Two jumps within such a time, and odometry tells nothing until it has been smooth for as long."""

MODEL_DTYPE = np.dtype([(f.name, np.float64) for f in fields(OdometryModel)])
"""The numbers of an `OdometryModel` as a record."""


class Preintegrated(NamedTuple):
    """What the steps of a track have added up to by an instant, in the track's frame.

    Attributes:
        stamp_ns: The instant.
        covariance: (3, 3) G of the pose's right-invariant error.
        jacobian: (3, 3) D, by how much the pose moves per unit of each parameter of the motion.
    """

    stamp_ns: int
    covariance: FloatArray
    jacobian: FloatArray

    @classmethod
    def begin(cls, stamp_ns: int) -> Preintegrated:
        """Where a track begins: nothing yet."""
        return cls(stamp_ns, np.zeros((3, 3)), np.zeros((3, 3)))


class TrackArrays(NamedTuple):
    """The rows of all tracks and the models behind them, as compiled code reads them.

    Attributes:
        filled: (N,) rows in use per robot.
        stamp_ns: (N, capacity) instants, calibrated for delay.
        raw: (N, capacity, 3) poses as reported, headings unwrapped.
        pose: (N, capacity, 3) calibrated poses O, headings unwrapped.
        covariance: (N, capacity, 3, 3) preintegrated until the row, see `Preintegrated`.
        jacobian: (N, capacity, 3, 3) until the row; its columns are those of `estimated_parameters`.
        rate: (N, capacity, 3) calibrated velocity forward and left [m/s] and turn rate [rad/s] at the row,
            behind the lag.
        known_ns: (N, capacity) until when the motion is known: the row's own instant, but for jumps.
        jump_ns: (N, capacity, 2) the instants of the last two jumps, the last one first.
        delay_ns: (N,) delay of the stamps.
        model: (N,) records of the numbers of `OdometryModel`.
        response: (N, 2, V, W) shares of speed and of turn rate of `MotionResponse`.
        response_speed: (N, V) speeds of its grid, filled up with infinity.
        response_turn_rate: (N, W) turn rates of its grid.
        begin_ns: (N,) instant of the very first row.
        begin_pose: (N, 3) the pose there, where nothing is preintegrated yet.
        is_stationary: (N,) whether the robot has no odometry: its track never leaves the origin.
        walk: (N, 2) variances per second of its position [m^2/s] and heading [rad^2/s] then.
    """

    filled: IntArray
    stamp_ns: IntArray
    raw: FloatArray
    pose: FloatArray
    covariance: FloatArray
    jacobian: FloatArray
    rate: FloatArray
    known_ns: IntArray
    jump_ns: IntArray
    delay_ns: IntArray
    model: NDArray[np.void]
    response: FloatArray
    response_speed: FloatArray
    response_turn_rate: FloatArray
    begin_ns: IntArray
    begin_pose: FloatArray
    is_stationary: NDArray[np.bool_]
    walk: FloatArray


@cached_njit
def continue_tracks(
    tracks: TrackArrays,
    oldest_ns: int,
    robots: IntArray,
    stamps_ns: IntArray,
    raw: FloatArray,
    changed_from_ns: IntArray,
) -> int:
    """Append rows (k,) in their order, if all are newer than what their tracks hold and not too old.

    Stamps are as reported, not calibrated for delay. Writes (N,) after which instant each track changes.

    Returns:
        How many rows are jumps; -1, and nothing is changed, when some are not new, or there is no room.
    """
    newest, filled = np.empty(tracks.filled.size, dtype=np.int64), tracks.filled.copy()
    for robot in range(newest.size):
        newest[robot] = tracks.stamp_ns[robot, filled[robot] - 1] if filled[robot] else BEFORE_ALL_NS
        changed_from_ns[robot] = UNCHANGED_NS
    delayed = np.empty(robots.size, dtype=np.int64)
    for k in range(robots.size):
        robot = robots[k]
        delayed[k] = stamps_ns[k] + tracks.delay_ns[robot]
        filled[robot] += 1
        if (
            stamps_ns[k] < oldest_ns
            or delayed[k] <= newest[robot]
            or filled[robot] > tracks.stamp_ns.shape[1]
        ):
            return -1
        if changed_from_ns[robot] == UNCHANGED_NS:
            changed_from_ns[robot] = newest[robot]
        newest[robot] = delayed[k]
    return integrate(tracks, robots, delayed, raw, np.ones(robots.size, dtype=np.bool_))[1]


@cached_njit
def integrate(
    tracks: TrackArrays, robots: IntArray, stamps_ns: IntArray, raw: FloatArray, new: NDArray[np.bool_]
) -> tuple[int, int]:
    """Append rows sorted by robot and stamp; return how many were duplicates, how many new ones jumps."""
    duplicates, jumps = 0, 0
    for k in range(robots.size):
        robot = robots[k]
        row = tracks.filled[robot]
        if row and stamps_ns[k] <= tracks.stamp_ns[robot, row - 1]:
            duplicates += 1
            continue
        tracks.stamp_ns[robot, row] = stamps_ns[k]
        assign(tracks.raw[robot, row], raw[k])
        if row == 0:  # a track begins where its driver says
            assign(tracks.pose[robot, 0], raw[k])
            tracks.covariance[robot, 0].fill(0.0)
            tracks.jacobian[robot, 0].fill(0.0)
            tracks.rate[robot, 0].fill(0.0)
            assign(tracks.begin_pose[robot], raw[k])
            tracks.begin_ns[robot] = tracks.known_ns[robot, 0] = stamps_ns[k]
            tracks.jump_ns[robot, 0, 0] = tracks.jump_ns[robot, 0, 1] = BEFORE_ALL_NS // 2
        else:
            before = tracks.raw[robot, row - 1, 2]
            tracks.raw[robot, row, 2] = before + wrap(raw[k, 2] - before)
            jumped = _integrate_step(tracks, robot, row)
            jumps += jumped and new[k]
        tracks.filled[robot] = row + 1
    return duplicates, jumps


@inlined_njit
def _integrate_step(tracks: TrackArrays, robot: int, row: int) -> bool:
    """Fill a row from the row before and its raw pose; return whether no robot can drive so fast."""
    model = tracks.model[robot]
    before, after = tracks.raw[robot, row - 1], tracks.raw[robot, row]
    duration_s = (tracks.stamp_ns[robot, row] - tracks.stamp_ns[robot, row - 1]) * 1e-9
    turn = after[2] - before[2]
    middle = before[2] + 0.5 * turn
    dx, dy = after[0] - before[0], after[1] - before[1]
    # half a robot's width of slack: stamps jitter
    jump = math.hypot(dx, dy) > model.max_speed * duration_s + 0.5 * model.wheel_separation
    start, rate = tracks.pose[robot, row - 1], tracks.rate[robot, row]
    covariance, jacobian = tracks.covariance[robot, row], tracks.jacobian[robot, row]
    assign_matrix(covariance, tracks.covariance[robot, row - 1])
    assign_matrix(jacobian, tracks.jacobian[robot, row - 1])
    stamp_ns, known_ns = tracks.stamp_ns[robot, row], tracks.known_ns[robot, row - 1]
    jumps_ns = tracks.jump_ns[robot, row]
    jumps_ns[0], jumps_ns[1] = tracks.jump_ns[robot, row - 1, 0], tracks.jump_ns[robot, row - 1, 1]
    if jump:
        jumps_ns[0], jumps_ns[1] = stamp_ns, jumps_ns[0]
    # one jump is a driver that has started again; several are two of them that contradict each other
    contradictory = stamp_ns - jumps_ns[1] < _CONTRADICTORY_NS
    if jump or contradictory or duration_s > model.timeout_s:  # where it went is unknown
        assign(tracks.pose[robot, row], start)
        rate.fill(0.0)
        unknown_s = (tracks.stamp_ns[robot, row - 1] - known_ns) * 1e-9, (stamp_ns - known_ns) * 1e-9
        _add_unknown(model, unknown_s, start, rate, covariance)
        tracks.known_ns[robot, row] = known_ns if contradictory else stamp_ns
        return bool(jump)
    tracks.known_ns[robot, row] = stamp_ns
    cos, sin = math.cos(middle), math.sin(middle)
    reported = (cos * dx + sin * dy, cos * dy - sin * dx, turn)
    before_rate = tracks.rate[robot, row - 1]
    forward, left, turn = _true_motion(tracks, robot, reported, duration_s, before_rate, rate)
    # the way of the axle, then that of base_link ahead of it
    cos, sin = math.cos(model.course_offset), math.sin(model.course_offset)
    way_x, way_y = cos * forward - sin * left, sin * forward + cos * left + model.axle_offset * turn
    middle = start[2] + 0.5 * turn
    cos, sin = math.cos(middle), math.sin(middle)
    step_x, step_y = cos * way_x - sin * way_y, sin * way_x + cos * way_y
    tracks.pose[robot, row, 0] = start[0] + step_x
    tracks.pose[robot, row, 1] = start[1] + step_y
    tracks.pose[robot, row, 2] = start[2] + turn
    changed = abs(rate[2] - before_rate[2])
    x, y = start[0] + 0.5 * step_x, start[1] + 0.5 * step_y
    step = OdometryStep(forward, left, turn, changed, duration_s, x, y, middle)
    add_step_noise(model, step, covariance)
    add_step_jacobian(model, step, jacobian)
    return False


@cached_njit
def _add_unknown(
    model: OdometryModel,
    unknown_s: tuple[float, float],
    pose: FloatArray,
    rate: FloatArray,
    covariance: FloatArray,
) -> None:
    """Add the noise of a motion that goes on being unknown, at a pose (3,) and rate (3,).

    Args:
        model: The robot's.
        unknown_s: For how long it was unknown at the row before, and at this one [s].
        pose: (3,).
        rate: (3,).
        covariance: (3, 3) added to.
    """
    add_dropout_noise(model, unknown_s[1], True, pose, rate, covariance)
    if unknown_s[0] > 0.0:  # it has grown so far already
        known = np.zeros((3, 3))
        add_dropout_noise(model, unknown_s[0], True, pose, rate, known)
        add_scaled(covariance, known, -1.0)


@inlined_njit
def _true_motion(
    tracks: TrackArrays,
    robot: int,
    reported: tuple[float, float, float],
    duration_s: float,
    before_rate: FloatArray,
    rate: FloatArray,
) -> tuple[float, float, float]:
    """Calibrated way forward and left and turn of a reported step; writes their rates (3,) at its end."""
    model = tracks.model[robot]
    speed = math.hypot(reported[0], reported[1]) / duration_s
    speed_share, turn_share = _response(tracks, robot, speed, abs(reported[2]) / duration_s)
    scale, turn_scale = model.distance_scale * speed_share, model.turn_scale * turn_share
    ahead, aside, turning = reported
    true_rate = (scale * ahead / duration_s, scale * aside / duration_s, turn_scale * turning / duration_s)
    remaining, mean = 0.0, 0.0  # of what is left to follow: at the end, and on average over the step
    if model.lag_s > 0.0:
        remaining = math.exp(-duration_s / model.lag_s)
        mean = (1.0 - remaining) * model.lag_s / duration_s
    forward, left, turn = (
        before_rate[0] - true_rate[0],
        before_rate[1] - true_rate[1],
        before_rate[2] - true_rate[2],
    )
    rate[0], rate[1] = true_rate[0] + remaining * forward, true_rate[1] + remaining * left
    rate[2] = true_rate[2] + remaining * turn
    return (
        (true_rate[0] + mean * forward) * duration_s,
        (true_rate[1] + mean * left) * duration_s,
        (true_rate[2] + mean * turn) * duration_s,
    )


@inlined_njit
def _response(tracks: TrackArrays, robot: int, speed: float, turn_rate: float) -> tuple[float, float]:
    """Shares of speed and turn rate that are true, bilinear in the grid of the robot's response."""
    i, a = _bracket(tracks.response_speed[robot], speed)
    j, b = _bracket(tracks.response_turn_rate[robot], turn_rate)
    table = tracks.response[robot]
    return _bilinear(table[0], i, j, a, b), _bilinear(table[1], i, j, a, b)


@inlined_njit
def _bilinear(table: FloatArray, i: int, j: int, a: float, b: float) -> float:
    """A number of a table (V, W), by shares a and b of the way to the next row and column."""
    ii, jj = min(i + 1, table.shape[0] - 1), min(j + 1, table.shape[1] - 1)
    low: float = table[i, j] * (1.0 - b) + table[i, jj] * b
    high: float = table[ii, j] * (1.0 - b) + table[ii, jj] * b
    return low * (1.0 - a) + high * a


@inlined_njit
def _bracket(axis: FloatArray, value: float) -> tuple[int, float]:
    """The interval of an ascending axis nearest to the value, and how far in the value lies (0 to 1)."""
    i = max(0, min(np.searchsorted(axis, value, side="right") - 1, axis.size - 1))
    if i + 1 == axis.size or math.isinf(axis[i + 1]):
        return i, 0.0
    return i, min(1.0, max(0.0, (value - axis[i]) / (axis[i + 1] - axis[i])))
