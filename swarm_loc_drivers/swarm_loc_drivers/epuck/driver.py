"""Driver of one e-puck: link, wheel commands and odometry from its step counters, without ROS.

The counters count commanded steps, so a change that the commands since the last reading cannot explain means
that a reading has lost bytes or that the robot has restarted. After a gap between readings, delayed readings
may arrive: for a while the commands of the whole gap are taken into account.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.common.link import Link, open_link
from swarm_loc_drivers.common.odometry import DeadReckoning, OdometryState, WheelGeometry
from swarm_loc_drivers.common.robot_driver import RobotDriver, Velocity, VelocityCommand
from swarm_loc_drivers.epuck.hardware import CameraImage, as_counter, unwrapped_difference
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_drivers.epuck.serial_session import SerialSession
from swarm_loc_drivers.epuck.wifi_session import WifiSession
from swarm_loc_estimator.common.arrays import FloatArray, IntArray

EpuckSession = SerialSession | WifiSession
Rates = tuple[float, float]

# Checked by test_epuck_motion.py and by the bad links of test_epuck_sessions.py.
_TIMING_SLACK_S = 0.15
"""Further uncertainty of a stamp, beyond that known to the session: stamps are those of the computer."""
_DELAY_NS = 500_000_000  # Longest delay of a command to the robot, and of a reading from it
_MIN_PERIOD_NS = 4_000_000  # No robot answers faster: readings closer together were delayed in transit
_ROUNDING_STEPS = 2


class _RateLimits(NamedTuple):
    """Limits of the rates of the left and the right wheel [steps/s] from an instant [ns] on."""

    since_ns: int
    slowest: Rates
    fastest: Rates


class WheelOdometry:
    """Integrates steps to a pose, see `DeadReckoning`, and checks them against the commands.

    Counts `implausible_counters`, `counter_restarts`, `reversed_counters` and `time_jumps`.
    """

    def __init__(self, geometry: WheelGeometry, wheel_noise: float, counts: Counter[str]) -> None:
        self._geometry = geometry
        self._counts = counts
        self._reckoning = DeadReckoning(geometry, wheel_noise)
        self._last: tuple[int, int, int] | None = None
        self._last_doubt_ns = 0
        self._rates: Rates = (0.0, 0.0)
        self._held: Rates = (0.0, 0.0)  # at the last reading; the robot keeps them during a gap
        self._limits_since = deque([_RateLimits(0, self._rates, self._rates)])
        self._gap_ns = (0, 0)
        self._right_sign = 1
        self._doubtful = False

    def note_rates(self, now_ns: int, left: float, right: float) -> None:
        """The wheels turn at these commanded rates [steps/s] from now on."""
        self._rates = (left, right)
        self._limit_rates(now_ns, self._rates, self._rates)

    def doubt_rates(self, now_ns: int, max_rate: float) -> None:
        """The rates are unknown, up to `max_rate` [steps/s], until the next command."""
        self._limit_rates(now_ns, (-max_rate, -max_rate), (max_rate, max_rate))

    def _limit_rates(self, now_ns: int, slowest: Rates, fastest: Rates) -> None:
        if (slowest, fastest) != self._limits_since[-1][1:]:
            self._limits_since.append(_RateLimits(now_ns, slowest, fastest))

    def update(self, stamp_ns: int, left: int, right: int, *, doubt_ns: int = 0) -> OdometryState | None:
        """Take counters of 16 bits, read at `stamp_ns` with an uncertainty of `doubt_ns`.

        Returns:
            The state; None if the reading is too close to the last one or impossible.
        """
        right, last = as_counter(self._right_sign * right), self._last
        # the first reading, and those that come too early
        if last is None:
            self._restart(stamp_ns, doubt_ns, left, right)
            return self._reckoning.state(stamp_ns, 0.0, 0.0, 0.0)
        if 0 <= stamp_ns - last[0] < _MIN_PERIOD_NS:
            return None
        # the longest time in which the wheels may have turned
        has_jumped = stamp_ns < last[0]
        if has_jumped:
            self._counts["time_jumps"] += 1
        elapsed_s = 0.0 if has_jumped else (stamp_ns - last[0]) * 1e-9
        if elapsed_s > _TIMING_SLACK_S:
            self._gap_ns = self._since_ns(last[0]), stamp_ns
        longest_s = max(elapsed_s, (stamp_ns - self._since_ns(stamp_ns)) * 1e-9)
        longest_s += _TIMING_SLACK_S + (self._last_doubt_ns + doubt_ns) * 1e-9
        # steps that the commands can explain, also if the right counter runs backwards
        steps = self._steps(left, right, elapsed_s)
        mirrored = self._steps(left, right, elapsed_s, right_sign=-1)
        is_known = self._possible(steps, longest_s)
        if not is_known and self._doubtful and self._possible(mirrored, longest_s):
            self._counts["reversed_counters"] += 1
            self._right_sign, right = -self._right_sign, as_counter(-right)
            is_known, steps = True, mirrored
        elif not is_known and not self._doubtful and not has_jumped:  # a single reading may have lost bytes
            self._counts["implausible_counters"] += 1
            self._doubtful = True
            return None
        # move, or as fast as commanded in an unknown way
        metres = self._geometry.metres_per_step
        paths = (metres * steps[0], metres * steps[1]) if is_known else (0.0, 0.0)
        if is_known:
            self._reckoning.advance(*paths)
        else:
            self._counts["counter_restarts"] += 1
            self._reckoning.forget_motion(float(np.abs(self._limits()).max()) * metres * longest_s)
        self._restart(stamp_ns, doubt_ns, left, right)
        return self._reckoning.state(stamp_ns, *paths, elapsed_s)

    def _steps(self, left: int, right: int, elapsed_s: float, right_sign: int = 1) -> tuple[int, int]:
        """Steps since the last reading: those possible by the counters that are closest to the commands."""
        _, last_left, last_right = self._last or (0, left, right)
        expected_left, expected_right = (rate * elapsed_s for rate in self._held)
        return (
            unwrapped_difference(last_left, left, expected_left),
            unwrapped_difference(right_sign * last_right, right_sign * right, expected_right),
        )

    def _restart(self, stamp_ns: int, doubt_ns: int, left: int, right: int) -> None:
        """Make this the last reading."""
        self._last, self._last_doubt_ns = (stamp_ns, left, right), doubt_ns
        self._held = self._rates
        first_ns, last_ns = self._since_ns(stamp_ns) - _DELAY_NS, stamp_ns + _DELAY_NS
        while len(self._limits_since) > 1 and not first_ns < self._limits_since[1].since_ns <= last_ns:
            self._limits_since.popleft()
        self._doubtful = False

    def _since_ns(self, stamp_ns: int) -> int:
        """Start of the time that a reading may cover: soon after a gap, the start of the gap."""
        begin_ns, end_ns = self._gap_ns
        return begin_ns if 0 <= stamp_ns - end_ns <= _DELAY_NS else stamp_ns

    def _limits(self) -> FloatArray:
        """(2, 2) slowest and fastest rates since the last reading; zero is always possible."""
        rates = np.array([((0.0, 0.0), (0.0, 0.0)), *(one[1:] for one in self._limits_since)])
        return np.stack([rates[:, 0].min(axis=0), rates[:, 1].max(axis=0)])

    def _possible(self, steps: tuple[int, int], longest_s: float) -> bool:
        """Whether the commands allow these steps within `longest_s`."""
        slowest, fastest = self._limits() * longest_s
        low, high = slowest - _ROUNDING_STEPS <= steps, steps <= fastest + _ROUNDING_STEPS
        return bool(low.all() and high.all())


_MAX_IDLE_S = 0.5
"""Longest wait for a tick, for instance while simulated time stands still; then the robot is asked [s]."""
_READ_S = 0.02


@dataclass(frozen=True)
class EpuckListeners:
    """Receivers of the robot's data, called in the driver's thread."""

    odometry: Callable[[OdometryState], None]  # Receives every new state
    proximity: Callable[[int, IntArray], None]  # Receives stamps [ns] and raw values (8,)
    image: Callable[[CameraImage], None]  # Receives images


class EpuckDriver(RobotDriver[EpuckSession]):
    """Drives one robot in its own thread, see `RobotDriver`."""

    def __init__(self, params: EpuckParameters, listeners: EpuckListeners, clock: Callable[[], int]) -> None:
        super().__init__(str(params.link_address), clock)
        self._params = params
        self._listeners = listeners
        self._command = VelocityCommand(params.cmd_vel_timeout_s, clock, self.counts)
        self._odometry = WheelOdometry(params.geometry, params.wheel_noise, self.counts)
        self._tick = threading.Event()

    def tick(self) -> None:
        """Request the next reading of a robot that has to be asked."""
        self._tick.set()

    def set_velocity(self, velocity: Velocity) -> None:
        """Follow a velocity from now on; wheels ignore its component to the left."""
        forward, _, turn_rate = velocity
        self._command.set((forward, 0.0, turn_rate))
        self._tick.set()

    def begin_to_stop(self) -> None:
        """See `RobotDriver.begin_to_stop`."""
        super().begin_to_stop()
        self._tick.set()

    def _open(self) -> Link:
        params = self._params
        return open_link(params.link_address, params.baud_rate, params.reply_timeout_s)

    def _begin(self) -> EpuckSession:
        if self._params.link_address.device:
            return SerialSession(self._params, self._speeds, self._doubt, self.counts)
        return WifiSession(self._params, self._speeds, self.counts)

    def _step(self, session: EpuckSession, link: Link) -> bytes:
        if session.is_idle:
            self._tick.wait(_MAX_IDLE_S)
            self._tick.clear()
        data = link.read(0.0 if session.is_idle else _READ_S)
        return session.step(data, self._clock(), time.monotonic())

    def _serve(self, session: EpuckSession) -> None:
        found, session.found = session.found, []
        for one in found:
            if not one.stamp_ns:
                self.counts["no_clock"] += 1
            elif isinstance(one, CameraImage):
                self.counts["images"] += 1
                self._listeners.image(one)
            else:
                self.counts["readings"] += 1
                self._listeners.proximity(one.stamp_ns, one.proximity)
                counters = one.left_counter, one.right_counter
                state = self._odometry.update(one.stamp_ns, *counters, doubt_ns=one.doubt_ns)
                if state is not None:
                    self._listeners.odometry(state)

    def _speeds(self) -> tuple[int, int]:
        """Commands of the wheels now."""
        speed, _, turn_rate = self._command.velocity()
        model = self._params.epuck_model
        left, right = model.wheel_commands(self._params.geometry, speed, turn_rate)
        self._odometry.note_rates(self._clock(), model.rate(left), model.rate(right))
        return left, right

    def _doubt(self) -> None:
        """The rates of the wheels are unknown."""
        self._odometry.doubt_rates(self._clock(), self._params.epuck_model.max_rate)
