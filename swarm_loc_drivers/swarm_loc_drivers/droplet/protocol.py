"""The serial console of a Droplet: command lines and the meaning of printed lines, without I/O.

The console echoes every character and answers the end of a line with CR LF. CR and LF each end a line, so
exactly one of them may be sent. All other output is text for people, and echoes may interrupt it. Matrices
have one row per emitter and one column per sensor. Formats are those of the firmware of 2014, 2016 and 2018
(correlllab/cu-droplet).

A Droplet ignores its console for a sixth of a second during an infrared exchange, and a line that has lost
characters may be another command. So a line is terminated only after its complete echo; otherwise it is
deleted and typed again.

Actions that take time are generators: they yield the time [ns] at which to continue at the latest, and
continue whenever output arrives.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Generator
from typing import NamedTuple, TypeVar

from swarm_loc_drivers.common.robot_driver import SessionError
from swarm_loc_drivers.droplet.hardware import ELEMENTS, FULL_POWER, HANDLING_NS, message_ns

TERMINATOR = b"\r"
ERASE = b"\b"  # Deletes the last character of the line; the console answers `\b \b` even for an empty line
BACKSPACES_PER_ERASE = 2

MAX_LINE = 63  # The line buffer has 64 characters, including the terminator
MAX_TARGETED_LINE = 31  # A command for another robot is copied to a buffer of 32 characters without a check
MAX_STEPS = 0xFFFF

GET_ID = "get_id"
STOP = "stop_walk"
EMIT = "rnb_b"
MOTOR_SETTINGS = "print_motor_settings"

_MAX_PRINTED_LINE = 512
_MAX_DIGITS = 5
_BACKSPACE = 8
BROKEN, UNKNOWN = "broken_matrices", "unknown_lines"  # What lines without sense are counted as


class CommandError(ValueError):
    """A line that the console does not accept; the message is one sentence."""


def move_steps(direction: int, steps: int) -> str:
    """Move; acknowledged but ignored while the robot is moving."""
    return f"move_steps {direction} {steps}"


def set_power(power: int) -> str:
    """Set the power of the emitters, 0 to 256."""
    if not 0 <= power <= FULL_POWER:
        raise CommandError(f"power {power} must lie in [0, {FULL_POWER}].")
    return f"set_ir {power}"


def for_robot(robot: int, line: str) -> str:
    """Send a line by infrared to another robot, which executes it like a typed one.

    Raises CommandError if the line is too long.
    """
    if len(line) > MAX_TARGETED_LINE:
        raise CommandError(f"'{line}' is too long: another robot takes {MAX_TARGETED_LINE} characters.")
    return f"tgt_cmd {robot:04X} {line}"


def typed(line: str) -> bytes:
    """The characters of a line, without its end.

    Raises CommandError if the line is empty, too long or not printable.
    """
    if not 0 < len(line) <= MAX_LINE or not line.isascii() or not line.isprintable():
        raise CommandError(f"{line!r} must be 1 to {MAX_LINE} printable ASCII characters.")
    return line.encode()


class Echo(NamedTuple):
    """Echo of a typed command."""

    line: str


class Identity(NamedTuple):
    """Id of the robot."""

    robot: int


class MoveStarted(NamedTuple):
    """A command to move was accepted; it has no effect if the robot was already moving."""

    direction: int
    steps: int


class SendAborted(NamedTuple):
    """A message was not sent because infrared is busy."""

    status: int


class Matrix(NamedTuple):
    """A brightness matrix."""

    emitter: int | None  # Id of the emitting robot; None if the format lacks it
    receiver: int | None  # Id of the measuring robot; None if the format lacks it
    brightness: tuple[tuple[int, ...], ...]  # One row per emitter, one count per sensor


class MotorTrims(NamedTuple):
    """Trims of the three motors in a direction."""

    direction: int
    trims: tuple[int, int, int]


class StepLength(NamedTuple):
    """Calibrated path [mm] or turn [deg] of 1000 steps in a direction."""

    direction: int
    per_kilostep: int


class Noted(NamedTuple):
    """Any other line: what it is counted as, or "" for an ordinary one, and its text."""

    reason: str
    text: str


Event = Echo | Identity | MoveStarted | SendAborted | Matrix | MotorTrims | StepLength | Noted


class Said(NamedTuple):
    """A line that the console has printed."""

    stamp_ns: int  # Arrival of its first character [ns]
    event: Event  # Its meaning


_COMMANDS = (
    "adj_motors|broadcast_id|cmd|coll|get_id|get_rgb|move_steps|msg|msg_tst|print_motor_settings|reset|rnb_b|"
    "set_dist_per_step|set_ir|set_led|set_motors|stop_walk|tasks|tgt|tgt_cmd|walk|write_motor_settings"
)
_HEX = "([0-9A-F]{4})"
_NUMBER = rf" *(-?\d{{1,{_MAX_DIGITS}}})"


def _noted(count: str) -> Callable[[re.Match[str]], Noted]:
    return lambda match: Noted(count, match[0])


def _integers(match: re.Match[str]) -> tuple[int, ...]:
    return tuple(int(group) for group in match.groups())


def _relayed(match: re.Match[str]) -> Noted:
    """A line is sent to another robot, or to all."""
    line, length = match.groups()
    return Noted("" if len(line) == int(length) else UNKNOWN, match[0])


def _motor_trims(match: re.Match[str]) -> MotorTrims:
    direction, first, second, third = _integers(match)
    return MotorTrims(direction, (first, second, third))


_LINES: tuple[tuple[re.Pattern[str], Callable[[re.Match[str]], Event]], ...] = tuple(
    (re.compile(pattern), make)
    for pattern, make in (
        (r"My ID is: ([0-9A-F]{1,4})", lambda m: Identity(int(m[1], 16))),
        (r"walk direction (\d), num_steps (\d{1,5})", lambda m: MoveStarted(*_integers(m))),
        (r'Broadcasting command(?: to [0-9A-F]{4})?: "(.*)", of length (\d{1,2})\.', _relayed),
        (r"Aborting IR send \[([0-9A-Fa-f]{2})\] while trying: .*", lambda m: SendAborted(int(m[1], 16))),
        (r"RNB Broadcast failed \[ [0-9A-F]{2} \]", _noted("failed_emissions")),
        (rf"\t\(RNB\) ID: {_HEX} \| R:{_NUMBER} B:{_NUMBER} H:{_NUMBER}", _noted("range_bearings")),
        (r"!!!\tGot \d+ consecutive nothings from sensor \d\.\t!!!", _noted("silent_sensors")),
        (rf"\tdir: ([0-7])\t{_NUMBER}\t{_NUMBER}\t{_NUMBER}\t", _motor_trims),
        (r"\t([0-7])\t(\d{1,5})", lambda m: StepLength(*_integers(m))),
        (r"Motor Values|Dist \(mm\) per kilostep", _noted("")),
        (r"\tCommand \( .* \) not recognized\.", _noted("unknown_commands")),
        (r"ERROR: Serial input buffer capacity of \d+ characters exceeded\.", _noted("overflows")),
        (r"(?:!!!|error|ERROR|Error).*", _noted("firmware_errors")),
        (rf"(?:{_COMMANDS})(?: .*)?", lambda m: Echo(m[0])),
    )
)


class ConsoleParser:
    """Parses the output of the console, in pieces of any size and after any stray bytes.

    Matrices of another number of emitters and of sensors than `elements` are broken.
    """

    def __init__(self, elements: int = ELEMENTS) -> None:
        self.partial = ""  # The unfinished line, as a terminal would show it
        self.backspaces = 0  # Number of received backspaces
        self._stamp_ns = 0
        row = r"\{" + ",".join([_NUMBER] * elements) + r"\}"
        rows = r"\{" + ",".join([row] * elements) + r"\}"
        self._elements = elements
        self._named = re.compile(rf'\{{"{_HEX}", "{_HEX}", {rows}\}},')
        self._nameless = re.compile(rf"{rows};")
        self._row = re.compile(rf"\t{row}(,?)")
        self._last = re.compile(rf"\}};(?: sum={_NUMBER})?")
        self._rows: list[tuple[int, ...]] | None = None
        self._rows_stamp_ns = 0

    def feed(self, data: bytes, stamp_ns: int) -> list[Said]:
        """Take bytes that arrived at `stamp_ns`; the lines that they complete."""
        said: list[Said] = []
        for code in data:
            if code in TERMINATOR + b"\n":
                said += self._line(self.partial) if self.partial else []
                self.partial = ""
            elif code == _BACKSPACE:
                self.partial = self.partial[:-1]
                self.backspaces += 1
            elif len(self.partial) < _MAX_PRINTED_LINE:
                self._stamp_ns = self._stamp_ns if self.partial else stamp_ns
                self.partial += chr(code)
        return said

    def _line(self, line: str) -> list[Said]:
        """Parse a line; empty while it is part of a matrix."""
        if self._rows is not None:
            return self._line_of_matrix(line, self._rows)
        if line == "{":
            self._rows, self._rows_stamp_ns = [], self._stamp_ns
            return []
        # a matrix in one line, another known line, or one without sense
        event: Event = Noted(BROKEN if "{" in line or "}" in line else UNKNOWN, line)
        if match := self._named.fullmatch(line):
            emitter, receiver, *cells = match.groups()
            event = Matrix(int(emitter, 16), int(receiver, 16), self._square(cells))
        elif match := self._nameless.fullmatch(line):
            event = Matrix(None, None, self._square(match.groups()))
        else:
            for pattern, make in _LINES:
                if match := pattern.fullmatch(line):
                    event = make(match)
                    break
        return [Said(self._stamp_ns, event)]

    def _line_of_matrix(self, line: str, rows: list[tuple[int, ...]]) -> list[Said]:
        """Parse a line after an opening brace."""
        missing = self._elements - len(rows)
        if missing and (row := self._row.fullmatch(line)):
            *cells, comma = row.groups()
            if bool(comma) == (missing > 1):
                rows.append(tuple(int(cell) for cell in cells))
                return []
        self._rows = None
        if not missing and self._last.fullmatch(line):
            return [Said(self._rows_stamp_ns, Matrix(None, None, tuple(rows)))]
        return [Said(self._rows_stamp_ns, Noted(BROKEN, "{")), *self._line(line)]

    def _square(self, cells: tuple[str, ...] | list[str]) -> tuple[tuple[int, ...], ...]:
        """Arrange cells in rows."""
        numbers = [int(cell) for cell in cells]
        return tuple(tuple(numbers[k : k + self._elements]) for k in range(0, len(numbers), self._elements))


Result = TypeVar("Result")
Talk = Generator[int, None, Result]  # Yields the time [ns] at which to continue at the latest

MARGIN_NS = 15_000_000  # Tolerance for the robot's clock, which counts milliseconds [ns]
_TRIES = 8
_ERASED_AT_ONCE = 7  # Each deleted character is answered by three; more at once would be lost


class ConsoleTalk:
    """The computer's end of the console of a robot with some number of emitters, and of sensors.

    `on_said` receives every printed line. Counts `lines`, `bad_echoes`, and unrequested lines by kind.
    """

    def __init__(
        self, elements: int, echo_timeout_ns: int, on_said: Callable[[Said], None], counts: Counter[str]
    ) -> None:
        self._parser = ConsoleParser(elements)
        self._timeout_ns = echo_timeout_ns
        self._on_said = on_said
        self._counts = counts
        self._output = bytearray()
        self._echoes: list[str] = []
        self._awaited = 0  # Backspaces that answer the last erasure
        self.now_ns = 0  # Time of the last step [ns]

    def hear(self, data: bytes, now_ns: int) -> None:
        """Take output of the console."""
        self.now_ns = now_ns
        for said in self._parser.feed(data, now_ns):
            if isinstance(said.event, Echo):
                self._echoes.append(said.event.line)
            elif isinstance(said.event, Noted) and said.event.reason:
                self._counts[said.event.reason] += 1
            self._on_said(said)

    def take_output(self) -> bytes:
        """Bytes to send now."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def until(self, condition: Callable[[], bool], timeout_ns: int | None = None) -> Talk[bool]:
        """Wait for a condition; whether it holds before the timeout (default: that of an echo).

        A jump back in time ends the wait, since the elapsed time is unknown.
        """
        begin_ns = self.now_ns
        deadline_ns = begin_ns + (self._timeout_ns if timeout_ns is None else timeout_ns)
        while not condition():
            if not begin_ns <= self.now_ns < deadline_ns:
                return False
            yield deadline_ns
        return True

    def pause(self, duration_ns: int) -> Talk[bool]:
        """Wait; see `until`."""
        return self.until(lambda: False, duration_ns)

    def enter(self, line: str) -> Talk[int]:
        """Type and terminate a line; the time at which the robot accepted it [ns].

        Raises SessionError if the robot does not echo the line in several attempts.
        """
        for _ in range(_TRIES):
            self._output += typed(line)
            if (yield from self.until(lambda: self._parser.partial == line)):
                self._echoes.clear()
                self._output += TERMINATOR
                if (yield from self.until(lambda: line in self._echoes)):
                    self._counts["lines"] += 1
                    return self.now_ns
            self._counts["bad_echoes"] += 1
            if not (yield from self.forget_line()):
                break
        raise SessionError(f"the robot does not echo '{line}'")

    def forget_line(self) -> Talk[bool]:
        """Delete the unfinished line, no faster than the robot can answer; whether it answered.

        The visible line does not show its true length, since other output may interrupt an echo.
        """
        erased = missed = 0
        while erased < MAX_LINE:
            self._awaited = self._parser.backspaces + BACKSPACES_PER_ERASE * _ERASED_AT_ONCE
            self._output += _ERASED_AT_ONCE * ERASE
            if (yield from self.until(lambda: self._parser.backspaces >= self._awaited)):
                erased += _ERASED_AT_ONCE
            elif (missed := missed + 1) == _TRIES:
                return False
        return True


def relay(console: ConsoleTalk, target: int, line: str) -> Talk[int]:
    """Send a line to another robot, without confirmation; the time at which it executes the line [ns].

    Raises SessionError if the robot at the cable does not echo the line.
    """
    sent_ns = yield from console.enter(for_robot(target, line))
    due_ns = sent_ns + message_ns(len(line)) + HANDLING_NS
    yield from console.pause(due_ns + MARGIN_NS - console.now_ns)
    return due_ns
