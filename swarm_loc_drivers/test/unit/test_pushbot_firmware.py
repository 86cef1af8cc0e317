"""Command lines of an emulated PushBot against what firmware 0.7.1 says and does."""

import pytest

from swarm_loc_drivers.pushbot.protocol import (
    BRAKE,
    FIRST_FIRMWARE,
    SECOND_FIRMWARE,
    FirmwareGeneration,
    Lights,
    is_refusal,
    lights,
)
from swarm_loc_drivers.sim.pushbot.event_camera import Blinking
from swarm_loc_drivers.sim.pushbot.firmware import PushbotFirmware


class Bench:
    """A board on a bench, whose wheels are held and whose motor driver is on; the wire to it has no echo."""

    def __init__(self, generation: FirmwareGeneration = SECOND_FIRMWARE) -> None:
        self.now_ns = 1_000_000_000
        self.ticks = 0, 0
        self.duties = 0.0, 0.0
        self.lights = Blinking(), Blinking(), Blinking()
        self.firmware = PushbotFirmware(self, generation)
        self.firmware.late_share = 0.0
        self.say("!U0", "!M+")

    def set_duties(self, left: float, right: float) -> None:
        """See `PushbotBody`."""
        self.duties = left, right

    def wheel_ticks(self) -> tuple[int, int]:
        """See `PushbotBody`."""
        return self.ticks

    def set_lights(self, laser: Blinking, rear: Blinking, front: Blinking) -> None:
        """See `PushbotBody`."""
        self.lights = laser, rear, front

    def say(self, *lines: str) -> str:
        """Send lines; what the board answers at once."""
        for line in lines:
            self.firmware.receive(line.encode() + b"\n")
        return self.heard()

    def wait(self, milliseconds: int) -> str:
        """Let time pass; what the board says in it."""
        heard = ""
        for _ in range(milliseconds):
            self.now_ns += 1_000_000
            self.firmware.millisecond()
            heard += self.heard()
        return heard

    def heard(self) -> str:
        """What the board has said since the last call."""
        texts = self.firmware.board.texts
        heard = b"".join(text for _, text in texts).decode()
        texts.clear()
        return heard


SET, GET = "Set: parsing error\n", "Get: parsing error\n"
ANSWERS = [
    ("!M2=%1", "Error setting motor speed\n"),
    ("!MV2=1", "Error setting motor speed\n"),
    ("!MVD2=1", "Error setting motor speed\n"),
    ("!M", SET),
    ("!MV", SET),
    ("!MVDx", SET),
    ("!E4;?E", "-E4\n"),
    ("!E5", SET),
    ("!E", SET),
    ("!PD=5", "Channel not recognized\n"),
    ("!S+1", SET),
    ("!S+", SET),
    ("!S-x", SET),
    ("!U3", SET),
    ("!X", SET),
    ("?X", GET),
    ("?M", GET),
    ("x", "?\n"),
]


@pytest.mark.parametrize(("lines", "answer"), ANSWERS, ids=[lines for lines, _ in ANSWERS])
def test_a_command_line_is_answered_as_by_the_firmware(lines: str, answer: str) -> None:
    assert Bench().say(*lines.split(";")) == answer
    assert is_refusal(answer.encode()) is (answer != "-E4\n")


@pytest.mark.parametrize(
    ("lines", "left"),
    [
        ("!M0=%25", 0.25),
        ("!M0=%-30", -0.3),
        ("!M0=%-130", -1.0),
        ("!MV0=5", 8400 / 9600),  # 5 ticks after the first millisecond, with a gain of 80 counts: see below
    ],
)
def test_a_motor_is_driven_as_by_the_firmware(lines: str, left: float) -> None:
    """A wheel that is held winds the controller up."""
    bench = Bench()
    bench.say(*lines.split(";"))
    if lines.startswith("!MV"):
        bench.wait(21 * 20 + 1)
    assert bench.duties[0] == pytest.approx(left)
    assert bench.duties[1] == 0.0


def test_a_stop_just_after_a_tick_of_the_clock_is_overwritten_and_lasts() -> None:
    bench = Bench()
    bench.say("!MV0=20")
    bench.wait(5)
    bench.firmware.late_share = 1.0
    bench.firmware.receive(BRAKE)
    bench.wait(1)
    assert bench.duties[0] == pytest.approx(20 * 80 / 9600)
    bench.wait(500)
    assert bench.duties[0] == pytest.approx(20 * 80 / 9600)


@pytest.mark.parametrize(
    ("lines", "laser"),
    [
        ("!PA=1000;!PA0=500", (1000, 500)),
        ("!PA=1000;!PA0=1000", (1000, 1000)),
        ("!PA0=500", (500, 500)),
        ("!PA0=500;!PA=1000", (1000, 500)),
        ("!PA=1000;!PA0=500;!PA=0;!PA=2000", (2000, 0)),
        ("!PA=1000;!PA0=500;!PA=0", (0, 0)),
    ],
)
def test_the_laser_is_lit_as_by_the_firmware(lines: str, laser: tuple[int, int]) -> None:
    """Period and lit time [us]; a light as long as its period, or without one, does not blink."""
    bench = Bench()
    bench.say(*lines.split(";"))
    assert bench.lights[0] == laser


def test_the_drivers_commands_are_taken_and_blink() -> None:
    bench = Bench()
    assert bench.say(lights(Lights(450.0, 300.0)).decode()) == ""
    assert bench.lights == ((2222, 1111), (3333, 1666), (3333, 1666))
    assert bench.say(lights(Lights(0.0, 0.0)).decode()) == ""
    assert [one.lit_us for one in bench.lights] == [0, 0, 0]
    assert bench.say("!M0=%50", "!M1=%50", BRAKE.decode()) == ""
    assert bench.duties == (0.0, 0.0)


def test_wheel_ticks_come_by_the_clock() -> None:
    bench = Bench()
    bench.say("!S+268435456,3")
    assert bench.wait(6) == "-S28 0 0\n" * 2
    bench.say("!S+268435456,2")  # the running period goes on to its end
    assert bench.wait(5) == "-S28 0 0\n" * 2
    assert bench.say("!S-") == bench.wait(10) == ""


def test_the_list_names_every_sensor() -> None:
    rows = Bench().say("??S").splitlines()
    assert [int(row.split()[0]) for row in rows[2:] if row] == [*range(22), 28]


def test_characters_are_echoed() -> None:
    bench = Bench()
    bench.say("!U1")
    assert bench.say("?E") == "?E\n-E0\n"
    assert bench.say("!E2") == "!E2\n"
    assert bench.say("x" * 127 + "?E") == "x" * 127 + "E\n-E2\n"  # the line is full: the `?` begins it again


def test_the_first_firmware_stops_for_the_brake_and_knows_no_decay() -> None:
    bench = Bench(FIRST_FIRMWARE)
    assert bench.say("!MV0=5") == ""
    bench.wait(1)
    assert bench.duties[0] == pytest.approx(5 * 80 / 9600)
    assert bench.say(BRAKE.decode()) == ""
    assert bench.duties == (0.0, 0.0)
    assert bench.say("!MVD0=5") == SET
