"""Driver of one Droplet at a cable and of those that it reaches by infrared, without ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from swarm_loc_drivers.common.link import Link, SerialLink
from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import RobotDriver
from swarm_loc_drivers.common.velocity_command import Velocity, VelocityCommand
from swarm_loc_drivers.droplet.exchange import Brightness
from swarm_loc_drivers.droplet.hardware import BAUD_RATE
from swarm_loc_drivers.droplet.odometry import CommandedMotion
from swarm_loc_drivers.droplet.parameters import DropletParameters
from swarm_loc_drivers.droplet.session import DropletMover, DropletSession

OWN = ""  # Name of the robot at the cable
_READ_S, _STOP_READ_S = 0.05, 0.01  # Longest wait for bytes in a step, and while robots are stopped [s]


@dataclass(frozen=True)
class DropletListeners:
    """Receivers of the robots' data, called in the driver's thread."""

    # Receives names, `OWN` for the robot at the cable, and states
    odometry: Callable[[str, OdometryState], None]
    # Receives the id of the robot at the cable and its matrices
    brightness: Callable[[int, Brightness], None]


class DropletDriver(RobotDriver[DropletSession]):
    """Drives Droplets in its own thread, see `RobotDriver`."""

    def __init__(
        self, params: DropletParameters, listeners: DropletListeners, clock: Callable[[], int]
    ) -> None:
        super().__init__(params.address, clock)
        self._params = params
        self._listeners = listeners
        self._requested = threading.Event()
        self._odometry_due_ns = 0
        relayed = params.relayed_ids
        self._commands = {
            name: VelocityCommand(params.cmd_vel_timeout_s, clock, self.counts) for name in (OWN, *relayed)
        }
        self._movers = {name: self._mover(name, relayed.get(name)) for name in self._commands}

    def _mover(self, name: str, target: int | None) -> DropletMover:
        params = self._params
        loss = params.relay_loss if target is not None else 0.0
        motion = CommandedMotion(params.motion_noise)
        return DropletMover(self._commands[name], motion, params.stride_s, target, loss)

    def set_velocity(self, name: str, velocity: Velocity) -> None:
        """Set the velocity of a robot."""
        self._commands[name].set(velocity)

    def request_exchanges(self) -> None:
        """Measure once with every partner."""
        self._requested.set()

    def _open(self) -> Link:
        return SerialLink(self._params.address, BAUD_RATE, self._params.reply_timeout_s)

    def _begin(self) -> DropletSession:
        relayed = [mover for name, mover in self._movers.items() if name != OWN]
        session = DropletSession(
            self._params.session,
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
        if not session.connected:
            return
        if self._requested.is_set():
            self._requested.clear()
            session.request_exchanges()
        now_ns = self._clock()
        period_ns = round(1e9 / self._params.odom_rate)
        if now_ns and not 0 < self._odometry_due_ns - now_ns <= period_ns:
            self._odometry_due_ns = now_ns + period_ns - now_ns % period_ns
            for name, mover in self._movers.items():
                self._listeners.odometry(name, mover.motion.state(now_ns))
