"""Reported and true motion over time windows: the data of the motion regression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.offline.calibration.sightings import DENSE_GAP_NS
from swarm_loc_estimator.swarm.swarm import OdometryModel

GRID_S = 0.02
_SETTLING_S = 5.0


@dataclass(frozen=True)
class Steps:
    """Odometry as speeds: from one message to the next.

    Attributes:
        stamp_ns: (n + 1,) of the messages.
        speed: (n,) reported [m/s].
        turn_rate: (n,) reported [rad/s].
        duration_s: (n,).
    """

    stamp_ns: IntArray
    speed: FloatArray
    turn_rate: FloatArray
    duration_s: FloatArray


@dataclass(frozen=True)
class TrueMotion:
    """A robot's true motion, gathered on an even grid.

    Attributes:
        time_s: (g,) since the first odometry.
        path: (g,) [m], forwards.
        lateral: (g,) [m], to the left.
        turn: (g,) heading, unwrapped [rad].
        known: (g,) whether the ground truth is dense there.
    """

    time_s: FloatArray
    path: FloatArray
    lateral: FloatArray
    turn: FloatArray
    known: npt.NDArray[np.bool_]


def steps_of(track: Trajectory, model: OdometryModel) -> Steps:
    """The reported motion between messages; steps that the estimator would not believe stand still."""
    duration_s = np.maximum(np.diff(track.stamp_ns) * 1e-9, 1e-6)
    turn = se2.wrap_angle(np.diff(track.pose[:, 2]))
    middle = track.pose[:-1, 2] + 0.5 * turn
    dx, dy = np.diff(track.pose[:, :2], axis=0).T
    distance = np.cos(middle) * dx + np.sin(middle) * dy
    believed = (duration_s <= model.timeout_s) & (
        np.hypot(dx, dy) <= model.max_speed * duration_s + 0.5 * model.wheel_separation
    )
    zero = np.where(believed, 1.0 / duration_s, 0.0)
    return Steps(track.stamp_ns, distance * zero, turn * zero, duration_s)


def true_motion(truth: Trajectory, begin_ns: int, end_ns: int) -> TrueMotion:
    """The true motion between two stamps."""
    time_s = np.arange(0.0, (end_ns - begin_ns) * 1e-9, GRID_S)
    pose, known = interpolate(truth, begin_ns + np.rint(time_s * 1e9).astype(np.int64), DENSE_GAP_NS)
    pose[~known] = 0.0
    turn = se2.wrap_angle(np.diff(pose[:, 2]))
    middle = pose[:-1, 2] + 0.5 * turn
    dx, dy = np.diff(pose[:, :2], axis=0).T
    path, lateral = np.cos(middle) * dx + np.sin(middle) * dy, -np.sin(middle) * dx + np.cos(middle) * dy
    path, lateral, turn = (np.concatenate([[0.0], np.cumsum(column)]) for column in (path, lateral, turn))
    return TrueMotion(time_s, path, lateral, turn, known)


def windows(motion: TrueMotion, length_s: float) -> tuple[IntArray, IntArray]:
    """First and last grid index of windows within which the ground truth is dense throughout."""
    length = max(1, round(length_s / GRID_S))
    settling = round(_SETTLING_S / GRID_S)
    first = np.arange(settling, motion.time_s.size - length, max(length // 8, 5))
    gaps = np.concatenate([[0], np.cumsum(~motion.known)])
    first = first[gaps[first + length + 1] == gaps[first]]
    return first, first + length


def gathered(
    values: FloatArray, steps: Steps, motion: TrueMotion, delay_s: float, lag_s: float
) -> FloatArray:
    """Integral (g, p) over the grid of values (n, p) per second held during the steps, late and lagged."""
    ends = (steps.stamp_ns - steps.stamp_ns[0]) * 1e-9 + delay_s
    total = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(values * steps.duration_s[:, None], axis=0)]
    )
    share = np.interp(motion.time_s, ends, np.arange(ends.size))
    row = np.minimum(share.astype(np.int64), ends.size - 2)
    on_grid: FloatArray = total[row] + (share - row)[:, None] * (total[row + 1] - total[row])
    if lag_s <= 0.0:
        return on_grid
    remaining = np.exp(-GRID_S / lag_s)
    lagged: FloatArray = lfilter([1.0 - remaining], [1.0, -remaining], on_grid, axis=0)
    return lagged
