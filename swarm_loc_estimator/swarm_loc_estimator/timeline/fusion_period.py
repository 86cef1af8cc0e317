"""Fusion periods: stretches of time whose measurements a large swarm fuses together.

Each is closed at its end, (t, t + T]: what is measured at the very instant of fusing belongs to the period
that ends then, and opens no other one.
"""

from __future__ import annotations

from typing import TypeVar

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.jit import cached_njit

Stamps = TypeVar("Stamps", int, IntArray)


def end_of_period(stamp_ns: Stamps, period_ns: int) -> Stamps:
    """The last instant of the period of a stamp, or of stamps (m,): a multiple of its length."""
    return -(-stamp_ns // period_ns) * period_ns


_end_of_period = cached_njit(end_of_period)


@cached_njit
def middle_of_period(stamp_ns: int, period_ns: int) -> int:
    """The instant to which robots are predicted for all measurements of the period of a stamp.

    Not the mean of what has come: so more that comes of the period finds the same prediction.
    """
    return _end_of_period(stamp_ns, period_ns) - period_ns + period_ns // 2
