"""The e-pucks' bytes: as documented, in pieces of any size, and with garbage between them."""

import functools
import itertools
import math
import struct
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from swarm_loc_drivers.epuck import serial_session
from swarm_loc_drivers.epuck import wifi_session as epuck_wifi
from swarm_loc_drivers.epuck.hardware import (
    EPUCK1,
    EPUCK2,
    MAX_RANGE_M,
    PROXIMITY_BEARINGS,
    EpuckModel,
    as_counter,
    decode_rgb565,
    encode_rgb565,
    range_of_raw,
    raw_of_distance,
    unwrapped_difference,
)
from swarm_loc_drivers.epuck.wifi_session import SENSORS_DTYPE, Command, StreamParser, plausible

MODELS = pytest.mark.parametrize("model", [EPUCK1, EPUCK2], ids=lambda model: model.name)
SPEED = st.integers(-1100, 1100)


@pytest.mark.parametrize(
    ("model", "command", "rate"),
    [
        (EPUCK1, 300, 10000 / 33),
        (EPUCK1, 600, 625.0),
        (EPUCK1, 700, 10000 / 14),
        (EPUCK1, -900, -10000 / 11),
        (EPUCK1, 5000, 1000.0),
        (EPUCK2, 600, 100000 / 83 / 2),
        (EPUCK2, 1100, 100000 / 45 / 2),
        (EPUCK2, -2000, -100000 / 45 / 2),
        (EPUCK2, 0, 0.0),
    ],
)
def test_true_rates_are_those_of_the_firmware(model: EpuckModel, command: int, rate: float) -> None:
    assert model.rate(command) == pytest.approx(rate, rel=1e-12)


@MODELS
@given(rate=st.floats(-1500.0, 1500.0))
def test_no_command_comes_closer_to_a_wanted_rate(model: EpuckModel, rate: float) -> None:
    command = model.command_for(rate)
    best = np.abs(_rates(model) - rate).min()

    assert abs(command) <= model.max_command
    assert abs(model.rate(command) - rate) == pytest.approx(best, abs=1e-9)


@functools.cache
def _rates(model: EpuckModel) -> NDArray[np.float64]:
    """All that a command can make."""
    return np.array([model.rate(command) for command in range(-1200, 1201)])


@given(
    start=st.integers(-(10**6), 10**6), steps=st.integers(-(10**6), 10**6), error=st.integers(-32000, 32000)
)
def test_counters_are_unwrapped_as_long_as_the_expectation_is_no_half_span_off(
    start: int, steps: int, error: int
) -> None:
    assert unwrapped_difference(as_counter(start), as_counter(start + steps), steps + error) == steps


def test_counters_are_signed_words() -> None:
    assert [as_counter(n) for n in (32767, 32768, -32768, -32769, 65536)] == [32767, -32768, -32768, 32767, 0]


def test_bearings_run_clockwise_from_the_front() -> None:
    degrees = np.rad2deg(PROXIMITY_BEARINGS)
    assert degrees == pytest.approx([-17, -46, -90, -151, 151, 90, 46, 17])


@given(distance=st.floats(0.005, MAX_RANGE_M - 1e-4))
def test_proximity_is_read_as_it_is_made(distance: float) -> None:
    assert float(range_of_raw(raw_of_distance(distance))) == pytest.approx(distance, abs=1e-9)


def test_proximity_out_of_range_is_infinite() -> None:
    assert range_of_raw([60.0, 4095.0]).tolist() == [math.inf, -math.inf]


def test_pixels_are_big_endian_and_keep_full_scale() -> None:
    picture = decode_rgb565(bytes.fromhex("F80007E0001FFFFF"), 2, 2)
    assert picture.tolist() == [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]]
    assert encode_rgb565(picture) == bytes.fromhex("F80007E0001FFFFF")


@given(data=st.binary(min_size=2 * 12, max_size=2 * 12))
def test_pixels_survive_decoding(data: bytes) -> None:
    assert encode_rgb565(decode_rgb565(data, 4, 3)) == data


def test_a_request_sets_the_speeds_and_is_framed_by_them() -> None:
    request = serial_session.readings_request(200, -200, is_new=True)
    assert request.data.hex(" ").upper() == "BC C8 00 38 FF BB AF B2 BB 00"
    assert request.mark == struct.pack("<2h", 200, -200)
    assert serial_session.image_request(0, 0, 40, 40).data.hex(" ").upper() == "BB B7 BB 00"


def test_a_picture_of_another_size_or_mode_is_refused() -> None:
    assert serial_session.decode_image(bytes([1, 2, 1]) + b"abcd", 2, 1) == b"abcd"
    assert serial_session.decode_image(bytes([0, 2, 1]) + b"abcd", 2, 1) is None
    assert serial_session.decode_image(bytes([1, 40, 40]) + b"abcd", 2, 1) is None


def cut(data: bytes, places: Iterable[int]) -> list[bytes]:
    """The bytes in pieces."""
    ends = sorted({0, len(data), *(place % len(data) for place in places)})
    return [data[begin:end] for begin, end in itertools.pairwise(ends)]


CUTS = st.lists(st.integers(0, 10**6), max_size=12)


@given(
    left=SPEED,
    right=SPEED,
    body=st.binary(min_size=20, max_size=20),
    garbage=st.binary(max_size=60),
    cuts=CUTS,
)
def test_a_reply_is_found_behind_garbage_in_any_pieces(
    left: int, right: int, body: bytes, garbage: bytes, cuts: list[int]
) -> None:
    request = serial_session.readings_request(left, right, is_new=True)
    frame = request.mark + body + request.mark
    if (garbage + frame).find(request.mark) != len(garbage):
        return  # the garbage itself looks like a mark
    parser = serial_session.ReplyParser(request)
    found = [parser.feed(piece) for piece in cut(garbage + frame, cuts)]

    assert found[-1] == body
    assert set(found[:-1]) <= {None}
    assert parser.skipped == len(garbage)


@given(
    left=SPEED.filter(bool), right=SPEED, body=st.binary(min_size=20, max_size=20), lost=st.integers(0, 27)
)
def test_a_reply_that_lost_a_byte_is_none(left: int, right: int, body: bytes, lost: int) -> None:
    request = serial_session.readings_request(left, right, is_new=True)
    frame = request.mark + body + request.mark
    assert serial_session.ReplyParser(request).feed(frame[:lost] + frame[lost + 1 :]) is None


def test_the_wifi_command_is_as_documented() -> None:
    data = Command(200, -200, camera=False, sensors=True).encode()
    assert data == bytes.fromhex("80 02 00 C8 00 38 FF") + bytes(14)
    assert Command(0, 0, camera=True, sensors=False).encode()[1] == 1


def test_sensor_values_lie_where_the_firmware_puts_them() -> None:
    offsets = {name: SENSORS_DTYPE.fields[name][1] for name in SENSORS_DTYPE.names}  # type: ignore[index,union-attr]
    assert SENSORS_DTYPE.itemsize == 104
    expected = {
        "acceleration": 0, "acceleration_polar": 6, "gyro": 18, "magnetic_field": 24, "temperature": 36,
        "proximity": 37, "ambient": 53, "tof": 69, "microphones": 71, "left_counter": 79, "right_counter": 81,
        "battery": 83, "sd_card": 85, "remote_control": 86, "selector": 89, "ground": 90,
        "ground_ambient": 96, "button": 102, "spare": 103,
    }  # fmt: skip
    assert offsets == expected


def sensors_message(rng: np.random.Generator) -> bytes:
    """Sensor values as a robot may send them."""
    record = np.zeros((), SENSORS_DTYPE)
    for name in ("proximity", "ambient", "microphones"):
        record[name] = rng.integers(0, 4096, record[name].shape)
    record["acceleration_polar"] = rng.normal(size=3)
    record["left_counter"], record["right_counter"] = rng.integers(-32768, 32768, 2)
    record["selector"] = rng.integers(0, 16)
    return bytes([epuck_wifi.SENSORS_ID]) + record.tobytes()


def image_message(rng: np.random.Generator) -> bytes:
    """A picture of noise."""
    return bytes([epuck_wifi.IMAGE_ID]) + rng.bytes(epuck_wifi.IMAGE_SIZE)


def stream(kinds: str, seed: int) -> list[bytes]:
    """Messages: s for sensor values, i for a picture, n for nothing."""
    rng = np.random.default_rng(seed)
    make: dict[str, Callable[[np.random.Generator], bytes]] = {
        "s": sensors_message,
        "i": image_message,
        "n": lambda _: bytes([epuck_wifi.NOTHING_ID]),
    }
    return [make[kind](rng) for kind in kinds]


def parsed(parser: StreamParser, pieces: Iterable[bytes]) -> list[bytes]:
    """What the parser finds, as bytes again."""
    return [bytes([m.id]) + m.payload for piece in pieces for m in parser.feed(piece, 0)]


@given(kinds=st.text("sin", min_size=1, max_size=8), seed=st.integers(0, 2**32), cuts=CUTS)
def test_a_clean_stream_is_cut_into_its_messages(kinds: str, seed: int, cuts: list[int]) -> None:
    messages = stream(kinds + "s", seed)  # a picture waits for what follows it
    parser = StreamParser()
    assert parsed(parser, cut(b"".join(messages), cuts)) == messages
    assert (parser.skipped, parser.resyncs) == (0, 0)


@given(
    groups=st.lists(st.sampled_from(["ss", "sss", "siss", "sssiss"]), min_size=1, max_size=4),
    garbage=st.lists(st.binary(min_size=1, max_size=300), min_size=4, max_size=4),
    seed=st.integers(0, 2**32),
    cuts=CUTS,
)
def test_behind_garbage_every_message_that_another_follows_is_found(
    groups: list[str], garbage: list[bytes], seed: int, cuts: list[int]
) -> None:
    sent = [stream(group, seed + k) for k, group in enumerate(groups)]
    data = b"".join(noise + b"".join(messages) for noise, messages in zip(garbage, sent, strict=False))
    parser = StreamParser()
    found = parsed(parser, cut(data + b"".join(stream("ss", seed + 9)), cuts))

    genuine = {message for messages in sent for message in messages} | set(stream("ss", seed + 9))
    followed = [message for messages in sent for message in messages[:-1]]
    invented = [m for m in found if m not in genuine and m[0] == epuck_wifi.SENSORS_ID]
    assert not invented
    noise_begins_a_picture = any(noise[0] in (1, 3) for noise in garbage[: len(groups)])
    if not noise_begins_a_picture:
        assert [message for message in found if message in set(followed)] == followed


@given(seed=st.integers(0, 2**32), kinds=st.sampled_from(["ssss", "siss", "sisiss"]), data=st.data())
def test_lost_bytes_cost_no_more_than_the_messages_around_them(
    seed: int, kinds: str, data: st.DataObject
) -> None:
    messages = stream(kinds + "sss", seed)
    broken = data.draw(st.integers(0, len(kinds) - 1))
    begin = data.draw(st.integers(0, len(messages[broken]) - 1))
    end = data.draw(st.integers(begin + 1, len(messages[broken])))
    shortened = list(messages)
    shortened[broken] = messages[broken][:begin] + messages[broken][end:]
    found = parsed(StreamParser(), [b"".join(shortened)])

    untouched = messages[:broken] + messages[broken + 1 :]
    missing = [message for message in untouched if message not in found]
    assert len(missing) <= 2
    assert found[-2:] == messages[-2:]


def test_a_picture_cut_short_does_not_swallow_the_sensor_values_behind_it() -> None:
    sensors, image, *rest = stream("siss", 3)
    found = parsed(StreamParser(), [sensors + image[:20000] + b"".join(rest)])
    assert found == [sensors, *rest]


def test_a_picture_that_lacks_bytes_does_not_swallow_the_sensor_values_behind_it() -> None:
    """Also where it seems to end at a byte that another picture could begin with: seed 1, 473 bytes."""
    sensors, image, *rest = stream("siss" + "sss", 1)
    for lost in range(1, 526, 4):
        found = parsed(StreamParser(), [sensors + image[:1] + image[1 + lost :] + b"".join(rest)])
        assert [message for message in rest if message not in found] in ([], rest[:1], rest[:2]), lost


def test_messages_carry_the_arrival_of_their_first_byte() -> None:
    data = b"".join(stream("sss", 5))
    parser = StreamParser()
    messages = [m for k, piece in enumerate(cut(data, [50, 106, 300])) for m in parser.feed(piece, 10 * k)]
    assert [message.stamp_ns for message in messages] == [0, 10, 20]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("proximity", 4096),
        ("ambient", 65535),
        ("microphones", 4096),
        ("selector", 16),
        ("button", 2),
        ("acceleration_polar", math.nan),
        ("magnetic_field", math.inf),
    ],
)
def test_what_no_sensor_gives_is_not_plausible(name: str, value: float) -> None:
    record = np.zeros((), SENSORS_DTYPE)
    assert plausible(record.tobytes())
    record[name] = value
    assert not plausible(record.tobytes())
