"""Command lines of an emulated PushBot against what firmware 0.7.1 says and does."""

from __future__ import annotations

import pytest

from swarm_loc_drivers.pushbot.hardware import FIRST_FIRMWARE, SECOND_FIRMWARE, FirmwareGeneration
from swarm_loc_drivers.pushbot.protocol import BRAKE, Lights, is_refusal, lights
from swarm_loc_drivers.sim.pushbot.console import PushbotFirmware
from swarm_loc_drivers.sim.pushbot.event_camera import Blinking


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
    ("?B", "-B0=1067\n"),
    ("?B9", "-B9=19187\n"),
    ("?B12", "-B12=0\n"),
    ("!B3=100;?B3", "-B3=100\n"),
    ("!B99=5;?B99", "-B99=0\n"),
    ("!U2;!B3=100", "!B3=100\n-B3=100\n"),
    ("!U2;!BF", "!BF\n-BF\n"),
    ("!BF", ""),
    ("!U2;!BD1", "!BD1\n-BD1\n"),
    ("!BD2;?B0", "-B0=1966\n"),
    ("!BD", "Select default bias set: parsing error\n"),
    ("!BD6", "Select default bias set: parsing error\n"),
    ("?MC", "-MC0 80,0,0\n"),
    ("?MC1", "-MC1 80,0,0\n"),
    ("?MC2", ""),
    ("?M", GET),
    ("!MC1=1,-2,3;?MC1", "-MC1 1,-2,3\n"),
    ("!MC0=1,2", SET),
    ("!MC2=1,2,3", "Error setting controller PID\n"),
    ("!MP0=0", "Error setting motor PWM\n"),
    ("!MP2=50", "Error setting motor PWM\n"),
    ("!MP0=22369622", "Error setting motor PWM\n"),
    ("!MP", SET),
    ("!M0=-30", "Error setting motor width\n"),
    ("!MD0=-30", "Error setting motor speed\n"),
    ("!M0=22369622", "Error setting motor width\n"),
    ("!M2=1", "Error setting motor mode\n"),
    ("!MD2=1", "Error setting motor speed\n"),
    ("!MV2=1", "Error setting motor speed\n"),
    ("!MVD2=1", "Error setting motor speed\n"),
    ("!M", SET),
    ("!MV", SET),
    ("!MVDx", SET),
    ("?T", "-T0000-00-00 00:00:00\n"),
    ("!T+;?T", "-T+\n-T2014-10-09 16:49:39\n"),
    ("!T-", "-T-\n"),
    ("!T2026-11-25 12:00:00", "Wrong format\n"),
    ("!T2026-11-25 12:00:00;!T2026-11-25 12:00:00 ", "Wrong format\nRTC not enabled\n"),
    ("!T+;!T2026-11-25 12:00:00 ;?T", "-T+\n-T2026-11-25 12:00:00\n"),
    ("!E4;?E", "-E4\n"),
    ("!U2;!E3", "!E3\n-E3\n"),
    ("!E5", SET),
    ("!E", SET),
    ("!ETS", "-ETS\n"),
    ("!ETM0", "-ETM0\n"),
    ("!ETM+", "-ETM+\n"),
    ("!ETI", "-ETI\n"),
    ("!ER+", "-ER-\n"),
    ("!ER", SET),
    ("!A=1024", "Analog output should be between [0-1023]\n"),
    ("!A1023", ""),
    ("!L2", ""),
    ("!L3", SET),
    ("!PD=5", "Channel not recognized\n"),
    ("!ETS;!PA=5", "-ETS\nError setting PWM frequency\n"),
    ("!ETS;!PA0=5", "-ETS\nError setting PWM width\n"),
    ("!ETS;!PA0=%5", "-ETS\nError setting PWM dutycycle\n"),
    ("!S+1", SET),
    ("!S+", SET),
    ("!S-x", SET),
    ("!U2;!U=115200", "!U=115200\nSwitching Baud Rate to 115200 Baud!\n"),
    ("!U3", SET),
    ("!X", SET),
    ("?X", GET),
    ("x", "?\n"),
    ("S", ""),
    ("?S1", "-S0 7399\n"),
    ("?S126", "-S1 0\n-S2 0\n-S3 0\n-S4 0\n-S5 0\n-S6 0\n"),
    ("?S896", "-S7 0 0 0\n-S8 0 0 16384\n-S9 0 67 147\n"),
    ("?S7168", "-S10 0 0 0 0\n-S11 0 0 10000\n-S12 140000 0 FFD40000\n"),
    ("?S24576", "-S13 40000000 0 0 0\n-S14 0 0 0 0\n"),
    ("?S32768", "-S15 40000000 0 0 0 40000000 0 0 0 40000000\n"),
    ("?S458752", "-S16 0\n-S17 0 0 0\n-S18 250 0\n"),
    ("!M0=25;!M1=%-30;?S524288", "-S19 25 -15 50 -30\n"),
    ("?S1048576", "-S20 0 0\n"),
    ("?S2097152", "-S21 0 0 0\n"),
    ("?S268435456", "-S28 0 0\n"),
]


@pytest.mark.parametrize(("lines", "answer"), ANSWERS, ids=[lines for lines, _ in ANSWERS])
def test_a_command_line_is_answered_as_by_the_firmware(lines: str, answer: str) -> None:
    assert Bench().say(*lines.split(";")).removeprefix("!U2\n") == answer


@pytest.mark.parametrize(
    ("lines", "left"),
    [
        ("!M0=25", 0.5),
        ("!M0=%25", 0.25),
        ("!M0=%-30", -0.3),
        ("!M0=60", 1.0),
        ("!M0=-30", 0.0),
        ("!M0=%-130", -1.0),
        ("!M0=12000000", -1.0),  # more than a signed number has room for
        ("!MD0=%40", 0.4),
        ("!MP0=100;!M0=25", 0.25),
        ("!M0=25;!MP0=100", 0.75),  # the longer part of the old period remains the pulse's pause
        ("!M0=%-20;!MP0=25", -0.4),
        ("!MV0=5", 8400 / 9600),  # 5 ticks after the first millisecond, with a gain of 80 counts: see below
    ],
)
def test_a_motor_is_driven_as_by_the_firmware(lines: str, left: float) -> None:
    """A width is in us and a percentage has its sign; a wheel that is held winds the controller up."""
    bench = Bench()
    bench.say(*lines.split(";"))
    if lines.startswith("!MV"):
        bench.wait(21 * 20 + 1)
    assert bench.duties[0] == pytest.approx(left)
    assert bench.duties[1] == 0.0


def test_a_refused_width_ends_the_velocity_control() -> None:
    bench = Bench()
    bench.say("!MV0=5")
    bench.wait(1)
    assert bench.duties[0] == pytest.approx(5 * 80 / 9600)
    bench.say("!M0=-30")
    bench.wait(100)
    assert bench.duties[0] == pytest.approx(5 * 80 / 9600)


def test_a_duty_cycle_that_decays_loses_a_tenth_each_tenth_of_a_second() -> None:
    bench = Bench()
    bench.say("!MD0=%50")
    bench.wait(1000)
    assert bench.duties[0] == 0.5
    bench.wait(200)
    assert bench.duties[0] == pytest.approx(0.5 * 0.9**2, abs=1e-3)


def test_new_gains_and_periods_change_the_controller() -> None:
    bench = Bench()
    bench.say("!MC0=40,0,0", "!MV0=5")
    bench.wait(1)
    assert bench.duties[0] == pytest.approx(5 * 40 / 9600)
    bench.say("!MP0=50", "!MC0=1,0,0")
    bench.wait(3000)
    # the error is limited to the period by the old gain, and a step of the target comes before the limit
    assert 240 / 9600 <= bench.duties[0] <= 245 / 9600


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
        ("!PA=1000;!PA0=%30", (1000, 300)),
        ("!PA=1000;!PA0=1000", (1000, 1000)),
        ("!PA0=500", (500, 500)),
        ("!PA0=500;!PA=1000", (1000, 500)),
        ("!PA=1000;!PA0=500;!PA=0;!PA=2000", (2000, 0)),
        ("!PA=1000;!PA0=500;!PA2=700", (0, 0)),
        ("!PA=%50;!PA0=9", (9, 9)),
        ("!PA=1000;!PA0=500;!ETS;!ETI", (0, 0)),
        ("!PA=1000;!PA0=500;!PA", (0, 0)),
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


def test_a_short_command_is_read_on_from_an_earlier_line() -> None:
    """The firmware ends a line with a zero and passes over it."""
    bench = Bench()
    bench.say("xxxxx250", "!PA0")
    assert bench.lights[0] == (250, 250)
    bench.say("xxxx%25", "!M0")
    assert bench.duties == (0.25, 0.0)


def test_sensors_come_by_the_clock_and_keep_their_old_places() -> None:
    bench = Bench()
    bench.say("!S+1,2", "!S+268435456,3")
    assert bench.wait(6).count("-S0") == 3
    assert bench.wait(6).count("-S28 0 0\n") == 2
    bench.say("!S-1")
    assert bench.wait(6) == "-S28 0 0\n" * 2
    bench.say("!S+2097152,3", "!S-268435456")  # the last in the queue goes, not the ticks
    assert bench.wait(3) == "-S28 0 0\n"
    assert bench.say("!S-") == bench.wait(10) == ""


def test_the_clock_of_the_events_stands_without_the_pulses_of_a_master() -> None:
    bench = Bench()
    board = bench.firmware.board
    bench.wait(5)
    assert board.board_us(bench.now_ns // 1000) == 5000
    bench.say("!ETS")
    bench.wait(5)
    assert board.board_us(bench.now_ns // 1000) == 0
    bench.say("!ETI")
    bench.wait(5)
    assert board.board_us(bench.now_ns // 1000) == 5000


def test_the_calendar_runs_until_it_is_stopped() -> None:
    bench = Bench()
    bench.say("!T+")
    bench.wait(2100)
    assert bench.say("?T", "!T-") == "-T2014-10-09 16:49:41\n-T-\n"
    bench.wait(2000)
    assert bench.say("?T") == "-T2014-10-09 16:49:41\n"
    bench.say("!T2026-13-45 12:00:00 ")
    assert bench.say("?T") == "-T2026-13-45 12:00:00\n"


def test_lists_name_every_format_and_every_sensor() -> None:
    bench = Bench()
    assert bench.say("??E").count(" !E") == 5
    rows = bench.say("??S").splitlines()
    assert [int(row.split()[0]) for row in rows[2:] if row] == [*range(22), 28]
    assert "EDVS-4337" in bench.say("??")


def test_characters_are_echoed_and_erased() -> None:
    bench = Bench()
    bench.say("!U1")
    assert bench.say("?X\b\b?E") == "?X\b \b\b \b?E\n-E0\n"
    assert bench.say("!E2") == "!E2\n"
    assert bench.say("x" * 127 + "?E") == "x" * 127 + "E\n-E2\n"  # the line is full: the `?` begins it again


def test_a_board_in_its_bootloader_stands_and_is_silent() -> None:
    bench = Bench()
    bench.say("!M0=%50", "!S+1,2", "P")
    assert bench.duties == (0.0, 0.0)
    assert bench.say("?E", "!M+", "!M0=%50", "R") + bench.wait(10) == ""
    assert bench.duties == (0.0, 0.0)


def test_the_first_firmware_takes_a_number_as_percent() -> None:
    bench = Bench(FIRST_FIRMWARE)
    assert bench.say("!M0=25", "!M1=%25") == ""
    assert bench.duties == (0.25, 0.0)
    assert bench.say("?MC") == GET


@pytest.mark.parametrize("line", ["!M0=-30", "!E5", "?M", "x", "!PD=5", "!MC2=1,2,3"])
def test_the_driver_knows_a_refusal(line: str) -> None:
    assert is_refusal(Bench().say(line).encode())
