"""Dead reckoning by the robot's step counters, with the uncertainty of the wheels' paths.

The counters count commanded steps. So between two readings they can only have gone where the commands of that
time lead; anything else is a reading that lost bytes, or a robot that was switched off and on.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.core.odometry_state import FloatArray, OdometryState, carried_on
from swarm_loc_drivers.core.wheels import WheelGeometry
from swarm_loc_drivers.protocols.epuck import unwrapped_difference

Rates = tuple[float, float]

_TIMING_SLACK_S = 0.15
"""Stamps are those of the computer; the robot may have read its counters so much earlier or later."""
_DELAY_NS = 500_000_000
"""A command may take so long to the robot, and a reading so long from it."""
_SHORTEST_NS = 4_000_000
"""No robot answers so fast: readings that come closer together were held up on the way."""
_ROUNDING_STEPS = 2
_STEP_VARIANCE = 1.0 / 12.0
"""Of a counter that has cut off the fraction of a step."""
_FORWARD_TURN = np.ix_((0, 2), (0, 2))


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
        counts: Gets `implausible_counters`, `counter_restarts` and `time_jumps`.
    """

    def __init__(self, geometry: WheelGeometry, wheel_noise: float, counts: Counter[str]) -> None:
        self._geometry = geometry
        self._wheel_noise = wheel_noise
        self._counts = counts
        self._pose = (0.0, 0.0, 0.0)
        self._covariance = np.zeros((3, 3))
        self._last: tuple[int, int, int] | None = None
        self._rates: Rates = (0.0, 0.0)
        self._held: Rates = (0.0, 0.0)  # since the last reading; through a gap the robot goes on with them
        self._told = deque([_Told(0, self._rates, self._rates)])
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

    def update(self, stamp_ns: int, left: int, right: int) -> OdometryState | None:
        """Take counters of 16 bits; the state, or None when they tell nothing new or cannot be true."""
        last = self._last
        if last is None:
            self._restart(stamp_ns, left, right)
            return self._state(stamp_ns, 0.0, 0.0, 0.0)
        if 0 <= stamp_ns - last[0] < _SHORTEST_NS:
            return None
        has_jumped = stamp_ns < last[0]
        if has_jumped:
            self._counts["time_jumps"] += 1
        elapsed_s = 0.0 if has_jumped else (stamp_ns - last[0]) * 1e-9
        counters = ((last[1], left), (last[2], right))
        left_steps, right_steps = (
            unwrapped_difference(before, after, rate * elapsed_s)
            for (before, after), rate in zip(counters, self._held, strict=True)
        )
        paths = left_steps * self._geometry.metres_per_step, right_steps * self._geometry.metres_per_step
        if self._possible((left_steps, right_steps), elapsed_s):
            self._advance(*paths)
        elif self._doubtful or has_jumped:
            self._counts["counter_restarts"] += 1
            self._forget_motion(elapsed_s)
            paths = 0.0, 0.0
        else:  # a single one may have lost bytes on the way
            self._counts["implausible_counters"] += 1
            self._doubtful = True
            return None
        self._restart(stamp_ns, left, right)
        return self._state(stamp_ns, *paths, elapsed_s)

    def _restart(self, stamp_ns: int, left: int, right: int) -> None:
        """Count from here."""
        self._last = (stamp_ns, left, right)
        self._held = self._rates
        while (
            len(self._told) > 1 and not stamp_ns - _DELAY_NS < self._told[1].since_ns <= stamp_ns + _DELAY_NS
        ):
            self._told.popleft()
        self._doubtful = False

    def _limits(self) -> tuple[Rates, Rates]:
        """The slowest and the fastest rates since the last reading; it may also have stood."""
        slowest = [(0.0, 0.0), *(told.slowest for told in self._told)]
        fastest = [(0.0, 0.0), *(told.fastest for told in self._told)]
        return (
            (min(left for left, _ in slowest), min(right for _, right in slowest)),
            (max(left for left, _ in fastest), max(right for _, right in fastest)),
        )

    def _possible(self, steps: tuple[int, int], elapsed_s: float) -> bool:
        """Whether commands since the last reading allow so many steps; the robot may also have stood."""
        longest_s = elapsed_s + _TIMING_SLACK_S
        ranges = zip(steps, *self._limits(), strict=True)
        return all(
            slowest * longest_s - _ROUNDING_STEPS <= done <= fastest * longest_s + _ROUNDING_STEPS
            for done, slowest, fastest in ranges
        )

    def _advance(self, left: float, right: float) -> None:
        """Move by the wheels' paths [m], an arc, and add its noise about its middle."""
        x, y, theta = self._pose
        turn = (right - left) / self._geometry.wheel_separation
        half = 0.5 * turn
        chord = 0.5 * (left + right) * (math.sin(half) / half if half else 1.0)
        forward = np.array([math.cos(theta + half), math.sin(theta + half)])
        dx, dy = (chord * forward).tolist()
        self._pose = (x + dx, y + dy, (theta + turn + math.pi) % (2.0 * math.pi) - math.pi)
        self._covariance = carried_on(self._covariance, dx, dy)
        effect = np.array([[forward[0], -0.5 * dy], [forward[1], 0.5 * dx], [0.0, 1.0]])
        self._covariance += effect @ self._twist_noise(abs(left), abs(right), self._wheel_noise) @ effect.T

    def _twist_noise(self, left: float, right: float, scale: float) -> FloatArray:
        """Covariance (2, 2) of path and turn when the wheels' paths have the variances scale * left, right.

        covar(ds_r, ds_l) = diag(k |ds_r|, k |ds_l|) of Siegwart and Nourbakhsh, as the estimator has it.
        """
        separation = self._geometry.wheel_separation
        both = 0.5 * (right - left) / separation
        return scale * np.array([[0.25 * (left + right), both], [both, (left + right) / separation**2]])

    def _forget_motion(self, elapsed_s: float) -> None:
        """The robot went nobody knows where, at most as fast as it was told."""
        rate = max(abs(rate) for limit in self._limits() for rate in limit)
        reach = rate * self._geometry.metres_per_step * (elapsed_s + _TIMING_SLACK_S)
        turned = min(2.0 * reach / self._geometry.wheel_separation, math.pi)
        self._covariance += np.diag([reach**2, reach**2, turned**2]) / 3.0

    def _state(self, stamp_ns: int, left: float, right: float, elapsed_s: float) -> OdometryState:
        """What is published; `left` and `right` are the wheels' last paths [m]."""
        cut_off = _STEP_VARIANCE * self._geometry.metres_per_step**2
        (along, _), (_, turned) = self._twist_noise(1.0, 1.0, cut_off).tolist()
        covariance = self._covariance + np.diag([along, along, turned])
        twist, twist_noise = np.zeros(3), np.zeros((3, 3))
        if elapsed_s > 0.0:
            turned_rad = (right - left) / self._geometry.wheel_separation
            twist = np.array([0.5 * (left + right), 0.0, turned_rad]) / elapsed_s
            noise = self._twist_noise(abs(left), abs(right), self._wheel_noise)
            twist_noise[_FORWARD_TURN] = (noise + self._twist_noise(2.0, 2.0, cut_off)) / elapsed_s**2
        return OdometryState(stamp_ns, np.array(self._pose), covariance, twist, twist_noise)
