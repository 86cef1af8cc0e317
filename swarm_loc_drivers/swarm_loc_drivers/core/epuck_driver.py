"""The driver of one e-puck: keeps the link up, the wheels obedient and the odometry added up. No ROS here."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.core.epuck_serial_session import SerialCamera, SerialSession
from swarm_loc_drivers.core.epuck_session import Photo, Session
from swarm_loc_drivers.core.epuck_wifi_session import WifiSession
from swarm_loc_drivers.core.link_keeper import LinkKeeper, SessionError
from swarm_loc_drivers.core.odometry_state import OdometryState
from swarm_loc_drivers.core.velocity_command import VelocityCommand
from swarm_loc_drivers.core.wheel_odometry import WheelOdometry
from swarm_loc_drivers.core.wheels import WheelGeometry
from swarm_loc_drivers.protocols.epuck import EpuckModel
from swarm_loc_drivers.transports.link import Address, Link, LinkError
from swarm_loc_drivers.transports.serial_link import SerialLink
from swarm_loc_drivers.transports.tcp_link import TcpLink


@dataclass(frozen=True)
class EpuckSettings:
    """How to reach a robot and what it is.

    Attributes:
        address: Where it answers; over TCP it is an e-puck2 with the WiFi firmware.
        model: Its generation.
        geometry: Its wheels.
        wheel_noise: Variance of each wheel's path per metre it rolls [m^2/m].
        command_timeout_s: How long a velocity counts [s].
        baud_rate: Of a serial port [bit/s].
        reading_period_s: Between two readings over TCP that are used [s]; over serial the ticks decide.
        reply_timeout_s: How long an answer may take, and half of how long a stream may be silent [s].
        camera: Which pictures to ask for, None for none; over TCP they have one size only.
    """

    address: Address
    model: EpuckModel
    geometry: WheelGeometry
    wheel_noise: float
    command_timeout_s: float
    baud_rate: int
    reading_period_s: float
    reply_timeout_s: float
    camera: SerialCamera | None


@dataclass(frozen=True)
class Listeners:
    """Who gets what the robot measures; called in the driver's thread.

    Attributes:
        odometry: Gets every new state.
        proximity: Gets stamps [ns] and raw values (8,).
        photo: Gets pictures.
    """

    odometry: Callable[[OdometryState], None]
    proximity: Callable[[int, NDArray[np.int64]], None]
    photo: Callable[[Photo], None]


class EpuckDriver:
    """Drives one robot in a thread of its own.

    Args:
        settings: The robot.
        listeners: Who gets its data.
        clock: Tells the time [ns]; may be simulated, and 0 is none.

    Attributes:
        counts: What happened how often, for people.
    """

    def __init__(self, settings: EpuckSettings, listeners: Listeners, clock: Callable[[], int]) -> None:
        self._settings = settings
        self._listeners = listeners
        self._clock = clock
        self.counts: Counter[str] = Counter()
        self.command = VelocityCommand(settings.command_timeout_s, clock, self.counts)
        self._odometry = WheelOdometry(settings.geometry, settings.wheel_noise, self.counts)
        self._tick = threading.Event()
        self._keeper = LinkKeeper(str(settings.address), self._converse, self.counts)

    @property
    def trouble(self) -> str:
        """Why there is no connection; "" while there is one."""
        return self._keeper.trouble

    def start(self) -> None:
        """Begin."""
        self._keeper.start()

    def tick(self) -> None:
        """It is time to ask the robot, where it has to be asked."""
        self._tick.set()

    def set_velocity(self, speed: float, turn_rate: float) -> None:
        """Drive forward [m/s] and turn to the left [rad/s] from now on."""
        self.command.set((speed, 0.0, turn_rate))
        self._tick.set()

    def stop(self) -> None:
        """Stop the robot and end."""
        self._keeper.stopping.set()
        self._tick.set()
        self._keeper.stop()

    def _converse(self) -> None:
        """One connection, from its begin to the end of the driver."""
        link = self._open()
        try:
            session = self._session(link)
            self._keeper.may_run = True
            session.begin()
            self._keeper.note_connection()
            try:
                while not self._keeper.stopping.is_set():
                    self._exchange(session)
            except (LinkError, SessionError):
                raise
            except BaseException:  # a robot must not run on because of a mistake up here
                session.end()
                raise
            session.end()
            self._keeper.may_run = False
        finally:
            link.close()

    def _exchange(self, session: Session) -> None:
        for found in session.exchange(self._speeds):
            if not found.stamp_ns:
                self.counts["no_clock"] += 1
            elif isinstance(found, Photo):
                self.counts["pictures"] += 1
                self._listeners.photo(found)
            else:
                self.counts["readings"] += 1
                self._listeners.proximity(found.stamp_ns, found.proximity)
                state = self._odometry.update(found.stamp_ns, found.left_counter, found.right_counter)
                if state is not None:
                    self._listeners.odometry(state)

    def _speeds(self) -> tuple[int, int]:
        """What the wheels are told now."""
        speed, _, turn_rate = self.command.velocity()
        left, right = self._settings.geometry.commands_for(speed, turn_rate, self._settings.model)
        rate = self._settings.model.rate
        self._odometry.note_rates(self._clock(), rate(left), rate(right))
        return left, right

    def _open(self) -> Link:
        settings = self._settings
        if settings.address.device:
            return SerialLink(settings.address.device, settings.baud_rate, settings.reply_timeout_s)
        return TcpLink(settings.address.host, settings.address.port, 2.0 * settings.reply_timeout_s)

    def _session(self, link: Link) -> Session:
        settings = self._settings
        if settings.address.device:
            return SerialSession(
                link,
                settings.baud_rate,
                settings.camera,
                settings.reply_timeout_s,
                self._tick,
                self._clock,
                lambda: self._odometry.doubt_rates(self._clock(), settings.model.max_rate),
                self.counts,
            )
        return WifiSession(
            link,
            settings.camera is not None,
            settings.reading_period_s,
            2.0 * settings.reply_timeout_s,
            self._clock,
            self.counts,
        )
