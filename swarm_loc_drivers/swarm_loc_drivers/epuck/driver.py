"""Driver of one e-puck: link, wheel commands and odometry, without ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.common.link import Link, open_link
from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.common.robot_driver import RobotDriver
from swarm_loc_drivers.common.velocity_command import Velocity, VelocityCommand
from swarm_loc_drivers.epuck.odometry import WheelOdometry
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_drivers.epuck.serial_session import SerialSession
from swarm_loc_drivers.epuck.session import CameraImage, EpuckSession
from swarm_loc_drivers.epuck.wifi_session import WifiSession

_MAX_IDLE_S = 0.5
"""Longest wait for a tick, for instance while simulated time stands still; then the robot is asked [s]."""
_READ_S = 0.02


@dataclass(frozen=True)
class EpuckListeners:
    """Receivers of the robot's data, called in the driver's thread."""

    odometry: Callable[[OdometryState], None]  # Receives every new state
    proximity: Callable[[int, NDArray[np.int64]], None]  # Receives stamps [ns] and raw values (8,)
    image: Callable[[CameraImage], None]  # Receives images


class EpuckDriver(RobotDriver[EpuckSession]):
    """Drives one robot in its own thread.

    Args:
        params: Parameters of the driver.
        listeners: Receivers of its data.
        clock: The time [ns]; may be simulated, and 0 means no time.
    """

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
