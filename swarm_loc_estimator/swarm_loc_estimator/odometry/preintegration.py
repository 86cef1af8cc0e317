"""Preintegration of odometry: calibrated poses along a track, with their covariance and Jacobian.

Steps are checked for jumps, resets, and a pose that is constant while the twist is not. A step is compared
with what the robot can do between two stamps, and with the twists at both ends. Drivers report the twist of
the step before, of the step after or of the instant, so the mean twist of a step lies between the two; while
it does not, or the twist is not filled, it proves nothing. Where there is a gyroscope, its turn rate is
integrated to the turn, as long as it agrees with the wheels, see `track_arrays.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit, norefcount_njit
from swarm_loc_estimator.common.numerics import add_scaled, assign, assign_matrix, wrap
from swarm_loc_estimator.odometry.track_arrays import (
    BEFORE_ALL_NS,
    DOUBT,
    LATEST_NS,
    SOON_UNSURE,
    UNSURE,
    OdometryStep,
    TrackArrays,
    add_dropout_noise,
    add_in_track_frame,
    add_step_jacobian,
    add_step_noise,
    begin_check,
    check_turn,
    continue_check,
    first_to_change,
    turn_variance,
    unmark_from,
)
from swarm_loc_estimator.swarm.error_models import OdometryModel

NO_FAULT, JUMP, RESET = 0, 1, 2
"""Faults of a step: none; beyond the speed limits; contradicts the twist, or a restart at the origin."""

_TURN_SLACK = 0.2  # Tolerance of a turn beyond the maximum turn rate [rad], because stamps jitter
_TWIST_TURN_SLACK = 0.03  # Tolerance of a turn outside the twists [rad]
_TWIST_PATH_SLACK = 0.1  # Tolerance of a displacement outside the twists, in wheel separations
_LEAST_RATE = 0.05
"""Share of the maximum rates by which rates may vary in a step, until the robot has reported larger ones."""
_AGREED_ENOUGH, _AGREED_MOST, _AGREED_LOSS = 20, 60, 30
"""Number of agreeing steps from which the twist is used, its maximum, and its loss at a contradiction."""
_RESTART_GAP = 2.5  # Pause before a restart at the origin, in previous steps
_ROUNDING = 1e-9
_UNMOVED_M, _UNMOVED_RAD = 0.02, 0.2  # Motion by the twist from which a constant pose is not believed
_UNMOVED_ROWS = 3  # Minimum number of rows with that pose
_UNMOVED_S = 10.0  # Time constant with which this motion is forgotten, so that a small bias does not add up


@norefcount_njit
def fault_of_step(
    tracks: TrackArrays, robot: int, row: int, step: tuple[float, float, float], duration_s: float
) -> int:
    """Fault of a step forward, left [m] and turn [rad] to a row; updates the row's evidence of the twist."""
    model = tracks.model[robot]
    agreed, fastest = tracks.agreed[robot, row], tracks.fastest[robot, row]
    for i in range(2):
        agreed[i], fastest[i] = tracks.agreed[robot, row - 1, i], tracks.fastest[robot, row - 1, i]
    # A step beyond the limits of the robot is a jump; one to the origin after a pause is a restart.
    fault, stamps = NO_FAULT, tracks.stamp_ns[robot]
    # tolerance of half a robot's width, because stamps jitter
    near = math.hypot(step[0], step[1]) <= model.max_speed * duration_s + 0.5 * model.wheel_separation
    if not (near and abs(step[2]) <= model.max_turn_rate * duration_s + _TURN_SLACK):  # True for NaN
        fault = JUMP
    elif row > 1 and _is_zero(tracks, robot, row) and not _is_zero(tracks, robot, row - 1):
        is_paused = duration_s > _RESTART_GAP * 1e-9 * (stamps[row - 1] - stamps[row - 2])
        fault = RESET if is_paused else NO_FAULT
    # The twist, where it is known, says how far the step may be.
    earlier, later = tracks.twist[robot, row - 1], tracks.twist[robot, row]
    known = math.isfinite(earlier[0] + earlier[1] + earlier[2] + later[0] + later[1] + later[2])
    if not known or duration_s > model.timeout_s:
        return fault
    speeds = math.hypot(earlier[0], earlier[1]), math.hypot(later[0], later[1])
    rates = abs(earlier[2]), abs(later[2])
    fastest[0] = max(fastest[0], speeds[0], speeds[1], _LEAST_RATE * model.max_speed)
    fastest[1] = max(fastest[1], rates[0], rates[1], _LEAST_RATE * model.max_turn_rate)
    half = 0.5 * step[2]
    arc = math.hypot(step[0], step[1]) * (half / math.sin(half) if half != 0.0 else 1.0)
    slack = _TWIST_PATH_SLACK * model.wheel_separation + fastest[0] * duration_s
    turn_slack = _TWIST_TURN_SLACK + fastest[1] * duration_s
    away = _outside(arc, speeds[0] * duration_s, speeds[1] * duration_s)  # some drivers turn the velocity
    turned = _outside(step[2], earlier[2] * duration_s, later[2] * duration_s)
    moves = (speeds[0] + speeds[1] > 0.0 and arc > 0.0), (rates[0] + rates[1] > 0.0 and step[2] != 0.0)
    # A step that contradicts a twist that has agreed before is a reset.
    for i, contradicts in enumerate((away > slack, turned > turn_slack)):
        if contradicts:
            if agreed[i] >= _AGREED_ENOUGH and fault == NO_FAULT:
                fault = RESET
            agreed[i] = max(0, agreed[i] - _AGREED_LOSS)
        elif moves[i]:
            agreed[i] = min(_AGREED_MOST, agreed[i] + 1)
    return fault


@inlined_njit
def _is_zero(tracks: TrackArrays, robot: int, row: int) -> bool:
    """Whether the reported pose of a row is zero up to rounding."""
    pose = tracks.raw[robot, row]
    return bool(abs(pose[0]) + abs(pose[1]) < _ROUNDING and math.cos(pose[2]) == 1.0)


@inlined_njit
def _outside(value: float, one: float, other: float) -> float:
    """Distance of a value from the interval between two others."""
    return max(0.0, value - max(one, other), min(one, other) - value)


@norefcount_njit
def update_unmoved(tracks: TrackArrays, robot: int, row: int, oldest_ns: int) -> bool:
    """Note whether a row's pose has changed; return whether the twist is integrated from now on.

    A pose that has been constant since the first row while the twist says that the robot has moved, or a
    heading while it says that it has turned, is not filled by its driver. Rows not older than `oldest_ns` are
    then integrated by their twists until the heading changes for the first time.
    """
    before, after = tracks.raw[robot, row - 1], tracks.raw[robot, row]
    moved = tracks.unmoved[robot, row]
    stamp_ns, before_ns = tracks.stamp_ns[robot, row], tracks.stamp_ns[robot, row - 1]
    duration_s = (stamp_ns - before_ns) * 1e-9
    left = math.exp(-duration_s / _UNMOVED_S)
    if duration_s > tracks.model[robot].timeout_s:
        duration_s = 0.0
    for i in range(3):
        mean = 0.5 * (tracks.twist[robot, row - 1, i] + tracks.twist[robot, row, i])
        moved[i] = left * tracks.unmoved[robot, row - 1, i] + (
            mean * duration_s if math.isfinite(mean) else 0.0
        )
    if after[0] != before[0] or after[1] != before[1] or after[2] != before[2]:
        if not math.isnan(moved[0]):
            moved[2] = 0.0  # from now on only the heading may be constant
            tracks.twist_until_ns[robot] = min(tracks.twist_until_ns[robot], before_ns)
        moved[0] = moved[1] = math.nan
    if after[2] != before[2]:
        moved[2] = math.nan
        tracks.twist_until_ns[robot] = min(tracks.twist_until_ns[robot], before_ns)
    has_moved = math.hypot(moved[0], moved[1]) > _UNMOVED_M or abs(moved[2]) > _UNMOVED_RAD  # False for NaN
    is_integrated = tracks.twist_from_ns[robot] < stamp_ns <= tracks.twist_until_ns[robot]
    if row < _UNMOVED_ROWS or not has_moved or is_integrated:
        return False
    tracks.twist_until_ns[robot] = LATEST_NS
    begin_ns = tracks.begin_ns[robot]
    if oldest_ns > BEFORE_ALL_NS:
        begin_ns = max(begin_ns, oldest_ns + tracks.delay_ns[robot])
    tracks.twist_from_ns[robot] = min(tracks.twist_from_ns[robot], begin_ns)
    return True


_STILL_SIGMAS = 4.0  # Turns within so many sigma of noise and bias are none while the wheels stand


@cached_njit
def insert_rates(
    tracks: TrackArrays, robots: IntArray, stamps_ns: IntArray, rates: FloatArray, from_ns: IntArray
) -> int:
    """Insert turn rates (k,) in any order, for which there is space, and integrate them.

    Stamps are calibrated for delay, rates finite and about the vertical as measured [rad/s]. Rows are not
    integrated again, see `integrate_again`; `from_ns` (N,) is written: the instant after which turns of
    odometry steps have changed; LATEST_NS: never. Returns the number of dropped ones, at the instant of
    another.
    """
    duplicates, first = 0, np.full(from_ns.size, LATEST_NS)
    for k in range(robots.size):
        robot = robots[k]
        count, stamps = tracks.gyro_filled[robot], tracks.gyro_ns[robot]
        place = np.searchsorted(stamps[:count], stamps_ns[k])
        if place < count and stamps[place] == stamps_ns[k]:
            duplicates += 1
            continue
        for later in range(count, place, -1):
            stamps[later] = stamps[later - 1]
            tracks.gyro_rate[robot, later] = tracks.gyro_rate[robot, later - 1]
        stamps[place], tracks.gyro_rate[robot, place] = stamps_ns[k], rates[k]
        tracks.gyro_filled[robot] = count + 1
        first[robot] = min(first[robot], place)
    for robot in range(from_ns.size):
        from_ns[robot] = LATEST_NS
        if first[robot] < tracks.gyro_filled[robot]:
            _integrate(tracks, robot, first[robot])
            changed_ns = tracks.gyro_ns[robot, max(0, first[robot] - 1)]
            newest_ns = tracks.gyro_ns[robot, tracks.gyro_filled[robot] - 1]
            stamps = tracks.stamp_ns[robot, : tracks.filled[robot]]
            row = np.searchsorted(stamps, changed_ns, side="right")
            if row < stamps.size and stamps[row] <= newest_ns:  # there is odometry in between
                from_ns[robot] = changed_ns
    return duplicates


@inlined_njit
def _integrate(tracks: TrackArrays, robot: int, first: int) -> None:
    """Integrate a robot's turn rates from an index on, by the trapezoidal rule."""
    stamps, rates = tracks.gyro_ns[robot], tracks.gyro_rate[robot]
    angles, pieces = tracks.gyro_angle[robot], tracks.gyro_piece[robot]
    pause_ns = tracks.imu[robot].timeout_s * 1e9
    for k in range(first, tracks.gyro_filled[robot]):
        angles[k], pieces[k] = 0.0, 0
        if k > 0:
            step_ns = stamps[k] - stamps[k - 1]
            angles[k], pieces[k] = angles[k - 1], pieces[k - 1]
            if step_ns > pause_ns:
                pieces[k] += 1
            else:
                angles[k] += 0.5 * (rates[k - 1] + rates[k]) * step_ns * 1e-9


@inlined_njit
def turn_by_gyro(
    tracks: TrackArrays, robot: int, begin_ns: int, end_ns: int, is_moving: bool
) -> tuple[float, bool]:
    """Calibrated turn of a robot between two instants [rad], and whether the measured value is repeated.

    The turn is NaN if it was not measured throughout. While the wheels stand, what noise and bias explain is
    no turn.
    """
    stamps, imu = tracks.gyro_ns[robot, : tracks.gyro_filled[robot]], tracks.imu[robot]
    before = int(np.searchsorted(stamps, begin_ns, side="right")) - 1
    after = int(np.searchsorted(stamps, end_ns))
    if before < 0 or after == stamps.size:
        return math.nan, False
    if tracks.gyro_piece[robot, before] != tracks.gyro_piece[robot, after]:
        return math.nan, False
    repeats = tracks.gyro_rate[robot, before] == tracks.gyro_rate[robot, after]
    angle = _angle_at(tracks, robot, after, end_ns) - _angle_at(tracks, robot, before, begin_ns)
    duration_s = (end_ns - begin_ns) * 1e-9
    turn: float = imu.turn_scale * angle + imu.turn_bias * duration_s
    noise, bias = imu.turn_noise_density * math.sqrt(duration_s), imu.turn_bias_sigma * duration_s
    if not is_moving and abs(turn) <= _STILL_SIGMAS * math.hypot(noise, bias):
        return 0.0, repeats
    return turn, repeats


@inlined_njit
def _angle_at(tracks: TrackArrays, robot: int, k: int, stamp_ns: int) -> float:
    """Integral of the turn rate until an instant next to measurement k; the rate is linear in between."""
    stamps, rates = tracks.gyro_ns[robot], tracks.gyro_rate[robot]
    angle: float = tracks.gyro_angle[robot, k]
    if stamps[k] == stamp_ns:
        return angle
    other = k + 1 if stamp_ns > stamps[k] else k - 1
    share = (stamp_ns - stamps[k]) / (stamps[other] - stamps[k])
    mean = rates[k] + 0.5 * share * (rates[other] - rates[k])
    angle += mean * (stamp_ns - stamps[k]) * 1e-9
    return angle


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
    new: BoolArray  # (k,) False for rows that are integrated again


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
        is_late = stamps_ns[k] < oldest_ns or delayed[k] <= newest[robot]
        if is_late or filled[robot] > tracks.stamp_ns.shape[1]:
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
        # Append the row.
        tracks.stamp_ns[robot, row] = stamps_ns[k]
        assign(tracks.raw[robot, row], raw[k])
        assign(tracks.twist[robot, row], twist[k])
        # A track starts at the reported pose.
        if row == 0:
            assign(tracks.pose[robot, 0], raw[k])
            tracks.covariance[robot, 0].fill(0.0)
            tracks.jacobian[robot, 0].fill(0.0)
            tracks.rate[robot, 0].fill(0.0)
            tracks.agreed[robot, 0].fill(0)
            tracks.fastest[robot, 0].fill(0.0)
            tracks.unmoved[robot, 0].fill(0.0)
            if tracks.imu[robot].turn_noise_density > 0.0:
                begin_check(tracks, robot)
            assign(tracks.begin_pose[robot], raw[k])
            tracks.begin_ns[robot] = tracks.known_ns[robot, 0] = stamps_ns[k]
            tracks.jump_ns[robot, 0, 0] = tracks.jump_ns[robot, 0, 1] = BEFORE_ALL_NS // 2
        else:  # integrate the step to it, and those before whose twist counts from now on
            before = tracks.raw[robot, row - 1, 2]
            tracks.raw[robot, row, 2] = before + wrap(raw[k, 2] - before)
            first = row
            if update_unmoved(tracks, robot, row, oldest_ns):
                stamps = tracks.stamp_ns[robot, :row]
                first = max(1, np.searchsorted(stamps, tracks.twist_from_ns[robot], side="right"))
                changed_from_ns[robot] = min(changed_from_ns[robot], stamps[first - 1])
            tracks.gyro_check[robot, row].fill(0.0)
            for changed in range(first, row):
                _integrate_row(tracks, robot, changed, changed_from_ns)
            counts[_integrate_row(tracks, robot, row, changed_from_ns)] += new[k]
        tracks.filled[robot] = row + 1
    return Integrated(duplicates, counts[JUMP], counts[RESET])


@cached_njit
def integrate_again(tracks: TrackArrays, from_ns: IntArray, changed_from_ns: IntArray) -> None:
    """Integrate the rows of each robot after an instant (N,) again; lower `changed_from_ns` (N,)."""
    for robot in range(from_ns.size):
        stamps = tracks.stamp_ns[robot, : tracks.filled[robot]]
        first = max(1, unmark_from(tracks, robot, np.searchsorted(stamps, from_ns[robot], side="right")))
        for row in range(first, stamps.size):
            _integrate_row(tracks, robot, row, changed_from_ns)
        if first < stamps.size:
            changed_from_ns[robot] = min(changed_from_ns[robot], stamps[first - 1])


@norefcount_njit
def _integrate_row(tracks: TrackArrays, robot: int, row: int, changed_from_ns: IntArray) -> int:
    """The same as `_integrate_step`; rows before whose certainty it changes are integrated again."""
    fault = _integrate_step(tracks, robot, row)
    if tracks.imu[robot].turn_noise_density > 0.0:
        first = first_to_change(tracks, robot, row)
        if first < row:
            changed_from_ns[robot] = min(changed_from_ns[robot], tracks.stamp_ns[robot, first - 1])
            for changed in range(first, row + 1):
                _integrate_step(tracks, robot, changed)
    return fault


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
    if tracks.imu[robot].turn_noise_density > 0.0:
        continue_check(tracks, robot, row)
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
    has_imu, gyro_variance, covered = tracks.imu[robot].turn_noise_density > 0.0, math.nan, 0.0
    estimates_turn = not has_imu
    if has_imu:
        is_moving = reported[0] != 0.0 or reported[1] != 0.0 or reported[2] != 0.0
        turned, repeats = turn_by_gyro(tracks, robot, before_ns, stamp_ns, is_moving)
        if not math.isnan(turned):
            wheels = model.turn_scale * reported[2]  # its lag is short
            wheels_variance = turn_variance(model, math.hypot(forward, left), wheels, duration_s)
            turns = wheels, turned, wheels_variance
            covered = check_turn(tracks, robot, row, turns, duration_s, is_moving, repeats)
            check = tracks.gyro_check[robot, row]
            if check[DOUBT] <= 0.0:
                turn, rate[2], estimates_turn = turned, turned / duration_s, covered == 0.0
                if check[UNSURE] + check[SOON_UNSURE] <= 0.0:  # otherwise the noise is that of the wheels
                    is_turning = is_moving or turned != 0.0
                    density = tracks.imu[robot].turn_noise_density if is_turning else 0.0
                    gyro_variance = density**2 * duration_s
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
    step = OdometryStep(forward, left, turn, changed, duration_s, x, y, middle, gyro_variance, estimates_turn)
    add_step_noise(model, step, covariance)
    add_step_jacobian(model, step, jacobian)
    if covered > 0.0:
        add_in_track_frame((x, y, middle), (0.0, 0.0, covered, 0.0), covariance)
    if by_twist and before_ns <= tracks.twist_from_ns[robot]:  # the motion before is lost
        lost = tracks.unmoved[robot, row - 1]
        path = 0.0 if math.isnan(lost[0]) else lost[0] ** 2 + lost[1] ** 2
        turned = 0.0 if math.isnan(lost[2]) else lost[2] ** 2
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
    """Add the noise of a step of motion that is unknown, until the previous row and this one [s]."""
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
    # True shares of speed and turn rate, bilinear in the grid of the robot's response.
    speed = math.hypot(reported[0], reported[1]) / duration_s
    i, a = _bracket(tracks.response_speed[robot], speed)
    j, b = _bracket(tracks.response_turn_rate[robot], abs(reported[2]) / duration_s)
    scale = model.distance_scale * _bilinear(tracks.response[robot, 0], i, j, a, b)
    turn_scale = model.turn_scale * _bilinear(tracks.response[robot, 1], i, j, a, b)
    ahead, aside, turning = reported
    is_moving = ahead != 0.0 or aside != 0.0 or turning != 0.0
    turn_rate = turn_scale * turning / duration_s + (model.turn_bias if is_moving else 0.0)
    true_rate = (scale * ahead / duration_s, scale * aside / duration_s, turn_rate)
    remaining, mean = 0.0, 0.0  # remaining share of the lag's transient: at the end, and mean over the step
    if model.lag_s > 0.0:
        remaining = math.exp(-duration_s / model.lag_s)
        mean = (1.0 - remaining) * model.lag_s / duration_s
    forward, left = before_rate[0] - true_rate[0], before_rate[1] - true_rate[1]
    turn = before_rate[2] - true_rate[2]
    rate[0], rate[1] = true_rate[0] + remaining * forward, true_rate[1] + remaining * left
    rate[2] = true_rate[2] + remaining * turn
    forward, left = true_rate[0] + mean * forward, true_rate[1] + mean * left
    return forward * duration_s, left * duration_s, (true_rate[2] + mean * turn) * duration_s


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
