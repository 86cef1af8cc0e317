"""Reliable transfer of command lines over a Droplet's console, verified by their echo, without I/O or clock.

A Droplet ignores its console for a sixth of a second during an infrared exchange, and a line that has lost
characters may be another command. So a line is terminated only after its complete echo; otherwise it is
deleted and typed again.

Actions that take time are generators: they yield the time [ns] at which to continue at the latest, and
continue whenever output arrives.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator
from typing import TypeVar

from swarm_loc_drivers.common.session import SessionError
from swarm_loc_drivers.droplet import protocol
from swarm_loc_drivers.droplet.hardware import HANDLING_NS, message_ns
from swarm_loc_drivers.droplet.protocol import Echo, Said

Result = TypeVar("Result")
Talk = Generator[int, None, Result]  # Yields the time [ns] at which to continue at the latest

MARGIN_NS = 15_000_000  # Tolerance for the robot's clock, which counts milliseconds [ns]
_TRIES = 8
_ERASED_AT_ONCE = 7  # Each deleted character is answered by three; more at once would be lost

_COUNTED = {
    protocol.Broken: "broken_matrices",
    protocol.Unknown: "unknown_lines",
    protocol.NotRecognised: "unknown_commands",
    protocol.Overflow: "overflows",
    protocol.Complaint: "firmware_errors",
    protocol.SilentSensor: "silent_sensors",
    protocol.EmissionFailed: "failed_emissions",
    protocol.RangeBearing: "range_bearings",
}


class ConsoleTalk:
    """The computer's end of the console of a robot with some number of emitters, and of sensors.

    `on_said` receives every printed line. Counts `lines`, `bad_echoes`, and unrequested lines by kind.
    """

    def __init__(
        self, elements: int, echo_timeout_ns: int, on_said: Callable[[Said], None], counts: Counter[str]
    ) -> None:
        self._parser = protocol.ConsoleParser(elements)
        self._timeout_ns = echo_timeout_ns
        self._on_said = on_said
        self._counts = counts
        self._output = bytearray()
        self._echoes: list[str] = []
        self.now_ns = 0  # Time of the last step [ns]

    def hear(self, data: bytes, now_ns: int) -> None:
        """Take output of the console."""
        self.now_ns = now_ns
        for said in self._parser.feed(data, now_ns):
            if isinstance(said.event, Echo):
                self._echoes.append(said.event.line)
            elif (name := _COUNTED.get(type(said.event))) is not None:
                self._counts[name] += 1
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

    def pause(self, duration_ns: int) -> Talk[None]:
        """Wait."""
        yield from self.until(lambda: False, duration_ns)

    def enter(self, line: str) -> Talk[int]:
        """Type and terminate a line; the time at which the robot accepted it [ns].

        Raises:
            SessionError: The robot does not echo the line in several attempts.
        """
        for _ in range(_TRIES):
            self._output += protocol.typed(line)
            if (yield from self.until(lambda: self._parser.partial == line)):
                self._echoes.clear()
                self._output += protocol.TERMINATOR
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
        while erased < protocol.MAX_LINE:
            if (yield from self._erase(_ERASED_AT_ONCE)):
                erased += _ERASED_AT_ONCE
            elif (missed := missed + 1) == _TRIES:
                return False
        return True

    def _erase(self, count: int) -> Talk[bool]:
        """Delete characters; whether the robot answers."""
        answered = self._parser.backspaces + protocol.BACKSPACES_PER_ERASE * count
        self._output += count * protocol.ERASE
        return (yield from self.until(lambda: self._parser.backspaces >= answered))


def relay(console: ConsoleTalk, target: int, line: str) -> Talk[int]:
    """Send a line to another robot, without confirmation; the time at which it executes the line [ns].

    Raises:
        SessionError: The robot at the cable does not echo the line.
    """
    sent_ns = yield from console.enter(protocol.for_robot(target, line))
    due_ns = sent_ns + message_ns(len(line)) + HANDLING_NS
    yield from console.pause(due_ns + MARGIN_NS - console.now_ns)
    return due_ns
