"""Driver of one Droplet at a cable and of those that it reaches by infrared, without ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from swarm_loc_drivers.common.link import Link, SerialLink
from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import RobotDriver
from swarm_loc_drivers.common.velocity_command import Velocity, VelocityCommand
from swarm_loc_drivers.droplet.exchange import Brightness
from swarm_loc_drivers.droplet.hardware import BAUD_RATE
from swarm_loc_drivers.droplet.odometry import CommandedMotion, MotionNoise
from swarm_loc_drivers.droplet.session import DropletMover, DropletSession, SessionSettings

OWN = ""
"""Name of the robot at the cable."""
_READ_S, _STOP_READ_S = 0.05, 0.01
"""Longest wait for bytes in a step, and while robots are stopped [s]."""


@dataclass(frozen=True)
class DropletSettings:
    """How to reach a robot, and what it does.

    Attributes:
        device: Serial port.
        session: Settings of the session.
        noise: Noise of commanded motion.
        stride_s: Duration of a command to move [s].
        relayed: Name -> id of robots without a cable that are driven through this one.
        relay_loss: Share of lost commands to these robots.
        command_timeout_s: How long a velocity is valid [s].
        odometry_period_s: Time between two states [s].
    """

    device: str
    session: SessionSettings
    noise: MotionNoise
    stride_s: float
    relayed: Mapping[str, int]
    relay_loss: float
    command_timeout_s: float
    odometry_period_s: float


@dataclass(frozen=True)
class DropletListeners:
    """Receivers of the robots' data, called in the driver's thread.

    Attributes:
        odometry: Receives names, `OWN` for the robot at the cable, and states.
        brightness: Receives the id of the robot at the cable and its matrices.
    """

    odometry: Callable[[str, OdometryState], None]
    brightness: Callable[[int, Brightness], None]


class DropletDriver(RobotDriver[DropletSession]):
    """Drives Droplets in its own thread.

    Args:
        settings: Settings of the robots.
        listeners: Receivers of their data.
        clock: The time [ns]; may be simulated, and 0 means no time.
    """

    def __init__(
        self, settings: DropletSettings, listeners: DropletListeners, clock: Callable[[], int]
    ) -> None:
        super().__init__(settings.device)
        self._settings = settings
        self._listeners = listeners
        self._clock = clock
        self._requested = threading.Event()
        self._odometry_due_ns = 0
        names = (OWN, *settings.relayed)
        self._commands = {
            name: VelocityCommand(settings.command_timeout_s, clock, self.counts) for name in names
        }
        self._movers = {name: self._mover(name) for name in names}

    def _mover(self, name: str) -> DropletMover:
        settings, target = self._settings, self._settings.relayed.get(name)
        loss = settings.relay_loss if target is not None else 0.0
        motion = CommandedMotion(settings.noise)
        return DropletMover(self._commands[name], motion, settings.stride_s, target, loss)

    def set_velocity(self, name: str, velocity: Velocity) -> None:
        """Set the velocity of a robot."""
        self._commands[name].set(velocity)

    def request_exchanges(self) -> None:
        """Measure once with every partner."""
        self._requested.set()

    def _open(self) -> Link:
        return SerialLink(self._settings.device, BAUD_RATE, self._settings.session.reply_timeout_s)

    def _begin(self) -> DropletSession:
        relayed = [mover for name, mover in self._movers.items() if name != OWN]
        session = DropletSession(
            self._settings.session,
            self._movers[OWN],
            relayed,
            lambda one: self._listeners.brightness(session.robot, one),
            self.counts,
        )
        return session

    def _step(self, session: DropletSession, link: Link) -> bytes:
        return session.step(link.read(_STOP_READ_S if session.ending else _READ_S), self._clock())

    def _lose(self, session: DropletSession) -> None:
        session.abandon(self._clock())

    def _serve(self, session: DropletSession) -> None:
        """Pass on requests and publish odometry."""
        if not session.connected:
            return
        if self._requested.is_set():
            self._requested.clear()
            session.request_exchanges()
        now_ns = self._clock()
        period_ns = round(self._settings.odometry_period_s * 1e9)
        if now_ns and not 0 < self._odometry_due_ns - now_ns <= period_ns:
            self._odometry_due_ns = now_ns + period_ns - now_ns % period_ns
            for name, mover in self._movers.items():
                self._listeners.odometry(name, mover.motion.state(now_ns))
