"""Levenberg-Marquardt search for the pose of minimum cost: preparation of readings, workspace and search.

At a kink of the curves the slope is one-sided; damping copes with it. The covariance is averaged over points
on both sides of a near kink.

Solutions: relative poses with covariance, or the reason why there is none.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, norefcount_njit
from swarm_loc_estimator.common.numerics import assign_matrix, wrap
from swarm_loc_estimator.infrared import brightness
from swarm_loc_estimator.infrared.cost import (
    MEASURED,
    MISSING,
    SATURATED,
    Costs,
    CostWorkspace,
    Pair,
    cost_of,
    new_cost_workspace,
    new_costs,
    stabilized,
)
from swarm_loc_estimator.swarm.ir_board import IrModel, IrPlatform, PairGains

DARKEST = -6.0  # Minimum of a valid reading; lower ones count as missing [sigma]


class IrOutcome(IntEnum):
    """Whether a pose was found, or why not."""

    FOUND = 0
    TOO_WEAK = 1  # readings do not exceed noise
    TOO_FEW = 2  # most readings are missing or invalid, such as far below zero
    UNDETERMINED = 3  # range, bearing or heading is not observable, as where all readings are saturated
    MISFIT = 4  # no pose explains most of the readings


class IrSolutions(NamedTuple):
    """Relative poses of k pairs: range [m], bearing [rad], heading [rad]; NaN where there is none."""

    poses: FloatArray  # (k, 3)
    covariances: FloatArray  # (k, 3, 3)
    outcomes: IntArray  # (k,) of `IrOutcome`
    alternatives: FloatArray  # (k, 3) the second-best pose where it is nearly as likely, else NaN
    odds: FloatArray  # (k,) its likelihood relative to the best one's, in [0, 1]
    # (k, 3) share of each variance that is systematic, mostly from unknown gains
    systematic_share: FloatArray
    # (k,) sum of squared residuals per degree of freedom; about 1 where the platform's noise matches the
    # readings
    misfits: FloatArray


@cached_njit
def no_solutions(count: int) -> IrSolutions:
    """Solutions of `count` pairs, all without a pose."""
    poses, alternatives, shares = np.full((3, count, 3), np.nan)
    covariances, misfits = np.full((count, 3, 3), np.nan), np.full(count, np.nan)
    outcomes, odds = np.zeros(count, np.int64), np.zeros(count)
    return IrSolutions(poses, covariances, outcomes, alternatives, odds, shares, misfits)


class ReadingsError(ValueError):
    """Readings that do not belong to the platform."""


def checked(
    platform: IrPlatform, readings: ArrayLike, gains: PairGains | None, saturation: ArrayLike | None
) -> tuple[FloatArray, PairGains, FloatArray]:
    """Validate readings (k, modes, n, n), gains and saturation (k, modes), and fill in defaults.

    Raises ReadingsError if they have another shape.
    """
    values = np.ascontiguousarray(readings, dtype=np.float64)
    wanted = (len(platform.amplitudes), platform.n, platform.n)
    if values.ndim != 4 or values.shape[1:] != wanted:
        must = f"(pairs, {wanted[0]}, {wanted[1]}, {wanted[2]})"
        raise ReadingsError(f"readings have the shape {values.shape} but must have {must}.")
    known = platform.unknown_gains(len(values)) if gains is None else gains
    if known.sensor.shape != (len(values), platform.n):
        must = f"{(len(values), platform.n)}"
        raise ReadingsError(f"gains have the shape {known.sensor.shape} but must have {must}.")
    if saturation is None:
        return values, known, np.full(values.shape[:2], platform.saturation)
    limits = np.ascontiguousarray(saturation, dtype=np.float64)
    if limits.shape != values.shape[:2]:
        raise ReadingsError(f"saturation has the shape {limits.shape} but must have {values.shape[:2]}.")
    return values, known, limits


TABLE_STARTS = 3  # Maximum number of starts from the table


class Workspace(NamedTuple):
    """Memory of one search, reused for all pairs."""

    plain: CostWorkspace  # For a search over only the pose
    full: CostWorkspace  # Includes the gains where they are unknown, else `plain`
    start: brightness.StartWorkspace  # Of the search for starts
    starts: FloatArray  # (S, 4) range, bearing, heading, misfit
    pattern: brightness.Float32Array  # (F,) compressed readings
    present: brightness.Float32Array  # (F,) 1 where there is a reading, else 0
    cut: FloatArray  # (F,) of `Pair`
    stable: FloatArray  # (F,) of `Pair`
    kinds: NDArray[np.int8]  # (F,) of `Pair`
    exact: Costs  # Likelihoods of the readings for the exact model
    soft: Costs  # Likelihoods of the readings for the blurred model
    prior: FloatArray  # (2, 2) of `Pair`
    minima: FloatArray  # (2, 4) range, bearing, heading and cost of the best two distinct minima
    best: FloatArray  # (P,) the best minimum with its gains
    found: FloatArray  # (P,) another minimum
    first: FloatArray  # (4,) the table's best start
    covariance: FloatArray  # (3, 3) pose covariance at a minimum


@cached_njit
def new_workspace(table: brightness.StartTable, modes: int, n: int, known: bool) -> Workspace:
    """Memory for one platform; `known`: whether gains are known."""
    plain = new_cost_workspace(modes, n, False)
    full = plain if known else new_cost_workspace(modes, n, True)
    readings = modes * n * n
    pattern, present = np.empty(readings, np.float32), np.empty(readings, np.float32)
    cut, stable = np.empty(readings), np.empty(readings)
    searches = (
        plain,
        full,
        brightness.new_start_workspace(table),
        np.empty((1 + TABLE_STARTS, 4)),
        pattern,
        present,
    )
    costs = cut, stable, np.empty(readings, np.int8), new_costs(readings), new_costs(readings)
    best, found = np.empty(full.at.size), np.empty(full.at.size)
    minima = np.empty((2, 2)), np.empty((2, 4)), best, found, np.empty(4), np.empty((3, 3))
    return Workspace(*searches, *costs, *minima)


@norefcount_njit
def compress_readings(
    model: IrModel, pair: Pair, pattern: brightness.Float32Array, present: brightness.Float32Array
) -> None:
    """Write the readings divided by the gains and compressed as in the table."""
    n = pair.sensor.size
    for f in range(pair.kinds.size):
        there = pair.kinds[f] != MISSING
        gain = pair.sensor[f // n % n] * pair.emitter[f % n]
        pattern[f] = brightness.compress(model, pair.readings[f] / gain) if there else 0.0
        present[f] = 1.0 if there else 0.0


@norefcount_njit
def classify(model: IrModel, saturation: FloatArray, pair: Pair) -> tuple[int, int, float]:
    """Write `cut`, `stable`, `kinds`; returns the numbers of measured and saturated readings, and brightness.

    Of SATURATED readings, `saturation` (modes,) is the minimum [count]. The brightness is the sum of squared
    readings in sigmas.
    """
    n, measured, saturated, bright = pair.sensor.size, 0, 0, 0.0
    for f in range(pair.kinds.size):
        reading, limit = pair.readings[f], saturation[f // (n * n)]
        dead = math.isnan(pair.sensor[f // n % n] * pair.emitter[f % n])
        pair.kinds[f], pair.cut[f] = MISSING, 0.0
        if dead or not math.isfinite(reading) or reading < DARKEST * model.noise:
            continue
        pair.cut[f] = min(reading, limit)
        sigmas = pair.cut[f] / model.noise
        bright += sigmas * sigmas
        pair.stable[f] = stabilized(model.errors, pair.cut[f])[0]
        if reading >= limit:
            pair.kinds[f] = SATURATED
            saturated += 1
        else:
            pair.kinds[f] = MEASURED
            measured += 1
    return measured, saturated, bright


# The constants of the search are checked by `make bench-droplet`, errors relative to the Cramer-Rao bound.
_ROUNDS = 40  # Maximum number of steps
_FIRST_DAMPING = 1e-3  # Relative increase of the Hessian's diagonal
_MAX_DAMPING = 1e8  # Damping at which the search gives up
_LONGEST_TURN = 0.4  # Maximum change of bearing and heading per step [rad]
_LONGEST_SHARE = 0.4  # Maximum relative change of range per step
_BESIDE = 0.03  # Distance from a known minimum [rad, relative in range] within which a search ends early
_AWAY = 2.5  # Distance from a minimum of the points over which its covariance is averaged [sigma]
_CORNER = 3.0**-0.5
_AROUND = (
    (_CORNER, _CORNER, _CORNER),
    (_CORNER, -_CORNER, -_CORNER),
    (-_CORNER, _CORNER, -_CORNER),
    (-_CORNER, -_CORNER, _CORNER),
)
"""Directions of these points: the corners of a tetrahedron."""


@norefcount_njit
def search(
    model: IrModel, pair: Pair, start: FloatArray, still: float, work: CostWorkspace, known: FloatArray
) -> float:
    """Minimize the cost from a start (range, bearing, heading, ...); returns the cost of the minimum.

    The search ends when the predicted decrease of the cost is below `still`, or near the minimum `known`:
    (4,) range, bearing, heading and cost; infinite cost: none is known.

    The cost is half the weighted sum of squared residuals of readings and priors, minus the log-probabilities
    of saturated readings. The minimum is written to `work.at`.
    """
    at, size, gradients, hessians = work.at, work.at.size, work.gradients, work.hessians
    for p in range(size - 3):
        at[p] = 0.0
    for p in range(3):
        at[size - 3 + p] = start[p]
    best, damping, growth = 0, _FIRST_DAMPING, 2.0
    cost = cost_of(model, pair, at, work, gradients[best], hessians[best])
    for _ in range(_ROUNDS):
        promise = _step(pair, work, gradients[best], hessians[best], damping)
        if promise < still:
            break
        now = cost_of(model, pair, work.trial, work, gradients[1 - best], hessians[1 - best])
        gain = (cost - now) / promise
        if gain > 1e-3:
            best, cost = 1 - best, now
            for p in range(size):
                at[p] = work.trial[p]
            if known[3] < math.inf and now < known[3] + 1.0 and _beside(known, at):
                return float(min(now, known[3]))
            damping, growth = damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 2.0
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > _MAX_DAMPING:
                break
    return cost


@norefcount_njit
def _beside(known: FloatArray, at: FloatArray) -> bool:
    """Whether the estimate `at` is near a known minimum."""
    x = at.size - 3
    turned = max(abs(wrap(at[x + 1] - known[1])), abs(wrap(at[x + 2] - known[2])))
    return bool(max(turned, abs(at[x] / known[0] - 1.0)) < _BESIDE)


@norefcount_njit
def _step(
    pair: Pair, work: CostWorkspace, gradient: FloatArray, hessian: FloatArray, damping: float
) -> float:
    """Write the next trial; returns the decrease of the cost that the quadratic model predicts."""
    step, size = work.step, work.step.size
    distance = work.at[size - 3]
    # the range stays fixed where a step would exceed its limit
    held = (distance <= pair.nearest and gradient[size - 3] > 0.0) or (
        distance >= pair.farthest and gradient[size - 3] < 0.0
    )
    while not _factorize(hessian, damping, work.factor, held):
        damping = max(10.0 * damping, _FIRST_DAMPING)
        if damping > _MAX_DAMPING:
            return 0.0
    for p in range(size):
        step[p] = -gradient[p]
    if held:
        step[size - 3] = 0.0
    _solve(work.factor, step)
    shorter = 1.0
    for p in (size - 2, size - 1):
        shorter = min(shorter, _LONGEST_TURN / max(abs(step[p]), 1e-12))
    shorter = min(shorter, _LONGEST_SHARE * distance / max(abs(step[size - 3]), 1e-12))
    slope, bend = 0.0, 0.0
    for p in range(size):
        step[p] *= shorter
        slope += gradient[p] * step[p]
        bend += 0.5 * hessian[p, p] * step[p] * step[p]
        for q in range(p):
            bend += hessian[p, q] * step[p] * step[q]
        work.trial[p] = work.at[p] + step[p]
    work.trial[size - 3] = min(max(work.trial[size - 3], pair.nearest), pair.farthest)
    return -slope - bend


@norefcount_njit
def _factorize(matrix: FloatArray, damping: float, factor: FloatArray, held: bool) -> bool:
    """Cholesky factorization with a damped diagonal; returns whether the matrix is positive definite.

    Of the matrix (P, P) the lower triangle is used. `held` leaves out the range, its third last row and
    column.
    """
    size = matrix.shape[0]
    for p in range(size):
        for q in range(p + 1):
            value = matrix[p, q] * (1.0 + damping if p == q else 1.0)
            if held and size - 3 in (p, q):
                value = 1.0 if p == q else 0.0
            for k in range(q):
                value -= factor[p, k] * factor[q, k]
            if p == q:
                if not value > 1e-12 * matrix[p, p]:
                    return False
                factor[p, p] = math.sqrt(value)
            else:
                factor[p, q] = value / factor[q, q]
    return True


@norefcount_njit
def _solve(factor: FloatArray, vector: FloatArray) -> None:
    """Solve factor factor^T x = vector in place."""
    size = vector.size
    for p in range(size):
        for k in range(p):
            vector[p] -= factor[p, k] * vector[k]
        vector[p] /= factor[p, p]
    for p in range(size - 1, -1, -1):
        for k in range(p + 1, size):
            vector[p] -= factor[k, p] * vector[k]
        vector[p] /= factor[p, p]


@norefcount_njit
def pose_covariance(
    model: IrModel, pair: Pair, at: FloatArray, work: CostWorkspace, covariance: FloatArray
) -> bool:
    """Write the pose's covariance (3, 3) at a minimum (P,); returns whether the readings determine the pose.

    The covariance is the mean of the inverse information at the minimum and at points around it, since beyond
    a kink of the curves readings may be much less informative. `work.tally` and `work.of_gains` (the share
    of gains or of systematic noise) refer to the minimum.
    """
    hessian = work.hessians[0]
    cost_of(model, pair, at, work, work.gradients[0], hessian)
    squares, freedom, all_squares = work.tally
    if not _invert(hessian, work):
        return False
    _write_share_of_gains(pair, work)
    _add_square(work.root, covariance, 1.0 / (1.0 + len(_AROUND)), 0.0)
    root, x = work.first_root, at.size - 3
    assign_matrix(root, work.root)
    for direction in _AROUND:
        for p in range(at.size):
            work.trial[p] = at[p]
        for p in range(3):
            for q in range(p, 3):
                work.trial[x + p] += _AWAY * root[q, p] * direction[q]
        work.trial[x] = max(work.trial[x], pair.nearest)
        cost_of(model, pair, work.trial, work, work.gradients[0], hessian)
        if not _invert(hessian, work):
            return False
        _add_square(work.root, covariance, 1.0 / (1.0 + len(_AROUND)), 1.0)
    work.tally[0], work.tally[1], work.tally[2] = squares, freedom, all_squares
    return True


@norefcount_njit
def _write_share_of_gains(pair: Pair, work: CostWorkspace) -> None:
    """Write the share of the pose's variances that comes from errors of the gains.

    With the inverse Hessian C and the prior information W of the gains, their errors e cause the pose error
    -C_pose,gains W e. Without gains as unknowns, the share is that of systematic noise.
    """
    x, n, row = work.at.size - 3, pair.sensor.size, work.step
    for p in range(3):
        work.of_gains[p] = 0.0
        for q in range(row.size):
            row[q] = 1.0 if q == x + p else 0.0
        _solve(work.factor, row)
        if x == 0:
            part = 0.0
            for a in range(3):
                for b in range(3):
                    part += row[a] * work.systematic[a, b] * row[b]
            work.of_gains[p] = part / row[p]
            continue
        for side in range(2):
            squares, total = 0.0, 0.0
            for q in range(side * n, side * n + n):
                squares += row[q] * row[q]
                total += row[q]
            part = pair.prior[side, 0] * (squares - pair.prior[side, 1] * total * total)
            work.of_gains[p] += part / row[x + p]


@norefcount_njit
def _invert(information: FloatArray, work: CostWorkspace) -> bool:
    """Write the inverse of the pose block of the information's factor; returns whether it exists."""
    if not _factorize(information, 0.0, work.factor, False):
        return False
    factor, root, x = work.factor, work.root, information.shape[0] - 3
    for p in range(3):
        root[p, p] = 1.0 / factor[x + p, x + p]
    root[1, 0] = -factor[x + 1, x] * root[0, 0] * root[1, 1]
    root[2, 1] = -factor[x + 2, x + 1] * root[1, 1] * root[2, 2]
    root[2, 0] = -(factor[x + 2, x] * root[0, 0] + factor[x + 2, x + 1] * root[1, 0]) * root[2, 2]
    return True


@norefcount_njit
def _add_square(root: FloatArray, matrix: FloatArray, weight: float, keep: float) -> None:
    """Set matrix = keep * matrix + weight * root^T root, all (3, 3)."""
    for p in range(3):
        for q in range(3):
            value = 0.0
            for k in range(max(p, q), 3):
                value += root[k, p] * root[k, q]
            matrix[p, q] = (keep * matrix[p, q] if keep else 0.0) + weight * value
