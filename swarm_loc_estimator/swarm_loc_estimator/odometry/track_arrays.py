"""Odometry tracks as arrays for compiled code: process noise, interpolation, extrapolation, gyroscopes.

A gyroscope is checked against the wheels of its robot, row by row along a track. The turns of both are summed
with forgetting. A gyroscope is wrong when it contradicts the wheels for seconds of turning: it reports zeros,
turns about another axis, the wrong way or in other units, or repeats one value.
A robot that is blocked, slides or is pushed contradicts its wheels for a shorter time. Until it is known
which of the two is wrong, their difference is the uncertainty of the turn, from a second before it shows on;
until a gyroscope has agreed with the wheels for the first time, its turns are no more certain than theirs.
A verdict at a row depends on earlier rows only, what is uncertain on rows of the next second as well, so that
late data and replays give the same track.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit, norefcount_njit
from swarm_loc_estimator.common.numerics import assign, assign_matrix
from swarm_loc_estimator.swarm.calibration_states import DISTANCE_SCALE, TURN_BIAS, TURN_SCALE
from swarm_loc_estimator.swarm.error_models import ImuModel, OdometryModel

_MAX_DISTANCE_M = 1e3
_MAX_TURNING_S = 100.0

WHEELS, GYRO = 0, 1  # Turn of wheels and of the gyroscope, forgotten with `_MEMORY_S` [rad]
_VARIANCE = 2  # Described variance of their difference [rad^2]
_LAST, _NOISE, _STEPS = 3, 4, 5
"""Difference of the last step [rad]; variance by the changes of this per described one, and steps with it."""
_RATIO, _AGREED_S = 6, 7
"""Usual turn of the gyroscope per turn of the wheels, 0.5 if these skid, and the time it was learned [s]."""
_COVERED = 8  # Difference of the sums that the covariance covers already, forgotten in the same way [rad]
DOUBT, _REPEATED_S = 9, 10
"""Time of contradiction minus time of agreement, within +-`_PATIENCE_S`; time with one measured value [s]."""
UNSURE = 11  # 1: that time is too long for a turn that changes, or both never agreed; 2: they contradict; 0
SOON_UNSURE = 12
"""The largest of a row that begins it within `COVER_NS`; -1: both agree there for the first time. It is not
continued from row to row."""
CHECKS = 13  # Number of these values

_MEMORY_S, _RATIO_MEMORY_S = 1.2, 10.0
COVER_NS = round(1e9 * _MEMORY_S)  # Time for which turns before a contradiction are uncertain
_PATIENCE_S, _NEW_PATIENCE_S = 3.0, 0.5  # The second one before the gyroscope has agreed
_FIRST_STEPS, _MOST_STEPS = 8.0, 200.0  # Weight of the described noise in steps, and memory of the noise
_MOST_NOISE = 100.0  # Largest measured noise of a step, in described ones
_LEAST_TURN, _SIGMAS = 0.1, 3.0  # Least turn of the wheels for a verdict [rad], and in multiples of sigma
_LEAST_APART, _APART_SIGMAS = 0.03, 3.0  # The same of the difference to be covered
_LEAST_RATIO, _MOST_RATIO = 0.3, 3.0
_SLACK, _SKID_SLACK, _REPEATED_SLACK = 0.1, 0.3, 0.05
"""Relative change of the ratio that is not covered: always, and per difference from one, as slip varies; of a
repeated value."""
_MOST_REPEATED_S = 0.5  # A value repeated for longer measures a turn that changes no better than the wheels
_REPEATED_WEIGHT = 3.0  # Of such a time for a verdict: no moving gyroscope does so


class OdometryStep(NamedTuple):
    """One step of a robot along its track."""

    forward: float  # Displacement of the body [m], as is left
    left: float
    turn: float  # Change of heading [rad]
    turn_rate_change: float  # Absolute change of the turn rate [rad/s]
    duration_s: float  # Duration [s]
    x: float  # Position on the track in the middle of the step [m], as is y
    y: float
    theta: float  # Heading in the middle of the step [rad]
    turn_variance: float  # Variance of a turn that a gyroscope measured [rad^2]; NaN: of the wheels
    estimates_turn: bool  # Whether the estimated scale and bias of turns are those of the sensor of this turn


@inlined_njit
def turn_variance(model: OdometryModel, path: float, turn: float, duration_s: float) -> float:
    """Variance of the turn of a step by the wheels [rad^2], but for that of a change of the turn rate."""
    turned = 0.5 * model.wheel_separation * turn
    wheels = abs(path + turned) + abs(path - turned)
    drift = model.turn_drift * duration_s if wheels > 0.0 else 0.0
    return model.wheel_noise * wheels / model.wheel_separation**2 + model.turn_noise * abs(turn) + drift


@cached_njit
def add_step_noise(model: OdometryModel, step: OdometryStep, covariance: FloatArray) -> None:
    """Add a step's noise to a covariance (3, 3) in the track's frame.

    Wheels: covar(ds_r, ds_l) = diag(k |ds_r|, k |ds_l|) (Siegwart and Nourbakhsh), the U Q U^T of the e-puck
    paper's eq. (9), whose Q is not printed. The noise along, across and in heading is relative to the
    direction of motion, so a sideways step has the noise of a forward step of that length.
    """
    turn, duration_s = step.turn, step.duration_s
    separation, wheel, path = model.wheel_separation, model.wheel_noise, math.hypot(step.forward, step.left)
    right_wheel, left_wheel = abs(path + 0.5 * separation * turn), abs(path - 0.5 * separation * turn)
    along = 0.25 * wheel * (right_wheel + left_wheel) + model.distance_noise * path
    along += model.distance_turn_noise * abs(turn)
    across = model.lateral_noise * path
    heading = turn_variance(model, path, turn, duration_s)
    heading += model.turn_change_noise * step.turn_rate_change
    if right_wheel + left_wheel > 0.0:
        along += model.distance_drift * duration_s
        across += model.lateral_drift * duration_s
    cross = 0.5 * wheel * (right_wheel - left_wheel) / separation
    if not math.isnan(step.turn_variance):
        heading, cross = step.turn_variance, 0.0
    course = step.theta + math.atan2(step.left, step.forward)
    add_in_track_frame((step.x, step.y, course), (along, across, heading, cross), covariance)


@cached_njit
def add_step_jacobian(model: OdometryModel, step: OdometryStep, jacobian: FloatArray) -> None:
    """Add the Jacobian (3, 3) of a step's motion by the parameters: Ad(O) times their body directions.

    The model gives the position of the axle.
    """
    forward, left, turn = step.forward, step.left, step.turn
    if forward == 0.0 and left == 0.0 and turn == 0.0:
        return
    cos, sin = math.cos(step.theta + model.course_offset), math.sin(step.theta + model.course_offset)
    jacobian[0, DISTANCE_SCALE] += cos * forward - sin * left
    jacobian[1, DISTANCE_SCALE] += sin * forward + cos * left
    if not step.estimates_turn:
        return
    # when the axle turns, base_link ahead of it also moves sideways
    turned_x = step.y - math.sin(step.theta) * model.axle_offset
    turned_y = -step.x + math.cos(step.theta) * model.axle_offset
    for parameter, angle in ((TURN_BIAS, step.duration_s), (TURN_SCALE, turn)):
        jacobian[0, parameter] += turned_x * angle
        jacobian[1, parameter] += turned_y * angle
        jacobian[2, parameter] += angle


@cached_njit
def add_dropout_noise(
    model: OdometryModel,
    silence_s: float,
    unknown: bool,
    pose: FloatArray,
    rate: FloatArray,
    covariance: FloatArray,
) -> None:
    """Add the noise of an odometry dropout that started at `pose` (3,) on the track with `rate` (3,).

    Speed and turn rate are random walks at first; if the motion is `unknown`, any feasible motion is covered.
    Both noises act about the last known pose, so the covariance never decreases with time.
    """
    # bounded, so that rounding does not lose the noise of later steps
    reach = min(model.max_speed * silence_s, _MAX_DISTANCE_M) ** 2 / 3.0
    turned = min(model.max_turn_rate * silence_s, math.pi) ** 2 / 3.0  # pi: any heading
    if model.max_turn_rate * silence_s > math.pi:  # the noise grows further while the robot may turn
        turned += min(silence_s - math.pi / model.max_turn_rate, _MAX_TURNING_S) * math.pi**2 / 3.0
    along, across, heading = reach, reach, turned
    if not unknown:
        walked = silence_s**3 / 3.0
        along, across = min(along, model.speed_change**2 * walked), 0.0
        heading = min(heading, model.turn_rate_change**2 * walked)
    course = pose[2] + math.atan2(rate[1], rate[0])
    add_in_track_frame((pose[0], pose[1], course), (along, across, heading, 0.0), covariance)


@cached_njit
def add_in_track_frame(
    pose: tuple[float, float, float], body: tuple[float, float, float, float], covariance: FloatArray
) -> None:
    """Add Ad(pose) Q Ad(pose)^T for body variances along, across, heading and cov(along, heading)."""
    x, y, theta = pose
    along, across, heading, cross = body
    cos, sin = math.cos(theta), math.sin(theta)
    forward, left, turning = (cos, sin, 0.0), (-sin, cos, 0.0), (y, -x, 1.0)
    for i in range(3):
        for j in range(3):
            covariance[i, j] += along * forward[i] * forward[j] + across * left[i] * left[j]
            covariance[i, j] += heading * turning[i] * turning[j]
            covariance[i, j] += cross * (forward[i] * turning[j] + turning[i] * forward[j])


_LEAST_STEP = 0.75  # Shortest step whose rate is extrapolated, in usual ones: the median of the three before
_RATE_STEPS = 4  # Steps whose rate is extrapolated instead

BEFORE_ALL_NS, LATEST_NS = np.iinfo(np.int64).min, np.iinfo(np.int64).max

MODEL_DTYPE = np.dtype([(f.name, np.float64) for f in fields(OdometryModel)])
"""Record of the numbers of an `OdometryModel`."""
IMU_DTYPE = np.dtype([(f.name, np.float64) for f in fields(ImuModel)])  # Record of the numbers of `ImuModel`


class TrackArrays(NamedTuple):
    """Rows and models of all tracks, for compiled code."""

    filled: IntArray  # (N,) number of rows in use
    stamp_ns: IntArray  # (N, capacity) instants, calibrated for delay
    raw: FloatArray  # (N, capacity, 3) poses as reported, headings unwrapped
    pose: FloatArray  # (N, capacity, 3) calibrated poses O, headings unwrapped
    covariance: FloatArray  # (N, capacity, 3, 3) preintegrated to the row, see `Preintegrated`
    jacobian: FloatArray  # (N, capacity, 3, 3) preintegrated to the row; columns as in `estimated_parameters`
    # (N, capacity, 3) calibrated velocity forward and left [m/s] and turn rate [rad/s] at the row, after the
    # lag
    rate: FloatArray
    # (N, capacity, 3) reported velocity forward, left [m/s] and turn rate [rad/s]; NaN: not known
    twist: FloatArray
    # (N, capacity, 2) evidence that twists agree with displacements and turns, see `fault_of_step`
    agreed: IntArray
    fastest: FloatArray  # (N, capacity, 2) largest speed [m/s] and turn rate [rad/s] of the twists so far
    # (N, capacity, 3) displacement [m] and turn [rad] by the twists while the pose and the heading are
    # constant; NaN after these have changed
    unmoved: FloatArray
    # (N, capacity) end of the known motion: the row's instant, or earlier after repeated faults
    known_ns: IntArray
    jump_ns: IntArray  # (N, capacity, 2) instants of the last two faults, newest first
    gyro_check: FloatArray  # (N, capacity, CHECKS) see `check_turn`; (N, capacity, 0) without an IMU
    twist_from_ns: IntArray  # (N,) instant after which the twist is integrated; LATEST_NS: never
    twist_until_ns: IntArray  # (N,) instant until which it is
    delay_ns: IntArray  # (N,) delay of the stamps
    model: NDArray[np.void]  # (N,) of MODEL_DTYPE
    response: FloatArray  # (N, 2, V, W) shares of speed and of turn rate of `MotionResponse`
    response_speed: FloatArray  # (N, V) speeds of its grid, padded with infinity
    response_turn_rate: FloatArray  # (N, W) turn rates of its grid
    begin_ns: IntArray  # (N,) instant of the very first row
    begin_pose: FloatArray  # (N, 3) pose of the very first row
    is_stationary: NDArray[np.bool_]  # (N,) True for a robot without odometry: its track stays at the origin
    imu: NDArray[np.void]  # (N,) of IMU_DTYPE
    gyro_filled: IntArray  # (N,) number of turn rates in use
    gyro_ns: IntArray  # (N, G) their instants, calibrated for delay
    gyro_rate: FloatArray  # (N, G) measured turn rates about the vertical [rad/s]
    gyro_angle: FloatArray  # (N, G) their integral [rad]
    gyro_piece: IntArray  # (N, G) number of the pause before, beyond which nothing is integrated
    walk: FloatArray  # (N, 2) its variances per second of position [m^2/s] and heading [rad^2/s]


class OdometrySample(NamedTuple):
    """Tracks looked up at some instants (m,)."""

    pose: FloatArray  # (m, 3) calibrated odometry pose O, heading not wrapped
    raw: FloatArray  # (m, 3) pose reported by the driver, interpolated in the same way
    covariance: FloatArray  # (m, 3, 3) preintegrated covariance, see `Preintegrated`
    jacobian: FloatArray  # (m, 3, 3) preintegrated Jacobian
    silence_s: FloatArray  # (m,) time since the newest message of the robot [s]; 0 within the track


@cached_njit
def new_sample(count: int) -> OdometrySample:
    """Allocate a sample of `count` look-ups."""
    (pose, raw), (covariance, jacobian) = np.zeros((2, count, 3)), np.zeros((2, count, 3, 3))
    return OdometrySample(pose, raw, covariance, jacobian, np.zeros(count))


@inlined_njit
def look_up(tracks: TrackArrays, robot: int, stamp_ns: int, out: OdometrySample, k: int) -> None:
    """Look a robot's track up at an instant, and write row k of a sample.

    Within a step the twist is constant. Past the newest row the last twist is extrapolated with growing
    covariance, that of several steps if the last one is much shorter than usual, as after a wrong stamp;
    after `timeout_s` the motion since that row is unknown. Before the first row the robot is stationary.
    A robot without odometry is stationary or a random walk in its body frame.
    """
    count = tracks.filled[robot]
    out.silence_s[k] = 0.0
    if count == 0:
        out.pose[k].fill(0.0)
        out.raw[k].fill(0.0)
        out.covariance[k].fill(0.0)
        out.jacobian[k].fill(0.0)
        out.silence_s[k] = 0.0 if tracks.is_stationary[robot] else math.inf
        for i in range(3):  # for a random walk, only differences between instants matter
            out.covariance[k, i, i] = tracks.walk[robot, i // 2] * (1e-9 * stamp_ns)
        return
    row, end, fraction = _find_step(tracks, robot, stamp_ns)
    if fraction < 0.0:
        assign(out.pose[k], tracks.pose[robot, row])
        assign(out.raw[k], tracks.raw[robot, row])
        assign_matrix(out.covariance[k], tracks.covariance[robot, row])
        assign_matrix(out.jacobian[k], tracks.jacobian[robot, row])
    else:
        _interpolate(tracks.pose[robot, row], tracks.pose[robot, end], fraction, out.pose[k])
        _interpolate(tracks.raw[robot, row], tracks.raw[robot, end], fraction, out.raw[k])
        for i in range(3):
            for j in range(3):
                for table, target in ((tracks.covariance, out.covariance), (tracks.jacobian, out.jacobian)):
                    before, after = table[robot, row, i, j], table[robot, end, i, j]
                    target[k, i, j] = before + fraction * (after - before)
        if fraction < 1.0:
            return
        row = end
    model, pose, rate = tracks.model[robot], tracks.pose[robot, row], tracks.rate[robot, row]
    silence_ns = max(0, stamp_ns - tracks.stamp_ns[robot, row])
    unknown = silence_ns > model.timeout_s * 1e9
    out.silence_s[k] = silence_s = silence_ns * 1e-9
    add_dropout_noise(model, silence_s, unknown, pose, rate, out.covariance[k])


@inlined_njit
def look_up_pose(tracks: TrackArrays, robot: int, stamp_ns: int, out: FloatArray) -> None:
    """Write only the pose (3,) of `look_up`."""
    if tracks.filled[robot] == 0:
        out.fill(0.0)
        return
    row, end, fraction = _find_step(tracks, robot, stamp_ns)
    if fraction < 0.0:
        assign(out, tracks.pose[robot, row])
    else:
        _interpolate(tracks.pose[robot, row], tracks.pose[robot, end], fraction, out)


@inlined_njit
def _find_step(tracks: TrackArrays, robot: int, stamp_ns: int) -> tuple[int, int, float]:
    """Rows before and after an instant on a track that is not empty, and the fraction of the step between.

    A fraction of 1 or more extrapolates past the newest row; below 0, the robot is stationary at the row.
    """
    count = tracks.filled[robot]
    stamps, timeout_ns = tracks.stamp_ns[robot, :count], tracks.model[robot].timeout_s * 1e9
    row = max(0, np.searchsorted(stamps, stamp_ns, side="right") - 1)
    if row + 1 < count and stamps[row + 1] - stamps[row] <= timeout_ns:
        return row, row + 1, max(0, stamp_ns - stamps[row]) / (stamps[row + 1] - stamps[row])
    silence_ns = max(0, stamp_ns - stamps[row])
    if row > 0 and silence_ns <= timeout_ns and stamps[row] - stamps[row - 1] <= timeout_ns:
        # the rate at a row is that since the one before, or of several steps where this one is short, see
        # `look_up`
        begin = row - 1
        if row > _RATE_STEPS:
            one, two = stamps[row - 1] - stamps[row - 2], stamps[row - 2] - stamps[row - 3]
            usual = max(min(one, two), min(max(one, two), stamps[row - 3] - stamps[row - 4]))
            if stamps[row] - stamps[row - 1] < _LEAST_STEP * usual:
                begin = row - _RATE_STEPS
        return begin, row, 1.0 + silence_ns / (stamps[row] - stamps[begin])
    return row, row, -1.0


@inlined_njit
def rate_at(tracks: TrackArrays, robot: int, stamp_ns: int) -> tuple[float, float, float]:
    """Velocity forward and left [m/s] and turn rate [rad/s] of base_link at an instant.

    At a row, the rate is that of the step before, so that later rows do not change it. It is zero up to the
    first row and where the motion is unknown.
    """
    count = tracks.filled[robot]
    stamps, timeout_ns = tracks.stamp_ns[robot, :count], tracks.model[robot].timeout_s * 1e9
    row = min(np.searchsorted(stamps, stamp_ns), count - 1)
    if row < 1:
        return 0.0, 0.0, 0.0
    if max(stamps[row], stamp_ns) - stamps[row - 1] > timeout_ns:
        return 0.0, 0.0, 0.0
    before, after = tracks.pose[robot, row - 1], tracks.pose[robot, row]
    duration_s = (stamps[row] - stamps[row - 1]) * 1e-9
    turn = after[2] - before[2]
    cos, sin = math.cos(before[2] + 0.5 * turn), math.sin(before[2] + 0.5 * turn)
    dx, dy = after[0] - before[0], after[1] - before[1]
    return (cos * dx + sin * dy) / duration_s, (cos * dy - sin * dx) / duration_s, turn / duration_s


@cached_njit
def look_up_all(tracks: TrackArrays, robots: IntArray, stamps_ns: IntArray) -> OdometrySample:
    """Look up m robots at m instants; see `look_up`."""
    out = new_sample(robots.size)
    for k in range(robots.size):
        look_up(tracks, robots[k], stamps_ns[k], out, k)
    return out


@inlined_njit
def _interpolate(start: FloatArray, end: FloatArray, fraction: float, out: FloatArray) -> None:
    """Interpolate from `start` to `end` with constant twist; a `fraction` above 1 extrapolates."""
    turn = end[2] - start[2]
    back = -0.5 * (1.0 - fraction) * turn
    cos, sin = math.cos(back), math.sin(back)
    dx, dy = end[0] - start[0], end[1] - start[1]
    out[0] = start[0] + fraction * (cos * dx - sin * dy)
    out[1] = start[1] + fraction * (sin * dx + cos * dy)
    out[2] = start[2] + fraction * turn


@inlined_njit
def begin_check(tracks: TrackArrays, robot: int) -> None:
    """Begin the check at the first row of a track."""
    first = tracks.gyro_check[robot, 0]
    first.fill(0.0)
    first[_RATIO], first[DOUBT] = 1.0, -_NEW_PATIENCE_S
    first[_NOISE], first[_STEPS] = 1.0, _FIRST_STEPS


@inlined_njit
def continue_check(tracks: TrackArrays, robot: int, row: int) -> None:
    """Copy the check of the row before."""
    for i in range(SOON_UNSURE):
        tracks.gyro_check[robot, row, i] = tracks.gyro_check[robot, row - 1, i]


@norefcount_njit
def check_turn(
    tracks: TrackArrays,
    robot: int,
    row: int,
    turns: tuple[float, float, float],
    duration_s: float,
    is_moving: bool,
    repeats: bool,
) -> float:
    """Compare the turns of a row's step by wheels and gyroscope; update its check, a copy of that before.

    `turns` are those by the wheels, which move or not, and by the gyroscope, which repeats one value or not
    [rad], and the described variance of the first one [rad^2].

    Returns:
        Variance of the heading [rad^2] that was not added for earlier rows, while both contradict each other.
    """
    check, imu = tracks.gyro_check[robot, row], tracks.imu[robot]
    wheels, gyro, variance = turns
    variance += imu.turn_noise_density**2 * duration_s
    # Odometry without headings says nothing, nor do standing wheels of a robot that a hand turns.
    check[_REPEATED_S] = check[_REPEATED_S] + duration_s if repeats else 0.0
    is_repeated = check[_REPEATED_S] > _MOST_REPEATED_S
    if wheels == 0.0 and (check[WHEELS] == 0.0 or not (is_moving or is_repeated)):
        check[UNSURE] = 0.0
        return 0.0
    # Sums of turns, of one repeated value without forgetting; their noise is what changes from step to step.
    kept = 1.0 if is_repeated else math.exp(-duration_s / _MEMORY_S)
    difference = gyro - check[_RATIO] * wheels
    check[WHEELS] = kept * check[WHEELS] + wheels
    check[GYRO] = kept * check[GYRO] + gyro
    check[_VARIANCE] = kept**2 * check[_VARIANCE] + variance
    if check[UNSURE] < 2.0:  # otherwise the change may be that of a wrong gyroscope
        noise = min(_MOST_NOISE, 0.5 * (difference - check[_LAST]) ** 2 / variance)
        check[_STEPS] = min(_MOST_STEPS, check[_STEPS] + 1.0)
        check[_NOISE] += (noise - check[_NOISE]) / check[_STEPS]
    check[_LAST] = difference
    check[_COVERED] *= kept
    by_wheels, by_gyro = check[WHEELS], check[GYRO]
    sigma = math.hypot(math.sqrt(check[_NOISE] * check[_VARIANCE]), imu.turn_bias_sigma * _MEMORY_S)
    slack = _REPEATED_SLACK if is_repeated else _SLACK + _SKID_SLACK * abs(1.0 - check[_RATIO])
    slack *= check[_RATIO] * abs(by_wheels)
    apart = abs(by_gyro - check[_RATIO] * by_wheels)
    # Time for and against the gyroscope, while the robot turns.
    was_doubted = check[DOUBT] > 0.0
    least = max(_LEAST_TURN, _SIGMAS * sigma)
    turned = max(abs(by_wheels), abs(by_gyro)) if is_repeated else abs(by_wheels)
    if turned > least:
        along = by_gyro if by_wheels > 0.0 else -by_gyro
        agrees = _LEAST_RATIO * abs(by_wheels) < along < _MOST_RATIO * abs(by_wheels)
        if agrees and not (is_repeated and check[_AGREED_S] > 0.0):
            check[_AGREED_S] = min(_RATIO_MEMORY_S, check[_AGREED_S] + duration_s)
            check[_RATIO] += min(1.0, duration_s / check[_AGREED_S]) * (by_gyro / by_wheels - check[_RATIO])
        doubt = check[DOUBT] + (-duration_s if agrees else duration_s)
        if is_repeated:  # which proves nothing where it is right
            doubt = check[DOUBT] + (_REPEATED_WEIGHT * duration_s if apart > least + slack else 0.0)
        check[DOUBT] = min(_PATIENCE_S, max(-_PATIENCE_S, doubt))
    # Cover what neither noise nor an unusual ratio explains, and all at a verdict.
    is_doubted, covered = check[DOUBT] > 0.0, check[_COVERED]
    is_apart = apart > max(_LEAST_APART, _APART_SIGMAS * sigma) + slack
    check[UNSURE] = 2.0 if is_apart else 1.0 if is_repeated or check[_AGREED_S] == 0.0 else 0.0
    if was_doubted or not (is_doubted or is_apart or check[SOON_UNSURE] == 2.0) or apart <= covered:
        return 0.0
    check[_COVERED] = apart
    return float(apart**2 - covered**2)


@norefcount_njit
def first_to_change(tracks: TrackArrays, robot: int, row: int) -> int:
    """Mark rows before one that shows whether they are certain; the first of them, `row` if it does not."""
    check, stamps = tracks.gyro_check[robot], tracks.stamp_ns[robot, :row]
    mark = check[row, UNSURE]
    if check[row, _AGREED_S] > 0.0 and check[row - 1, _AGREED_S] == 0.0:
        mark = -1.0
    elif not mark > check[row - 1, UNSURE]:
        return row
    first: int = max(1, np.searchsorted(stamps, tracks.stamp_ns[robot, row] - COVER_NS))
    for before in range(first, row):
        old = check[before, SOON_UNSURE]
        check[before, SOON_UNSURE] = max(mark, old) if old != 0.0 else mark
    return first


@norefcount_njit
def unmark_from(tracks: TrackArrays, robot: int, row: int) -> int:
    """Unmark rows from one on, and those before that later rows may have marked; the first of these."""
    stamps, check = tracks.stamp_ns[robot, : tracks.filled[robot]], tracks.gyro_check[robot]
    if row >= stamps.size or not check.size:
        return row
    first = np.searchsorted(stamps, stamps[row] - COVER_NS)
    while first < row and check[first, SOON_UNSURE] == 0.0:
        first += 1
    check[first:, SOON_UNSURE] = 0.0
    found: int = first
    return found
