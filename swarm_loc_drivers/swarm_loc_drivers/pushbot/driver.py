"""Driver of one PushBot: link, wheel commands and odometry, without ROS.

Wheel odometry of a PushBot from its ticks.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from swarm_loc_drivers.common.link import Link, open_link
from swarm_loc_drivers.common.odometry import DeadReckoning, OdometryState, WheelGeometry
from swarm_loc_drivers.common.robot_driver import RobotDriver
from swarm_loc_drivers.common.velocity_command import Velocity, VelocityCommand
from swarm_loc_drivers.pushbot.event_packets import EventPacket
from swarm_loc_drivers.pushbot.hardware import MAX_TICK_RATE, tick_difference, wheel_velocities
from swarm_loc_drivers.pushbot.parameters import PushbotParameters
from swarm_loc_drivers.pushbot.session import NO_STOP, PushbotSession, WheelTicks

_MAX_RATE = 2.0 * MAX_TICK_RATE  # Largest rate of a wheel, also while its controller catches up [ticks/s]
_SLACK_S = 0.15  # Largest error of a stamp [s]
_MAX_CORRECTION_S = 0.5
"""Stamps step back by at most so much when a smaller delay is found, or events arrive after ticks [s]."""
_UNHEARD_S = 1.0  # A robot that was not heard for so long before its board was reset has moved [s]


class PushbotOdometry:
    """Integrates ticks to a pose, see `DeadReckoning`.

    The wheels may also be turned by hand, so only readings that no motor can cause are rejected. Counts
    `implausible_counters`, `counter_restarts`, `time_jumps` and `corrected_times`.
    """

    def __init__(self, geometry: WheelGeometry, wheel_noise: float, counts: Counter[str]) -> None:
        self._metres_per_tick = geometry.metres_per_step
        self._begin = partial(DeadReckoning, geometry, wheel_noise)
        self._reckoning = self._begin()
        self._counts = counts
        self._last: WheelTicks | None = None
        self._heard_ns: int | None = None
        self._doubtful = False

    def restart(self) -> None:
        """The board is reset and its ticks are zero; the pose is, too, unless it is heard again soon."""
        self._heard_ns, self._last = self._last.stamp_ns if self._last else self._heard_ns, None

    def update(self, ticks: WheelTicks) -> OdometryState | None:
        """Take a reading; the state, or None if the reading is not newer or is impossible."""
        last = self._last
        if last is None:
            if self._heard_ns is not None and ticks.stamp_ns - self._heard_ns > 1e9 * _UNHEARD_S:
                self._reckoning = self._begin()
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


_READ_S = 0.02
_BATCH_S = 0.002  # Shortest time between two reads [s]; each read has a fixed cost


@dataclass(frozen=True)
class PushbotListeners:
    """Receivers of the robot's data, called in the driver's thread."""

    odometry: Callable[[OdometryState], None]  # Receives every new state
    events: Callable[[EventPacket], None]  # Receives packets of events


class PushbotDriver(RobotDriver[PushbotSession]):
    """Drives one robot in its own thread, see `RobotDriver`."""

    def __init__(
        self, params: PushbotParameters, listeners: PushbotListeners, clock: Callable[[], int]
    ) -> None:
        super().__init__(str(params.link_address), clock)
        self._params = params
        self._listeners = listeners
        self._command = VelocityCommand(params.cmd_vel_timeout_s, clock, self.counts)
        self._odometry = PushbotOdometry(params.geometry, params.wheel_noise, self.counts)
        self._read_s = 0.0

    def set_velocity(self, velocity: Velocity) -> None:
        """Follow a velocity from now on; wheels ignore its component to the left."""
        forward, _, turn_rate = velocity
        self._command.set((forward, 0.0, turn_rate))

    def _open(self) -> Link:
        params = self._params
        return open_link(params.link_address, params.baud_rate, params.reply_timeout_s)

    def _begin(self) -> PushbotSession:
        self._odometry.restart()
        return PushbotSession(self._params, self._velocities, self.counts)

    def _step(self, session: PushbotSession, link: Link) -> bytes:
        early_s = self._read_s + _BATCH_S - time.monotonic()
        if early_s > 0.0:
            time.sleep(early_s)
        data = link.read(_READ_S)
        self._read_s = time.monotonic()
        return session.step(data, self._clock(), self._read_s)

    def _serve(self, session: PushbotSession) -> None:
        self.warning = NO_STOP if session.does_not_stop else ""
        found, session.found = session.found, []
        for one in found:
            if one.stamp_ns <= 0:  # no clock yet, or a time before its beginning
                self.counts["no_clock"] += 1
            elif isinstance(one, EventPacket):
                self.counts["packets"] += 1
                self._listeners.events(one)
            elif (state := self._odometry.update(one)) is not None:
                self._listeners.odometry(state)

    def _velocities(self) -> tuple[int, int]:
        """Commands of the wheels now."""
        speed, _, turn_rate = self._command.velocity()
        return wheel_velocities(self._params.geometry, speed, turn_rate)
