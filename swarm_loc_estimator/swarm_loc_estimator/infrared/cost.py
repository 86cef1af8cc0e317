"""The negative log likelihood of readings, with gradient and Hessian by pose and gains.

The unknowns are the pose and, if gains are unknown, the log-gain of every sensor and emitter, each with a
Gaussian prior. Most readings have a Gaussian likelihood and are summed in vectorized loops. The others
(saturated readings and possible outliers) are evaluated one by one by `reading_cost`.

The negative log likelihood of one reading, and its derivatives by the expected reading.

A measured reading is the expected one plus noise that is Gaussian after a variance-stabilizing transform. A
saturated reading is a lower bound, with the probability of a normal tail. A dark reading where light is
expected may be blocked by another robot; on some boards readings may also be too bright.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, norefcount_njit, reassociated_njit
from swarm_loc_estimator.infrared.brightness import WAY_ROWS, predict_brightness
from swarm_loc_estimator.swarm.ir_board import IrModel, ReadingErrors

MISSING, MEASURED, SATURATED = 0, 1, 2

_TAIL = -6.0  # Threshold below which the normal tail uses its asymptotic series [sigma]
DARK = 4.0  # Maximum of blocked readings [sigma]
BELIEVED = 2.0  # Maximum cost of an inlier
_STRAY = 5.0  # Mean brightness of light that is not modelled [sigma]
_STRAY_DENSITY = math.log(_STRAY / math.sqrt(2.0 * math.pi))
_SURELY = 6.0  # Minimum difference in cost at which the outlier hypothesis is ignored


@cached_njit
def stabilized(errors: ReadingErrors, value: float) -> tuple[float, float]:
    """The variance-stabilizing transform of a brightness [sigma], and its slope [1/count].

    For the variance noise^2 + (relative value)^2 it is asinh(relative value / noise) / relative.
    """
    per_noise = 1.0 / errors.noise
    if errors.relative == 0.0:
        return value * per_noise, per_noise
    ratio = errors.relative * value * per_noise
    root = math.sqrt(1.0 + ratio * ratio)
    size = math.log(abs(ratio) + root) / errors.relative
    return math.copysign(size, value), per_noise / root


@cached_njit
def spread(errors: ReadingErrors, value: float) -> float:
    """The standard deviation of a brightness [count]."""
    if errors.relative == 0.0:
        return errors.noise
    return math.sqrt(errors.noise * errors.noise + (errors.relative * value) ** 2)


@cached_njit
def reading_cost(
    errors: ReadingErrors, kind: int, reading: float, stable: float, expected: float
) -> tuple[float, float, float, bool, float, float]:
    """The cost of a MEASURED or SATURATED reading and its two derivatives by the expected reading [count].

    The reading is cut at saturation [count], and given by `stabilized`, too [sigma].

    Returns:
        Cost, first and second derivative, whether the reading is certainly an inlier, the systematic share of
        its variance, and its squared residual as an inlier.
    """
    two_sided = errors.bright < math.inf
    if two_sided:
        more, slope = stabilized(errors, expected)
        more -= stable
    else:  # noise by the reading: simpler, and as accurate where noise is small
        slope = 1.0 / spread(errors, reading)
        more = (expected - reading) * slope
    if kind == SATURATED:
        cost, pull, weight = _of_saturated(slope, more)
        return cost, pull, weight, True, 0.0, 0.0
    systematic = errors.systematic * (1.0 - (errors.noise * slope) ** 2) if errors.systematic > 0.0 else 0.0
    limit = math.inf
    if more < 0.0:
        limit = errors.bright
    elif two_sided or reading < DARK * errors.noise:
        limit = errors.blocked
    square = more * more
    cost, pull, weight = 0.5 * square, more * slope, slope * slope
    if limit < math.inf:
        near = cost < BELIEVED
        if more < 0.0:  # it may be too bright: light that is not modelled has an exponential distribution
            per_count = 1.0 / (_STRAY * errors.noise)
            other = errors.bright + _STRAY_DENSITY + per_count * (reading - expected)
            if cost >= other - _SURELY:
                own = 1.0 / (1.0 + math.exp(cost - other))
                cost = min(cost, other) - math.log1p(math.exp(-abs(cost - other)))
                pull, weight = own * pull - (1.0 - own) * per_count, own * weight
        elif not near:  # it may be blocked: a robust loss, whose cost saturates at the limit
            seen = math.exp((BELIEVED - cost) / limit)
            cost, pull, weight = BELIEVED + limit * (1.0 - seen), seen * pull, seen * weight
        return cost, pull, weight, near and two_sided, systematic, square
    return cost, pull, weight, True, systematic, square


@cached_njit
def _of_saturated(per_sigma: float, z: float) -> tuple[float, float, float]:
    """The cost of a saturated reading whose expectation is z sigmas above saturation, and its derivatives."""
    if z > -_TAIL:
        return 0.0, 0.0, 0.0
    if z > _TAIL:
        share = 0.5 * math.erfc(-z / math.sqrt(2.0))
        hazard = math.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * share)
        cost = -math.log(share)
    else:
        series = 1.0 - 1.0 / (z * z) + 3.0 / (z * z * z * z)
        hazard = -z / series
        cost = 0.5 * z * z + math.log(-z * math.sqrt(2.0 * math.pi) / series)
    return cost, -hazard * per_sigma, max(hazard * (hazard + z), 0.0) * per_sigma * per_sigma


_MOST = math.sqrt(2.0 * BELIEVED)


class Costs(NamedTuple):
    """The likelihood model of each of F readings."""

    per_sigma: FloatArray  # (F,) inverse standard deviation of readings with a Gaussian likelihood, else 0
    # (F,) maximum residual, expected minus read [sigma]; beyond it the reading counts as blocked
    most: FloatArray
    # (F,) indices of readings evaluated by `reading_cost`; the first `counts[1]` are valid
    others: IntArray
    counts: IntArray  # (2,) number of Gaussian readings and of `others`


@cached_njit
def new_costs(readings: int) -> Costs:
    """Memory for the given number of readings."""
    return Costs(np.empty(readings), np.empty(readings), np.empty(readings, np.int64), np.empty(2, np.int64))


class Pair(NamedTuple):
    """The readings of one pair of robots; F is modes * n * n, by mode, sensor, emitter."""

    readings: FloatArray  # (F,) [count]
    cut: FloatArray  # (F,) readings cut at saturation; 0 where MISSING
    stable: FloatArray  # (F,) `cut` after the variance-stabilizing transform `stabilized` [sigma]
    kinds: NDArray[np.int8]  # (F,) MISSING, MEASURED or SATURATED
    costs: Costs  # Their likelihood model
    sensor: FloatArray  # (n,) gains of the receiver's sensors
    emitter: FloatArray  # (n,) gains of the transmitter's emitters
    # (2, 2) per side (sensors, emitters): w and c of the information matrix w (I - c 1 1^T) of the prior on
    # its log-gains; w = 0: gains are exact
    prior: FloatArray
    nearest: float  # Minimum range of the search [m]
    farthest: float  # Maximum range of the search [m]


class CostWorkspace(NamedTuple):
    """Memory of a search over P unknowns: the log-gains of sensors and emitters, if estimated, and the pose.

    The pose comes last, so that the last rows of the Hessian's factor are those of the pose alone.
    """

    ways: FloatArray  # (WAY_ROWS, n * n) workspace of `predict_brightness`
    expected: FloatArray  # (F,) expected readings for unit gains [count]
    slopes: FloatArray  # (3, F) derivatives of `expected` by range, bearing and heading
    pulls: FloatArray  # (F,) first derivative of each reading's cost by `expected`
    weights: FloatArray  # (F,) second derivative of each reading's cost by `expected`
    at: FloatArray  # (P,) best estimate so far
    trial: FloatArray  # (P,) next estimate to evaluate
    factors: FloatArray  # (F,) products of a sensor's and an emitter's gain
    gradients: FloatArray  # (2, P) gradients of the cost at `at` and at `trial`, in either order
    hessians: FloatArray  # (2, P, P) Gauss-Newton Hessians at the same estimates; lower triangles
    factor: FloatArray  # (P, P) Cholesky factor of the damped Hessian; lower triangle
    step: FloatArray  # (P,) Gauss-Newton step
    # (3,) sum of squared residuals of priors and inlier readings, degrees of freedom of these readings, and
    # sum of squared residuals of all readings
    tally: FloatArray
    # (3, 3) pose information from readings, weighted by the systematic share of their noise
    systematic: FloatArray
    of_gains: FloatArray  # (3,) share of the pose's variances that comes from unknown gains
    root: FloatArray  # (3, 3) inverse of the pose block of `factor`; lower triangle
    first_root: FloatArray  # (3, 3) `root` at a minimum


@cached_njit
def new_cost_workspace(modes: int, n: int, gains: bool) -> CostWorkspace:
    """Memory for a board with n elements per side; `gains`: whether gains are estimated."""
    size, readings = 3 + 2 * n if gains else 3, modes * n * n
    # one array each: sums may be in another order where the compiler cannot tell that they are apart
    expected, pulls = np.empty(readings), np.empty(readings)
    weights, factors = np.empty(readings), np.empty(readings)
    at, trial, step = np.zeros(size), np.zeros(size), np.empty(size)
    tally, of_gains = np.empty(3), np.zeros(3)
    of_readings = np.empty((WAY_ROWS, n * n)), expected, np.empty((3, readings)), pulls, weights
    matrices = np.empty((2, size)), np.empty((2, size, size)), np.empty((size, size)), step, tally
    systematic, root, first_root = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    return CostWorkspace(*of_readings, at, trial, factors, *matrices, systematic, of_gains, root, first_root)


@cached_njit
def with_stray_light(model: IrModel, readings: FloatArray) -> IrModel:
    """The model with its noise increased by the stray light of the brightest of these readings (F,)."""
    brightest, e = 0.0, model.errors
    for reading in readings:
        if math.isfinite(reading):
            brightest = max(brightest, reading)
    noise = math.hypot(e.noise, model.stray * min(brightest, model.saturation))
    return IrModel(*model[:7], noise, ReadingErrors(noise, *e[1:]), *model[9:])


@norefcount_njit
def write_costs(errors: ReadingErrors, pair: Pair) -> None:
    """Write `Pair.costs` for readings with these errors."""
    costs, squared, others = pair.costs, 0, 0
    one_by_one = errors.bright < math.inf or errors.systematic > 0.0
    for f in range(pair.kinds.size):
        costs.per_sigma[f], costs.most[f] = 0.0, math.inf
        if pair.kinds[f] == MISSING:
            continue
        alone = one_by_one or pair.kinds[f] != MEASURED
        if not alone:
            costs.per_sigma[f] = 1.0 / spread(errors, pair.cut[f])
            squared += 1
            if pair.cut[f] < DARK * errors.noise and errors.blocked < math.inf:
                costs.most[f] = _MOST
        if alone or costs.most[f] < math.inf:
            costs.others[others] = f
            others += 1
    costs.counts[0], costs.counts[1] = squared, others


@norefcount_njit
def cost_of(
    model: IrModel, pair: Pair, at: FloatArray, work: CostWorkspace, gradient: FloatArray, hessian: FloatArray
) -> float:
    """The cost of an estimate (P,); writes its gradient (P,) and Hessian (P, P)."""
    size, sought = at.size, at.size > 3
    predict_brightness(model, at[size - 3], at[size - 2], at[size - 1], work.ways, work.expected, work.slopes)
    _write_factors(pair, at, work.factors)
    for p in range(size):
        gradient[p] = 0.0
        for q in range(p + 1):
            hessian[p, q] = 0.0
    of_prior = _add_prior(pair, at, gradient, hessian) if sought else 0.0
    cost, costs = of_prior, pair.costs
    cost += _squares(
        work.expected, work.factors, pair.cut, costs.per_sigma, costs.most, work.pulls, work.weights
    )
    work.tally[0], work.tally[1], work.tally[2] = 2.0 * cost, costs.counts[0] - 3.0, 2.0 * (cost - of_prior)
    cost += _add_others(model.errors, pair, work)
    _add_by_pose(work.pulls, work.weights, work.slopes[0], work.slopes[1], work.slopes[2], gradient, hessian)
    if sought:
        _add_by_gains(pair.sensor.size, work, gradient, hessian)
    return cost


@norefcount_njit
def _write_factors(pair: Pair, at: FloatArray, factors: FloatArray) -> None:
    """Write the products of gains, scaled by the log-gains if these are estimated; 0 for dead elements."""
    n, sought = pair.sensor.size, at.size > 3
    for i in range(n):
        sensor = pair.sensor[i] * (math.exp(at[i]) if sought else 1.0)
        for j in range(n):
            factor = sensor * pair.emitter[j]
            factors[i * n + j] = 0.0 if math.isnan(factor) else factor
    for j in range(n if sought else 0):
        gain = math.exp(at[n + j])
        for i in range(n):
            factors[i * n + j] *= gain
    for f in range(n * n, factors.size):  # the same for all powers
        factors[f] = factors[f - n * n]


@reassociated_njit
def _squares(
    expected: FloatArray,
    factors: FloatArray,
    cut: FloatArray,
    per_sigma: FloatArray,
    most: FloatArray,
    pulls: FloatArray,
    weights: FloatArray,
) -> float:
    """The cost of all readings with a Gaussian likelihood; writes its derivatives."""
    cost = 0.0
    for w in range(expected.size):
        slope = factors[w] * per_sigma[w]
        more = min(slope * expected[w] - per_sigma[w] * cut[w], most[w])
        cost += 0.5 * more * more
        pulls[w] = slope * more
        weights[w] = slope * slope
    return cost


@norefcount_njit
def _add_others(errors: ReadingErrors, pair: Pair, work: CostWorkspace) -> float:
    """The correction of the cost for `Costs.others`; also corrects the derivatives and the tally."""
    total, tally, costs = 0.0, work.tally, pair.costs
    for p in range(3):
        for q in range(3):
            work.systematic[p, q] = 0.0
    for k in range(costs.counts[1]):
        f = costs.others[k]
        factor, kind = work.factors[f], pair.kinds[f]
        expected = factor * work.expected[f]
        taken = min(costs.per_sigma[f] * (expected - pair.cut[f]), costs.most[f])
        if costs.per_sigma[f] > 0.0:  # a dark reading may be blocked if a brighter one is expected
            if taken < 0.0:
                continue
            tally[0], tally[1] = tally[0] - taken * taken, tally[1] - 1.0
            if taken < costs.most[f]:
                continue
        cost, pull, weight, sure, systematic, square = reading_cost(
            errors, kind, pair.cut[f], pair.stable[f], expected
        )
        total += cost - 0.5 * taken * taken
        tally[2] += square - taken * taken
        if sure:
            tally[0], tally[1] = tally[0] + 2.0 * cost, tally[1] + (1.0 if kind == MEASURED else 0.0)
        work.pulls[f], work.weights[f] = factor * pull, factor * factor * weight
        if systematic > 0.0:
            for p in range(3):
                for q in range(3):
                    information = systematic * work.weights[f] * work.slopes[p, f] * work.slopes[q, f]
                    work.systematic[p, q] += information
    return total


@reassociated_njit
def _add_by_pose(
    pulls: FloatArray,
    weights: FloatArray,
    by_r: FloatArray,
    by_b: FloatArray,
    by_h: FloatArray,
    gradient: FloatArray,
    hessian: FloatArray,
) -> None:
    """Write the derivatives by the pose; `by_r`, `by_b`, `by_h`: (F,) slopes by range, bearing, heading."""
    r, b, h = 0.0, 0.0, 0.0
    rr, br, bb, hr, hb, hh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for f in range(pulls.size):
        r, b, h = r + pulls[f] * by_r[f], b + pulls[f] * by_b[f], h + pulls[f] * by_h[f]
        of_r, of_b, of_h = weights[f] * by_r[f], weights[f] * by_b[f], weights[f] * by_h[f]
        rr, br, hr = rr + of_r * by_r[f], br + of_r * by_b[f], hr + of_r * by_h[f]
        bb, hb, hh = bb + of_b * by_b[f], hb + of_b * by_h[f], hh + of_h * by_h[f]
    x = gradient.size - 3
    gradient[x], gradient[x + 1], gradient[x + 2] = r, b, h
    hessian[x, x], hessian[x + 1, x], hessian[x + 1, x + 1] = rr, br, bb
    hessian[x + 2, x], hessian[x + 2, x + 1], hessian[x + 2, x + 2] = hr, hb, hh


@norefcount_njit
def _add_by_gains(n: int, work: CostWorkspace, gradient: FloatArray, hessian: FloatArray) -> None:
    """Add the derivatives by log-gains; a reading has the same slope by its sensor's and its emitter's."""
    expected, pulls, slopes, x = work.expected, work.pulls, work.slopes, gradient.size - 3
    for w in range(n * n):
        i, j = w // n, n + w % n
        pull, both, by_r, by_b, by_h = 0.0, 0.0, 0.0, 0.0, 0.0
        for f in range(w, expected.size, n * n):
            weight = work.weights[f] * expected[f]
            pull += pulls[f] * expected[f]
            both += weight * expected[f]
            by_r += weight * slopes[0, f]
            by_b += weight * slopes[1, f]
            by_h += weight * slopes[2, f]
        hessian[j, i] += both
        for p in (i, j):
            gradient[p] += pull
            hessian[p, p] += both
            hessian[x, p] += by_r
            hessian[x + 1, p] += by_b
            hessian[x + 2, p] += by_h


@norefcount_njit
def _add_prior(pair: Pair, at: FloatArray, gradient: FloatArray, hessian: FloatArray) -> float:
    """Add the prior of log-gains: independent errors, and one error common to all elements of a side."""
    n, cost = pair.sensor.size, 0.0
    for side in range(2):
        weight, common = pair.prior[side, 0], pair.prior[side, 1]
        first, total = side * n, 0.0
        for p in range(first, first + n):
            total += at[p]
        for p in range(first, first + n):
            pull = weight * (at[p] - common * total)
            cost += 0.5 * pull * at[p]
            gradient[p] += pull
            hessian[p, p] += weight * (1.0 - common)
            for q in range(first, p):
                hessian[p, q] -= weight * common
    return cost
