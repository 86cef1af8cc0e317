"""The driver against emulated robots over real pseudo-terminals and sockets, also bad ones."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from epuck_bench import PATIENCE_S, SQUARE, Bench, Robots, settings
from epuck_body import GEOMETRY, PROXIMITY, DrivenBody

from swarm_loc_drivers.core.epuck_serial_session import SerialCamera
from swarm_loc_drivers.protocols.epuck import EPUCK1, EPUCK2, EpuckModel
from swarm_loc_drivers.sim.firmware.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.firmware.wifi_firmware import WifiFirmware
from swarm_loc_estimator.core import se2


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Robots]:
    with ExitStack() as stack:
        yield Robots(tmp_path, stack)


def assert_agrees_with_truth(bench: Bench, body: DrivenBody) -> None:
    """Odometry is true but for the rounding of steps, at the end of eight legs."""
    start = bench.states[0].pose
    assert not start.any()
    error = se2.between(body.pose, bench.states[-1].pose)
    step = GEOMETRY.metres_per_step
    assert math.hypot(error[0], error[1]) <= 20 * step
    assert abs(error[2]) <= 2.1 * step / GEOMETRY.wheel_separation


@pytest.mark.parametrize("model", [EPUCK1, EPUCK2], ids=lambda model: model.name)
def test_a_square_over_the_serial_port(robots: Robots, model: EpuckModel) -> None:
    emulator = robots.serial(model)
    patient = replace(settings(robots.serial_address, model), reply_timeout_s=PATIENCE_S)
    bench = robots.bench(patient)
    bench.drive(SQUARE)
    assert_agrees_with_truth(bench, emulator.body)
    assert (bench.proximity[-1] == PROXIMITY).all()
    counts = bench.driver.counts
    assert counts["exchanges"] > 100
    assert not counts["missed_replies"]
    assert not counts["implausible_counters"]
    assert bench.driver.trouble == ""


def test_a_square_over_wifi(robots: Robots) -> None:
    emulator = robots.wifi()
    bench = robots.bench(settings(robots.tcp_address, EPUCK2))
    bench.drive(SQUARE)
    assert_agrees_with_truth(bench, emulator.body)
    assert (bench.proximity[-1] == PROXIMITY).all()
    assert not bench.driver.counts["stray_bytes"]
    assert not bench.driver.counts["implausible_counters"]


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_the_robot_stands_when_the_driver_has_ended(robots: Robots, over: str) -> None:
    emulator = robots.serial() if over == "serial" else robots.wifi()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(settings(address, EPUCK2))
    bench.velocity = (0.06, 0.5)
    bench.until(lambda: any(emulator.body.rates))
    bench.driver.stop()
    assert emulator.body.rates == (0.0, 0.0)


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_the_robot_stands_when_velocities_stop_coming(robots: Robots, over: str) -> None:
    emulator = robots.serial(EPUCK1) if over == "serial" else robots.wifi()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(settings(address, EPUCK1 if over == "serial" else EPUCK2))
    bench.velocity = (0.06, 0.0)
    bench.until(lambda: any(emulator.body.rates))
    bench.fall_silent()
    bench.until(lambda: not any(emulator.body.rates))
    assert bench.driver.counts["stale_cmd_vel"] >= 1  # more where the machine paused before, too


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_a_robot_switched_off_and_on_is_found_again(robots: Robots, over: str) -> None:
    start = robots.serial if over == "serial" else robots.wifi
    emulator = start()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(settings(address, EPUCK2))
    bench.drive(SQUARE[:1])
    emulator.kill()
    bench.until(lambda: bench.driver.trouble)
    before = bench.states[-1]

    again = start()  # its counters and its place in the world begin at zero
    bench.until(lambda: not bench.driver.trouble)
    bench.until(lambda: bench.states[-1].stamp_ns > before.stamp_ns)
    found = bench.states[-1].pose
    origin = again.body.pose
    bench.drive(SQUARE[1:3])
    driven, true = se2.between(found, bench.states[-1].pose), se2.between(origin, again.body.pose)
    assert driven == pytest.approx(true, abs=5e-3)
    assert bench.driver.counts["connections"] == 2
    assert bench.driver.counts["link_failures"] >= 1


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_a_cut_link_costs_no_odometry_of_a_robot_that_runs_on(robots: Robots, over: str) -> None:
    start = robots.serial if over == "serial" else robots.wifi
    emulator = start()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(settings(address, EPUCK2))
    bench.velocity = (0.06, 0.4)
    bench.until(lambda: any(emulator.body.rates) and len(bench.states) > 10)
    emulator.kill()
    bench.until(lambda: bench.driver.trouble)
    start(body=emulator.body)
    bench.until(lambda: not bench.driver.trouble)
    bench.drive(SQUARE[:1])
    error = se2.between(emulator.body.pose, bench.states[-1].pose)
    assert math.hypot(error[0], error[1]) <= 5e-3
    assert abs(error[2]) <= 2.1 * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation
    assert not bench.driver.counts["counter_restarts"]


class Lossy:
    """A firmware at the end of a wire that loses and twists bytes in both directions."""

    def __init__(self, firmware: SerialFirmware, share: float, seed: int) -> None:
        self._firmware = firmware
        self.stream = firmware.stream
        self._rng = np.random.default_rng(seed)
        self.share = share
        self.hurt = 0

    def receive(self, data: bytes) -> bytes:
        """Bytes over the bad wire and back."""
        return self._worn(self._firmware.receive(self._worn(data)))

    def _worn(self, data: bytes) -> bytes:
        array = np.frombuffer(data, np.uint8).copy()
        hit = self._rng.random(len(array)) < self.share
        lost = hit & (self._rng.random(len(array)) < 0.7)
        array[hit] = self._rng.integers(0, 256, hit.sum())
        self.hurt += int(hit.sum())
        kept: bytes = array[~lost].tobytes()
        return kept


@pytest.mark.parametrize("seed", range(2))
def test_a_serial_wire_that_loses_bytes(robots: Robots, seed: int) -> None:
    wires: list[Lossy] = []

    def lossy(firmware: SerialFirmware) -> Lossy:
        wires.append(Lossy(firmware, 0.004, seed))
        return wires[0]

    emulator = robots.serial(EPUCK1, wrap=lossy)
    bench = robots.bench(replace(settings(robots.serial_address, EPUCK1), reply_timeout_s=0.1))
    bench.drive(SQUARE[:4])
    wires[0].share = 0.0
    bench.drive(SQUARE[4:5])
    error = se2.between(emulator.body.pose, bench.states[-1].pose)
    counts = bench.driver.counts
    assert wires[0].hurt > 5
    assert counts["missed_replies"] + counts["stray_bytes"] > 0
    # a twisted command may preset the counters; else they tell also of motion that nobody asked for
    if not counts["counter_restarts"]:
        assert math.hypot(error[0], error[1]) <= 0.02
        assert abs(error[2]) <= 4.2 * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation
    bench.driver.stop()
    assert emulator.body.rates == (0.0, 0.0)


class HoledStream:
    """A WiFi firmware whose stream loses pieces and gets foreign bytes."""

    def __init__(self, firmware: WifiFirmware, seed: int) -> None:
        self._firmware = firmware
        self._rng = np.random.default_rng(seed)
        self.receive = firmware.receive
        self.disconnect = firmware.disconnect
        self.whole = False

    def stream(self) -> bytes:
        """What comes, sometimes with a hole or a patch."""
        data = self._firmware.stream()
        if self.whole or not data or self._rng.random() > 0.05:
            return data
        begin, end = sorted(self._rng.integers(0, len(data) + 1, 2))
        return data[:begin] + self._rng.bytes(int(self._rng.integers(0, 40))) + data[end:]


@pytest.mark.parametrize("seed", range(2))
def test_a_stream_with_holes(robots: Robots, seed: int) -> None:
    holed: list[HoledStream] = []

    def wrapped(firmware: WifiFirmware) -> HoledStream:
        holed.append(HoledStream(firmware, seed))
        return holed[0]

    emulator = robots.wifi(wrap=wrapped)
    camera = SerialCamera(160, 120, 4, 0.1)
    rng = np.random.default_rng(seed)
    frame = rng.integers(0, 256, (120, 160, 3)).astype(np.uint8)
    emulator.body.frame = (frame, 1)
    bench = robots.bench(settings(robots.tcp_address, EPUCK2, camera))
    bench.drive(SQUARE[:4])
    holed[0].whole = True
    bench.drive(SQUARE[4:5])
    assert bench.driver.counts["stray_bytes"] > 0
    error = se2.between(emulator.body.pose, bench.states[-1].pose)
    assert math.hypot(error[0], error[1]) <= 5e-3
    assert abs(error[2]) <= 2.1 * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation


def test_pictures_over_wifi(robots: Robots) -> None:
    emulator = robots.wifi()
    rows, columns = np.mgrid[:120, :160]
    frame = np.stack([rows, columns, rows + columns], axis=-1).astype(np.uint8)
    bench = robots.bench(settings(robots.tcp_address, EPUCK2, SerialCamera(160, 120, 4, 0.1)))
    bench.until(lambda: bench.states)
    for exposure in range(3):
        emulator.body.frame = (frame, exposure)
        bench.until_count(bench.photos, exposure + 1)
    assert len(bench.photos) == 3
    for photo in bench.photos:
        assert np.abs(photo.pixels.astype(int) - frame).max() <= 7
        assert 0 <= time.monotonic_ns() - photo.stamp_ns < PATIENCE_S * 1e9


def test_pictures_over_the_serial_port(robots: Robots) -> None:
    emulator = robots.serial(EPUCK1)
    frame = np.full((480, 640), 96, np.uint8)
    emulator.body.frame = (frame, 1)
    camera = SerialCamera(32, 24, 8, 0.05)
    bench = robots.bench(settings(robots.serial_address, EPUCK1, camera))
    bench.until(lambda: len(bench.photos) >= 3)
    assert bench.photos[0].pixels.shape == (24, 32, 3)
    assert np.abs(bench.photos[0].pixels.astype(int) - 96).max() <= 7


def test_a_port_that_is_not_there_is_named_and_waited_for(robots: Robots) -> None:
    bench = robots.bench(settings(robots.serial_address, EPUCK1))
    bench.until(lambda: bench.driver.counts["link_failures"] >= 2)
    assert robots.serial_address.device in bench.driver.trouble
    robots.serial(EPUCK1)
    bench.until(lambda: bench.states)
    assert bench.driver.trouble == ""


def test_a_port_where_nobody_speaks_the_language_is_told(robots: Robots) -> None:
    class Mute:
        def receive(self, _: bytes) -> bytes:
            return b""

        def stream(self) -> bytes:
            return b""

    robots.serial(EPUCK1, wrap=lambda _: Mute())
    quick = replace(settings(robots.serial_address, EPUCK1), reply_timeout_s=0.02)
    bench = robots.bench(quick)
    bench.until(lambda: "does not answer" in bench.driver.trouble)


def test_stopping_while_the_link_is_down_still_stops_the_robot(robots: Robots) -> None:
    emulator = robots.wifi()
    bench = robots.bench(settings(robots.tcp_address, EPUCK2))
    bench.velocity = (0.06, 0.0)
    bench.until(lambda: any(emulator.body.rates))
    emulator.kill()
    bench.until(lambda: bench.driver.trouble)
    ending = threading.Thread(target=bench.driver.stop)
    ending.start()
    robots.wifi(body=emulator.body)
    ending.join(PATIENCE_S)
    assert emulator.body.rates == (0.0, 0.0)
