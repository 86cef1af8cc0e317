"""The velocity command with its timeout."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

STANDING_CLOCK_S = 1.0
"""A clock that stands still for so long of real time has died; a robot without a watchdog must stop then."""

MAX_VELOCITY = 1e3
"""[m/s] and [rad/s]; what is beyond is a mistake of who asks for it."""

Velocity = tuple[float, float, float]
"""Forward [m/s], to the left [m/s], turning to the left [rad/s]."""
STILL: Velocity = (0.0, 0.0, 0.0)


class VelocityCommand:
    """Keeps the newest velocity; zero when none has come lately.

    Args:
        timeout_s: How long a velocity counts.
        clock: Tells the time [ns]; may be simulated, and 0 is none.
        counts: Gets `bad_cmd_vel` and `stale_cmd_vel`.
        steady_s: Tells real time [s].
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
        self._expired: tuple[int, Velocity] | None = None  # of `velocity` alone: only `set` writes the newest
        self._clock_ran = (0, steady_s())

    def set(self, velocity: Velocity) -> None:
        """A velocity has come; one that is not finite, or absurd, is dropped."""
        if not all(abs(component) <= MAX_VELOCITY for component in velocity):
            self._counts["bad_cmd_vel"] += 1
            return
        self._latest = (self._clock(), velocity)

    def velocity(self) -> Velocity:
        """What the robot should do now."""
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
