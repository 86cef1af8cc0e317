"""Network model: messages arrive with a random delay, and some are lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Lateness:
    """Delay between the moment something happened and its arrival, uniform between two bounds.

    Attributes:
        low_s: Shortest delay [s].
        high_s: Longest delay [s].
    """

    low_s: float
    high_s: float


CAMERA_LATENESS = Lateness(0.150, 0.300)
"""Exposure, marker detection and wireless link of the e-puck paper, section V-B."""

ODOMETRY_LATENESS = Lateness(0.002, 0.020)
"""A few bytes on the same wireless link."""


def arrival_ns(rng: np.random.Generator, stamp_ns: NDArray[np.int64], late: Lateness) -> NDArray[np.int64]:
    """Arrival (M,) of what happened at `stamp_ns` (M,); each is delayed on its own, so order may change."""
    delay_s = rng.uniform(late.low_s, late.high_s, len(stamp_ns))
    return stamp_ns + np.rint(delay_s * 1e9).astype(np.int64)


def survivors(rng: np.random.Generator, count: int, loss: float) -> NDArray[np.bool_]:
    """Which of `count` messages arrive (count,), when each is lost with probability `loss`."""
    return rng.random(count) >= loss
