"""Wheel odometry of a PushBot from its ticks."""

from __future__ import annotations

from collections import Counter

from swarm_loc_drivers.common.odometry import DeadReckoning, OdometryState, WheelGeometry
from swarm_loc_drivers.pushbot.hardware import MAX_TICK_RATE, tick_difference
from swarm_loc_drivers.pushbot.session import WheelTicks

_MAX_RATE = 2.0 * MAX_TICK_RATE  # Largest rate of a wheel, also while its controller catches up [ticks/s]
_SLACK_S = 0.15  # Largest error of a stamp [s]
_MAX_CORRECTION_S = 0.5
"""Stamps step back by at most so much when a smaller delay is found, or events arrive after ticks [s]."""


class PushbotOdometry:
    """Integrates ticks to a pose.

    The wheels may also be turned by hand, so only readings that no motor can cause are rejected.

    Args:
        geometry: Geometry of the wheels.
        wheel_noise: Variance of each wheel's path per metre it rolls [m^2/m].
        counts: Counts `implausible_counters`, `counter_restarts`, `time_jumps` and `corrected_times`.
    """

    def __init__(self, geometry: WheelGeometry, wheel_noise: float, counts: Counter[str]) -> None:
        self._metres_per_tick = geometry.metres_per_step
        self._reckoning = DeadReckoning(geometry, wheel_noise)
        self._counts = counts
        self._last: WheelTicks | None = None
        self._doubtful = False

    def restart(self) -> None:
        """The board is reset and its ticks are zero; the robot has not moved in between."""
        self._last = None

    def update(self, ticks: WheelTicks) -> OdometryState | None:
        """Take a reading; the state, or None if the reading is not newer or is impossible."""
        last = self._last
        if last is None:
            self._last = ticks
            return self._reckoning.state(ticks.stamp_ns, 0.0, 0.0, 0.0)
        if ticks.stamp_ns == last.stamp_ns:
            return None
        elapsed_s = (ticks.stamp_ns - last.stamp_ns) * 1e-9
        if -_MAX_CORRECTION_S < elapsed_s < 0.0:
            self._counts["corrected_times"] += 1  # its motion is part of the next reading
            return None
        if elapsed_s < 0.0:
            self._counts["time_jumps"] += 1
            elapsed_s = 0.0
        done = tick_difference(last.left, ticks.left), tick_difference(last.right, ticks.right)
        if max(map(abs, done)) > _MAX_RATE * (elapsed_s + _SLACK_S):
            return self._distrust(ticks, elapsed_s)
        self._last, self._doubtful = ticks, False
        left, right = (self._metres_per_tick * one for one in done)
        self._reckoning.advance(left, right)
        return self._reckoning.state(ticks.stamp_ns, left, right, elapsed_s)

    def _distrust(self, ticks: WheelTicks, elapsed_s: float) -> OdometryState | None:
        """A single reading may have lost bytes; a second one shows that the counters have changed."""
        if not self._doubtful:
            self._counts["implausible_counters"] += 1
            self._doubtful = True
            return None
        self._counts["counter_restarts"] += 1
        self._reckoning.forget_motion(_MAX_RATE * self._metres_per_tick * elapsed_s)
        self._last, self._doubtful = ticks, False
        return self._reckoning.state(ticks.stamp_ns, 0.0, 0.0, 0.0)
