"""Driver of one PushBot: link, wheel commands and odometry, without ROS."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from swarm_loc_drivers.common.link import Link, open_link
from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import RobotDriver
from swarm_loc_drivers.common.velocity_command import Velocity, VelocityCommand
from swarm_loc_drivers.pushbot.event_packets import EventPacket
from swarm_loc_drivers.pushbot.hardware import wheel_velocities
from swarm_loc_drivers.pushbot.odometry import PushbotOdometry
from swarm_loc_drivers.pushbot.parameters import PushbotParameters
from swarm_loc_drivers.pushbot.session import NO_STOP, PushbotSession

_READ_S = 0.02
_BATCH_S = 0.002  # Shortest time between two reads [s]; each read has a fixed cost


@dataclass(frozen=True)
class PushbotListeners:
    """Receivers of the robot's data, called in the driver's thread."""

    odometry: Callable[[OdometryState], None]  # Receives every new state
    events: Callable[[EventPacket], None]  # Receives packets of events


class PushbotDriver(RobotDriver[PushbotSession]):
    """Drives one robot in its own thread.

    Args:
        params: Parameters of the driver.
        listeners: Receivers of its data.
        clock: The time [ns]; may be simulated, and 0 means no time.
    """

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
