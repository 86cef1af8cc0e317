"""The fit of how a type of robot responds to the motion it reports: shares, delay and lag.

Speeds and turn rates of an odometry that is a command, or slips, are true in part only, and late. The shares
are linear in the true motion, so a table of them is a linear regression; delay and lag are searched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from swarm_loc_estimator.calibration.robust import ridge, spread
from swarm_loc_estimator.calibration.windows import Steps, TrueMotion, gathered, windows
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.swarm import MotionResponse

LONGEST_DELAY_S = 0.5
LONGEST_LAG_S = 1.0

_WINDOW_S = 5.0
_SHORT_WINDOW_S = 0.5
_NODES = 5
_NEAR_ZERO = 0.05
_CLEARLY = 0.85
"""Lateness is believed where it lessens the errors of short windows to this share."""
_MOVING = 1e-3
"""Slower than this is standing [m/s, rad/s]."""
_SMOOTHNESS, _TO_ONE = 0.02, 0.001
"""Weight of the prior that neighbouring shares are alike, and that shares are 1."""
_FIRST_LATENESS = (0.05, 0.1)


@dataclass(frozen=True)
class Drive:
    """One robot's reported and true motion."""

    steps: Steps
    motion: TrueMotion


@dataclass(frozen=True)
class Lateness:
    """When a reported motion happens.

    Attributes:
        delay_s: After its stamp.
        lag_s: Time constant with which it is followed.
    """

    delay_s: float
    lag_s: float


def fit_lateness(drives: Sequence[Drive]) -> Lateness:
    """Delay and lag that explain the turns of short windows best, with one share driving and one in place."""

    def cost(late: FloatArray) -> float:
        delay_s, lag_s = late
        if not (-LONGEST_DELAY_S <= delay_s <= LONGEST_DELAY_S and 0.0 <= lag_s <= LONGEST_LAG_S):
            return float("inf")
        total = 0.0
        for drive in drives:
            moving = np.abs(drive.steps.speed) > _MOVING
            values = drive.steps.turn_rate[:, None] * np.column_stack([moving, ~moving])
            first, last = windows(drive.motion, _SHORT_WINDOW_S)
            integral = gathered(values, drive.steps, drive.motion, delay_s, lag_s)
            basis, wanted = (
                integral[last] - integral[first],
                drive.motion.turn[last] - drive.motion.turn[first],
            )
            share = ridge(basis, wanted, 1e-9 * np.eye(2), np.ones(2), rounds=2)
            total += float(np.sum(np.abs(wanted - basis @ share)))  # not squared: slips are no lateness
        return total

    simplex = np.array(_FIRST_LATENESS) + np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.15]])
    found = minimize(
        cost,
        np.array(_FIRST_LATENESS),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 3e-3, "fatol": 0.0, "maxfev": 60},
    )
    if found.fun > _CLEARLY * cost(np.zeros(2)):
        return Lateness(0.0, 0.0)
    return Lateness(float(found.x[0]), float(found.x[1]) if found.x[1] > 2e-3 else 0.0)


def nodes_of(values: FloatArray, duration_s: FloatArray, count: int = _NODES) -> FloatArray:
    """Grid points for reported values (n,): 0, and points evenly spaced over what was driven for long.

    Args:
        values: Absolute speeds or turn rates.
        duration_s: (n,) how long each held.
        count: Points above 0; fewer where the values hardly vary.
    """
    used = values > _MOVING
    if not used.any():
        return np.zeros(1)
    order = np.argsort(values[used])
    held = np.cumsum(duration_s[used][order])
    low, high = np.interp([0.01, 0.99], held / held[-1], values[used][order])
    if low < _NEAR_ZERO * high:  # a point so near to 0 would say what 0 says
        low = high / count
    spaced = np.linspace(low, high, count) if high > 1.2 * low else np.array([high])
    return np.concatenate([[0.0], np.round(spaced, 4)])


def fit_response(drives: Sequence[Drive], late: Lateness, *, table: bool) -> MotionResponse:
    """The shares of speed and turn rate that are true, for robots of one type; one of each unless `table`."""
    speed = np.concatenate([np.abs(drive.steps.speed) for drive in drives])
    turn_rate = np.concatenate([np.abs(drive.steps.turn_rate) for drive in drives])
    duration_s = np.concatenate([drive.steps.duration_s for drive in drives])
    speeds = nodes_of(speed, duration_s)
    turn_rates = nodes_of(turn_rate[speed > _MOVING], duration_s[speed > _MOVING])
    if not table:
        speeds = turn_rates = np.zeros(1)
    tables = [_shares(drives, late, speeds, turn_rates, column) for column in range(2)]
    return MotionResponse(
        tuple(speeds.tolist()),
        tuple(turn_rates.tolist()),
        *(tuple(tuple(row) for row in table.tolist()) for table in tables),
    )


def hats(values: FloatArray, nodes: FloatArray) -> FloatArray:
    """(n, k) linear weights of the nodes at values (n,), constant beyond the border."""
    return np.column_stack([np.interp(values, nodes, row) for row in np.eye(nodes.size)])


def _shares(
    drives: Sequence[Drive], late: Lateness, speeds: FloatArray, turn_rates: FloatArray, column: int
) -> FloatArray:
    """Shares (V, W) of the speed (column 0) or the turn rate (column 1)."""
    bases, targets = [], []
    for drive in drives:
        steps, motion = drive.steps, drive.motion
        weight = (
            hats(np.abs(steps.speed), speeds)[:, :, None] * hats(np.abs(steps.turn_rate), turn_rates)[:, None]
        )
        reported = steps.turn_rate if column else steps.speed
        values = weight.reshape(reported.size, -1) * reported[:, None]
        integral = gathered(values, steps, motion, late.delay_s, late.lag_s)
        true = motion.turn if column else motion.path
        first, last = windows(motion, _WINDOW_S)
        bases.append(integral[last] - integral[first])
        targets.append(true[last] - true[first])
    basis, wanted = np.concatenate(bases), np.concatenate(targets)
    typical = np.mean(np.sum(basis, axis=1) ** 2)  # of a window: the prior does not depend on units
    penalty = _prior(speeds.size, turn_rates.size) * typical
    shares = ridge(basis, wanted, penalty, np.ones(basis.shape[1]))
    return np.asarray(np.clip(shares, 0.0, 10.0).round(4).reshape(speeds.size, turn_rates.size), dtype=float)


def _prior(speeds: int, turn_rates: int) -> FloatArray:
    """Information (V W, V W) that neighbours in the grid are alike and all shares near 1."""
    size = speeds * turn_rates
    index = np.arange(size).reshape(speeds, turn_rates)
    pairs = np.concatenate(
        [
            np.column_stack([index[:-1].ravel(), index[1:].ravel()]),
            np.column_stack([index[:, :-1].ravel(), index[:, 1:].ravel()]),
        ]
    )
    difference = np.zeros((len(pairs), size))
    difference[np.arange(len(pairs)), pairs[:, 0]] = 1.0
    difference[np.arange(len(pairs)), pairs[:, 1]] = -1.0
    information: FloatArray = (_SMOOTHNESS * difference.T @ difference + _TO_ONE * np.eye(size)) / size
    return information


def explained(drives: Sequence[Drive], late: Lateness, response: MotionResponse | None) -> FloatArray:
    """Errors (m, 2) of path [m] and turn [rad] of 5 s windows."""
    errors = []
    for drive in drives:
        steps, motion = drive.steps, drive.motion
        reported = np.column_stack([steps.speed, steps.turn_rate])
        if response is not None:
            speed = hats(np.abs(steps.speed), np.array(response.speeds))
            turn_rate = hats(np.abs(steps.turn_rate), np.array(response.turn_rates))
            for column, table in enumerate((response.speed_share, response.turn_share)):
                reported[:, column] *= np.einsum("nv,vw,nw->n", speed, np.array(table), turn_rate)
        integral = gathered(reported, steps, motion, late.delay_s, late.lag_s)
        first, last = windows(motion, _WINDOW_S)
        true = np.column_stack([motion.path, motion.turn])
        errors.append((true[last] - true[first]) - (integral[last] - integral[first]))
    return np.concatenate(errors)


def spread_of(errors: FloatArray) -> tuple[float, float]:
    """Standard deviation of the good part of path [m] and turn [rad]."""
    return spread(errors[:, 0]), spread(errors[:, 1])
