"""Interpolation and extrapolation of odometry tracks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.small_matrix import assign, assign_matrix
from swarm_loc_estimator.odometry.process_noise import add_dropout_noise
from swarm_loc_estimator.odometry.track_arrays import TrackArrays


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
    return OdometrySample(
        np.zeros((count, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3, 3)),
        np.zeros(count),
    )


@inlined_njit
def look_up(tracks: TrackArrays, robot: int, stamp_ns: int, out: OdometrySample, k: int) -> None:
    """Look a robot's track up at an instant, and write row k of a sample.

    Within a step the twist is constant. Past the newest row the last twist is extrapolated with growing
    covariance; after `timeout_s` the motion since that row is unknown. Before the first row the robot is
    stationary. A robot without odometry is stationary or a random walk in its body frame.
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
    row, fraction = _find_step(tracks, robot, stamp_ns)
    if fraction < 0.0:
        assign(out.pose[k], tracks.pose[robot, row])
        assign(out.raw[k], tracks.raw[robot, row])
        assign_matrix(out.covariance[k], tracks.covariance[robot, row])
        assign_matrix(out.jacobian[k], tracks.jacobian[robot, row])
    else:
        _along_step(tracks, robot, row, fraction, out, k)
        if fraction < 1.0:
            return
        row += 1
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
    row, fraction = _find_step(tracks, robot, stamp_ns)
    if fraction < 0.0:
        assign(out, tracks.pose[robot, row])
    else:
        _interpolate(tracks.pose[robot, row], tracks.pose[robot, row + 1], fraction, out)


@inlined_njit
def _find_step(tracks: TrackArrays, robot: int, stamp_ns: int) -> tuple[int, float]:
    """Row before an instant on a track that is not empty, and the fraction of the step to the next row.

    A fraction of 1 or more extrapolates past the newest row; below 0, the robot is stationary at the row.
    """
    count = tracks.filled[robot]
    stamps, timeout_ns = tracks.stamp_ns[robot, :count], tracks.model[robot].timeout_s * 1e9
    row = max(0, np.searchsorted(stamps, stamp_ns, side="right") - 1)
    if row + 1 < count and stamps[row + 1] - stamps[row] <= timeout_ns:
        return row, max(0, stamp_ns - stamps[row]) / (stamps[row + 1] - stamps[row])
    silence_ns = max(0, stamp_ns - stamps[row])
    if row > 0 and silence_ns <= timeout_ns and stamps[row] - stamps[row - 1] <= timeout_ns:
        return row - 1, 1.0 + silence_ns / (stamps[row] - stamps[row - 1])
    return row, -1.0


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


@inlined_njit
def _along_step(
    tracks: TrackArrays, robot: int, row: int, fraction: float, out: OdometrySample, k: int
) -> None:
    """Write row k of `look_up` at a fraction of the step from a row to the next; may exceed 1."""
    _interpolate(tracks.pose[robot, row], tracks.pose[robot, row + 1], fraction, out.pose[k])
    _interpolate(tracks.raw[robot, row], tracks.raw[robot, row + 1], fraction, out.raw[k])
    for i in range(3):
        for j in range(3):
            for table, target in ((tracks.covariance, out.covariance), (tracks.jacobian, out.jacobian)):
                before, after = table[robot, row, i, j], table[robot, row + 1, i, j]
                target[k, i, j] = before + fraction * (after - before)


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
