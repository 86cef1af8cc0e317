"""The driver of one Droplet at a cable, and of those that it reaches by infrared. No ROS here."""

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
"""In place of a name: the robot at the cable."""
_READ_S, _STOP_READ_S = 0.05, 0.01
"""At least so often the driver looks at the time and at velocities; more often while robots are stopped."""


@dataclass(frozen=True)
class DropletSettings:
    """How to reach a robot and what it is to do.

    Attributes:
        device: Serial port.
        session: What to talk about.
        noise: How the robots stray from what they are told.
        stride_s: How far ahead they are told [s].
        relayed: Name -> id of robots without a cable that are driven through this one.
        relay_loss: Share of the commands to these that are not heard.
        command_timeout_s: How long a velocity counts [s].
        odometry_period_s: Between two states [s].
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
    """Who gets what comes of the robots; called in the driver's thread.

    Attributes:
        odometry: Gets names, `OWN` for the robot at the cable, and states.
        brightness: Gets the robot's own id and its matrices.
    """

    odometry: Callable[[str, OdometryState], None]
    brightness: Callable[[int, Brightness], None]


class DropletDriver(RobotDriver[DropletSession]):
    """Drives Droplets in a thread of its own.

    Args:
        settings: The robots.
        listeners: Who gets their data.
        clock: Tells the time [ns]; may be simulated, and 0 is none.
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
        """Have a robot move so from now on."""
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
        """Pass requests on, and tell where the robots are."""
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
