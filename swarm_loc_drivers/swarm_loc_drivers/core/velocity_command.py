"""The last velocity that was asked for, and when it no longer counts."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable

from swarm_loc_drivers.core.wheels import WheelGeometry
from swarm_loc_drivers.protocols.epuck import EpuckModel

STANDING_CLOCK_S = 1.0
"""A clock that stands still for so long of real time has died; a robot without a watchdog must stop then."""

_STILL = (0, 0)


class VelocityCommand:
    """Turns velocities into wheel speeds; zero when none has come lately.

    Args:
        geometry: The wheels.
        model: The robot's generation.
        timeout_s: How long a velocity counts.
        clock: Tells the time [ns]; may be simulated, and 0 is none.
        counts: Gets `bad_cmd_vel` and `stale_cmd_vel`.
        steady_s: Tells real time [s].
    """

    def __init__(
        self,
        geometry: WheelGeometry,
        model: EpuckModel,
        timeout_s: float,
        clock: Callable[[], int],
        counts: Counter[str],
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._geometry = geometry
        self._model = model
        self._timeout_ns = round(timeout_s * 1e9)
        self._clock = clock
        self._counts = counts
        self._steady_s = steady_s
        self._latest: tuple[int, tuple[int, int]] | None = None
        self._clock_ran = (0, steady_s())

    def set(self, speed: float, turn_rate: float) -> None:
        """A velocity has come: forward [m/s], to the left [rad/s]; one that is not finite is dropped."""
        if not (math.isfinite(speed) and math.isfinite(turn_rate)):
            self._counts["bad_cmd_vel"] += 1
            return
        self._latest = (self._clock(), self._geometry.commands_for(speed, turn_rate, self._model))

    def speeds(self) -> tuple[int, int]:
        """What the wheels should do now, left and right [steps/s]."""
        latest, now_ns = self._latest, self._clock()
        if now_ns != self._clock_ran[0]:
            self._clock_ran = (now_ns, self._steady_s())
        if latest is None:
            return _STILL
        age_ns = now_ns - latest[0]
        if 0 <= age_ns <= self._timeout_ns and self._steady_s() <= self._clock_ran[1] + STANDING_CLOCK_S:
            return latest[1]
        if latest[1] != _STILL:
            self._counts["stale_cmd_vel"] += 1
        self._latest = None
        return _STILL
