"""The Droplet's console: as its firmware prints, in pieces of any size, and with garbage between."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_drivers.droplet import protocol as console
from swarm_loc_drivers.droplet.hardware import (
    DIRECTIONS,
    ELEMENTS,
    TURN_CLOCKWISE,
    TURN_COUNTERCLOCKWISE,
    gait,
)
from swarm_loc_drivers.droplet.protocol import (
    BROKEN,
    UNKNOWN,
    ConsoleParser,
    Echo,
    Event,
    Identity,
    Matrix,
    MotorTrims,
    MoveStarted,
    Noted,
    Said,
    SendAborted,
    StepLength,
)

ROWS = tuple(tuple(range(10 * emitter, 10 * emitter + 6)) for emitter in range(6))
SIGNED = ((-29, 13, -44, -31, 31, 44), *ROWS[1:])


def in_braces(rows: Sequence[Sequence[int]]) -> str:
    return "{" + ",".join("{" + ",".join(map(str, row)) + "}" for row in rows) + "}"


def named(rows: Sequence[Sequence[int]]) -> str:
    return f'{{"6B6F", "DF64", {in_braces(rows)}}},\r\n'


def of_2014(rows: Sequence[Sequence[int]]) -> str:
    return f"{in_braces(rows)};\r\n"


def of_2016(rows: Sequence[Sequence[int]]) -> str:
    lines = ["\t{" + ",".join(f"{cell:4d}" for cell in row) + "}" for row in rows]
    return "{\r\n" + ",\r\n".join(lines) + f"\r\n}}; sum={sum(map(sum, rows))}\r\n"


def of_july_2016(rows: Sequence[Sequence[int]]) -> str:
    return of_2016(rows).partition(" sum=")[0] + "\r\n"


NOTED = [
    ('Broadcasting command to 0029: "rnb_b", of length 5.', ""),
    ('Broadcasting command: "reset", of length 5.', ""),
    ('Broadcasting command: "res", of length 5.', UNKNOWN),
    ("RNB Broadcast failed [ 4C ]", "failed_emissions"),
    ("\t(RNB) ID: 6B6F | R:  173 B:  -90 H:   45", "range_bearings"),
    ("!!!\tGot 15 consecutive nothings from sensor 3.\t!!!", "silent_sensors"),
    ("!!! something else !!!", "firmware_errors"),
    ("\tCommand ( dance ) not recognized.", "unknown_commands"),
    ("ERROR: Serial input buffer capacity of 64 characters exceeded.", "overflows"),
    ("ERROR! Should NOT be.", "firmware_errors"),
    ("Motor Values", ""),
    ("Dist (mm) per kilostep", ""),
    ("hello", UNKNOWN),
]
PRINTED: list[tuple[str, Event]] = [
    ("get_id\r\n", Echo("get_id")),
    ("My ID is: DF64\r\n", Identity(0xDF64)),
    ("My ID is: 29\r\n", Identity(0x29)),
    ("move_steps 0 50\r\n", Echo("move_steps 0 50")),
    ("walk 0 50\r\n", Echo("walk 0 50")),
    ("walk direction 0, num_steps 50\r\n", MoveStarted(0, 50)),
    ("Aborting IR send [0a] while trying: rnb_b\r\n", SendAborted(10)),
    (named(SIGNED), Matrix(0x6B6F, 0xDF64, SIGNED)),
    (of_2014(ROWS), Matrix(None, None, ROWS)),
    (of_2016(ROWS), Matrix(None, None, ROWS)),
    (of_july_2016(ROWS), Matrix(None, None, ROWS)),
    ("\tdir: 7\t-25\t0\t31\t\r\n", MotorTrims(7, (-25, 0, 31))),
    ("\t7\t65535\r\n", StepLength(7, 65535)),
    *((f"{text}\r\n", Noted(reason, text)) for text, reason in NOTED),
]
WHOLE = "".join(text for text, _ in PRINTED).encode()


def events(data: bytes, parser: ConsoleParser | None = None) -> list[Event]:
    return [said.event for said in (parser or ConsoleParser()).feed(data, 0)]


@pytest.mark.parametrize(("text", "event"), PRINTED, ids=[text.split("\r")[0].strip() for text, _ in PRINTED])
def test_every_line_is_understood(text: str, event: Event) -> None:
    assert events(text.encode()) == [event]


@given(cuts=st.lists(st.integers(0, len(WHOLE)), max_size=30))
def test_bytes_may_come_in_pieces_of_any_size(cuts: list[int]) -> None:
    parser = ConsoleParser()
    ends = [*sorted(cuts), len(WHOLE)]
    pieces = [WHOLE[begin:end] for begin, end in zip([0, *ends], ends, strict=False)]
    assert [one for piece in pieces for one in events(piece, parser)] == [event for _, event in PRINTED]


@st.composite
def corrupted(draw: st.DrawFn) -> bytes:
    """The print-outs with bytes lost, changed and added."""
    data = bytearray(WHOLE)
    for _ in range(draw(st.integers(1, 8))):
        begin = draw(st.integers(0, len(data)))
        end = min(len(data), begin + draw(st.integers(0, 120)))
        data[begin:end] = draw(st.binary(max_size=12))
    return bytes(data)


@given(data=corrupted())
def test_garbage_never_makes_a_matrix_of_another_size_and_is_forgotten(data: bytes) -> None:
    parser = ConsoleParser()
    for event in events(data, parser):
        if isinstance(event, Matrix):
            assert [len(row) for row in event.brightness] == [ELEMENTS] * ELEMENTS
    events(b"\r\n\r\n", parser)
    assert events(WHOLE, parser)[1:] == [event for _, event in PRINTED][1:]


@pytest.mark.parametrize("layout", [named, of_2014, of_2016])
def test_a_matrix_that_is_not_whole_is_broken_and_the_next_is_read(layout: object) -> None:
    assert callable(layout)
    text: str = layout(ROWS)
    for cut in (text.replace(",13", "", 1).replace(",  13", "", 1), text.replace("2", "x", 1)):
        found = events((cut + text).encode())
        assert any(isinstance(event, Noted) and event.reason == BROKEN for event in found), cut
        assert isinstance(found[-1], Matrix)
        assert sum(isinstance(event, Matrix) for event in found) == 1


@pytest.mark.parametrize("layout", [named, of_2014, of_2016])
def test_a_matrix_of_another_platform_has_its_size(layout: object) -> None:
    assert callable(layout)
    rows = np.arange(64).reshape(8, 8).tolist()
    (event,) = events(layout(rows).encode(), ConsoleParser(8))
    assert isinstance(event, Matrix)
    assert np.array(event.brightness).tolist() == rows
    assert not any(isinstance(event, Matrix) for event in events(layout(rows).encode()))


def test_a_line_is_stamped_with_its_first_character() -> None:
    parser = ConsoleParser()
    assert parser.feed(b"\r\n", 1) == []
    assert parser.feed(b"My ID", 2) == []
    assert parser.feed(b" is: DF64", 3) == []
    assert parser.feed(b"\r\nget", 4) == [Said(2, Identity(0xDF64))]
    assert parser.feed(b"_id\r\n", 5) == [Said(4, Echo("get_id"))]
    text = of_2016(ROWS).encode()
    assert parser.feed(text[:20], 6) == []
    assert parser.feed(text[20:], 7) == [Said(6, Matrix(None, None, ROWS))]


def test_what_is_taken_back_disappears() -> None:
    parser = ConsoleParser()
    parser.feed(b"stop" + 6 * b"\b \b" + b"get_i", 0)
    assert parser.partial == "get_i"
    assert events(b"d\r\n", parser) == [Echo("get_id")]


def test_an_endless_line_does_not_fill_the_memory() -> None:
    parser = ConsoleParser()
    for _ in range(100):
        parser.feed(b"{1234567890" * 10, 0)
    assert len(parser.partial) < 1000
    (event,) = events(b"\r\n", parser)
    assert isinstance(event, Noted)
    assert event.reason == BROKEN


def test_lines_to_type() -> None:
    assert console.typed(console.move_steps(0, 50)).hex(" ").upper() == (
        "6D 6F 76 65 5F 73 74 65 70 73 20 30 20 35 30"
    )
    assert console.for_robot(0x29, console.set_power(256)) == "tgt_cmd 0029 set_ir 256"


@pytest.mark.parametrize("line", ["", "x" * 64, "get_id\r", "get\nid", "get_id\x00", "gét_id"])
def test_what_no_line_may_hold_is_refused(line: str) -> None:
    with pytest.raises(console.CommandError, match="1 to 63 printable"):
        console.typed(line)


def test_what_the_firmware_has_no_room_for_is_refused() -> None:
    console.for_robot(1, "x" * 31)
    with pytest.raises(console.CommandError, match="31"):
        console.for_robot(1, "x" * 32)
    with pytest.raises(console.CommandError, match="power 257"):
        console.set_power(257)


def test_directions_go_clockwise_from_the_front() -> None:
    steps = [gait(direction, (1, -1, 0), 300) for direction in DIRECTIONS]
    walks = np.array([[step.forward, step.left] for step in steps[:6] if step])
    angles = np.rad2deg(np.arctan2(walks[:, 1], walks[:, 0]))
    assert np.mod(angles, 360.0) == pytest.approx([0, 300, 240, 180, 120, 60], abs=1e-9)
    assert np.hypot(*walks.T) == pytest.approx(300e-6)
    clockwise, counter = steps[TURN_CLOCKWISE], steps[TURN_COUNTERCLOCKWISE]
    assert clockwise is not None
    assert counter is not None
    assert (clockwise.turn, counter.turn) == pytest.approx((-math.radians(0.3), math.radians(0.3)))


def test_a_step_lasts_as_long_as_its_motors_take() -> None:
    one, two = gait(0, (0, 0, 32), 300), gait(0, (-64, 0, 32), 300)
    assert one is not None
    assert two is not None
    assert one.step_s == pytest.approx(61 * 1.024e-3)
    assert two.step_s == pytest.approx((62 + 61) * 1.024e-3)
    assert gait(0, (0, 0, 0), 300) is None


def test_an_uncalibrated_direction_has_the_firmwares_own_guess() -> None:
    walk, turn = gait(3, (-1, -1, -1), 0xFFFF), gait(7, (-1, -1, -1), 0xFFFF)
    assert walk is not None
    assert turn is not None
    assert walk.forward == pytest.approx(-600e-6)
    assert turn.turn == pytest.approx(math.radians(2.0))
