"""Fusion periods, and the swarm and batch sizes at which the fusion strategy changes.

A large swarm fuses the measurements of a fusion period as one batch. A period is closed at its end, (t, t +
T]: a measurement at the instant of fusion belongs to the period that ends then.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.filter.measurement_model import Kind, MeasurementArray

Stamps = TypeVar("Stamps", int, IntArray)


@dataclass(frozen=True)
class Policy:
    """Sizes at which the estimator changes its strategy; users set only `Settings.sparse_from`."""

    large_from: int = 16  # Minimum number of robots for batch updates; a smaller swarm has few measurements
    # Minimum number of measurements per fusion period for a batch update; sequential updates of fewer
    # measurements are faster
    batch_from: int = 64
    # Minimum number of robots to fuse a period only `fusion_delay_s` after its end; a smaller swarm fuses
    # late data again at little cost
    delay_from: int = 64
    # Maximum number of robots for which all parameters are re-estimated when several robots or landmarks are
    # contradicted; a larger swarm re-estimates only the contradicted ones
    reopen_all_up_to: int = 30
    # Default fusion period [s] by the minimum number of robots with calibrated odometry, largest number first
    fusion_periods_s: tuple[tuple[int, float], ...] = ((600, 0.5), (250, 0.4), (0, 0.2))

    def fusion_period_s(self, calibrated: int) -> float:
        """Default fusion period for a number of robots with calibrated odometry [s]."""
        return next(period_s for count, period_s in self.fusion_periods_s if calibrated >= count)


def end_of_period(stamp_ns: Stamps, period_ns: int) -> Stamps:
    """End of the period of a stamp, or of stamps (m,): the next multiple of its length."""
    return -(-stamp_ns // period_ns) * period_ns


_end_of_period = cached_njit(end_of_period)


@cached_njit
def middle_of_period(stamp_ns: int, period_ns: int) -> int:
    """Instant to which robots are predicted for all measurements of the period of a stamp.

    It does not depend on the measurements, so late measurements of the period use the same prediction.
    """
    return _end_of_period(stamp_ns, period_ns) - period_ns + period_ns // 2


_NO_IMAGE_NS = np.iinfo(np.int64).min


def parts_by_way(measurements: MeasurementArray) -> list[slice]:
    """Parts of measurements (m,) in order that are fused in one way: an aerial image, a scan, or others."""
    anonymous, scan = (measurements["kind"] == kind for kind in (Kind.ANONYMOUS, Kind.SCAN))
    if not (anonymous.any() or scan.any()):
        return [slice(0, measurements.size)]
    image_ns = np.where(anonymous, measurements["stamp_ns"], _NO_IMAGE_NS)
    changes = (np.diff(image_ns) != 0) | scan[1:] | scan[:-1]
    edges = [0, *(np.flatnonzero(changes) + 1).tolist(), measurements.size]
    return [slice(begin, end) for begin, end in itertools.pairwise(edges)]
