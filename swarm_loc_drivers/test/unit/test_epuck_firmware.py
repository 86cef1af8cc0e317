"""The emulated firmware answers bytes as the robots' documentation and sources say."""

import struct

import numpy as np
import pytest
from epuck_body import PROXIMITY, DrivenBody
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_drivers.epuck import serial_session
from swarm_loc_drivers.epuck import wifi_session as epuck_wifi
from swarm_loc_drivers.epuck.hardware import EPUCK1, EPUCK2, EpuckModel, decode_rgb565
from swarm_loc_drivers.sim.epuck.serial_firmware import SerialFirmware
from swarm_loc_drivers.sim.epuck.wifi_firmware import DELAY_NS, FAILED_EXCHANGE_NS, IMAGE_NS, WifiFirmware

MS = 1_000_000
SECOND = 1000 * MS
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
    assert len(firmware.receive(bytes.fromhex("AF B2 00"))) == 4 + 16


@MODELS
def test_answers_come_at_the_end_of_a_chain_in_the_order_of_the_requests(
    model: EpuckModel, body: DrivenBody
) -> None:
    firmware = SerialFirmware(body, model)
    request = serial_session.readings_request(300, -20, is_new=True)
    assert firmware.receive(request.data[:-1]) == b""
    reply = firmware.receive(request.data[-1:])
    assert reply == request.mark + struct.pack("<2h8H", 0, 0, *PROXIMITY) + request.mark
    assert body.rates == (model.rate(300), model.rate(-20))


@pytest.mark.parametrize(
    ("model", "command", "size"),
    [
        (EPUCK1, "BB", 4), (EPUCK1, "AF", 4), (EPUCK1, "B2", 16), (EPUCK1, "B7", 3203), (EPUCK1, "F8", 0),
        (EPUCK2, "BB", 4), (EPUCK2, "AF", 4), (EPUCK2, "B2", 16), (EPUCK2, "C8", 0), (EPUCK2, "B4 08 01", 0),
        (EPUCK2, "F6" + "00" * 12, 0), (EPUCK2, "F7" + "00" * 19, 0), (EPUCK2, "F1 01", 0),
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
        ("I\r", "i,1,40,40,8,3200\r\n"),
        ("J,1,10,20,4\r", "j\r\n"),
        ("\r\r\nE\r", "e,0,0\r\n"),
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
    assert len(firmware.receive(b"\xaf\xb7\x00")) > 4 + 3


def test_counters_wrap(clock: Clock) -> None:
    body = DrivenBody(clock, steps=(32700, -32700))
    firmware = SerialFirmware(body, EPUCK1)
    firmware.receive(b"D,100,-100\r")
    clock.now_ns += SECOND
    assert firmware.receive(b"\xaf\x00") == struct.pack("<2h", -32736, 32736)


@pytest.mark.parametrize(
    ("model", "setting", "taken"),
    [
        (EPUCK1, "J,1,48,36,8", "i,1,48,36,8,3456"),
        (EPUCK1, "J,1,47,37,8", "i,1,40,40,8,3200"),
        (EPUCK2, "J,1,47,44,8", "i,1,47,44,8,4136"),
        (EPUCK2, "J,1,48,44,8", "i,1,40,40,8,3200"),
    ],
)
def test_pictures_too_large_silently_become_the_default(
    model: EpuckModel, setting: str, taken: str, body: DrivenBody
) -> None:
    firmware = SerialFirmware(body, model)
    assert firmware.receive(f"{setting}\rI\r".encode()) == f"j\r\n{taken}\r\n".encode()


def test_a_lone_end_of_line_swallows_binary_commands(body: DrivenBody) -> None:
    firmware = SerialFirmware(body, EPUCK1)
    assert firmware.receive(b"\r" + serial_session.readings_request(1, 1, is_new=True).data) == b""
    assert firmware.receive(b"\r").startswith(b"z,")


@MODELS
@given(noise=st.binary(max_size=80).map(lambda noise: noise.replace(b"\xb7", b"")))  # two images are too many
def test_from_any_state_the_resynchronisation_leads_to_an_answer(model: EpuckModel, noise: bytes) -> None:
    firmware = SerialFirmware(DrivenBody(lambda: SECOND), model)
    firmware.receive(noise)
    reply = firmware.receive(serial_session.resync(5, -6))
    assert serial_session.speed_reply(5, -6).search(reply)
    request = serial_session.readings_request(3, 4, is_new=True)
    assert serial_session.ReplyParser(request).feed(firmware.receive(request.data)) is not None


def test_a_picture_is_the_middle_of_the_frame(body: DrivenBody) -> None:
    frame = np.zeros((960, 1280, 3), np.uint8)
    frame[320:640, 320:960] = (255, 0, 0)
    frame[:, 640:] //= 2
    body.frame = (frame, 5)
    firmware = SerialFirmware(body, EPUCK1)
    firmware.receive(b"J,1,40,20,8\r")
    request = serial_session.image_request(0, 0, 40, 20)
    parsed = serial_session.ReplyParser(request).feed(firmware.receive(request.data))
    assert parsed is not None
    pixels = serial_session.decode_image(parsed, 40, 20)
    assert pixels is not None
    picture = decode_rgb565(pixels, 40, 20)
    assert (picture[:, :20] == (255, 0, 0)).all()
    assert (picture[:, 20:] == (123, 0, 0)).all()


@pytest.mark.parametrize("zoom", [3, 8])
def test_an_epuck2_shows_a_zoom_that_it_lacks_as_four_and_says_nothing(body: DrivenBody, zoom: int) -> None:
    body.frame = (np.arange(480 * 640).reshape(480, 640).astype(np.uint8), 5)
    firmware = SerialFirmware(body, EPUCK2)
    assert firmware.receive(f"J,1,40,20,{zoom}\rI\r".encode()) == f"j\r\ni,1,40,20,{zoom},1600\r\n".encode()
    shown = firmware.receive(b"\xb7\x00")
    firmware.receive(b"J,1,40,20,4\r")
    assert firmware.receive(b"\xb7\x00") == shown


@pytest.mark.parametrize(("model", "width", "height"), [(EPUCK1, 41, 42), (EPUCK2, 48, 43)])
def test_an_image_that_fits_without_the_speeds_around_it_overruns_the_memory(
    model: EpuckModel, width: int, height: int, body: DrivenBody
) -> None:
    largest = SerialFirmware(body, model)
    largest.receive(f"J,1,{width},{height},4\r".encode())
    request = serial_session.image_request(0, 0, width, height)
    assert len(largest.receive(request.data)) == 2 * width * height + 11 <= model.answer_buffer
    assert model.largest_image == model.answer_buffer - 11
    beyond = SerialFirmware(body, model)
    beyond.receive(b"J,1,48,36,4\r" if model is EPUCK1 else b"J,1,47,44,4\r")
    assert beyond.receive(request.data) == b""
    assert beyond.receive(serial_session.resync(0, 0)) == b""


def command(left: int, right: int, *, camera: bool = False, sensors: bool = True) -> bytes:
    return epuck_wifi.Command(left, right, camera=camera, sensors=sensors).encode()


CYCLE_NS = 2 * DELAY_NS


class Client:
    """A robot with a WiFi firmware, and what this streams, read every millisecond."""

    def __init__(self, *, counts_right_backwards: bool = False) -> None:
        self.clock = Clock()
        self.body = DrivenBody(self.clock)
        self.firmware = WifiFirmware(self.body, counts_right_backwards=counts_right_backwards)
        self._parser = epuck_wifi.StreamParser()

    def command(self, left: int, right: int, *, camera: bool = False, sensors: bool = True) -> None:
        """Send a command."""
        self.firmware.receive(command(left, right, camera=camera, sensors=sensors))

    def read(self, duration_ns: int) -> list[epuck_wifi.Message]:
        """The messages of some time."""
        messages = []
        for _ in range(duration_ns // MS):
            self.clock.now_ns += MS
            if data := self.firmware.stream():
                messages += self._parser.feed(data, self.clock.now_ns)
        return messages


@pytest.fixture
def client() -> Client:
    return Client()


@pytest.mark.parametrize("first", [b"", bytes(21), bytes(20) + command(1, 1)])
def test_nothing_is_streamed_before_a_command_that_is_read_whole(client: Client, first: bytes) -> None:
    client.firmware.receive(first[:20])
    assert client.read(CYCLE_NS) == []
    client.firmware.receive(first[20:])
    assert client.read(CYCLE_NS) == []


def test_a_command_is_obeyed_when_the_values_before_it_have_been_fetched(client: Client) -> None:
    client.command(100, 200)
    (message,) = client.read(CYCLE_NS)
    assert message.id == epuck_wifi.SENSORS_ID
    assert client.body.rates == (100.0, 200.0)


def test_later_commands_are_not_checked_and_misalignment_persists(client: Client) -> None:
    client.command(0, 0)
    client.read(CYCLE_NS)
    client.firmware.receive(b"\x07" + command(100, 100) + command(100, 100))
    client.read(3 * CYCLE_NS)
    assert client.body.rates != (100.0, 100.0)


def test_of_too_many_commands_the_last_counts(client: Client) -> None:
    client.firmware.receive(b"".join(command(speed, speed) for speed in (0, 50, 60, 70, 80, 100)))
    client.read(CYCLE_NS)
    assert client.body.rates == (100.0, 100.0)


def test_without_camera_fifty_readings_a_second_come_each_a_cycle_old(client: Client) -> None:
    client.command(500, -500)
    messages = client.read(2 * SECOND)
    assert {message.id for message in messages} == {epuck_wifi.SENSORS_ID}
    assert 98 <= len(messages) <= 100
    counters = [int(message.sensors["left_counter"]) for message in messages]
    assert (
        counters[0] == counters[1] == 0
    )  # read when the robot was switched on, and when it was commanded to go
    assert np.diff(counters)[1:] == pytest.approx(10, abs=1)
    assert counters[-1] == pytest.approx(500 * (messages[-2].stamp_ns - messages[0].stamp_ns) / SECOND, abs=1)
    assert (messages[-1].sensors["proximity"] == PROXIMITY).all()


def test_with_camera_every_image_is_followed_by_one_reading_a_cycle_old(client: Client) -> None:
    client.command(500, -500, camera=True)
    messages = []
    for step in range(60):
        client.body.frame = (np.full((96, 128), step, np.uint8), client.clock.now_ns)
        messages += client.read(33 * MS)
    kinds = [message.id for message in messages]
    assert kinds[:20] == [epuck_wifi.IMAGE_ID, epuck_wifi.SENSORS_ID] * 10
    readings = [message for message in messages if message.id == epuck_wifi.SENSORS_ID]
    assert 10.0 <= len(readings) / 1.98 <= 12.0
    counters = [int(message.sensors["left_counter"]) for message in readings]
    assert counters[-1] == pytest.approx(500 * (readings[-2].stamp_ns - readings[0].stamp_ns) / SECOND, abs=1)


def test_an_image_is_sent_once_and_the_next_one_waited_for(client: Client) -> None:
    client.command(0, 0, camera=True)
    client.body.frame = (np.zeros((96, 128), np.uint8), 1)
    assert len(client.read(SECOND)) == 2
    client.body.frame = (np.zeros((96, 128), np.uint8), 2)
    assert len(client.read(2 * IMAGE_NS)) == 2


@pytest.mark.parametrize("blocked_ns", [200 * MS, SECOND])
def test_what_waited_while_sending_was_blocked_is_as_old_as_that(client: Client, blocked_ns: int) -> None:
    client.command(500, 500)
    before = client.read(SECOND)[-1]
    client.clock.now_ns += blocked_ns
    stale, fresh, *_ = client.read(2 * CYCLE_NS)
    gone = [int(message.sensors["left_counter"]) for message in (before, stale, fresh)]
    assert gone[1] - gone[0] == pytest.approx(10, abs=1)
    assert gone[2] - gone[1] == pytest.approx(500 * (blocked_ns + CYCLE_NS) / SECOND, abs=10)


def test_an_exchange_between_the_chips_that_fails_costs_a_second(client: Client) -> None:
    client.command(500, 500)
    client.read(SECOND)
    client.firmware.exchange_fails = True
    gaps_ns = np.diff([message.stamp_ns for message in client.read(2 * SECOND)])
    assert FAILED_EXCHANGE_NS <= gaps_ns.max() <= FAILED_EXCHANGE_NS + CYCLE_NS


def test_old_firmware_counts_the_right_wheel_backwards() -> None:
    client = Client(counts_right_backwards=True)
    client.command(500, 500)
    sensors = client.read(SECOND)[-1].sensors
    assert sensors["left_counter"] > 400
    assert sensors["right_counter"] == -sensors["left_counter"]


def test_both_streams_off_is_said(client: Client) -> None:
    client.command(-5, 7, sensors=False)
    assert {message.id for message in client.read(2 * CYCLE_NS)} == {epuck_wifi.NOTHING_ID}


def test_wheels_run_on_when_the_client_leaves(client: Client) -> None:
    client.command(100, 100)
    client.read(CYCLE_NS)
    client.firmware.disconnect()
    assert client.read(CYCLE_NS) == []
    assert client.body.rates == (100.0, 100.0)
