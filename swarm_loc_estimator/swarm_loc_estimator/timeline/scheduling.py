"""When measurements are fused, and which sizes of swarms and batches change how.

A large swarm fuses the measurements of a fusion period together. A period is closed at its end, (t, t + T]:
a measurement at the very instant of fusing belongs to the period that ends then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.jit import cached_njit

Stamps = TypeVar("Stamps", int, IntArray)


@dataclass(frozen=True)
class Policy:
    """Sizes from which on the estimator works differently; `Settings.sparse_from` is the one that users set.

    Attributes:
        batch_from: Measurements of a fusion period from which on one update with all of them costs less than
            one update each, whatever the size of the swarm.
        delay_from: Robots from which on a period is fused only `fusion_delay_s` after its end; a smaller
            swarm is fused again at little cost when late data arrive.
        reopen_all_up_to: Robots up to which all parameters are re-estimated when several robots or landmarks
            are contradicted; in a larger swarm only those of the contradicted ones.
        fusion_periods_s: Default fusion period [s] by the number of robots with calibrated odometry from
            which on it holds, largest number first.
    """

    batch_from: int = 64
    delay_from: int = 64
    reopen_all_up_to: int = 30
    fusion_periods_s: tuple[tuple[int, float], ...] = ((600, 0.5), (250, 0.4), (0, 0.2))

    def fusion_period_s(self, calibrated: int) -> float:
        """The default fusion period where the odometry of so many robots is calibrated [s]."""
        return next(period_s for count, period_s in self.fusion_periods_s if calibrated >= count)


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
