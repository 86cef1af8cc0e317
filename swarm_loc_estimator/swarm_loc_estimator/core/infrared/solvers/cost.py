"""The negative log likelihood of readings, with gradient and Hessian by pose and gains.

What is sought is the pose and, where elements differ by an unknown amount, every sensor's and emitter's
log-gain, which has a prior. A measured reading is its expectation plus noise, Gaussian on the scale on which
its variance is the same everywhere. A saturated one says only that expectation plus noise is at saturation or
above, which has the probability of a normal tail. One that shows no light where some is expected may be
blocked by another robot; on some boards others are too bright.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.infrared.board import IrModel, ReadingErrors
from swarm_loc_estimator.core.infrared.brightness import predict_brightness
from swarm_loc_estimator.numerics.arrays import FloatArray
from swarm_loc_estimator.numerics.jit import compiled

MISSING, MEASURED, SATURATED = 0, 1, 2

_TAIL = -6.0
"""Below, the normal distribution is asymptotic [sigma]."""
DARK = 4.0
"""Only darker readings can be blocked ones [sigma]."""
_BELIEVED = 2.0
"""A reading that costs less is no outlier."""


_STRAY = 5.0
"""Light that the model has not is so bright on average [sigma]."""
_STRAY_DENSITY = math.log(_STRAY / math.sqrt(2.0 * math.pi))
_SURELY = 6.0
"""An explanation whose cost is higher by this is out of the question."""


class Pair(NamedTuple):
    """The readings of one pair of robots.

    Attributes:
        readings: (modes, n, n) [count].
        stable: (modes, n, n) the readings, or saturation, by `stabilized` [sigma].
        saturation: (modes,) from where on they are SATURATED [count].
        kinds: (modes, n, n) MISSING, MEASURED or SATURATED.
        sensor: (n,) gains of the receiver's sensors.
        emitter: (n,) gains of the transmitter's emitters.
        prior: (2, 2) of sensors and emitters: what weighs every log-gain's square, and the share of their
            common part that this weight leaves free; weights of zero: gains are exact.
        nearest: The least range to seek [m].
        farthest: The largest.
    """

    readings: FloatArray
    stable: FloatArray
    saturation: FloatArray
    kinds: NDArray[np.int8]
    sensor: FloatArray
    emitter: FloatArray
    prior: FloatArray
    nearest: float
    farthest: float


class Scratch(NamedTuple):
    """Room to work in; P unknowns are the log-gains of n sensors and n emitters, if sought, and the pose.

    The pose comes last, so that the last rows of the Hessian's factor are those of the pose alone.

    Attributes:
        expected: (modes, n, n).
        slopes: (3, modes, n, n).
        at: (P,) the best so far.
        trial: (P,).
        factors: (2, n) sensors' and emitters' gains.
        gradients: (2, P) of the cost at the best so far, or at the trial.
        hessians: (2, P, P) likewise, by Gauss-Newton; lower triangles.
        factor: (P, P) lower triangle.
        step: (P,).
        tally: (3,) squares of what is left of priors and of the readings that are no outliers, the degrees of
            freedom of these, and squares of what is left of all.
        lasting: (3, 3) the part of the information on the pose by whose noise it errs the same every time.
        of_gains: (3,) the part of the pose's variances that is the unknown gains'.
        root: (3, 3) inverse of the pose's part of the factor, lower triangle.
    """

    expected: FloatArray
    slopes: FloatArray
    at: FloatArray
    trial: FloatArray
    factors: FloatArray
    gradients: FloatArray
    hessians: FloatArray
    factor: FloatArray
    step: FloatArray
    tally: FloatArray
    lasting: FloatArray
    of_gains: FloatArray
    root: FloatArray


@compiled
def new_scratch(modes: int, n: int, gains: bool) -> Scratch:
    """Room for a platform, with or without gains to seek."""
    size = 3 + 2 * n if gains else 3
    return Scratch(
        np.empty((modes, n, n)),
        np.empty((3, modes, n, n)),
        np.zeros(size),
        np.zeros(size),
        np.empty((2, n)),
        np.empty((2, size)),
        np.empty((2, size, size)),
        np.empty((size, size)),
        np.empty(size),
        np.empty(3),
        np.zeros((3, 3)),
        np.zeros(3),
        np.zeros((3, 3)),
    )


@compiled
def with_stray_light(model: IrModel, readings: FloatArray) -> IrModel:
    """The platform with the noise that an exchange has whose readings (modes, n, n) are so bright."""
    brightest, e = 0.0, model.errors
    for reading in readings.flat:
        if math.isfinite(reading):
            brightest = max(brightest, reading)
    noise = math.hypot(e.noise, model.stray * min(brightest, model.saturation))
    return IrModel(
        model.radius,
        model.angles,
        model.units,
        model.sensor,
        model.emitter,
        model.amplitudes,
        model.saturation,
        noise,
        ReadingErrors(noise, e.relative, e.lasting, e.blocked, e.bright),
        model.stray,
        model.scale,
    )


@compiled
def cost_of(
    model: IrModel, pair: Pair, at: FloatArray, room: Scratch, gradient: FloatArray, hessian: FloatArray
) -> float:
    """The cost at some place; writes its gradient and Hessian there."""
    size, modes, n = at.size, pair.readings.shape[0], pair.readings.shape[1]
    predict_brightness(model, at[size - 3], at[size - 2], at[size - 1], room.expected, room.slopes)
    sought, errors = size > 3, model.errors
    for i in range(n):
        room.factors[0, i] = pair.sensor[i] * (math.exp(at[i]) if sought else 1.0)
        room.factors[1, i] = pair.emitter[i] * (math.exp(at[n + i]) if sought else 1.0)
    for p in range(size):
        gradient[p] = 0.0
        for q in range(p + 1):
            hessian[p, q] = 0.0
    for p in range(3):
        for q in range(3):
            room.lasting[p, q] = 0.0
    cost = _add_prior(pair, at, gradient, hessian) if sought else 0.0
    squares, all_squares, sure = 2.0 * cost, 0.0, 0
    # by the pose alone, summed apart: in arrays the sums would be stored for each reading
    by_r, by_b, by_h = 0.0, 0.0, 0.0
    rr, br, bb, hr, hb, hh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(modes):
        for i in range(n):
            for j in range(n):
                kind = pair.kinds[m, i, j]
                if kind == MISSING:
                    continue
                factor = room.factors[0, i] * room.factors[1, j]
                expected = factor * room.expected[m, i, j]
                reading = min(pair.readings[m, i, j], pair.saturation[m])
                one, pull, weight, sure_of_it, lasting, square = _of_reading(
                    errors, kind, reading, pair.stable[m, i, j], expected
                )
                cost += one
                all_squares += square
                if sure_of_it:
                    squares += 2.0 * one
                    sure += 1 if kind == MEASURED else 0
                if weight == 0.0:
                    continue
                a = factor * room.slopes[0, m, i, j]
                b = factor * room.slopes[1, m, i, j]
                c = factor * room.slopes[2, m, i, j]
                by_r, by_b, by_h = by_r + pull * a, by_b + pull * b, by_h + pull * c
                rr, br, bb = rr + weight * a * a, br + weight * a * b, bb + weight * b * b
                hr, hb, hh = hr + weight * a * c, hb + weight * b * c, hh + weight * c * c
                if lasting > 0.0:
                    _add_lasting(lasting * weight, (a, b, c), room.lasting)
                if sought:
                    _add_by_gains(pull, weight, expected, i, n + j, gradient, hessian)
                    _add_by_both(weight * expected, a, b, c, i, n + j, hessian)
    x = size - 3
    gradient[x], gradient[x + 1], gradient[x + 2] = by_r, by_b, by_h
    hessian[x, x], hessian[x + 1, x], hessian[x + 1, x + 1] = rr, br, bb
    hessian[x + 2, x], hessian[x + 2, x + 1], hessian[x + 2, x + 2] = hr, hb, hh
    room.tally[0], room.tally[1], room.tally[2] = squares, sure - 3.0, all_squares
    return cost


@compiled
def stabilized(errors: ReadingErrors, value: float) -> tuple[float, float]:
    """A brightness on the scale on which noise is one everywhere, and the slope of this scale [1/count].

    With the variance noise^2 + (relative value)^2 it is asinh(relative value / noise) / relative.
    """
    per_noise = 1.0 / errors.noise
    if errors.relative == 0.0:
        return value * per_noise, per_noise
    ratio = errors.relative * value * per_noise
    root = math.sqrt(1.0 + ratio * ratio)
    size = math.log(abs(ratio) + root) / errors.relative
    return math.copysign(size, value), per_noise / root


@compiled
def _of_reading(
    errors: ReadingErrors, kind: int, reading: float, stable: float, expected: float
) -> tuple[float, float, float, bool, float, float]:
    """The cost of a reading and its two derivatives by the expectation.

    Args:
        errors: Of the platform.
        kind: MEASURED or SATURATED.
        reading: Cut at saturation [count].
        stable: The reading by `stabilized` [sigma].
        expected: At this pose with these gains [count].

    Returns:
        Besides, whether it is no outlier for sure, the share of its variance that is the same every time, and
        the square of what it is off as if it were none.
    """
    two_sided = errors.bright < math.inf
    if two_sided:
        more, slope = stabilized(errors, expected)
        more -= stable
    else:  # by the reading, as good where noise is small, and simpler
        sigma = errors.noise
        if errors.relative > 0.0:
            sigma = math.sqrt(sigma * sigma + (errors.relative * reading) ** 2)
        slope = 1.0 / sigma
        more = (expected - reading) * slope
    if kind == SATURATED:
        cost, pull, weight = _of_saturated(slope, more)
        return cost, pull, weight, True, 0.0, 0.0
    lasting = errors.lasting * (1.0 - (errors.noise * slope) ** 2) if errors.lasting > 0.0 else 0.0
    limit = math.inf
    if more < 0.0:
        limit = errors.bright
    elif two_sided or reading < DARK * errors.noise:
        limit = errors.blocked
    square = more * more
    cost, pull, weight = 0.5 * square, more * slope, slope * slope
    if limit < math.inf:
        near = cost < _BELIEVED
        if more < 0.0:
            cost, pull, weight = _of_bright(errors, reading - expected, cost, pull, weight)
        else:
            cost, pull, weight = _of_outlier(cost, pull, weight, limit)
        return cost, pull, weight, near and two_sided, lasting, square
    return cost, pull, weight, True, lasting, square


@compiled
def _add_by_gains(
    pull: float, weight: float, slope: float, i: int, j: int, gradient: FloatArray, hessian: FloatArray
) -> None:
    """Add a reading by the log-gains i of its sensor and j of its emitter; by both it has the same slope."""
    gradient[i] += pull * slope
    gradient[j] += pull * slope
    both = weight * slope * slope
    hessian[i, i] += both
    hessian[j, j] += both
    hessian[j, i] += both


@compiled
def _add_by_both(weight: float, a: float, b: float, c: float, i: int, j: int, hessian: FloatArray) -> None:
    """Add what couples the pose to the log-gains i and j, by its slopes a, b and c."""
    row = hessian.shape[0] - 3
    for slope in (a, b, c):
        mixed = weight * slope
        hessian[row, i] += mixed
        hessian[row, j] += mixed
        row += 1


@compiled
def _add_prior(pair: Pair, at: FloatArray, gradient: FloatArray, hessian: FloatArray) -> float:
    """Add the priors of log-gains: independent errors, and one common to all of a side."""
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


@compiled
def _add_lasting(weight: float, slopes: tuple[float, float, float], lasting: FloatArray) -> None:
    """Add a reading whose noise has a part that is the same every time."""
    for p in range(3):
        for q in range(3):
            lasting[p, q] += weight * slopes[p] * slopes[q]


@compiled
def _of_outlier(cost: float, pull: float, weight: float, limit: float) -> tuple[float, float, float]:
    """The cost of a reading that may be an outlier, and its derivatives by the expectation.

    It may be blocked by something in between, or lit by something else: the farther it is from expectation,
    the less it counts, and its cost ends at a limit.
    """
    if cost < _BELIEVED:
        return cost, pull, weight
    seen = math.exp((_BELIEVED - cost) / limit)
    return _BELIEVED + limit * (1.0 - seen), seen * pull, seen * weight


@compiled
def _of_bright(
    errors: ReadingErrors, more: float, cost: float, pull: float, weight: float
) -> tuple[float, float, float]:
    """The cost of a reading that is so much brighter than expected [count], and its derivatives.

    Light that the model has not is seldom strong: how bright it is has an exponential distribution.
    """
    per_count = 1.0 / (_STRAY * errors.noise)
    other = errors.bright + _STRAY_DENSITY + per_count * more
    if cost < other - _SURELY:
        return cost, pull, weight
    own = 1.0 / (1.0 + math.exp(cost - other))
    total = min(cost, other) - math.log1p(math.exp(-abs(cost - other)))
    return total, own * pull - (1.0 - own) * per_count, own * weight


@compiled
def _of_saturated(per_sigma: float, z: float) -> tuple[float, float, float]:
    """The cost of a saturated reading, and its derivatives by the expectation, z sigmas beyond saturation."""
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
