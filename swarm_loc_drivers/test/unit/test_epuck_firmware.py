"""The emulated firmware answers bytes as the robots' documentation and sources say."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from epuck_body import PROXIMITY, DrivenBody
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_drivers.protocols import epuck_serial, epuck_wifi
from swarm_loc_drivers.protocols.epuck import EPUCK1, EPUCK2, EpuckModel
from swarm_loc_drivers.protocols.rgb565 import decode_rgb565
from swarm_loc_drivers.sim.firmware.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.firmware.wifi_firmware import CYCLE_NS, WifiFirmware

SECOND = 1_000_000_000
MODELS = pytest.mark.parametrize("model", [EPUCK1, EPUCK2], ids=lambda model: model.name)


class Clock:
    """A time that tests set."""

    def __init__(self) -> None:
        self.now_ns = SECOND

    def __call__(self) -> int:
        """The time [ns]."""
        return self.now_ns


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def body(clock: Clock) -> DrivenBody:
    return DrivenBody(clock)


def test_the_documented_examples(body: DrivenBody) -> None:
    firmware = SerialFirmware(body, EPUCK1)
    assert firmware.receive(bytes.fromhex("442C3230302C2D3230300D")) == bytes.fromhex("640D0A")
    assert body.rates == (200.0, -200.0)
    assert firmware.receive(bytes.fromhex("BC 00 00 00 00 00")) == b""
    assert firmware.receive(bytes.fromhex("BC C8 00 38 FF 00")) == b""
    assert body.rates == (200.0, -200.0)
    assert len(firmware.receive(bytes.fromhex("AF 9F 00"))) == 4 + 6


@MODELS
def test_answers_come_at_the_end_of_a_chain_in_the_order_of_the_requests(
    model: EpuckModel, body: DrivenBody
) -> None:
    firmware = SerialFirmware(body, model)
    request = epuck_serial.readings_request(300, -20)
    assert firmware.receive(request.data[:-1]) == b""
    reply = firmware.receive(request.data[-1:])
    assert reply == request.mark + struct.pack("<2h8H", 0, 0, *PROXIMITY) + request.mark
    assert body.rates == (model.rate(300), model.rate(-20))


@pytest.mark.parametrize(
    ("model", "command", "size"),
    [
        (EPUCK1, "BB", 4), (EPUCK1, "AF", 4), (EPUCK1, "9F", 6), (EPUCK1, "BF", 12), (EPUCK1, "99", 6),
        (EPUCK1, "B2", 16), (EPUCK1, "B1", 16), (EPUCK1, "B3", 10), (EPUCK1, "8C", 1), (EPUCK1, "8B", 6),
        (EPUCK1, "9E", 2), (EPUCK1, "B7", 3203), (EPUCK1, "AB", 601), (EPUCK1, "F8", 0),
        (EPUCK2, "B3", 8), (EPUCK2, "AB", 0), (EPUCK2, "F8", 103), (EPUCK2, "F5", 1), (EPUCK2, "F4", 8),
        (EPUCK2, "F3", 2), (EPUCK2, "F2", 1), (EPUCK2, "F1 01", 1), (EPUCK2, "F0 00", 1),
        (EPUCK2, "EF 01", 1), (EPUCK2, "C8", 0),
        (EPUCK2, "F6" + "00" * 12, 0), (EPUCK2, "F7" + "00" * 19, 0), (EPUCK2, "B4 08 01", 0),
    ],
)  # fmt: skip
def test_payloads_have_the_documented_sizes(
    model: EpuckModel, command: str, size: int, body: DrivenBody
) -> None:
    firmware = SerialFirmware(body, model)
    assert len(firmware.receive(bytes.fromhex(command) + b"\x00")) == size
    assert firmware.receive(b"E\r") == b"e,0,0\r\n"


@MODELS
@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("D,7,-8\r", "d\r\n"),
        ("d,7,-8\n", "d\r\n"),
        ("e\r", "e,0,0\r\n"),
        ("P,5,6\r", "p\r\n"),
        ("Q\r", "q,0,0\r\n"),
        ("N\r", "n," + ",".join(map(str, PROXIMITY)) + "\r\n"),
        ("I\r", "i,1,40,40,8,3200\r\n"),
        ("J,1,10,20,4\r", "j\r\n"),
        ("\r\r\nS\r", "s\r\n"),
        ("t\r", "t\r\n"),
        ("x\r", "z,Command not found\r\n"),
    ],
)
def test_lines_are_answered(model: EpuckModel, line: str, answer: str, body: DrivenBody) -> None:
    assert SerialFirmware(body, model).receive(line.encode()).decode() == answer


@MODELS
@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("D,40000,-40000", (-25536, 25536)),
        ("D,99999999999999999999,0", (-1, 0)),
        (f"D,{'9' * 5000},1", None),
        ("P,99999999999999999999,0", (0, 0)),
        ("J,300,10,10,1", (0, 0)),
        ("J,-1,99999999999999999999,1,1", (0, 0)),
        ("J,1,10,10,99999999999", (0, 0)),
    ],
)
def test_numbers_that_do_not_fit_wrap_and_stop_nothing(
    model: EpuckModel, line: str, told: tuple[int, int] | None, body: DrivenBody
) -> None:
    firmware = SerialFirmware(body, model)
    firmware.receive(f"{line}\r".encode())
    speeds = firmware.receive(b"\xbb\x00")
    left, right = struct.unpack("<2h", speeds)
    assert told in (None, (left, right))
    assert firmware.receive(b"E\r") == f"e,{left},{right}\r\n".encode()
    assert len(firmware.receive(b"\xb1\xb7\x00")) > 4 + 3


def test_counters_can_be_preset_and_wrap(body: DrivenBody, clock: Clock) -> None:
    first, second = SerialFirmware(body, EPUCK1), SerialFirmware(body, EPUCK2)
    for firmware in (first, second):
        firmware.receive(b"P,32700,-32700\r")
    first.receive(b"D,100,-100\r")
    clock.now_ns += SECOND
    assert first.receive(b"Q\r") == b"q,-32736,32736\r\n"
    assert second.receive(b"Q\r") == b"q,32800,-32800\r\n"
    assert second.receive(b"\xaf\x00") == struct.pack("<2h", -32736, 32736)


@pytest.mark.parametrize(
    ("model", "setting", "taken"),
    [
        (EPUCK1, "J,1,48,36,8", "i,1,48,36,8,3456"),
        (EPUCK1, "J,1,47,37,8", "i,1,40,40,8,3200"),
        (EPUCK1, "J,0,60,57,4", "i,0,60,57,4,3420"),
        (EPUCK2, "J,1,47,44,8", "i,1,47,44,8,4136"),
        (EPUCK2, "J,1,48,44,8", "i,1,40,40,8,3200"),
    ],
)
def test_pictures_too_large_silently_become_the_default(
    model: EpuckModel, setting: str, taken: str, body: DrivenBody
) -> None:
    firmware = SerialFirmware(body, model)
    assert firmware.receive(f"{setting}\rI\r".encode()) == f"j\r\n{taken}\r\n".encode()


def test_only_the_first_generation_resets(body: DrivenBody, clock: Clock) -> None:
    first, second = SerialFirmware(body, EPUCK1), SerialFirmware(body, EPUCK2)
    for firmware in (first, second):
        firmware.receive(b"D,100,100\r")
    clock.now_ns += SECOND
    assert second.receive(b"R\r") == b""
    assert body.rates == (100.0, 100.0)
    assert first.receive(b"R\r").startswith(b"r\r\n\f\aWELCOME")
    assert body.rates == (0.0, 0.0)
    assert first.receive(b"Q\r") == b"q,0,0\r\n"


def test_a_lone_end_of_line_swallows_binary_commands(body: DrivenBody) -> None:
    firmware = SerialFirmware(body, EPUCK1)
    assert firmware.receive(b"\r" + epuck_serial.readings_request(1, 1).data) == b""
    assert firmware.receive(b"\r").startswith(b"z,")


@MODELS
@given(noise=st.binary(max_size=80))
def test_from_any_state_the_resynchronisation_leads_to_an_answer(model: EpuckModel, noise: bytes) -> None:
    firmware = SerialFirmware(DrivenBody(lambda: SECOND), model)
    firmware.receive(noise)
    reply = firmware.receive(epuck_serial.RESYNC)
    assert epuck_serial.ASCII_SPEED_REPLY.search(reply)
    request = epuck_serial.readings_request(3, 4)
    assert epuck_serial.ReplyParser(request).feed(firmware.receive(request.data)) is not None


def test_a_picture_is_the_middle_of_the_frame(body: DrivenBody) -> None:
    frame = np.zeros((960, 1280, 3), np.uint8)
    frame[320:640, 320:960] = (255, 0, 0)
    frame[:, 640:] //= 2
    body.frame = (frame, 5)
    firmware = SerialFirmware(body, EPUCK2)
    firmware.receive(b"J,1,40,20,8\r")
    request = epuck_serial.image_request(0, 0, 40, 20)
    parsed = epuck_serial.ReplyParser(request).feed(firmware.receive(request.data))
    assert parsed is not None
    pixels = epuck_serial.decode_image(parsed, 40, 20)
    assert pixels is not None
    picture = decode_rgb565(pixels, 40, 20)
    assert (picture[:, :20] == (255, 0, 0)).all()
    assert (picture[:, 20:] == (123, 0, 0)).all()


def command(left: int, right: int, *, camera: bool = False, sensors: bool = True) -> bytes:
    return epuck_wifi.Command(left, right, camera=camera, sensors=sensors).encode()


def test_nothing_is_streamed_before_a_valid_command(body: DrivenBody, clock: Clock) -> None:
    firmware = WifiFirmware(body)
    for data in (b"", bytes(21), command(1, 1)[:20]):
        firmware.receive(data)
        clock.now_ns += CYCLE_NS
        assert firmware.stream() == b""
    firmware.receive(command(100, 200))
    clock.now_ns += CYCLE_NS
    assert len(firmware.stream()) == 105
    assert body.rates == (100.0, 200.0)


def test_later_commands_are_not_checked_and_misalignment_persists(body: DrivenBody) -> None:
    firmware = WifiFirmware(body)
    firmware.receive(command(0, 0))
    firmware.receive(b"\x07" + command(100, 100))
    firmware.receive(command(100, 100))
    assert body.rates != (100.0, 100.0)


def test_of_too_many_commands_the_last_counts(body: DrivenBody) -> None:
    firmware = WifiFirmware(body)
    firmware.receive(command(0, 0))
    firmware.receive(b"".join(command(speed, speed) for speed in (50, 60, 70, 80, 100)))
    assert body.rates == (100.0, 100.0)


def test_the_stream_keeps_its_cycle_and_sends_every_frame_once(body: DrivenBody, clock: Clock) -> None:
    firmware = WifiFirmware(body)
    firmware.receive(command(500, -500, camera=True))
    parser = epuck_wifi.StreamParser()
    messages = []
    for step in range(200):
        clock.now_ns += 4_000_000
        if step % 33 == 0:
            body.frame = (np.full((96, 128), step, np.uint8), clock.now_ns)
        messages += parser.feed(firmware.stream(), clock.now_ns)
    kinds = [message.id for message in messages]
    assert kinds.count(epuck_wifi.SENSORS_ID) == 1 + 200 * 4 // 16
    assert kinds.count(epuck_wifi.IMAGE_ID) == 7
    counters = [int(m.sensors["left_counter"]) for m in messages if m.id == epuck_wifi.SENSORS_ID]
    assert np.diff(counters)[1:] == pytest.approx(8, abs=1)
    assert (messages[-1].sensors["proximity"] == PROXIMITY).all()


def test_both_streams_off_is_said_and_counters_can_be_preset(body: DrivenBody, clock: Clock) -> None:
    firmware = WifiFirmware(body)
    preset = bytearray(command(-5, 7, sensors=False))
    preset[2] = 4
    firmware.receive(bytes(preset))
    clock.now_ns += CYCLE_NS
    assert firmware.stream() == bytes([epuck_wifi.NOTHING_ID])
    assert body.rates == (0.0, 0.0)
    firmware.receive(command(0, 0))
    clock.now_ns += CYCLE_NS
    (message,) = epuck_wifi.StreamParser().feed(firmware.stream(), 0)
    assert (message.sensors["left_counter"], message.sensors["right_counter"]) == (-5, 7)


def test_wheels_run_on_when_the_client_leaves(body: DrivenBody, clock: Clock) -> None:
    firmware = WifiFirmware(body)
    firmware.receive(command(100, 100))
    firmware.disconnect()
    clock.now_ns += CYCLE_NS
    assert firmware.stream() == b""
    assert body.rates == (100.0, 100.0)
