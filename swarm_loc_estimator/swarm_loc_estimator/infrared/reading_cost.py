"""The negative log likelihood of one reading, and its derivatives by what is expected.

A measured reading is its expectation plus noise, Gaussian on the scale on which its variance is the same
everywhere. A saturated one says only that expectation plus noise is at saturation or above, which has the
probability of a normal tail. One that shows no light where some is expected may be blocked by another robot;
on some boards others are too bright.
"""

from __future__ import annotations

import math

from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.swarm.ir_board import ReadingErrors

MISSING, MEASURED, SATURATED = 0, 1, 2

_TAIL = -6.0
"""Below, the normal distribution is asymptotic [sigma]."""
DARK = 4.0
"""Only darker readings can be blocked ones [sigma]."""
BELIEVED = 2.0
"""A reading that costs less is no outlier."""
_STRAY = 5.0
"""Light that the model has not is so bright on average [sigma]."""
_STRAY_DENSITY = math.log(_STRAY / math.sqrt(2.0 * math.pi))
_SURELY = 6.0
"""An explanation whose cost is higher by this is out of the question."""


@cached_njit
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
    """The cost of a reading that may be an outlier, and its derivatives by the expectation.

    It may be blocked by something in between, or lit by something else: the farther it is from expectation,
    the less it counts, and its cost ends at a limit.
    """
    if cost < BELIEVED:
        return cost, pull, weight
    seen = math.exp((BELIEVED - cost) / limit)
    return BELIEVED + limit * (1.0 - seen), seen * pull, seen * weight


@cached_njit
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


@cached_njit
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
