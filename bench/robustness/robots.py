"""Drivers of emulated robots in simulated time: whole drivers with their sessions, without threads and I/O.

The clock moves while a driver waits for bytes, pauses or sleeps, and everything that a robot sends passes a
`Wire` while it is corrupted.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from bench.robustness.wire import Wire
from swarm_loc_drivers.droplet.driver import OWN, DropletDriver, DropletListeners
from swarm_loc_drivers.droplet.hardware import DIRECTIONS
from swarm_loc_drivers.droplet.parameters import DropletParameters
from swarm_loc_drivers.epuck.driver import EpuckDriver, EpuckListeners
from swarm_loc_drivers.epuck.hardware import EPUCK1, EPUCK2
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_drivers.pushbot.driver import PushbotDriver, PushbotListeners
from swarm_loc_drivers.pushbot.parameters import PushbotParameters
from swarm_loc_drivers.pushbot.protocol import MAX_TICK_RATE, SECOND_FIRMWARE
from swarm_loc_drivers.sim.droplet.firmware import DropletFirmware
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.wifi_firmware import WifiFirmware
from swarm_loc_drivers.sim.pushbot.event_camera import Blinking
from swarm_loc_drivers.sim.pushbot.firmware import PushbotFirmware

_NS = 1_000_000_000
_STEP_S, _TICK_S = 0.005, 0.05
_EVENTS = 20  # Events of a PushBot in each millisecond


class Body:
    """Wheels, motors and sensors of any of the robots; `rates` are those of the wheels [1/s]."""

    robot_id = 0xDF64
    trims = tuple((20, -20, 5) for _ in DIRECTIONS)
    lengths = tuple(400 for _ in DIRECTIONS)

    def __init__(self) -> None:
        self.now_ns = 100 * _NS
        self.rates = (0.0, 0.0)
        self._steps = [700.0, 900.0]

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        self.now_ns += round(seconds * _NS)
        self._steps = [steps + seconds * rate for steps, rate in zip(self._steps, self.rates, strict=True)]

    def set_wheel_speeds(self, left: float, right: float) -> None:
        """See `EpuckBody`."""
        self.rates = left, right

    def set_duties(self, left: float, right: float) -> None:
        """See `PushbotBody`."""
        self.rates = MAX_TICK_RATE * left, MAX_TICK_RATE * right

    def move(self, direction: int | None) -> None:
        """See `DropletBody`."""
        self.rates = (0.0, 0.0) if direction is None else (1.0, 1.0)

    def wheel_steps(self) -> tuple[int, int]:
        """See `EpuckBody`."""
        return math.floor(self._steps[0]), math.floor(self._steps[1])

    wheel_ticks = wheel_steps

    def proximity(self) -> NDArray[np.int64]:
        """See `EpuckBody`."""
        return np.array([150, 110, 60, 70, 80, 60, 110, 2000])

    def image(self) -> None:
        """It has no camera."""

    def set_lights(self, laser: Blinking, rear: Blinking, front: Blinking) -> None:
        """It has no lights."""

    def infrared_status(self) -> int:
        """Nothing is heard."""
        return 0

    def send(self, line: str, target: int) -> None:
        """Nobody hears it."""

    def emit(self, power: int) -> None:
        """Nobody sees it."""

    def heard(self) -> Sequence[Any]:
        """Nothing is heard."""
        return ()

    def deaf_until_ns(self) -> int:
        """It always listens."""
        return 0


class Run:
    """A driver of a robot, in the simulated time of its body; `protocol` is a key of `PROTOCOLS`.

    It is a link and an event as well, of which the clock moves. `watch` is called whenever time has passed.
    """

    def __init__(self, protocol: str, watch: Callable[[], None]) -> None:
        self.body, self.wire, self.watch = Body(), None, watch
        self.hears_wrong = False  # Whether what the robot hears is corrupted, too
        self.firmware, self.driver = PROTOCOLS[protocol](self)
        self.received = 0  # Number of states of odometry
        self._pending = b""
        self._stopping = False

    wire: Wire | None

    @property
    def now_s(self) -> float:
        """The simulated time [s]."""
        return 1e-9 * self.body.now_ns

    def go(self) -> None:
        """Run the driver's thread until the driver is stopped.

        Raises:
            Exception: What ends the thread.
        """
        fakes: Mapping[str, Any] = {"_open": self.open, "_stopping": self, "_tick": self}
        fakes = {name: one for name, one in fakes.items() if hasattr(self.driver, name)}
        with (
            patch.multiple(self.driver, **fakes),
            patch.multiple(time, monotonic=lambda: self.now_s, sleep=self.advance),
        ):
            self.driver._run()  # noqa: SLF001 # its thread's function

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        end_ns = self.body.now_ns + max(round(seconds * _NS), 1_000)
        while self.body.now_ns < end_ns:
            step_s = min(_STEP_S, 1e-9 * (end_ns - self.body.now_ns))
            self.body.advance(step_s)
            self._run_board(step_s)
            sent = self.firmware.stream()
            self._pending += self.wire(sent) if self.wire else sent
            self.watch()

    def _run_board(self, step_s: float) -> None:
        """Run the board of a PushBot, whose camera sees noise."""
        if isinstance(self.firmware, PushbotFirmware):
            for _ in range(max(1, round(1e3 * step_s))):
                self.firmware.millisecond()
            end_us, count = self.body.now_ns // 1000, round(1e3 * _EVENTS * step_s)
            times = end_us + np.arange(1 - count, 1) * 1000 // _EVENTS
            words = (times * 2_654_435_761 & 0x7FFF).astype(np.uint16)
            self.firmware.see(words, times)

    def open(self) -> Run:
        """The link."""
        return self

    def read(self, timeout_s: float) -> bytes:
        """See `Link`."""
        end_s = self.now_s + timeout_s
        while True:
            self.advance(min(_STEP_S, max(0.0, end_s - self.now_s)))
            if self._pending or self.now_s >= end_s:
                data, self._pending = self._pending, b""
                return data

    def write(self, data: bytes) -> None:
        """See `Link`."""
        reply = self.firmware.receive(self.wire(data) if self.wire and self.hears_wrong else data)
        self._pending += self.wire(reply) if self.wire and reply else reply

    def close(self) -> None:
        """See `Link`."""
        self._pending = b""
        if isinstance(self.firmware, WifiFirmware):
            self.firmware.disconnect()

    def wait(self, timeout_s: float) -> bool:
        """See `Event`."""
        if not self._stopping:
            self.advance(min(timeout_s, _TICK_S))
        return self._stopping

    def set(self) -> None:
        """See `Event`."""

    def clear(self) -> None:
        """See `Event`."""

    def is_set(self) -> bool:
        """See `Event`."""
        return self._stopping

    def stop(self) -> None:
        """Begin to stop the driver."""
        self._stopping = True

    def drive(self, velocity: tuple[float, float, float]) -> None:
        """Command a velocity."""
        if isinstance(self.driver, DropletDriver):
            self.driver.set_velocity(OWN, velocity)
        else:
            self.driver.set_velocity(velocity)

    def note(self, *_: object) -> None:
        """Take a state of odometry."""
        self.received += 1


def _nothing(*_: object) -> None:
    """Receive data that does not matter."""


Emulated = tuple[Any, Any]


def _serial(run: Run) -> Emulated:
    listeners = EpuckListeners(run.note, _nothing, _nothing)
    driver = EpuckDriver(EpuckParameters("/dev/epuck", "epuck1"), listeners, lambda: run.body.now_ns)
    return SerialFirmware(run.body, EPUCK1), driver


def _serial2(run: Run) -> Emulated:
    listeners = EpuckListeners(run.note, _nothing, _nothing)
    driver = EpuckDriver(EpuckParameters("/dev/epuck"), listeners, lambda: run.body.now_ns)
    return SerialFirmware(run.body, EPUCK2), driver


def _wifi(run: Run) -> Emulated:
    listeners = EpuckListeners(run.note, _nothing, _nothing)
    driver = EpuckDriver(EpuckParameters("tcp://epuck"), listeners, lambda: run.body.now_ns)
    return WifiFirmware(run.body), driver


def _pushbot(run: Run) -> Emulated:
    listeners = PushbotListeners(run.note, _nothing)
    driver = PushbotDriver(PushbotParameters(address="/dev/pushbot"), listeners, lambda: run.body.now_ns)
    return PushbotFirmware(run.body, SECOND_FIRMWARE), driver


def _droplet(run: Run) -> Emulated:
    listeners = DropletListeners(run.note, _nothing)
    driver = DropletDriver(DropletParameters(address="/dev/droplet"), listeners, lambda: run.body.now_ns)
    return DropletFirmware(run.body), driver


PROTOCOLS: Mapping[str, Callable[[Run], Emulated]] = {
    "epuck_serial": _serial,
    "epuck2_serial": _serial2,
    "epuck2_wifi": _wifi,
    "pushbot": _pushbot,
    "droplet": _droplet,
}
"""Protocol -> its firmware and driver."""
