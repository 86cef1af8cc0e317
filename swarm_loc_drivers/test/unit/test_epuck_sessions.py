"""Conversations with e-pucks, bytes in and bytes out, by a clock that only the test moves."""

import math
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bad_wire import BadWire
from epuck_body import GEOMETRY, PROXIMITY
from epuck_rig import SQUARE, Mute, params_of
from epuck_wire import MS, SECOND, Wire
from numpy.typing import NDArray

from swarm_loc_drivers.common.robot_driver import SessionError
from swarm_loc_drivers.epuck import serial_session, wifi_session
from swarm_loc_drivers.epuck.hardware import EPUCK1, CameraImage, Reading
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.wifi_firmware import DELAY_NS, WifiFirmware

CYCLE_NS = 2 * DELAY_NS
EXPOSURE_PERIOD_NS = 66 * MS
WIFI = replace(params_of("tcp://robot"), reply_timeout_s=0.5)
SERIAL = params_of("/dev/robot", "epuck1")
IMAGES: dict[str, Any] = {
    "camera": True, "image_width": 32, "image_height": 24, "image_zoom": 8, "image_period_s": 0.05
}  # fmt: skip


def stamps_ns(found: list[Reading | CameraImage], kind: type) -> NDArray[np.int64]:
    return np.array([one.stamp_ns for one in found if isinstance(one, kind)])


@pytest.mark.parametrize("period_s", [0.02, 0.05, 0.1])
def test_of_a_stream_as_many_readings_are_used_as_wanted(period_s: float) -> None:
    wire = Wire(replace(WIFI, reading_rate=1.0 / period_s))
    wire.run(8.0)
    gaps_ns = np.diff(stamps_ns(wire.found, Reading))
    assert gaps_ns.size > 50
    assert abs(gaps_ns.mean() - period_s * 1e9) <= CYCLE_NS / gaps_ns.size
    assert np.abs(gaps_ns - period_s * 1e9).max() <= CYCLE_NS


def test_a_silent_robot_is_found_out_although_the_clock_has_jumped_back() -> None:
    wire = Wire(WIFI)
    wire.clock_ns = 1000 * SECOND
    wire.run(0.5)
    assert wire.session.connected
    wire.clock_ns, wire.is_blocked = 0, True
    wire.run(1.9)
    with pytest.raises(SessionError, match="silent for 2 s"):
        wire.run(0.2)


def test_a_port_where_nobody_speaks_the_language_is_told() -> None:
    with pytest.raises(SessionError, match="does not answer"):
        Wire(SERIAL, lambda _: Mute()).run(60.0)


def test_over_the_serial_port_every_tick_gives_a_reading_and_images_keep_their_period() -> None:
    wire = Wire(replace(SERIAL, **IMAGES))
    wire.body.frame = (np.full((480, 640), 96, np.uint8), 1)
    wire.run(2.1)
    readings, images = stamps_ns(wire.found, Reading), stamps_ns(wire.found, CameraImage)
    assert set(np.diff(readings)) == {20 * MS}
    assert readings.size > 100
    assert set(np.diff(images)) == {60 * MS}  # the first tick at which one is due
    first = next(one for one in wire.found if isinstance(one, CameraImage))
    assert first.pixels.shape == (24, 32, 3)
    assert np.abs(first.pixels.astype(int) - 96).max() <= 7


def assert_agrees_with_truth(wire: Wire, but_for: str = "") -> None:
    """Odometry is true but for the rounding of steps, at the end of eight legs, and there was no trouble."""
    position, heading = wire.error()
    assert position <= 20 * GEOMETRY.metres_per_step
    assert heading <= 2.1 * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation
    for trouble in ("missed_replies", "implausible_counters", "counter_restarts", "stray_bytes"):
        assert trouble == but_for or not wire.counts[trouble]


@pytest.mark.parametrize(
    "robot", [SERIAL, replace(SERIAL, model="epuck2"), WIFI], ids=["epuck1", "epuck2", "wifi"]
)
def test_a_square(robot: EpuckParameters) -> None:
    wire = Wire(robot)
    wire.drive(SQUARE)
    assert_agrees_with_truth(wire)
    reading = wire.found[-1]
    assert isinstance(reading, Reading)
    assert (reading.proximity == PROXIMITY).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_serial_wire_that_loses_bytes(seed: int) -> None:
    wire = Wire(
        replace(SERIAL, reply_timeout_s=0.1), lambda body: BadWire(SerialFirmware(body, EPUCK1), 0.004, seed)
    )
    wire.reconnects = True
    wire.drive(SQUARE[:4])
    assert wire.firmware.hurt > 5
    wire.firmware.share = 0.0
    wire.drive(SQUARE[4:5])
    assert wire.counts["missed_replies"] + wire.counts["stray_bytes"] > 0
    # counters that are not continuous were read wrong; else they also show motion that nobody asked for
    if not wire.counts["counter_restarts"]:
        position, heading = wire.error()
        assert position <= 0.02
        assert heading <= 4.2 * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation
    wire.firmware.share = 0.004
    wire.speeds = (500, 500)
    wire.run(0.5)
    wire.session.ending = True
    wire.run(5.0)
    assert wire.session.ended
    assert wire.body.rates == (0.0, 0.0)


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


@pytest.mark.parametrize("seed", range(4))
def test_a_stream_with_holes(seed: int) -> None:
    wire = Wire(replace(WIFI, camera=True), lambda body: HoledStream(WifiFirmware(body), seed))
    wire.reconnects = True
    frame = np.random.default_rng(seed).integers(0, 256, (120, 160, 3)).astype(np.uint8)
    wire.body.frame = (frame, None)
    wire.drive(SQUARE[:4])
    wire.firmware.whole = True
    wire.drive(SQUARE[4:5])
    assert wire.counts["stray_bytes"] > 0
    position, heading = wire.error()
    assert position <= 5e-3
    assert heading <= 2.1 * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation


def test_images_over_wifi_are_stamped_when_the_firmware_fetched_them() -> None:
    """When one is sent the next is fetched: taken within a period before, or the first one after."""
    wire = Wire(replace(WIFI, camera=True))
    exposures_ns = []
    for number in range(31):
        exposures_ns.append(wire.now_ns)
        wire.body.frame = (np.full((120, 160), 8 * number, np.uint8), wire.now_ns)
        wire.run(EXPOSURE_PERIOD_NS / SECOND)
    ages_ns = [
        image.stamp_ns - exposures_ns[image.pixels[0, 0, 0] // 8]
        for image in wire.found
        if isinstance(image, CameraImage)
    ]
    assert len(ages_ns) > 15
    assert np.abs(ages_ns).max() <= EXPOSURE_PERIOD_NS


@pytest.mark.parametrize("mode", ["waits", "is_under_way", "is_queued"])
@pytest.mark.parametrize("stall_s", [0.2, 0.4, 0.6, 0.8, 1.0])
def test_stalls_of_the_stream_cost_no_odometry(stall_s: float, mode: str) -> None:
    """A minute's drive in which the way to the computer is blocked every two to three seconds."""
    wire = Wire(replace(WIFI, camera=stall_s in {0.4, 0.8}, reading_rate=20.0))
    wire.body.frame = (np.zeros((120, 160), np.uint8), None)
    wire.run(0.5)
    rng = np.random.default_rng(round(10 * stall_s))
    while wire.now_ns < 60 * SECOND:
        left, right = rng.integers(200, 800, 2).tolist()
        wire.speeds = (left, right)
        wire.run(rng.uniform(1.0, 2.0))
        wire.stall(stall_s, mode)
        wire.run(rng.uniform(0.5, 1.0))
    wire.speeds = (0, 0)
    wire.run(1.0)
    errors = [wire.error()] if mode == "is_queued" else [wire.error(), wire.worst_error()]
    for position, heading in errors:
        assert position <= 0.005
        assert heading <= math.radians(2.0)
    assert not wire.counts["counter_restarts"]


def test_a_right_wheel_that_is_counted_backwards_is_found_out_told_and_corrected() -> None:
    wire = Wire(WIFI, lambda body: WifiFirmware(body, counts_right_backwards=True))
    wire.drive(SQUARE)
    assert_agrees_with_truth(wire, but_for="implausible_counters")
    assert wire.counts["reversed_counters"] == 1


def test_a_robot_that_hears_but_is_not_heard_stops_when_it_shall() -> None:
    wire = Wire(SERIAL)
    wire.reconnects = True
    wire.speeds = (500, 500)
    wire.run(1.0)
    assert wire.body.rates == (500.0, 500.0)
    wire.is_heard = False
    wire.run(0.2)
    wire.speeds = (0, 0)
    wire.run(1.0)
    assert wire.body.rates == (0.0, 0.0)


def test_speeds_are_commanded_when_they_change_and_no_more() -> None:
    wire = Wire(SERIAL)
    wire.speeds = (200, 200)
    wire.run(2.0)
    wire.speeds = (200, 190)
    wire.run(2.0)
    told = bytes([serial_session.code("D")])
    assert wire.sent.count(told) == 2
    assert all(wire.sent.count(told + struct.pack("<2h", 200, right)) == 1 for right in (200, 190))


@pytest.mark.parametrize("seed", range(4))
def test_a_message_that_looks_right_by_chance_is_no_sign_of_life(seed: int) -> None:
    """Among bytes that make no sense, one whole message comes within the time of silence."""
    wire = Wire(WIFI)
    wire.run(0.5)
    assert wire.session.connected
    rng = np.random.default_rng(seed)
    message = bytes([wifi_session.SENSORS_ID]) + bytes(wifi_session.SENSORS_DTYPE.itemsize)
    chance_ns = wire.now_ns + int(rng.integers(500, 1900)) * MS
    wire.firmware.stream = lambda: (
        message + bytes([wifi_session.NOTHING_ID]) if wire.now_ns == chance_ns else rng.bytes(20)
    )
    count = wire.counts["messages"]
    with pytest.raises(SessionError, match="made no sense"):
        wire.run(2.1)
    assert wire.counts["messages"] > count


def test_counters_that_jump_about_are_no_sign_of_life() -> None:
    """The replies are whole, as those of a shuffled line sometimes are, and say what no wheel can do."""
    wire = Wire(SERIAL)
    wire.run(0.5)
    assert wire.session.connected
    rng = np.random.default_rng(1)
    wire.body.wheel_steps = lambda: tuple(rng.integers(0, 1 << 16, 2).tolist())  # type: ignore[method-assign]
    with pytest.raises(SessionError, match="no sense"):
        wire.run(3.0)


def test_a_counter_that_jumps_once_costs_no_more_than_a_new_connection() -> None:
    wire = Wire(SERIAL)
    wire.reconnects = True
    wire.run(0.5)
    steps = wire.body.wheel_steps
    wire.body.wheel_steps = lambda: tuple(one + 9000 for one in steps())  # type: ignore[method-assign,assignment,return-value]
    wire.run(6.0)
    count = len(wire.states)
    wire.run(3.0)
    assert wire.session.connected
    assert len(wire.states) >= count + 140
