"""Turn rates of gyroscopes, integrated to the turns of odometry steps."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.odometry.track_arrays import LATEST_NS, TrackArrays

_STILL_SIGMAS = 4.0  # Turns within so many sigma of noise and bias are none while the wheels stand


@cached_njit
def insert_rates(
    tracks: TrackArrays, robots: IntArray, stamps_ns: IntArray, rates: FloatArray, from_ns: IntArray
) -> int:
    """Insert turn rates (k,) in any order, for which there is space, and integrate them.

    Args:
        tracks: The tracks; their rows are not integrated again, see `integrate_again`.
        robots: (k,) robot of each.
        stamps_ns: (k,) instants, calibrated for delay.
        rates: (k,) finite turn rates about the vertical as measured [rad/s].
        from_ns: (N,) written: instant after which turns of odometry steps have changed; LATEST_NS: never.

    Returns:
        Number of rates at the instant of another one, which are dropped.
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
            if _has_rows(tracks, robot, changed_ns, newest_ns):
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
def _has_rows(tracks: TrackArrays, robot: int, after_ns: int, until_ns: int) -> bool:
    """Whether a robot has odometry after an instant and not after another one."""
    stamps = tracks.stamp_ns[robot, : tracks.filled[robot]]
    row = np.searchsorted(stamps, after_ns, side="right")
    return bool(row < stamps.size and stamps[row] <= until_ns)


@inlined_njit
def turn_by_gyro(tracks: TrackArrays, robot: int, begin_ns: int, end_ns: int, is_moving: bool) -> float:
    """Calibrated turn of a robot between two instants [rad]; NaN if it was not measured throughout.

    While the wheels stand, what noise and bias explain is no turn.
    """
    stamps, imu = tracks.gyro_ns[robot, : tracks.gyro_filled[robot]], tracks.imu[robot]
    before = int(np.searchsorted(stamps, begin_ns, side="right")) - 1
    after = int(np.searchsorted(stamps, end_ns))
    if before < 0 or after == stamps.size:
        return math.nan
    if tracks.gyro_piece[robot, before] != tracks.gyro_piece[robot, after]:
        return math.nan
    angle = _angle_at(tracks, robot, after, end_ns) - _angle_at(tracks, robot, before, begin_ns)
    duration_s = (end_ns - begin_ns) * 1e-9
    turn: float = imu.turn_scale * angle + imu.turn_bias * duration_s
    noise, bias = imu.turn_noise_density * math.sqrt(duration_s), imu.turn_bias_sigma * duration_s
    if not is_moving and abs(turn) <= _STILL_SIGMAS * math.hypot(noise, bias):
        return 0.0
    return turn


@inlined_njit
def _angle_at(tracks: TrackArrays, robot: int, k: int, stamp_ns: int) -> float:
    """Integral of the turn rate until an instant beside measurement k; the rate is linear in between."""
    stamps, rates = tracks.gyro_ns[robot], tracks.gyro_rate[robot]
    angle: float = tracks.gyro_angle[robot, k]
    if stamps[k] == stamp_ns:
        return angle
    other = k + 1 if stamp_ns > stamps[k] else k - 1
    share = (stamp_ns - stamps[k]) / (stamps[other] - stamps[k])
    mean = rates[k] + 0.5 * share * (rates[other] - rates[k])
    angle += mean * (stamp_ns - stamps[k]) * 1e-9
    return angle
