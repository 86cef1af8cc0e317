"""The velocity command with its timeout."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

STANDING_CLOCK_S = 1.0
"""A clock that stands still for so long of real time counts as dead, and the robot stops [s]."""

MAX_VELOCITY = 1e3  # [m/s] and [rad/s]; larger velocities are dropped as errors

Velocity = tuple[float, float, float]  # Forward [m/s], to the left [m/s], turning to the left [rad/s]
STILL: Velocity = (0.0, 0.0, 0.0)


class VelocityCommand:
    """Holds the newest velocity; zero after a timeout [s].

    The clock [ns] may be simulated, and 0 means no time; `steady_s` is real time. Counts `bad_cmd_vel` and
    `stale_cmd_vel`.
    """

    def __init__(
        self,
        timeout_s: float,
        clock: Callable[[], int],
        counts: Counter[str],
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._timeout_ns = round(timeout_s * 1e9)
        self._clock = clock
        self._counts = counts
        self._steady_s = steady_s
        self._latest: tuple[int, Velocity] | None = None
        self._expired: tuple[int, Velocity] | None = None  # by `velocity`; `_latest` by `set`
        self._clock_ran = (0, steady_s())

    def set(self, velocity: Velocity) -> None:
        """Take a velocity; one that is not finite or too large is dropped."""
        if not all(abs(component) <= MAX_VELOCITY for component in velocity):
            self._counts["bad_cmd_vel"] += 1
            return
        self._latest = (self._clock(), velocity)

    def velocity(self) -> Velocity:
        """The velocity to drive now."""
        latest, now_ns = self._latest, self._clock()
        if now_ns != self._clock_ran[0]:
            self._clock_ran = (now_ns, self._steady_s())
        if latest is None or latest is self._expired:
            return STILL
        age_ns = now_ns - latest[0]
        if 0 <= age_ns <= self._timeout_ns and self._steady_s() <= self._clock_ran[1] + STANDING_CLOCK_S:
            return latest[1]
        if latest[1] != STILL:
            self._counts["stale_cmd_vel"] += 1
        self._expired = latest
        return STILL
