"""Motion response: true share of the reported motion, for odometry from commands or with slip."""

from __future__ import annotations

import itertools
from dataclasses import dataclass


class MotionResponseError(ValueError):
    """An inconsistent response; the message is one sentence."""


@dataclass(frozen=True)
class MotionResponse:
    """True shares of the reported speed and turn rate, for odometry from commands or with slip.

    Shares are interpolated between the points of the grid and constant beyond its border.

    Raises:
        MotionResponseError: Sizes differ, an axis does not ascend, or a share is not in [0, 10].
    """

    speeds: tuple[float, ...]  #: (V,) reported speeds [m/s], ascending from 0
    turn_rates: tuple[float, ...]  #: (W,) absolute reported turn rates [rad/s], ascending from 0
    speed_share: tuple[tuple[float, ...], ...]  #: (V, W) true speed per reported speed
    turn_share: tuple[tuple[float, ...], ...]  #: (V, W) true turn rate per reported turn rate

    def __post_init__(self) -> None:
        for name in ("speeds", "turn_rates"):
            axis = getattr(self, name)
            ascends = all(low < high for low, high in itertools.pairwise(axis))
            if not axis or not all(0.0 <= v <= 1e3 for v in axis) or not ascends:
                raise MotionResponseError(
                    f"response.{name} is {list(axis)} but must ascend within [0, 1000]."
                )
        for name in ("speed_share", "turn_share"):
            table = getattr(self, name)
            if len(table) != len(self.speeds) or any(len(row) != len(self.turn_rates) for row in table):
                raise MotionResponseError(
                    f"response.{name} must have {len(self.speeds)} rows, one per speed,"
                    f" of {len(self.turn_rates)} numbers, one per turn rate."
                )
            if not all(0.0 <= v <= 10.0 for row in table for v in row):
                raise MotionResponseError(f"response.{name} must hold numbers in [0, 10] only.")
