"""The console of an emulated PushBot: it parses lines of text as the firmware does.

Source: uart.c of the board's firmware EDVSBoardOS (eDVS4337), its first public revision and version 0.7.1.

The firmware of a PushBot: its main loop, and the limited rate of its wire.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.hardware import BAUD_RATE, FirmwareGeneration
from swarm_loc_drivers.sim.pushbot.board import BIAS_SETS, TX_BUFFER, Board, ClockMode, PushbotBody
from swarm_loc_drivers.sim.pushbot.motor import int32

_MAX_LINE = 128
_ALL_SENSORS = 0xFFFFFFFF
_DATE_LENGTH = 22  # Of a command that sets the date: one character more than the date takes
_MAX_ANALOG = 1023


class CommandLine:
    """A command line, and a place in it from which it is read.

    The firmware ends a line with a zero and leaves the rest of earlier lines behind it. Commands that are too
    short are read from there.

    Attributes:
        length: Number of characters.
    """

    def __init__(self) -> None:
        self._characters = bytearray(_MAX_LINE + 8)
        self._at = self.length = 0

    def put(self, character: int) -> bool:
        """Append a character; a full line begins again with it. Whether there was room."""
        has_room = self.length < _MAX_LINE - 1
        self.length = self.length if has_room else 0
        self._characters[self.length] = character
        self.length += 1
        return has_room

    def end(self) -> None:
        """End the line, and go to its begin."""
        self._characters[self.length] = 0
        self._at = 0

    def peek(self) -> str:
        """The next character as a capital letter."""
        return chr(self._characters[self._at]).upper()

    def take(self) -> str:
        """The next character as a capital letter, whatever it is."""
        self._at += 1
        return chr(self._characters[self._at - 1]).upper()

    def accept(self, characters: str) -> bool:
        """Take the next character if it is one of these."""
        is_one = self.peek() in characters
        self._at += is_one
        return is_one

    def unsigned(self) -> int:
        """Take a number without sign of 32 bits; 0 where there is none."""
        value = 0
        while self.peek().isdigit():
            value = (10 * value + int(self.take())) % 2**32
        return value

    def signed(self) -> int:
        """Take a number of 32 bits; 0 where there is none."""
        sign = -1 if self.accept("-") else 1
        if sign > 0:
            self.accept("+")
        return int32(sign * self.unsigned())


class Console:
    """Takes characters and acts on a board.

    Args:
        board: What commands act on.
        generation: Which firmware it is.

    Attributes:
        echo: 0: none, 1: characters, 2: characters and settings.
    """

    def __init__(self, board: Board, generation: FirmwareGeneration) -> None:
        self._board = board
        self._generation = generation
        self._is_second = generation.has_decay
        self._line = CommandLine()
        self.echo = 2

    def take(self, character: int) -> None:
        """Process a character."""
        board, line = self._board, self._line
        if board.is_halted:
            return
        echoes = self.echo > 0 and not board.is_streaming
        if character in b"\r\n":
            if echoes:
                board.say("\n")
            if line.length:
                line.end()
                self._execute()
                line.length = 0
        elif character == 8:
            if line.length:
                line.length -= 1
                if echoes:
                    board.say("\b \b")
        elif character < 0x80 and line.put(character) and echoes:
            board.say(chr(character))

    def _execute(self) -> None:
        first = self._line.take()
        if first == "?":
            self._get()
        elif first == "!":
            if not self._set():
                self._board.say("Set: parsing error\n")
        elif first == "R":
            self._board.reset()
        elif first == "E":
            self._board.stream_events(self._line.peek() == "+")
        elif first == "P":
            self._board.enter_bootloader()
        elif first not in "SW":
            self._board.say("?\n")

    def _confirm(self, setting: str) -> None:
        """Repeat a setting if the echo is to."""
        if self.echo > 1 and not self._board.is_streaming:
            self._board.say(f"{setting}\n")

    def _get(self) -> None:
        board, line, what = self._board, self._line, self._line.take()
        if what == "B":
            for number in range(len(board.biases)) if line.accept("A") else (line.unsigned(),):
                board.say(f"{self._bias(number)}\n")
        elif what == "E":
            board.say(f"-E{board.event_format}\n")
        elif what == "M" and self._is_second and line.accept("C"):
            if (motor := line.unsigned()) < len(board.motors):
                board.say(f"-MC{motor} " + "{},{},{}\n".format(*board.motors[motor].gains))
        elif what == "S":
            board.report(line.unsigned())
        elif what == "T":
            board.say("-T{:04}-{:02}-{:02} {:02}:{:02}:{:02}\n".format(*(board.date or [0] * 6)))
        elif what == "?":
            self._help()
        else:
            board.say("Get: parsing error\n")

    def _help(self) -> None:
        """Answer `??`, in fewer words than the firmware."""
        if self._line.peek() == "S":
            self._board.say(self._board.sensors.listing())
        elif self._line.peek() == "E":
            formats = self._generation.formats.items()
            rows = (f" !E{digit}   - timestamps: {name}\n" for name, digit in formats)
            self._board.say("".join(["List of available event data formats:\n", *rows, "\n"]))
        else:
            self._board.say_version()

    def _bias(self, number: int) -> str:
        biases = self._board.biases
        return f"-B{int32(number)}={int32(biases[number]) if number < len(biases) else 0}"

    def _set(self) -> bool:
        """Execute a command `!`; whether it was understood."""
        commands = {
            "A": self._set_analog,
            "B": self._set_bias,
            "E": self._set_events,
            "L": self._set_led,
            "M": self._set_motors,
            "P": self._set_timer,
            "S": self._set_sensors,
            "T": self._set_date,
            "U": self._set_wire,
        }
        command = commands.get(self._line.take())
        return command is not None and command()

    def _set_analog(self) -> bool:
        """Nothing is connected to the analog output."""
        self._line.accept("=")
        if self._line.unsigned() > _MAX_ANALOG:
            self._board.say("Analog output should be between [0-1023]\n")
        return True

    def _set_bias(self) -> bool:
        board, line = self._board, self._line
        if line.accept("F"):
            self._confirm("-BF")
        elif line.accept("D"):
            chosen = line.take()
            if chosen in "012345":
                self._confirm(f"-BD{chosen}")
                board.biases = list(BIAS_SETS[int(chosen)])
            else:
                board.say("Select default bias set: parsing error\n")
        else:
            number = line.unsigned()
            line.take()
            value = line.unsigned()
            if number < len(board.biases):
                board.biases[number] = value
            self._confirm(self._bias(number))
        return True

    def _set_events(self) -> bool:
        board, line = self._board, self._line
        if line.accept("T"):
            self._set_clock()
            return True
        if line.accept("R"):
            if line.accept("+"):
                board.say("-ER-\n")  # there is no card
                return True
            return line.accept("-")
        if not line.peek().isdigit() or int(line.peek()) not in self._generation.formats.values():
            return False
        board.event_format = int(line.peek())
        self._confirm(f"-E{board.event_format}")
        return True

    def _set_clock(self) -> None:
        """Set the clock of the events; the second firmware skips a character before the number."""
        board, line = self._board, self._line
        name = line.take() if self._is_second else ""
        if name == "M":
            name += "0" if line.peek() == "0" else "+"
        if name and name in [mode.value for mode in ClockMode]:
            board.set_clock_mode(ClockMode(name))
            board.say(f"-ET{name}\n")
        else:
            board.set_time(line.unsigned())

    def _set_led(self) -> bool:
        return self._line.peek() in "012"

    def _set_motors(self) -> bool:
        board, line = self._board, self._line
        if line.peek() in "+-":
            board.enable_motors(line.take() == "+")
            return True
        kind = next((letter for letter in ("DVPC" if self._is_second else "DVP") if line.accept(letter)), "")
        decays = kind == "D" or (kind == "V" and self._is_second and line.accept("D"))
        if self._is_second and not line.peek().isdigit():
            return False
        motor = line.unsigned()
        if kind == "C":
            return self._set_gains(motor)
        line.take()
        if kind == "P":
            if not board.set_motor_period(motor, line.unsigned()):
                board.say("Error setting motor PWM\n")
        elif kind == "V":
            if not board.drive(motor, line.signed(), "velocity", decays=decays):
                board.say("Error setting motor speed\n")
        elif not decays and motor >= len(board.motors):
            board.say("Error setting motor mode\n")
        elif not self._is_second or line.accept("%"):
            if not board.drive(motor, line.signed(), "percent", decays=decays):
                board.say("Error setting motor speed\n")
        elif not board.drive(motor, line.signed(), "us", decays=decays):
            board.say(f"Error setting motor {'speed' if decays else 'width'}\n")
        return True

    def _set_gains(self, motor: int) -> bool:
        gains = []
        for separator in "=,,":
            if not self._line.accept(separator):
                return False
            gains.append(self._line.signed())
        if motor >= len(self._board.motors):
            self._board.say("Error setting controller PID\n")
        else:
            self._board.motors[motor].gains = (gains[0], gains[1], gains[2])
        return True

    def _set_timer(self) -> bool:
        board, line, timer = self._board, self._line, self._line.take()
        if timer not in "ABC":
            board.say("Channel not recognized\n")
            return True
        output = line.take()
        if output not in "01":
            if not board.set_period(timer, line.unsigned()):
                board.say("Error setting PWM frequency\n")
            return True
        line.take()
        is_percent = line.accept("%")
        value = line.unsigned()
        width_us = min(value, 100) * board.period(timer) % 2**32 // 100 if is_percent else value
        if not board.set_width(timer, output, width_us):
            board.say(f"Error setting PWM {'dutycycle' if is_percent else 'width'}\n")
        return True

    def _set_sensors(self) -> bool:
        sensors, line, sign = self._board.sensors, self._line, self._line.take()
        if not self._is_second:
            line.take()
        elif not (line.peek().isdigit() and sign in "+-") and (sign != "-" or line.length > len("!S-")):
            return False
        mask = line.unsigned()
        if sign != "+":
            sensors.stop(mask if line.length > len("!S-") else _ALL_SENSORS)
        elif line.accept(",") or not self._is_second:
            sensors.start(mask, line.unsigned())
        else:
            return False
        return True

    def _set_date(self) -> bool:
        board, line = self._board, self._line
        if line.peek() in "+-":
            sign = line.take()
            board.run_date(sign == "+")
            board.say(f"-T{sign}\n")
        elif line.length < _DATE_LENGTH:
            board.say("Wrong format\n")
        elif not board.date:
            board.say("RTC not enabled\n")
        else:
            fields = []
            for _ in range(6):
                fields.append(line.unsigned())
                line.take()
            board.set_date(fields)
        return True

    def _set_wire(self) -> bool:
        """Set the echo, or the baud rate, which only changes what is said: links here have one rate."""
        line = self._line
        if line.peek() in "012":
            self.echo = int(line.take())
        elif line.accept("=") or not self._is_second:
            self._confirm(f"Switching Baud Rate to {int32(line.unsigned())} Baud!")
        else:
            return False
        return True


_BITS_PER_BYTE = 10
LATE_SHARE = 0.03
"""Share of received bytes that are parsed between a tick of the clock and the controllers' update."""
_MAX_GAP_S = 0.02  # A wire that was blocked for longer does not catch up


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
        self.board.tick()
        self._work()
        self.board.run_controllers()

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
