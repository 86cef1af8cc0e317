"""Check of a gyroscope against the wheels of its robot, row by row along a track.

The turns of both are summed with forgetting. A gyroscope is wrong when it contradicts the wheels for seconds
of turning: it reports zeros, turns about another axis, the wrong way or in other units, or repeats one value.
A robot that is blocked, slides or is pushed contradicts its wheels for a shorter time. Until it is known
which of the two is wrong, their difference is the uncertainty of the turn, from a second before it shows on;
until a gyroscope has agreed with the wheels for the first time, its turns are no more certain than theirs.
A verdict at a row depends on earlier rows only, what is uncertain on rows of the next second as well, so that
late data and replays give the same track.
"""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.jit import inlined_njit, norefcount_njit
from swarm_loc_estimator.odometry.track_arrays import TrackArrays

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
COVER_NS = round(1e9 * _MEMORY_S)
"""Time for which turns before a contradiction are uncertain."""
_PATIENCE_S, _NEW_PATIENCE_S = 3.0, 0.5  # The second one before the gyroscope has agreed
_FIRST_STEPS, _MOST_STEPS = 8.0, 200.0  # Weight of the described noise in steps, and memory of the noise
_MOST_NOISE = 100.0  # Largest measured noise of a step, in described ones
_LEAST_TURN, _SIGMAS = 0.1, 3.0
"""Least turn of the wheels for a verdict [rad], and the same in multiples of sigma."""
_LEAST_APART, _APART_SIGMAS = 0.05, 5.0  # The same of the difference to be covered
_LEAST_RATIO, _MOST_RATIO = 0.3, 3.0
_SLACK, _SKID_SLACK, _REPEATED_SLACK = 0.1, 0.3, 0.05
"""Relative change of the ratio that is not covered: always, and per difference from one, as slip varies; of a
repeated value."""
_MOST_REPEATED_S = 0.5  # A value repeated for longer measures a turn that changes no better than the wheels
_REPEATED_WEIGHT = 3.0  # Of such a time for a verdict: no moving gyroscope does so


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
    """Compare the turns of a step by wheels and gyroscope; update the check of its row.

    Args:
        tracks: The tracks.
        robot: Index of the robot.
        row: Row at the end of the step; its check is that of the row before.
        turns: By the wheels and by the gyroscope [rad], and described variance of the first one [rad^2].
        duration_s: Duration of the step [s].
        is_moving: Whether the wheels moved.
        repeats: Whether the gyroscope measured one value throughout.

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
