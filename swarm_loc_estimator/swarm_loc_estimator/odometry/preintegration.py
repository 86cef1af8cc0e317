"""Preintegration of odometry: calibrated poses along a track, with their covariance and Jacobian."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit, norefcount_njit
from swarm_loc_estimator.common.se2_scalar import wrap
from swarm_loc_estimator.common.small_matrix import add_scaled, assign, assign_matrix
from swarm_loc_estimator.odometry.continuity import JUMP, NO_FAULT, RESET, fault_of_step, update_unmoved
from swarm_loc_estimator.odometry.gyro import turn_by_gyro
from swarm_loc_estimator.odometry.process_noise import (
    OdometryStep,
    add_dropout_noise,
    add_in_track_frame,
    add_step_jacobian,
    add_step_noise,
)
from swarm_loc_estimator.odometry.track_arrays import BEFORE_ALL_NS, LATEST_NS, TrackArrays
from swarm_loc_estimator.swarm.error_models import OdometryModel

UNCHANGED_NS = LATEST_NS

_CONTRADICTORY_NS = 1_000_000_000
"""After two jumps within this time, odometry is ignored until it has been smooth for this time."""


class Preintegrated(NamedTuple):
    """Preintegrated odometry from the start of a track to an instant, in the track's frame."""

    stamp_ns: int  # The instant
    covariance: FloatArray  # (3, 3) covariance G of the right-invariant error
    jacobian: FloatArray  # (3, 3) Jacobian D of the pose by the parameters of the motion

    @classmethod
    def begin(cls, stamp_ns: int) -> Preintegrated:
        """Start of a track: zero covariance and Jacobian."""
        return cls(stamp_ns, np.zeros((3, 3)), np.zeros((3, 3)))


class NewRows(NamedTuple):
    """Rows (k,) sorted by robot and stamp."""

    robot: IntArray  # (k,) index of the robot
    stamp_ns: IntArray  # (k,) instants, calibrated for delay
    raw: FloatArray  # (k, 3) poses as reported
    twist: FloatArray  # (k, 3) twists as reported
    new: NDArray[np.bool_]  # (k,) False for rows that are integrated again


class Integrated(NamedTuple):
    """Numbers of rows: dropped as duplicates, and new ones with a jump or a reset before them."""

    duplicates: int
    jumps: int
    resets: int


@cached_njit
def continue_tracks(
    tracks: TrackArrays,
    oldest_ns: int,
    robots: IntArray,
    stamps_ns: IntArray,
    raw: FloatArray,
    twist: FloatArray,
    changed_from_ns: IntArray,
) -> Integrated:
    """Append rows (k,) if all are newer than their tracks and not older than `oldest_ns`.

    Stamps are as reported, not calibrated for delay. Writes `changed_from_ns` (N,), see `TrackChange`.

    Returns:
        Numbers of rows; -1 for each, without any change, if some rows are not newer or there is no space.
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
            return Integrated(-1, -1, -1)
        if changed_from_ns[robot] == UNCHANGED_NS:
            changed_from_ns[robot] = newest[robot]
        newest[robot] = delayed[k]
    rows = NewRows(robots, delayed, raw, twist, np.ones(robots.size, dtype=np.bool_))
    return integrate(tracks, oldest_ns, rows, changed_from_ns)


@cached_njit
def integrate(tracks: TrackArrays, oldest_ns: int, rows: NewRows, changed_from_ns: IntArray) -> Integrated:
    """Append rows; where the twist is integrated from now on, lower `changed_from_ns` (N,)."""
    robots, stamps_ns, raw, twist, new = rows
    duplicates, counts = 0, np.zeros(3, dtype=np.int64)
    for k in range(robots.size):
        robot = robots[k]
        row = tracks.filled[robot]
        if row and stamps_ns[k] <= tracks.stamp_ns[robot, row - 1]:
            duplicates += 1
            continue
        tracks.stamp_ns[robot, row] = stamps_ns[k]
        assign(tracks.raw[robot, row], raw[k])
        assign(tracks.twist[robot, row], twist[k])
        if row == 0:  # a track starts at the reported pose
            assign(tracks.pose[robot, 0], raw[k])
            tracks.covariance[robot, 0].fill(0.0)
            tracks.jacobian[robot, 0].fill(0.0)
            tracks.rate[robot, 0].fill(0.0)
            tracks.agreed[robot, 0].fill(0)
            tracks.fastest[robot, 0].fill(0.0)
            tracks.unmoved[robot, 0].fill(0.0)
            assign(tracks.begin_pose[robot], raw[k])
            tracks.begin_ns[robot] = tracks.known_ns[robot, 0] = stamps_ns[k]
            tracks.jump_ns[robot, 0, 0] = tracks.jump_ns[robot, 0, 1] = BEFORE_ALL_NS // 2
        else:
            before = tracks.raw[robot, row - 1, 2]
            tracks.raw[robot, row, 2] = before + wrap(raw[k, 2] - before)
            first = row
            if update_unmoved(tracks, robot, row, oldest_ns):
                stamps = tracks.stamp_ns[robot, :row]
                first = max(1, np.searchsorted(stamps, tracks.twist_from_ns[robot], side="right"))
                changed_from_ns[robot] = min(changed_from_ns[robot], stamps[first - 1])
            for changed in range(first, row):
                _integrate_step(tracks, robot, changed)
            counts[_integrate_step(tracks, robot, row)] += new[k]
        tracks.filled[robot] = row + 1
    return Integrated(duplicates, counts[JUMP], counts[RESET])


@cached_njit
def integrate_again(tracks: TrackArrays, from_ns: IntArray, changed_from_ns: IntArray) -> None:
    """Integrate the rows of each robot behind an instant (N,) again; lower `changed_from_ns` (N,)."""
    for robot in range(from_ns.size):
        stamps = tracks.stamp_ns[robot, : tracks.filled[robot]]
        first = max(1, np.searchsorted(stamps, from_ns[robot], side="right"))
        for row in range(first, stamps.size):
            _integrate_step(tracks, robot, row)
        if first < stamps.size:
            changed_from_ns[robot] = min(changed_from_ns[robot], stamps[first - 1])


@norefcount_njit
def _integrate_step(tracks: TrackArrays, robot: int, row: int) -> int:
    """Integrate from the previous row to a row; return the fault of the step, see `fault_of_step`."""
    model = tracks.model[robot]
    before_ns, stamp_ns = tracks.stamp_ns[robot, row - 1], tracks.stamp_ns[robot, row]
    duration_s = (stamp_ns - before_ns) * 1e-9
    by_twist = tracks.twist_from_ns[robot] < stamp_ns <= tracks.twist_until_ns[robot]
    reported = _step_by_pose(tracks, robot, row)
    if by_twist:
        reported = _step_by_twist(tracks, robot, row, duration_s)
    fault = fault_of_step(tracks, robot, row, reported, duration_s)
    start, rate = tracks.pose[robot, row - 1], tracks.rate[robot, row]
    covariance, jacobian = tracks.covariance[robot, row], tracks.jacobian[robot, row]
    assign_matrix(covariance, tracks.covariance[robot, row - 1])
    assign_matrix(jacobian, tracks.jacobian[robot, row - 1])
    known_ns = tracks.known_ns[robot, row - 1]
    jumps_ns = tracks.jump_ns[robot, row]
    jumps_ns[0], jumps_ns[1] = tracks.jump_ns[robot, row - 1, 0], tracks.jump_ns[robot, row - 1, 1]
    if fault != NO_FAULT:
        jumps_ns[0], jumps_ns[1] = stamp_ns, jumps_ns[0]
    # one fault: the driver has restarted; several: two drivers publish conflicting odometry
    contradictory = stamp_ns - jumps_ns[1] < _CONTRADICTORY_NS
    if fault != NO_FAULT or contradictory or duration_s > model.timeout_s:  # the motion is unknown
        assign(tracks.pose[robot, row], start)
        rate.fill(0.0)
        unknown_s = (before_ns - known_ns) * 1e-9, (stamp_ns - known_ns) * 1e-9
        _add_unknown(model, unknown_s, start, rate, covariance)
        tracks.known_ns[robot, row] = known_ns if contradictory else stamp_ns
        return fault
    tracks.known_ns[robot, row] = stamp_ns
    before_rate = tracks.rate[robot, row - 1]
    forward, left, turn = _true_motion(tracks, robot, reported, duration_s, before_rate, rate)
    has_imu, turn_variance = tracks.imu[robot].turn_noise_density > 0.0, math.nan
    if has_imu:
        is_moving = reported[0] != 0.0 or reported[1] != 0.0 or reported[2] != 0.0
        turned = turn_by_gyro(tracks, robot, before_ns, stamp_ns, is_moving)
        if not math.isnan(turned):
            turn, rate[2] = turned, turned / duration_s
            turn_variance = 0.0
            if is_moving or turned != 0.0:
                turn_variance = tracks.imu[robot].turn_noise_density ** 2 * duration_s
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
    estimates_turn = not (has_imu and math.isnan(turn_variance))
    step = OdometryStep(forward, left, turn, changed, duration_s, x, y, middle, turn_variance, estimates_turn)
    add_step_noise(model, step, covariance)
    add_step_jacobian(model, step, jacobian)
    if by_twist and before_ns <= tracks.twist_from_ns[robot]:  # the motion before is lost
        lost = tracks.unmoved[robot, row - 1]
        path, turned = lost[0] ** 2 + lost[1] ** 2, lost[2] ** 2
        add_in_track_frame((start[0], start[1], start[2]), (path, path, turned, 0.0), covariance)
    return fault


@inlined_njit
def _step_by_pose(tracks: TrackArrays, robot: int, row: int) -> tuple[float, float, float]:
    """Displacement forward and left of the mean heading, and turn, between the reported poses of a step."""
    before, after = tracks.raw[robot, row - 1], tracks.raw[robot, row]
    turn = after[2] - before[2]
    middle = before[2] + 0.5 * turn
    dx, dy = after[0] - before[0], after[1] - before[1]
    cos, sin = math.cos(middle), math.sin(middle)
    return cos * dx + sin * dy, cos * dy - sin * dx, turn


@inlined_njit
def _step_by_twist(
    tracks: TrackArrays, robot: int, row: int, duration_s: float
) -> tuple[float, float, float]:
    """The same step by the mean of the reported twists at both ends: the chord of an arc."""
    before, after = tracks.twist[robot, row - 1], tracks.twist[robot, row]
    half = 0.25 * (before[2] + after[2]) * duration_s
    chord = 0.5 * duration_s * (math.sin(half) / half if half != 0.0 else 1.0)
    return chord * (before[0] + after[0]), chord * (before[1] + after[1]), 2.0 * half


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
