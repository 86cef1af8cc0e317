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
"""After two jumps within this time, odometry is ignored until it has been smooth for this time."""

MODEL_DTYPE = np.dtype([(f.name, np.float64) for f in fields(OdometryModel)])
"""Record of the numbers of an `OdometryModel`."""


class Preintegrated(NamedTuple):
    """Preintegrated odometry from the start of a track to an instant, in the track's frame.

    Attributes:
        stamp_ns: The instant.
        covariance: (3, 3) covariance G of the right-invariant error.
        jacobian: (3, 3) Jacobian D of the pose by the parameters of the motion.
    """

    stamp_ns: int
    covariance: FloatArray
    jacobian: FloatArray

    @classmethod
    def begin(cls, stamp_ns: int) -> Preintegrated:
        """Start of a track: zero covariance and Jacobian."""
        return cls(stamp_ns, np.zeros((3, 3)), np.zeros((3, 3)))


class TrackArrays(NamedTuple):
    """Rows and models of all tracks, for compiled code.

    Attributes:
        filled: (N,) number of rows in use.
        stamp_ns: (N, capacity) instants, calibrated for delay.
        raw: (N, capacity, 3) poses as reported, headings unwrapped.
        pose: (N, capacity, 3) calibrated poses O, headings unwrapped.
        covariance: (N, capacity, 3, 3) preintegrated to the row, see `Preintegrated`.
        jacobian: (N, capacity, 3, 3) preintegrated to the row; columns as in `estimated_parameters`.
        rate: (N, capacity, 3) calibrated velocity forward and left [m/s] and turn rate [rad/s] at the row,
            after the lag.
        known_ns: (N, capacity) end of the known motion: the row's instant, or earlier after repeated jumps.
        jump_ns: (N, capacity, 2) instants of the last two jumps, newest first.
        delay_ns: (N,) delay of the stamps.
        model: (N,) of MODEL_DTYPE.
        response: (N, 2, V, W) shares of speed and of turn rate of `MotionResponse`.
        response_speed: (N, V) speeds of its grid, padded with infinity.
        response_turn_rate: (N, W) turn rates of its grid.
        begin_ns: (N,) instant of the very first row.
        begin_pose: (N, 3) pose of the very first row.
        is_stationary: (N,) True for a robot without odometry: its track stays at the origin.
        walk: (N, 2) its variances per second of position [m^2/s] and heading [rad^2/s].
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
    """Append rows (k,) if all are newer than their tracks and not older than `oldest_ns`.

    Stamps are as reported, not calibrated for delay. Writes `changed_from_ns` (N,), see `TrackChange`.

    Returns:
        Number of jumps; -1, without any change, if some rows are not newer or there is no space.
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
    """Append rows sorted by robot and stamp; return the numbers of duplicates and of new jumps."""
    duplicates, jumps = 0, 0
    for k in range(robots.size):
        robot = robots[k]
        row = tracks.filled[robot]
        if row and stamps_ns[k] <= tracks.stamp_ns[robot, row - 1]:
            duplicates += 1
            continue
        tracks.stamp_ns[robot, row] = stamps_ns[k]
        assign(tracks.raw[robot, row], raw[k])
        if row == 0:  # a track starts at the reported pose
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
    """Integrate from the previous row to the raw pose of a row; return whether the step is a jump."""
    model = tracks.model[robot]
    before, after = tracks.raw[robot, row - 1], tracks.raw[robot, row]
    duration_s = (tracks.stamp_ns[robot, row] - tracks.stamp_ns[robot, row - 1]) * 1e-9
    turn = after[2] - before[2]
    middle = before[2] + 0.5 * turn
    dx, dy = after[0] - before[0], after[1] - before[1]
    # tolerance of half a robot's width, because stamps jitter
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
    # one jump: the driver has restarted; several: two drivers publish conflicting odometry
    contradictory = stamp_ns - jumps_ns[1] < _CONTRADICTORY_NS
    if jump or contradictory or duration_s > model.timeout_s:  # the motion is unknown
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
    # displacement of the axle, then of base_link ahead of it
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
    """Add the noise of one step of unknown motion.

    Args:
        model: Odometry model of the robot.
        unknown_s: Duration of the unknown motion at the previous row and at this row [s].
        pose: (3,) pose at the start of the unknown motion.
        rate: (3,) rate at the start of the unknown motion.
        covariance: (3, 3) sum to add to.
    """
    add_dropout_noise(model, unknown_s[1], True, pose, rate, covariance)
    if unknown_s[0] > 0.0:  # already added at the previous row
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
    """Calibrated displacement forward and left and turn of a reported step; writes the final rate (3,)."""
    model = tracks.model[robot]
    speed = math.hypot(reported[0], reported[1]) / duration_s
    speed_share, turn_share = _response(tracks, robot, speed, abs(reported[2]) / duration_s)
    scale, turn_scale = model.distance_scale * speed_share, model.turn_scale * turn_share
    ahead, aside, turning = reported
    is_moving = ahead != 0.0 or aside != 0.0 or turning != 0.0
    turn_rate = turn_scale * turning / duration_s + (model.turn_bias if is_moving else 0.0)
    true_rate = (scale * ahead / duration_s, scale * aside / duration_s, turn_rate)
    remaining, mean = 0.0, 0.0  # remaining share of the lag's transient: at the end, and mean over the step
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
    """True shares of speed and turn rate, bilinear in the grid of the robot's response."""
    i, a = _bracket(tracks.response_speed[robot], speed)
    j, b = _bracket(tracks.response_turn_rate[robot], turn_rate)
    table = tracks.response[robot]
    return _bilinear(table[0], i, j, a, b), _bilinear(table[1], i, j, a, b)


@inlined_njit
def _bilinear(table: FloatArray, i: int, j: int, a: float, b: float) -> float:
    """Bilinear interpolation of a table (V, W) at fractions a and b to the next row and column."""
    ii, jj = min(i + 1, table.shape[0] - 1), min(j + 1, table.shape[1] - 1)
    low: float = table[i, j] * (1.0 - b) + table[i, jj] * b
    high: float = table[ii, j] * (1.0 - b) + table[ii, jj] * b
    return low * (1.0 - a) + high * a


@inlined_njit
def _bracket(axis: FloatArray, value: float) -> tuple[int, float]:
    """Interval of an ascending axis that is nearest to the value, and the fraction within it (0 to 1)."""
    i = max(0, min(np.searchsorted(axis, value, side="right") - 1, axis.size - 1))
    if i + 1 == axis.size or math.isinf(axis[i + 1]):
        return i, 0.0
    return i, min(1.0, max(0.0, (value - axis[i]) / (axis[i + 1] - axis[i])))
