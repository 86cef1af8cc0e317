"""Calibrate the motion of a type of robot: scale factors by speed and turn rate, delay and lag.

An odometry that is a command, or whose wheels slip, reports too much motion, and too early. The true shares
of it are linear in the true motion over time windows, so a table of them is a linear regression; delay and
lag are searched. Offsets are those of the turn rate, of the course and of the axle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.offline.calibration.recording import DENSE_GAP_NS
from swarm_loc_estimator.offline.calibration.sightings import ridge, spread
from swarm_loc_estimator.swarm.error_models import MotionResponse, OdometryModel

LONGEST_DELAY_S = 0.5
LONGEST_LAG_S = 1.0

WINDOW_S = 5.0  # Length of the windows in which motion is compared

# The fit of the table and of lateness is checked by test_calibration.py and make bench-mrclam.
_SHORT_WINDOW_S = 0.5  # Length of the windows in which turns show delay and lag
_NODES = (0, 2, 5)  # Numbers of points above 0 that are tried for the table; 0: one scale factor
_BLOCKS = 5  # Blocks of time of the cross-validation
_CLEAR_SIGMAS = 2.0  # A grid is worse than the best one from this many standard errors on
_NEAR_ZERO = 0.05  # Share of the greatest value below which a point would duplicate 0
_CLEARLY = 0.85  # Delay and lag are used if they reduce the errors of short windows to this share
_MOVING = 1e-3  # Speeds below which a robot counts as stationary [m/s, rad/s]
_SMOOTHNESS, _TO_ONE = 0.02, 0.001
"""Weights of the priors that neighbouring scale factors are equal, and that they are 1."""
_FIRST_LATENESS = (0.05, 0.1)
GRID_S = 0.02
_BIAS_SIGMA, _OVERLAP = 0.01, 8  # Prior of a turn bias [rad/s]; windows that share a part of their time
_SETTLING_S = 5.0


@dataclass(frozen=True)
class Drive:
    """One robot's reported motion between odometry messages, and its true one on a regular grid of time."""

    stamp_ns: IntArray  # (n + 1,) of the messages
    speed: FloatArray  # (n,) reported [m/s]
    turn_rate: FloatArray  # (n,) reported [rad/s]
    turn_bias: FloatArray  # (n,) true minus scaled turn rate [rad/s], the same while the robot moves
    duration_s: FloatArray  # (n,)
    time_s: FloatArray  # (g,) since the first message
    path: FloatArray  # (g,) true [m], forwards
    turn: FloatArray  # (g,) true heading, unwrapped [rad]
    known: BoolArray  # (g,) whether the ground truth is dense there


@dataclass(frozen=True)
class Lateness:
    """Delay of the true motion after the reported one."""

    delay_s: float  # Dead time
    lag_s: float  # Time constant of a first-order lag


def drive_of(track: Trajectory, model: OdometryModel, truth: Trajectory) -> Drive:
    """The motion of a robot by its odometry, without what the estimator would reject, and by its truth."""
    duration_s = np.maximum(np.diff(track.stamp_ns) * 1e-9, 1e-6)
    apart = np.linalg.norm(np.diff(track.pose[:, :2], axis=0), axis=1)
    plausible = (duration_s <= model.timeout_s) & (
        apart <= model.max_speed * duration_s + 0.5 * model.wheel_separation
    )
    zero = np.where(plausible, 1.0 / duration_s, 0.0)
    speed, turn_rate = (zero * one for one in _moved(track.pose))
    time_s = np.arange(0.0, (track.stamp_ns[-1] - track.stamp_ns[0]) * 1e-9, GRID_S)
    at_ns = track.stamp_ns[0] + np.rint(time_s * 1e9).astype(np.int64)
    pose, known = interpolate(truth, at_ns, DENSE_GAP_NS)
    pose[~known] = 0.0
    path, turn = (np.concatenate([[0.0], np.cumsum(one)]) for one in _moved(pose))
    return Drive(
        track.stamp_ns, speed, turn_rate, np.zeros(duration_s.size), duration_s, time_s, path, turn, known
    )


def _moved(pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ways forwards (n - 1,) and turns (n - 1,) between poses (n, 3)."""
    turn = se2.wrap_angle(np.diff(pose[:, 2]))
    middle = pose[:-1, 2] + 0.5 * turn
    dx, dy = np.diff(pose[:, :2], axis=0).T
    return np.cos(middle) * dx + np.sin(middle) * dy, turn


def biased(drive: Drive, late: Lateness, response: MotionResponse) -> Drive:
    """The drive with the turn bias that its turns show with a table of scale factors, by regression."""
    moves = np.where((np.abs(drive.speed) > _MOVING) | (np.abs(drive.turn_rate) > _MOVING), 1.0, 0.0)
    first, last = windows(drive, WINDOW_S)
    integral = gathered(moves[:, None], drive, late)
    moving_s, missed = integral[last] - integral[first], explained([drive], late, response)[:, 1]
    penalty = np.array([[_OVERLAP * (spread(missed) / _BIAS_SIGMA) ** 2 / max(1, missed.size)]])
    change = ridge(moving_s, missed, penalty, np.zeros(1))[0]
    return replace(drive, turn_bias=drive.turn_bias + change * moves)


def windows(drive: Drive, length_s: float) -> tuple[IntArray, IntArray]:
    """First and last grid index of windows with dense ground truth."""
    length = max(1, round(length_s / GRID_S))
    settling = round(_SETTLING_S / GRID_S)
    first = np.arange(settling, drive.time_s.size - length, max(length // 8, 5))
    gaps = np.concatenate([[0], np.cumsum(~drive.known)])
    first = first[gaps[first + length + 1] == gaps[first]]
    return first, first + length


def gathered(values: FloatArray, drive: Drive, late: Lateness) -> FloatArray:
    """Integral (g, p) over the grid of rates (n, p) that are constant during steps, with delay and lag."""
    ends = (drive.stamp_ns - drive.stamp_ns[0]) * 1e-9 + late.delay_s
    total = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(values * drive.duration_s[:, None], axis=0)]
    )
    share = np.interp(drive.time_s, ends, np.arange(ends.size))
    row = np.minimum(share.astype(np.int64), ends.size - 2)
    on_grid: FloatArray = total[row] + (share - row)[:, None] * (total[row + 1] - total[row])
    if late.lag_s <= 0.0:
        return on_grid
    remaining = np.exp(-GRID_S / late.lag_s)
    lagged: FloatArray = lfilter([1.0 - remaining], [1.0, -remaining], on_grid, axis=0)
    return lagged


def fit_lateness(drives: Sequence[Drive], least_share: float = _CLEARLY) -> Lateness:
    """Delay and lag that explain turns in short windows best, with scale factors for driving and in place.

    They are zero unless they reduce the errors to `least_share`.
    """

    def cost(late: FloatArray) -> float:
        delay_s, lag_s = late
        if not (-LONGEST_DELAY_S <= delay_s <= LONGEST_DELAY_S and 0.0 <= lag_s <= LONGEST_LAG_S):
            return float("inf")
        total = 0.0
        for drive in drives:
            moving = np.abs(drive.speed) > _MOVING
            values = drive.turn_rate[:, None] * np.column_stack([moving, ~moving])
            first, last = windows(drive, _SHORT_WINDOW_S)
            integral = gathered(values, drive, Lateness(delay_s, lag_s))
            basis, wanted = integral[last] - integral[first], drive.turn[last] - drive.turn[first]
            share = ridge(basis, wanted, 1e-9 * np.eye(2), np.ones(2), rounds=2)
            total += float(np.sum(np.abs(wanted - basis @ share)))  # not squared: slip is no delay
        return total

    simplex = np.array(_FIRST_LATENESS) + np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.15]])
    found = minimize(
        cost,
        np.array(_FIRST_LATENESS),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 3e-3, "fatol": 0.0, "maxfev": 60},
    )
    if found.fun > least_share * cost(np.zeros(2)):
        return Lateness(0.0, 0.0)
    return Lateness(float(found.x[0]), float(found.x[1]) if found.x[1] > 2e-3 else 0.0)


def nodes_of(values: FloatArray, duration_s: FloatArray, count: int) -> FloatArray:
    """Grid points for reported values (n,): 0, and `count` points evenly spaced over the frequent ones.

    Values are absolute speeds or turn rates, which held for durations (n,). There are fewer points where they
    hardly vary.
    """
    used = values > _MOVING
    if not used.any():
        return np.zeros(1)
    order = np.argsort(values[used])
    held = np.cumsum(duration_s[used][order])
    low, high = np.interp([0.01, 0.99], held / held[-1], values[used][order])
    if low < _NEAR_ZERO * high:  # a point this near to 0 would duplicate it
        low = high / count
    spaced = np.linspace(low, high, count) if high > 1.2 * low else np.array([high])
    return np.concatenate([[0.0], np.round(spaced, 4)])


def fit_response(drives: Sequence[Drive], late: Lateness, *, table: bool) -> MotionResponse:
    """True per reported speed and turn rate, for robots of one type with a known delay and lag.

    Several grids are compared by cross-validation over blocks of time; the smallest is used that is not
    clearly worse than the best. Without `table` there is one scale factor of each.
    """
    grids = [_grid(drives, count) for count in (_NODES if table else _NODES[:1])]
    held_out = [_held_out_error(drives, late, *grid) for grid in grids]
    best = held_out[int(np.argmin([np.mean(errors) for errors in held_out]))]
    smallest = next(
        grid
        for grid, errors in zip(grids, held_out, strict=True)
        if np.mean(errors - best) <= _CLEAR_SIGMAS * np.std(errors - best) / np.sqrt(_BLOCKS - 1)
    )
    tables = [
        _solved(_regression(drives, late, *smallest, column), *smallest).round(4) for column in range(2)
    ]
    return MotionResponse(
        *(tuple(axis.tolist()) for axis in smallest),
        *(tuple(tuple(row) for row in table.tolist()) for table in tables),
    )


def _grid(drives: Sequence[Drive], count: int) -> tuple[FloatArray, FloatArray]:
    """Speeds and turn rates of a grid with `count` points above 0; 0: one scale factor."""
    if not count:
        return np.zeros(1), np.zeros(1)
    speed, turn_rate, duration_s = (
        np.concatenate([np.abs(getattr(drive, name)) for drive in drives])
        for name in ("speed", "turn_rate", "duration_s")
    )
    driving = speed > _MOVING
    return nodes_of(speed, duration_s, count), nodes_of(turn_rate[driving], duration_s[driving], count)


def _held_out_error(
    drives: Sequence[Drive], late: Lateness, speeds: FloatArray, turn_rates: FloatArray
) -> FloatArray:
    """Mean absolute errors (blocks,) of path and turn in held-out blocks, relative to the motion."""
    total = np.zeros(_BLOCKS)
    for column in range(2):
        rows = _regression(drives, late, speeds, turn_rates, column)
        for block in range(_BLOCKS):
            held_out = (rows.block == block) & (rows.last_block == block)
            fitted = (rows.block != block) & (rows.last_block != block)
            shares = _solved(select(rows, fitted), speeds, turn_rates).ravel()
            error = rows.wanted[held_out] - rows.basis[held_out] @ shares
            total[block] += np.mean(np.abs(error)) / np.mean(np.abs(rows.wanted))
    return total


def hats(values: FloatArray, nodes: FloatArray) -> FloatArray:
    """(n, k) linear weights of the nodes at values (n,), constant beyond the border."""
    return np.column_stack([np.interp(values, nodes, row) for row in np.eye(nodes.size)])


class _Regression(NamedTuple):
    """Linear regression of the true motion in windows by scale factors."""

    basis: FloatArray  # (m, V W) reported motion by grid point
    wanted: FloatArray  # (m,) true path [m] or turn [rad]
    block: IntArray  # (m,) block of time in which a window begins
    last_block: IntArray  # (m,) block in which it ends


def _regression(
    drives: Sequence[Drive], late: Lateness, speeds: FloatArray, turn_rates: FloatArray, column: int
) -> _Regression:
    """The regression of all windows, of the path (column 0) or the turn (column 1)."""
    bases, targets, borders = [], [], []
    for drive in drives:
        weight = (
            hats(np.abs(drive.speed), speeds)[:, :, None] * hats(np.abs(drive.turn_rate), turn_rates)[:, None]
        )
        reported = drive.turn_rate if column else drive.speed
        values = weight.reshape(reported.size, -1) * reported[:, None]
        integral = gathered(values, drive, late)
        true = drive.path
        if column:
            true = drive.turn - gathered(drive.turn_bias[:, None], drive, late)[:, 0]
        first, last = windows(drive, WINDOW_S)
        bases.append(integral[last] - integral[first])
        targets.append(true[last] - true[first])
        # each block holds windows, whichever part of the time has ground truth
        cuts = np.quantile(first, np.arange(1, _BLOCKS) / _BLOCKS)
        borders.append(np.searchsorted(cuts, np.column_stack([first, last]), side="right"))
    return _Regression(np.concatenate(bases), np.concatenate(targets), *np.concatenate(borders).T)


def _solved(rows: _Regression, speeds: FloatArray, turn_rates: FloatArray) -> FloatArray:
    """Scale factors (V, W)."""
    typical = np.mean(np.sum(rows.basis, axis=1) ** 2)  # makes the prior independent of units
    penalty = _prior(speeds.size, turn_rates.size) * typical
    shares = ridge(rows.basis, rows.wanted, penalty, np.ones(rows.basis.shape[1]))
    return np.asarray(np.clip(shares, 0.0, 10.0).reshape(speeds.size, turn_rates.size))


def _prior(speeds: int, turn_rates: int) -> FloatArray:
    """Information (V W, V W) of the priors on scale factors."""
    size = speeds * turn_rates
    index = np.arange(size).reshape(speeds, turn_rates)
    before = np.concatenate([index[:-1].ravel(), index[:, :-1].ravel()])
    after = np.concatenate([index[1:].ravel(), index[:, 1:].ravel()])
    difference = np.eye(size)[before] - np.eye(size)[after]
    information: FloatArray = (_SMOOTHNESS * difference.T @ difference + _TO_ONE * np.eye(size)) / size
    return information


def explained(drives: Sequence[Drive], late: Lateness, response: MotionResponse | None) -> FloatArray:
    """Errors (m, 2) of path [m] and turn [rad] of 5 s windows."""
    errors = []
    for drive in drives:
        reported = np.column_stack([drive.speed, drive.turn_rate])
        if response is not None:
            speed = hats(np.abs(drive.speed), np.array(response.speeds))
            turn_rate = hats(np.abs(drive.turn_rate), np.array(response.turn_rates))
            for column, table in enumerate((response.speed_share, response.turn_share)):
                reported[:, column] *= np.einsum("nv,vw,nw->n", speed, np.array(table), turn_rate)
            reported[:, 1] += drive.turn_bias
        integral = gathered(reported, drive, late)
        first, last = windows(drive, WINDOW_S)
        true = np.column_stack([drive.path, drive.turn])
        errors.append((true[last] - true[first]) - (integral[last] - integral[first]))
    return np.concatenate(errors)
