"""Reliable transfer of command lines over a Droplet's console, checked by their echo. No I/O, no clock.

A Droplet that takes part in an infrared exchange does not listen to its console for a sixth of a second,
and a line of which some characters were lost may be another command. So a line is only ended when its echo
shows that it arrived whole; else it is taken back and typed anew.

What takes time is a generator: it yields the time [ns] at which it wants to go on at the latest, and goes on
whenever something was heard.
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
Talk = Generator[int, None, Result]
"""Yields the time [ns] at which it wants to go on at the latest."""

MARGIN_NS = 15_000_000
"""How much later than reckoned a robot may be ready: its clock runs by the millisecond."""
_TRIES = 8
_ERASED_AT_ONCE = 7
"""Each character taken back is answered by three; more at once would be lost on the way."""

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
    """One end of the line.

    Args:
        elements: Emitters, and sensors, of the robots.
        echo_timeout_ns: How long an echo, or an answer, may take.
        on_said: Gets every line that the console prints.
        counts: Gets `lines`, `bad_echoes`, and lines by kind that nobody asked for.

    Attributes:
        now_ns: The time at which something was last heard, or looked.
    """

    def __init__(
        self,
        elements: int,
        echo_timeout_ns: int,
        on_said: Callable[[Said], None],
        counts: Counter[str],
    ) -> None:
        self._parser = protocol.ConsoleParser(elements)
        self._timeout_ns = echo_timeout_ns
        self._on_said = on_said
        self._counts = counts
        self._output = bytearray()
        self._echoes: list[str] = []
        self.now_ns = 0

    def hear(self, data: bytes, now_ns: int) -> None:
        """The console has printed this."""
        self.now_ns = now_ns
        for said in self._parser.feed(data, now_ns):
            if isinstance(said.event, Echo):
                self._echoes.append(said.event.line)
            elif (name := _COUNTED.get(type(said.event))) is not None:
                self._counts[name] += 1
            self._on_said(said)

    def take_output(self) -> bytes:
        """What is to be sent now."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def until(self, condition: Callable[[], bool], timeout_ns: int | None = None) -> Talk[bool]:
        """Wait for something; whether it came before the timeout, that of an echo if none is given.

        Who waits while time jumps back waits no longer: how long it has been is not known.
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
        """Type a line and end it; when the robot took it [ns].

        Raises:
            SessionError: The robot does not echo it, though it was tried again and again.
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
        """Take back whatever was typed and not ended, no faster than the robot can answer; whether it did.

        What shows of the line does not tell how much there is: a print-out that falls into an echo ends it.
        """
        erased = missed = 0
        while erased < protocol.MAX_LINE:
            if (yield from self._erase(_ERASED_AT_ONCE)):
                erased += _ERASED_AT_ONCE
            elif (missed := missed + 1) == _TRIES:
                return False
        return True

    def _erase(self, count: int) -> Talk[bool]:
        """Take back so many characters; whether the robot answers."""
        answered = self._parser.backspaces + protocol.BACKSPACES_PER_ERASE * count
        self._output += count * protocol.ERASE
        return (yield from self.until(lambda: self._parser.backspaces >= answered))


def relay(console: ConsoleTalk, target: int, line: str) -> Talk[int]:
    """Have another robot take a line, which nobody confirms; when it does if it has heard it [ns].

    Raises:
        SessionError: The robot at the cable does not echo it.
    """
    sent_ns = yield from console.enter(protocol.for_robot(target, line))
    due_ns = sent_ns + message_ns(len(line)) + HANDLING_NS
    yield from console.pause(due_ns + MARGIN_NS - console.now_ns)
    return due_ns
