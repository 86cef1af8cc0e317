"""The negative log likelihood of one reading, and its derivatives by the expected reading.

A measured reading is the expected one plus noise that is Gaussian after a variance-stabilizing transform. A
saturated reading is a lower bound, with the probability of a normal tail. A dark reading where light is
expected may be blocked by another robot; on some boards readings may also be too bright.
"""

from __future__ import annotations

import math

from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.swarm.ir_board import ReadingErrors

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
    """The cost of a reading and its first two derivatives by the expected reading.

    Args:
        errors: Noise and outliers of the platform.
        kind: MEASURED or SATURATED.
        reading: Cut at saturation [count].
        stable: The reading by `stabilized` [sigma].
        expected: The expected reading with gains [count].

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
        if more < 0.0:
            cost, pull, weight = _of_bright(errors, reading - expected, cost, pull, weight)
        else:
            cost, pull, weight = _of_outlier(cost, pull, weight, limit)
        return cost, pull, weight, near and two_sided, systematic, square
    return cost, pull, weight, True, systematic, square


@cached_njit
def _of_outlier(cost: float, pull: float, weight: float, limit: float) -> tuple[float, float, float]:
    """The cost of a reading that may be blocked, and its derivatives by the expected reading.

    The loss is robust: the weight decreases with the residual, and the cost saturates at a limit.
    """
    if cost < BELIEVED:
        return cost, pull, weight
    seen = math.exp((BELIEVED - cost) / limit)
    return BELIEVED + limit * (1.0 - seen), seen * pull, seen * weight


@cached_njit
def _of_bright(
    errors: ReadingErrors, more: float, cost: float, pull: float, weight: float
) -> tuple[float, float, float]:
    """The cost of a reading that is brighter than expected by `more` [count], and its derivatives.

    The brightness of light that is not modelled has an exponential distribution.
    """
    per_count = 1.0 / (_STRAY * errors.noise)
    other = errors.bright + _STRAY_DENSITY + per_count * more
    if cost < other - _SURELY:
        return cost, pull, weight
    own = 1.0 / (1.0 + math.exp(cost - other))
    total = min(cost, other) - math.log1p(math.exp(-abs(cost - other)))
    return total, own * pull - (1.0 - own) * per_count, own * weight


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
