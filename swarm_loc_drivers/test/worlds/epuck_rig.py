"""What the driver's tests share: emulated robots in threads, a driver, and what it reports."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from background import Background
from epuck_body import GEOMETRY, DrivenBody
from numpy.typing import NDArray

from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.epuck.driver import EpuckDriver, EpuckListeners
from swarm_loc_drivers.epuck.hardware import EPUCK2, CameraImage, EpuckModel
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.wifi_firmware import WifiFirmware
from swarm_loc_drivers.sim.link_host import FirmwareHost
from swarm_loc_estimator.common import se2

PATIENCE_S = 60.0
TICK_S = 0.02
SQUARE = [leg for _ in range(4) for leg in ((0.1, 0.0, 0.06), (0.0, 3.0, 0.5 * math.pi))]
"""Speed [m/s], turn rate [rad/s], and how far to go [m or rad]."""

Item = TypeVar("Item")
Wrap = Callable[[Any], Any]  # Puts something between a firmware and its link


class Emulator:
    """An emulated robot in a thread, on a pseudo-terminal or behind a TCP port."""

    def __init__(self, body: DrivenBody, serve: Callable[[FirmwareHost], object]) -> None:
        self.body = body
        self._host = FirmwareHost()
        serve(self._host)
        self._background = Background(lambda: self._host.poll(0.002))

    def kill(self) -> None:
        """Switch it off."""
        self._background.end()
        self._host.close()


class Mute:
    """A firmware that says nothing."""

    def receive(self, _data: bytes) -> bytes:
        """See `ConsoleFirmware`."""
        return b""

    def stream(self) -> bytes:
        """See `ConsoleFirmware`."""
        return b""

    def disconnect(self) -> None:
        """See `StreamFirmware`."""


class Bench:
    """A driver and what it reports."""

    def __init__(self, params: EpuckParameters) -> None:
        self.states: list[OdometryState] = []
        self.images: list[CameraImage] = []
        self.proximity: list[NDArray[np.int64]] = []
        self.velocity = (0.0, 0.0)
        self._news = threading.Condition()
        listeners = EpuckListeners(
            self._keep(self.states), lambda _, raw: self.proximity.append(raw), self._keep(self.images)
        )
        self.driver = EpuckDriver(params, listeners, time.monotonic_ns)
        self._silent = threading.Event()

    def _keep(self, into: list[Item]) -> Callable[[Item], None]:
        def keep(item: Item) -> None:
            with self._news:
                into.append(item)
                self._news.notify_all()

        return keep

    def start(self) -> None:
        """Begin."""
        self.driver.start()
        self._ticker = Background(self._tick, TICK_S)

    def _tick(self) -> None:
        """Say the velocity again and again, as a controller does."""
        if self._silent.is_set():
            self.driver.tick()
        else:
            forward, turn_rate = self.velocity
            self.driver.set_velocity((forward, 0.0, turn_rate))

    def fall_silent(self) -> None:
        """No velocities any more; ticks go on."""
        self._silent.set()

    def until(self, condition: Callable[[], object]) -> None:
        """Wait until something is so, looking again at all new data."""
        with self._news:
            end_s = time.monotonic() + PATIENCE_S
            while not condition():
                self._news.wait(0.05)
                assert time.monotonic() < end_s, (self.driver.trouble, self.driver.counts)

    def until_count(self, items: Sequence[object], count: int) -> None:
        """Wait for this number."""
        self.until(lambda: len(items) >= count)

    def drive(self, legs: Sequence[tuple[float, float, float]]) -> None:
        """Drive legs by odometry, then stand."""
        self.until_count(self.states, 1)
        for speed, turn_rate, amount in legs:
            self.velocity = (speed, turn_rate)
            self._until_gone(self.states[-1].pose, amount, turning=bool(turn_rate))
        self.velocity = (0.0, 0.0)
        self.until(lambda: not any(state.twist.any() for state in self.states[-3:]))

    def _until_gone(self, start: NDArray[np.float64], amount: float, *, turning: bool) -> None:
        """Wait for a way [m] or a turn [rad]."""

        def gone() -> float:
            step = se2.between(start, self.states[-1].pose)
            return abs(float(step[2])) if turning else math.hypot(step[0], step[1])

        self.until(lambda: gone() >= amount)

    def stop(self) -> None:
        """End."""
        self._ticker.end()
        self.driver.stop()


def params_of(address: str, model: str = "epuck2") -> EpuckParameters:
    """A robot with the wheels of `DrivenBody`."""
    return EpuckParameters(
        address,
        model,
        reading_rate=50.0,
        reply_timeout_s=0.3,
        cmd_vel_timeout_s=0.3,
        wheel_separation=GEOMETRY.wheel_separation,
        wheel_noise=2e-4,
    )


def _as_is(firmware: Any) -> Any:
    return firmware


def fresh_body() -> DrivenBody:
    """One whose counters are about to wrap, each its own way."""
    return DrivenBody(time.monotonic_ns, steps=(32000, -32000))


class Robots:
    """Makes emulators and drivers, and ends them: each kind at the end of its stack."""

    def __init__(self, folder: Path, emulators: ExitStack, benches: ExitStack) -> None:
        self._device = folder / "epuck"
        self._emulators, self._benches = emulators, benches
        self._tcp_port = 0

    def serial(
        self, model: EpuckModel = EPUCK2, body: DrivenBody | None = None, wrap: Wrap = _as_is
    ) -> Emulator:
        """A robot on a serial port that always has the same name."""
        body = body or fresh_body()
        firmware = wrap(SerialFirmware(body, model))
        return self._kept(Emulator(body, lambda host: host.serve_pty(firmware, self._device)))

    def wifi(self, body: DrivenBody | None = None, wrap: Wrap = _as_is) -> Emulator:
        """A robot behind a TCP port, always the same."""
        body = body or fresh_body()
        firmware = wrap(WifiFirmware(body))

        def serve(host: FirmwareHost) -> None:
            self._tcp_port = host.serve_tcp(firmware, port=self._tcp_port)

        return self._kept(Emulator(body, serve))

    def _kept(self, emulator: Emulator) -> Emulator:
        self._emulators.callback(emulator.kill)
        return emulator

    @property
    def serial_address(self) -> str:
        """Where `serial` answers."""
        return str(self._device)

    @property
    def tcp_address(self) -> str:
        """Where `wifi` answers."""
        return f"tcp://127.0.0.1:{self._tcp_port}"

    def bench(self, params: EpuckParameters) -> Bench:
        """A driver at work."""
        bench = Bench(params)
        bench.start()
        self._benches.callback(bench.stop)
        return bench
