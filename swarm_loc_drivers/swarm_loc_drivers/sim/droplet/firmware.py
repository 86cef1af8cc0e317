"""The Droplet's firmware of 2018 at its serial console, as far as drivers speak to it.

Two things are up to the program that a user writes for his Droplets: that matrices are printed (the stock
firmware prints none), and that emitters shine as `set_ir` has said (in exchanges the stock one takes 256).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from swarm_loc_drivers.droplet.hardware import (
    DIRECTIONS,
    EMIT_DELAY_NS,
    FULL_POWER,
    HANDLING_NS,
    MAX_MESSAGE,
    PRINT_DELAY_NS,
    SET_POWER_DELAY_NS,
    gait,
)
from swarm_loc_drivers.sim.droplet.infrared import ExchangeReadings, InfraredCommand
from swarm_loc_estimator.common.arrays import IntArray


class DropletBody(Protocol):
    """Motors, infrared and clock of one Droplet; called by the thread that serves the firmware's bytes."""

    @property
    def robot_id(self) -> int:
        """The id in its chip, never 0."""

    @property
    def trims(self) -> Sequence[Sequence[int]]:
        """Calibration in its memory: the trims of the three motors per direction."""

    @property
    def lengths(self) -> Sequence[int]:
        """Calibration in its memory: path [mm] or turn [deg] per 1000 steps of each direction."""

    def move(self, direction: int | None) -> None:
        """Run the motors of a direction until the next call; None stops them."""

    def infrared_status(self) -> int:
        """Bits: 1 a message is coming in, 2 one is going out, 4 and 8 an exchange is going on."""

    def send(self, line: str, target: int) -> None:
        """Send a command to another robot; target 0: to all."""

    def emit(self, power: int) -> None:
        """Announce an exchange, then light the emitters one after the other at a power of 0 to 256."""

    def heard(self) -> Sequence[InfraredCommand | ExchangeReadings]:
        """The commands and readings received by infrared since the last call."""

    def deaf_until_ns(self) -> int:
        """End of the current exchange, during which the firmware does nothing else [ns]."""

    @property
    def now_ns(self) -> int:
        """The world's time [ns]."""


_BUFFER = 64
_RECEIVE_QUEUE = 2  # Characters that the serial port keeps while nobody fetches them
_BUSY_SENDING = 2
_BUSY_EXCHANGING = 4
_PROCESSING = 1 << 6
_BACKSPACE, _ESCAPE = 8, 27

Print = Callable[[int, int, IntArray], str]
"""Emitter's id, receiver's id, readings (n, n) emitters by sensors -> what the user's program prints."""


def print_named(emitter: int, receiver: int, readings: IntArray) -> str:
    """The format with the ids of both robots."""
    return f'{{"{emitter:04X}", "{receiver:04X}", {_braces(readings)}}},\r\n'


def _braces(readings: IntArray) -> str:
    return "{" + ",".join("{" + ",".join(map(str, row)) + "}" for row in readings.tolist()) + "}"


class DropletFirmware:
    """Answers bytes as the robot does; `print_matrix` is what the user's program prints."""

    def __init__(self, body: DropletBody, print_matrix: Print = print_named) -> None:
        self._body = body
        self._print_matrix = print_matrix
        self._line = bytearray()
        self._queue = bytearray()
        self._escape = 0
        self._output = ""
        self._tasks: list[tuple[int, Callable[[], None]]] = []
        self._moving = False
        self._stops = 0
        self._power = FULL_POWER
        self._unread = 0
        self._commands: dict[str, Callable[[list[str]], None]] = {
            "get_id": lambda _: self._say(f"My ID is: {body.robot_id:04X}"),
            "move_steps": self._move_steps,
            "stop_walk": lambda _: self._stop(),
            "rnb_b": lambda _: self._later(EMIT_DELAY_NS, self._emit),
            "set_ir": self._set_power,
            "cmd": lambda words: self._send(0, " ".join(words)),
            "tgt_cmd": lambda words: self._send(int(words[0], 16), " ".join(words[1:])),
            "print_motor_settings": lambda _: self._print_settings(),
        }

    def receive(self, data: bytes) -> bytes:
        """Take bytes; returns the answer. During an exchange most bytes are lost."""
        if self._is_deaf():
            self._queue += data[: _RECEIVE_QUEUE - len(self._queue)]
            return b""
        for byte in data:
            self._character(byte)
        return self._taken()

    def stream(self) -> bytes:
        """The bytes that the robot sends without being asked."""
        if self._is_deaf():
            return b""
        if self._queue:
            queued, self._queue = bytes(self._queue), bytearray()
            for byte in queued:
                self._character(byte)
        for heard in self._body.heard():
            if isinstance(heard, InfraredCommand):
                self._at(heard.end_ns + HANDLING_NS, lambda line=heard.line: self._execute(line))  # type: ignore[misc]
            else:
                self._unread += 1
                self._at(heard.end_ns + PRINT_DELAY_NS, lambda measured=heard: self._report(measured))  # type: ignore[misc]
        if self._tasks:
            self._run_tasks()
        return self._taken() if self._output else b""

    def _is_deaf(self) -> bool:
        return self._body.now_ns < self._body.deaf_until_ns()

    def _taken(self) -> bytes:
        output, self._output = self._output, ""
        return output.encode("latin-1")

    def _say(self, text: str) -> None:
        self._output += text + "\r\n"

    def _at(self, due_ns: int, task: Callable[[], None]) -> None:
        self._tasks.append((due_ns, task))

    def _later(self, delay_ns: int, task: Callable[[], None]) -> None:
        self._at(self._body.now_ns + delay_ns, task)

    def _run_tasks(self) -> None:
        """Run the tasks that are due, the oldest first; tasks may add others."""
        while self._tasks and not self._is_deaf():
            first = min(self._tasks, key=lambda one: one[0])
            due_ns, task = first
            if due_ns > self._body.now_ns:
                return
            self._tasks.remove(first)
            task()

    def _character(self, byte: int) -> None:
        """Process a typed character."""
        if self._escape:
            self._escape = 2 if self._escape == 1 and byte == ord("[") else 0
        elif byte in b"\r\n":
            line, self._line = self._line.decode("latin-1"), bytearray()
            self._output += "\r\n"
            self._execute(line)
        elif byte == _BACKSPACE:
            del self._line[-1:]
            self._output += "\b \b"
        elif byte == _ESCAPE:
            self._escape = 1
        elif len(self._line) == _BUFFER:
            self._line.clear()
            self._output += f"\r\nERROR: Serial input buffer capacity of {_BUFFER} characters exceeded.\r\n"
        else:
            self._line.append(byte)
            self._output += chr(byte)

    def _execute(self, line: str) -> None:
        """Execute a line, typed or sent by another robot."""
        if not line:
            return
        word, *arguments = line.split(" ")
        command = self._commands.get(word)
        if command is None:
            self._say(f"\tCommand ( {word} ) not recognized.")
            return
        try:
            command(arguments)
        except (IndexError, ValueError):
            self._reset()  # a missing argument crashes the firmware

    def _move_steps(self, words: list[str]) -> None:
        direction, steps = ord(words[0][0]) - ord("0"), int(words[1])
        if steps > 0:
            self._say(f"walk direction {direction}, num_steps {steps}")
            self._begin_move(direction, steps)

    def _begin_move(self, direction: int, steps: int) -> None:
        """Move, unless moving."""
        if self._moving or direction not in DIRECTIONS:
            return
        one = gait(direction, self._body.trims[direction], self._body.lengths[direction])
        if one is None:
            return
        self._moving = True
        self._body.move(direction)
        stops = self._stops

        def end() -> None:
            if self._stops == stops:
                self._stop()

        self._later(round(steps * one.step_s * 1e9), end)

    def _stop(self) -> None:
        self._stops += 1
        self._moving = False
        self._body.move(None)

    def _set_power(self, words: list[str]) -> None:
        power = int(words[0])

        def set_it() -> None:
            self._power = min(max(power, 0), FULL_POWER)

        self._later(SET_POWER_DELAY_NS, set_it)

    def _emit(self) -> None:
        status = self._body.infrared_status()
        if status >= _BUSY_EXCHANGING or self._unread:
            self._say(f"RNB Broadcast failed [ {_PROCESSING | status:02X} ]")
        else:
            self._body.emit(self._power)

    def _send(self, target: int, line: str) -> None:
        to = f" to {target:04X}" if target else ""
        self._say(f'Broadcasting command{to}: "{line}", of length {len(line)}.')
        status = self._body.infrared_status()
        if status >= _BUSY_SENDING:
            self._say(f"Aborting IR send [{status:02x}] while trying: {line}")
        elif len(line) > MAX_MESSAGE:
            self._say("ERROR: Message exceeds IR_BUFFER_SIZE.")
        else:
            self._body.send(line, target)

    def _report(self, measured: ExchangeReadings) -> None:
        self._unread -= 1
        self._output += self._print_matrix(measured.emitter, self._body.robot_id, measured.readings)

    def _print_settings(self) -> None:
        self._say("Motor Values")
        for direction in DIRECTIONS:
            trims = "\t".join(map(str, self._body.trims[direction]))
            self._say(f"\tdir: {direction}\t{trims}\t")
        self._say("")
        self._say("Dist (mm) per kilostep")
        for direction in DIRECTIONS:
            self._say(f"\t{direction}\t{self._body.lengths[direction]}")

    def _reset(self) -> None:
        self._stop()
        self._tasks.clear()
        self._line.clear()
        self._unread = 0
        self._power = FULL_POWER
        self._output += "\n"
