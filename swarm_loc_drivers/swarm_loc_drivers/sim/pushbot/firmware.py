"""The firmware of a PushBot: its console, and the limited rate of its wire."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.hardware import BAUD_RATE, FirmwareGeneration
from swarm_loc_drivers.sim.pushbot.board import TX_BUFFER, Board, PushbotBody

_MAX_LINE = 128
_SET_ERROR, _GET_ERROR = "Set: parsing error\n", "Get: parsing error\n"
_DUTY = re.compile(r"(\d+).(%?)([-+]?\d*)")
_VELOCITY = re.compile(r"(\d+).([-+]?\d*)")
_TIMER = re.compile(r"([A-Ca-c])([01]?).(%?)(\d*)")
_SENSORS = re.compile(r"(\d+)(?:,(\d*))?")


class Console:
    """Takes characters and acts on a board.

    Args:
        board: What commands act on.
        generation: Which firmware it is.
    """

    def __init__(self, board: Board, generation: FirmwareGeneration) -> None:
        self._board = board
        self._generation = generation
        self._line = ""
        self.echo = 2

    def take(self, character: int) -> None:
        """Process a character."""
        board = self._board
        echoes = self.echo > 0 and not board.is_streaming
        if character in b"\r\n":
            if echoes:
                board.say("\n")
            line, self._line = self._line, ""
            if line:
                self._execute(line)
        elif character == 8:
            self._line = self._line[:-1]
        elif character < 0x80:
            if echoes:
                board.say(chr(character))
            self._line = (self._line if len(self._line) < _MAX_LINE - 1 else "") + chr(character)

    def _execute(self, line: str) -> None:
        first = line[0].upper()
        if first == "?":
            self._get(line)
        elif first == "!":
            if not self._set(line[1:2].upper(), line[2:]):
                self._board.say(_SET_ERROR)
        elif first == "R":
            self._board.reset()
        elif first == "E":
            self._board.stream_events(line[1:2] == "+")
        elif first not in "PS":
            self._board.say("?\n")

    def _get(self, line: str) -> None:
        board, what = self._board, line[1:2].upper()
        if what == "E":
            board.say(f"-E{board.event_format}\n")
        elif what == "S":
            board.report(_number(line[2:]))
        elif line[1:3].upper() == "?S":
            board.list_sensors()
        elif what == "?":
            board.say_version()
        else:
            board.say(_GET_ERROR)

    def _set(self, what: str, rest: str) -> bool:
        """Execute a command `!`; whether it was understood."""
        if what == "E":
            return self._set_events(rest)
        if what == "M":
            return self._set_motors(rest)
        if what == "P":
            return self._set_timer(rest)
        if what == "S":
            return self._set_sensors(rest)
        if what == "U":
            if rest[:1] in ("0", "1", "2"):
                self.echo = int(rest[0])
            return rest[:1] in ("0", "1", "2") or rest[:1] == "="
        return what in ("B", "L")

    def _set_events(self, rest: str) -> bool:
        board = self._board
        if rest[:1].upper() == "T":  # the second firmware skips a character more
            board.set_time(_number(rest[2 if self._generation.has_decay else 1 :]))
            return True
        if rest[:1] not in tuple(str(digit) for digit in self._generation.formats.values()):
            return False
        board.event_format = int(rest[0])
        if not board.is_streaming and self.echo > 1:
            board.say(f"-E{board.event_format}\n")
        return True

    def _set_motors(self, rest: str) -> bool:
        board, mode = self._board, rest[:1].upper()
        if mode in ("+", "-"):
            board.enable_motors(mode == "+")
            return True
        if mode == "V":
            decays = rest[1:2].upper() == "D" and self._generation.has_decay
            # the first firmware takes any character for the number of a motor, which then is 0
            match = _VELOCITY.match(rest[2:] if decays else rest[1:])
            return self._drive(match[1], match[2], "velocity", decays=decays) if match else self._odd_drive()
        decays = mode == "D"
        match = _DUTY.match(rest[1:] if decays else rest)
        return self._drive(match[1], match[3], "duty", decays=decays) if match else False

    def _odd_drive(self) -> bool:
        if not self._generation.has_decay:
            self._board.drive(0, 0, "velocity", decays=False)
        return not self._generation.has_decay

    def _drive(self, motor: str, value: str, kind: str, *, decays: bool) -> bool:
        if int(motor) > 1:
            self._board.say("Error setting motor speed\n")
        else:
            self._board.drive(int(motor), _number(value), kind, decays=decays)
        return True

    def _set_timer(self, rest: str) -> bool:
        match = _TIMER.match(rest)
        if match is None:
            self._board.say("Channel not recognized\n")
            return True
        timer, output, percent, value = match[1].upper(), match[2], match[3], _number(match[4])
        if not output:
            self._board.set_period(timer, value)
        else:
            period = self._board.period(timer)
            width = min(value, 100) * period // 100 if percent else value
            self._board.set_width(timer, int(output), width)
        return True

    def _set_sensors(self, rest: str) -> bool:
        sign, rest = rest[:1], rest[1 + len(self._generation.sensor_prefix) :]
        if sign not in ("+", "-"):
            return False
        if sign == "-" and not rest:
            self._board.stop_sensors(0xFFFFFFFF)
            return True
        match = _SENSORS.match(rest)
        if match is None or (sign == "+" and match[2] is None):
            return False
        if sign == "+":
            self._board.start_sensors(int(match[1]), _number(match[2]))
        else:
            self._board.stop_sensors(int(match[1]))
        return True


def _number(text: str) -> int:
    """The whole number that a text begins with, 0 without one."""
    match = re.match(r"[-+]?\d+", text)
    return int(match[0]) if match else 0


_BITS_PER_BYTE = 10
LATE_SHARE = 0.03
"""Share of received bytes that are parsed between a tick of the clock and the controllers' update."""
_MAX_GAP_S = 0.02
"""A wire that was blocked for longer does not catch up."""


class PushbotFirmware:
    """A robot's firmware, for any link that waits for whoever reads it (RTS/CTS, TCP).

    Args:
        body: The robot.
        generation: Which firmware it is.
        baud_rate: Of the wire to the host or its radio [bit/s].
        seed: Decides which bytes are parsed just after a tick of the clock, see `Motor`.

    Attributes:
        late_share: Share of these bytes.
    """

    def __init__(
        self, body: PushbotBody, generation: FirmwareGeneration, baud_rate: int = BAUD_RATE, seed: int = 0
    ) -> None:
        self.late_share = LATE_SHARE
        self._rng = np.random.default_rng(seed)
        self._body = body
        self.board = Board(body, generation)
        self.board.was_reset = False
        self._generation = generation
        self._console = Console(self.board, generation)
        self._bytes_per_s = baud_rate / _BITS_PER_BYTE
        self._sent_ns = body.now_ns
        self._received = b""

    def millisecond(self) -> None:
        """A millisecond has passed in the world."""
        self.board.request_updates()
        self._work()
        self.board.millisecond()

    def see(self, words: NDArray[np.uint16], times_us: NDArray[np.int64]) -> None:
        """The camera has seen events `0yyyyyyy pxxxxxxx` (N,) at times of the world (N,) [us]."""
        self.board.see(words, times_us, self._budget() // 2)

    def receive(self, data: bytes) -> bytes:
        """Take bytes; answers come with `stream`."""
        self._received += data
        if not data or self._rng.random() >= self.late_share:
            self._work()
        return b""

    def _work(self) -> None:
        """Run the main loop until it has to wait for room in the text buffer."""
        used = 0
        for character in self._received:
            if self.board.is_blocked:
                break
            self._console.take(character)
            used += 1
            if self.board.was_reset:
                self.board.was_reset = False
                self._console = Console(self.board, self._generation)
        self._received = self._received[used:]

    def stream(self) -> bytes:
        """The bytes carried by the wire since the last call."""
        board, now_ns = self.board, self._body.now_ns
        budget, parts = self._budget(), []
        self._sent_ns = now_ns
        while budget > 0:
            text_ns = board.texts[0][0] if board.texts else now_ns
            data = b""
            if board.is_streaming:
                data = board.ring.take(board.board_us(text_ns // 1000), budget, board.stamp_bytes)
            if board.texts:
                data += board.texts.popleft()[1]
            elif not data:
                break
            parts.append(data)
            budget -= len(data)
        return b"".join(parts)

    def disconnect(self) -> None:
        """The host has disconnected, which the board does not notice."""

    def _budget(self) -> int:
        """Bytes that the wire can carry since the last call."""
        elapsed_s = min((self._body.now_ns - self._sent_ns) * 1e-9, _MAX_GAP_S)
        return min(round(elapsed_s * self._bytes_per_s), 2 * TX_BUFFER)
