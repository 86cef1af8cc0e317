"""Dead reckoning by the robot's step counters, with the uncertainty of the wheels' paths.

The counters count commanded steps. So between two readings they can only have gone where the commands of that
time lead; anything else is a reading that lost bytes, or a robot that was switched off and on. After a gap
between readings some may come that were held up on the way: for a while the whole gap counts.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import NamedTuple

from swarm_loc_drivers.common.odometry import DeadReckoning, OdometryState, WheelGeometry
from swarm_loc_drivers.epuck.hardware import as_counter, unwrapped_difference

Rates = tuple[float, float]

_TIMING_SLACK_S = 0.15
"""Stamps are those of the computer; the robot may have read its counters so much earlier or later still than
a session knows."""
_DELAY_NS = 500_000_000
"""A command may take so long to the robot, and a reading so long from it."""
_MIN_PERIOD_NS = 4_000_000
"""No robot answers so fast: readings that come closer together were held up on the way."""
_ROUNDING_STEPS = 2


class _Told(NamedTuple):
    """Between which rates [steps/s] the wheels are, left and right, from an instant [ns] on."""

    since_ns: int
    slowest: Rates
    fastest: Rates


class WheelOdometry:
    """Adds up steps.

    Args:
        geometry: The wheels.
        wheel_noise: Variance of each wheel's path per metre it rolls [m^2/m].
        counts: Gets `implausible_counters`, `counter_restarts`, `reversed_counters` and `time_jumps`.
    """

    def __init__(self, geometry: WheelGeometry, wheel_noise: float, counts: Counter[str]) -> None:
        self._geometry = geometry
        self._counts = counts
        self._reckoning = DeadReckoning(geometry, wheel_noise)
        self._last: tuple[int, int, int] | None = None
        self._last_doubt_ns = 0
        self._rates: Rates = (0.0, 0.0)
        self._held: Rates = (0.0, 0.0)  # since the last reading; through a gap the robot goes on with them
        self._told = deque([_Told(0, self._rates, self._rates)])
        self._gap_ns = (0, 0)
        self._right_sign = 1
        self._doubtful = False

    def note_rates(self, now_ns: int, left: float, right: float) -> None:
        """The robot is told to turn its wheels at these rates [steps/s] from now on."""
        self._rates = (left, right)
        self._note(_Told(now_ns, self._rates, self._rates))

    def doubt_rates(self, now_ns: int, max_rate: float) -> None:
        """Until it is told again the wheels may turn at any rate [steps/s] that they can."""
        self._note(_Told(now_ns, (-max_rate, -max_rate), (max_rate, max_rate)))

    def _note(self, told: _Told) -> None:
        newest = self._told[-1]
        if (told.slowest, told.fastest) != (newest.slowest, newest.fastest):
            self._told.append(told)

    def update(self, stamp_ns: int, left: int, right: int, *, doubt_ns: int = 0) -> OdometryState | None:
        """Take counters of 16 bits, read at a time or so much earlier or later.

        Returns:
            The state, or None when they tell nothing new or cannot be true.
        """
        right, last = as_counter(self._right_sign * right), self._last
        if last is None:
            self._restart(stamp_ns, doubt_ns, left, right)
            return self._reckoning.state(stamp_ns, 0.0, 0.0, 0.0)
        if 0 <= stamp_ns - last[0] < _MIN_PERIOD_NS:
            return None
        has_jumped = stamp_ns < last[0]
        if has_jumped:
            self._counts["time_jumps"] += 1
        elapsed_s = 0.0 if has_jumped else (stamp_ns - last[0]) * 1e-9
        if elapsed_s > _TIMING_SLACK_S:
            self._gap_ns = self._since_ns(last[0]), stamp_ns
        longest_s = max(elapsed_s, (stamp_ns - self._since_ns(stamp_ns)) * 1e-9)
        longest_s += _TIMING_SLACK_S + (self._last_doubt_ns + doubt_ns) * 1e-9
        steps = self._steps(left, right, elapsed_s)
        mirrored = self._steps(left, right, elapsed_s, right_sign=-1)
        paths = 0.0, 0.0
        if self._possible(steps, longest_s):
            paths = self._advance(*steps)
        elif self._doubtful and self._possible(mirrored, longest_s):
            self._counts["reversed_counters"] += 1
            self._right_sign, right = -self._right_sign, as_counter(-right)
            paths = self._advance(*mirrored)
        elif self._doubtful or has_jumped:
            self._counts["counter_restarts"] += 1
            self._forget_motion(longest_s)
        else:  # a single one may have lost bytes on the way
            self._counts["implausible_counters"] += 1
            self._doubtful = True
            return None
        self._restart(stamp_ns, doubt_ns, left, right)
        return self._reckoning.state(stamp_ns, *paths, elapsed_s)

    def _steps(self, left: int, right: int, elapsed_s: float, right_sign: int = 1) -> tuple[int, int]:
        """Steps since the last reading, the closest to what the wheels were told that the counters allow."""
        _, last_left, last_right = self._last or (0, left, right)
        expected_left, expected_right = (rate * elapsed_s for rate in self._held)
        return (
            unwrapped_difference(last_left, left, expected_left),
            unwrapped_difference(right_sign * last_right, right_sign * right, expected_right),
        )

    def _restart(self, stamp_ns: int, doubt_ns: int, left: int, right: int) -> None:
        """Count from here."""
        self._last, self._last_doubt_ns = (stamp_ns, left, right), doubt_ns
        self._held = self._rates
        first_ns, last_ns = self._since_ns(stamp_ns) - _DELAY_NS, stamp_ns + _DELAY_NS
        while len(self._told) > 1 and not first_ns < self._told[1].since_ns <= last_ns:
            self._told.popleft()
        self._doubtful = False

    def _since_ns(self, stamp_ns: int) -> int:
        """Since when what a reading tells may have happened: soon after a gap since that began."""
        begin_ns, end_ns = self._gap_ns
        return begin_ns if 0 <= stamp_ns - end_ns <= _DELAY_NS else stamp_ns

    def _limits(self) -> tuple[Rates, Rates]:
        """The slowest and the fastest rates since the last reading; it may also have stood."""
        slowest = [(0.0, 0.0), *(told.slowest for told in self._told)]
        fastest = [(0.0, 0.0), *(told.fastest for told in self._told)]
        return (
            (min(left for left, _ in slowest), min(right for _, right in slowest)),
            (max(left for left, _ in fastest), max(right for _, right in fastest)),
        )

    def _possible(self, steps: tuple[int, int], longest_s: float) -> bool:
        """Whether commands allow so many steps in so long at most; the robot may also have stood."""
        ranges = zip(steps, *self._limits(), strict=True)
        return all(
            slowest * longest_s - _ROUNDING_STEPS <= done <= fastest * longest_s + _ROUNDING_STEPS
            for done, slowest, fastest in ranges
        )

    def _advance(self, left_steps: int, right_steps: int) -> tuple[float, float]:
        """Move by the wheels' steps; their paths [m]."""
        left, right = (steps * self._geometry.metres_per_step for steps in (left_steps, right_steps))
        self._reckoning.advance(left, right)
        return left, right

    def _forget_motion(self, longest_s: float) -> None:
        """The robot went nobody knows where, at most as fast as it was told."""
        rate = max(abs(rate) for limit in self._limits() for rate in limit)
        self._reckoning.forget_motion(rate * self._geometry.metres_per_step * longest_s)
