"""Geared motors of simulated PushBots: voltage in, speed after a lag out."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray

_FREE_RATE = 6000.0
"""A wheel at full voltage [ticks/s]; the firmware's fastest velocity needs four fifths of it."""
_LAG_S = 0.02


class Drivetrain:
    """Two wheels of each of N robots.

    Args:
        count: N.
        step_s: Time of a step [s].

    Attributes:
        duties: (N, 2) share of the battery's voltage, left and right.
        ticks: (N, 2) that the wheels have turned.
    """

    def __init__(self, count: int, step_s: float) -> None:
        self.duties = np.zeros((count, 2))
        self.ticks = np.zeros((count, 2))
        self._rates = np.zeros((count, 2))
        self._step_s = step_s
        self._kept = np.exp(-step_s / _LAG_S)

    def step(self) -> FloatArray:
        """Let time pass; the ticks (N, 2) done in it."""
        self._rates = _FREE_RATE * self.duties + self._kept * (self._rates - _FREE_RATE * self.duties)
        done = self._rates * self._step_s
        self.ticks += done
        return done
