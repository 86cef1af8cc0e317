"""The firmware of an emulated PushBot, as far as drivers use it: motors, events, board, console, wire.

Source: uart.c, pwm.c, motors.c, sensors.c, DVS128Chip.c and main.c of the board's firmware EDVSBoardOS
(eDVS4337), its first public revision and version 0.7.1.
"""

from __future__ import annotations

import re
from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.protocol import BAUD_RATE, MAX_VELOCITY, TIMESTAMPS, FirmwareGeneration
from swarm_loc_drivers.sim.pushbot.event_camera import Blinking
from swarm_loc_estimator.common.arrays import IntArray

_PERIOD = 50 * 192  # Period of the pulses: 50 us of a timer of 192 MHz
_GAIN = 80  # Proportional gain of the velocity controller [counts of the timer per tick]
_WINDUP = _PERIOD // _GAIN * 20  # Largest error of the controller [ticks]
_PRESCALER = 20
_DECAY_TENTHS = 10
_MAX_PERCENT = 100


class Motor:
    """One motor: its command, and the resulting duty cycle.

    As on the board, a clock tick requests an update of the velocity controller, which the main loop executes
    after it has parsed the commands, whatever they have set: a duty cycle that is parsed in between is lost.
    """

    def __init__(self) -> None:
        self._width = 0  # of the pulses, negative for backward [counts of the timer]
        self._is_controlled = self._needs_update = self._decays = False
        self._decay_left = self._velocity = self._position = self._prescaled = 0

    @property
    def duty(self) -> float:
        """Share of the battery's voltage in [-1, 1]."""
        return self._width / _PERIOD

    def set_percent(self, percent: int) -> None:
        """Drive by a duty cycle [percent]."""
        self._is_controlled = self._decays = False
        self._set_width(int(max(-_MAX_PERCENT, min(_MAX_PERCENT, percent)) * _PERIOD / 100))

    def set_velocity(self, velocity: int, ticks: int, *, decays: bool) -> None:
        """Drive at a velocity [ticks per 21 ms]; `ticks` is where the wheel is now."""
        if not self._is_controlled:
            self._position = ticks
        self._is_controlled, self._decays, self._decay_left = True, decays, _DECAY_TENTHS
        self._velocity = max(-MAX_VELOCITY, min(MAX_VELOCITY, velocity))

    def decay(self) -> None:
        """Process a tick of a tenth of a second."""
        if self._decays and self._decay_left:
            self._decay_left -= 1
        elif self._decays:
            self._velocity -= (self._velocity > 0) - (self._velocity < 0)

    def request_update(self) -> None:
        """The clock ticks: request an update of the velocity controller."""
        self._needs_update = self._needs_update or self._is_controlled

    def update(self, ticks: int) -> None:
        """Update the velocity controller if it was requested; `ticks` is where the wheel is now."""
        if not self._needs_update:
            return
        self._needs_update = False
        if self._prescaled == 0:
            self._prescaled = _PRESCALER
            self._position = int32(self._position + self._velocity)
        else:
            self._prescaled -= 1
        error = int32(self._position - ticks)
        self._position = int32(ticks + max(-_WINDUP, min(_WINDUP, error)))
        self._set_width(_GAIN * error)

    def _set_width(self, width: int) -> None:
        self._width = max(-_PERIOD, min(_PERIOD, width))


def int32(value: int) -> int:
    """What is left of a number in a signed integer of 32 bits."""
    return (value + 2**31) % 2**32 - 2**31


RING = 4092  # Events that wait; with four places left the oldest is dropped
_DELTA_LIMITS = (0x7F, 0x3FFF, 0x1FFFFF)


class EventRing:
    """Ring buffer of events to be sent."""

    def __init__(self) -> None:
        self.dropped = 0  # Events that were overwritten, unnoticed by the board
        self._words = np.zeros(0, np.uint16)
        self._times = np.zeros(0, np.int64)
        self._last = 0

    def __len__(self) -> int:
        return len(self._words)

    def put(self, words: NDArray[np.uint16], times_us: IntArray, sent: int) -> None:
        """Take events `0yyyyyyy pxxxxxxx` (N,), in order, with their board's time (N,) [us].

        `sent` events are sent while these come, which leave their places.
        """
        self._words = np.concatenate([self._words, words])
        self._times = np.concatenate([self._times, times_us])
        self._forget(RING + sent)

    def _forget(self, kept: int) -> None:
        extra = len(self._words) - kept
        if extra > 0:
            self.dropped += extra
            self._words, self._times = self._words[extra:], self._times[extra:]

    def clear(self) -> None:
        """Drop all events, as when nothing is streamed."""
        self._words, self._times = self._words[:0], self._times[:0]

    def take(self, until_us: int, max_bytes: int, stamp_bytes: int) -> bytes:
        """The bytes of events up to a time, as many as fit; stamp_bytes of -1: differences."""
        due = int(np.searchsorted(self._times, until_us, side="right"))
        if stamp_bytes >= 0:
            count = min(due, max_bytes // (2 + stamp_bytes))
            data = _fixed(self._words[:count], self._times[:count], stamp_bytes)
        else:
            deltas = np.diff(self._times[:due], prepend=self._last) & 0xFFFFFFFF
            sizes = 3 + np.searchsorted(_DELTA_LIMITS, deltas, side="right")
            count = int(np.searchsorted(np.cumsum(sizes), max_bytes, side="right"))
            data = _differences(self._words[:count], deltas[:count], sizes[:count])
            self._last = int(self._times[count - 1]) if count else self._last
        self._words, self._times = self._words[count:], self._times[count:]
        self._forget(RING)
        return data


def _fixed(words: NDArray[np.uint16], times: IntArray, stamp_bytes: int) -> bytes:
    """Events with timestamps of one length, the most significant byte first."""
    stamps = times[:, None] >> 8 * np.arange(stamp_bytes)[::-1] & 0xFF
    return np.column_stack([words >> 8 | 0x80, words & 0xFF, stamps]).astype(np.uint8).tobytes()


def _differences(words: NDArray[np.uint16], deltas: IntArray, sizes: IntArray) -> bytes:
    """Events with the time since the last one, seven bits a byte, the last byte marked."""
    ends = np.cumsum(sizes)
    data = np.zeros(int(ends[-1]) if len(ends) else 0, np.uint8)
    data[ends - sizes] = words >> 8 | 0x80
    data[ends - sizes + 1] = words & 0xFF
    for k in range(4):
        has = sizes >= 3 + k
        data[ends[has] - 1 - k] = (deltas[has] >> 7 * k & 0x7F) | (0x80 if k == 0 else 0)
    return data.tobytes()


_SENSORS = (
    *(("BATTERY", 1), *((f"ADC CHANNEL{channel}", 1) for channel in range(6))),
    *(("RAW GYRO", 3), ("RAW ACCEL", 3), ("RAW COMPASS", 3), ("CAL GYRO", 3), ("CAL ACCEL", 3)),
    *(("CAL COMPASS", 3), ("QUARTERNION", 4), ("EULER ANGLES", 4), ("ROTATION MATRIX", 9), ("HEADING", 1)),
    *(("LINEAR ACCEL", 3), ("IMU STATUS", 2), ("PWM SIGNALS", 4), ("MOTOR CURRENTS", 2), ("EVENTS RATE", 3)),
)
"""Sensors of the second firmware by their numbers from 0, with how many values each has."""
_WHEELS = "MOTOR SENSORS"


def _listing(generation: FirmwareGeneration) -> str:
    """Answer to `??S`; the second firmware adds a description to each row."""
    wheels = (generation.tick_bit, _WHEELS, 2)
    if not generation.has_decay:
        first = ((0, "BATTERY", 1), (14, "EVENTS RATE", 1), wheels)
        rows = (f" {bit} {name.replace(' ', '_')} {size}" for bit, name, size in first)
        return "\n".join([" Bit Name Values", *rows, "", ""])
    second = [*((bit, *sensor) for bit, sensor in enumerate(_SENSORS)), wheels]
    rows = (f" {bit:<3} {1 << bit:<9} {name:<15} {size}" for bit, name, size in second)
    title = " Bit Dec-Value Name     # Values"
    return "\n".join(["Bitlist for available sensors:", title, *rows, "", ""])


class PushbotBody(Protocol):
    """Motors, wheel encoders, lights and clock of one PushBot; called by the thread that steps the world."""

    def set_duties(self, left: float, right: float) -> None:
        """Drive the motors by shares of the battery's voltage in [-1, 1] until the next call; 0 brakes."""

    def wheel_ticks(self) -> tuple[int, int]:
        """Return the quadrature counts of the wheels since power-on, left and right."""

    def set_lights(self, laser: Blinking, rear: Blinking, front: Blinking) -> None:
        """Let laser pointer and LEDs blink until the next call."""

    @property
    def now_ns(self) -> int:
        """The world's time [ns]."""


TX_BUFFER = 4096
"""Capacity of the text buffer [bytes]; when full, it blocks the main loop with commands and motor control."""


class Board:
    """State of a board since its last reset: clock, motors, timers of the lights, wheel ticks and events."""

    def __init__(self, body: PushbotBody, generation: FirmwareGeneration) -> None:
        self._body = body
        self._generation = generation
        self.reset()

    def reset(self) -> None:
        """Reset: all off, ticks and clock at zero."""
        self.ring = EventRing()
        self.texts: deque[tuple[int, bytes]] = deque()
        self.motors = Motor(), Motor()
        self.is_streaming = self._motors_on = False
        self.event_format = 0
        self._periods = dict.fromkeys("ABC", 0)
        self._widths: dict[str, int] = {}
        self._origin = self._body.wheel_ticks()
        self._boot_us = self._body.now_ns // 1000
        self._milliseconds = 0
        self._report_period = self._report_in = 0  # [ms]; 0: ticks are not reported
        self._report_due = False
        self._light_up()
        self._body.set_duties(0.0, 0.0)
        second = "EDVS-4337, RELEASE V0.7.1 IMU PBOT SD Oct  9 2014, 16:49:39"
        banner = second if self._generation.has_decay else "EDVS-4337, V0.1_MROB"
        self.say(f"\n{banner}\nSystem Clock: 192MHz; 1us event time resolution\n")

    @property
    def stamp_bytes(self) -> int:
        """Bytes of an event's timestamp."""
        names = {digit: name for name, digit in self._generation.formats.items()}
        return TIMESTAMPS[names[self.event_format]]

    def board_us(self, time_us: int) -> int:
        """The board's clock at a time of the world [us]."""
        return time_us - self._boot_us

    def say(self, text: str) -> None:
        """Send text, now."""
        self.texts.append((self._body.now_ns, text.encode("latin-1")))

    @property
    def is_blocked(self) -> bool:
        """Whether the main loop waits for room to say something."""
        return sum(len(text) for _, text in self.texts) >= TX_BUFFER

    def enable_motors(self, on: bool) -> None:
        """Switch the motor driver; the controllers go on without it."""
        self._motors_on = on
        self._apply_duties()

    def drive(self, motor: int, velocity: int, *, decays: bool) -> bool:
        """Command a velocity [ticks per 21 ms]; whether there is such a motor."""
        if motor >= len(self.motors):
            return False
        self.motors[motor].set_velocity(velocity, self.ticks()[motor], decays=decays)
        self._apply_duties()
        return True

    def set_duty(self, motor: int, percent: int) -> bool:
        """Command a duty cycle [%]; whether there is such a motor."""
        if motor >= len(self.motors):
            return False
        self.motors[motor].set_percent(percent)
        self._apply_duties()
        return True

    def ticks(self) -> tuple[int, int]:
        """Wheel ticks since the reset, in 32 bits."""
        left, right = (
            int32(now - then) for now, then in zip(self._body.wheel_ticks(), self._origin, strict=True)
        )
        return left, right

    def set_period(self, timer: str, period_us: int) -> None:
        """Let a timer run; a period of 0 forgets its widths."""
        self._periods[timer] = period_us
        if not period_us:
            self._widths = {output: width for output, width in self._widths.items() if output[0] != timer}
        self._light_up()

    def set_width(self, output: str, width_us: int) -> None:
        """How long an output is lit in each period; without a period, or with a shorter one, always."""
        self._widths[output] = width_us
        self._light_up()

    def report_ticks(self, period_ms: int) -> None:
        """Report the wheel ticks periodically, a running period to its end; 0: no longer."""
        if not (self._report_period and period_ms):
            self._report_in, self._report_due = period_ms, False
        self._report_period = period_ms

    def see(self, words: NDArray[np.uint16], times_us: IntArray, sent: int) -> None:
        """Take the camera's events (N,) with times of the world [us]; see `EventRing.put`."""
        if self.is_streaming:
            self.ring.put(words, times_us - self._boot_us, sent)
        else:
            self.ring.clear()

    def tick(self) -> None:
        """The firmware's clock ticks, once a millisecond, even while the main loop is blocked."""
        self._milliseconds += 1
        for motor in self.motors:
            if self._milliseconds % 100 == 0:
                motor.decay()
            motor.request_update()
        if self._report_period:
            self._report_in -= 1
            if self._report_in == 0:
                self._report_in, self._report_due = self._report_period, True

    def run_controllers(self) -> None:
        """The main loop does what the clock has requested."""
        if self.is_blocked:
            return
        for motor, ticks in zip(self.motors, self.ticks(), strict=True):
            motor.update(ticks)
        self._apply_duties()
        if self._report_due:
            self._report_due = False
            self.say(f"-S{self._generation.tick_bit} " + "{} {}\n".format(*self.ticks()))

    def _apply_duties(self) -> None:
        left, right = (motor.duty if self._motors_on else 0.0 for motor in self.motors)
        self._body.set_duties(left, right)

    def _light_up(self) -> None:
        """Let laser and LEDs blink; one that is always lit has a period as long as its light."""
        periods = [self._periods[output[0]] for output in _LIGHTS]
        widths = [self._widths.get(output, 0) for output in _LIGHTS]
        self._body.set_lights(*(Blinking(max(p, w), w) for p, w in zip(periods, widths, strict=True)))


_LIGHTS = "A0", "C0", "C1"  # Outputs of the timers: laser pointer, rear and front LED
_MAX_LINE = 127  # Characters of a command


class Console:
    """Parses lines of text and acts on a board. It knows the commands that drivers send."""

    def __init__(self, board: Board, generation: FirmwareGeneration) -> None:
        self._board = board
        self._generation = generation
        self._line = ""
        self._echoes = True

    def take(self, character: int) -> None:
        """Process a character; those beyond ASCII are ignored, and one too many begins the line again."""
        echoes = self._echoes and not self._board.is_streaming
        if character in b"\r\n":
            if echoes:
                self._board.say("\n")
            line, self._line = self._line, ""
            if line:
                self._execute(line)
        elif character < 0x80:
            if echoes and len(self._line) < _MAX_LINE:
                self._board.say(chr(character))
            self._line = (self._line if len(self._line) < _MAX_LINE else "") + chr(character)

    def _execute(self, line: str) -> None:
        board = self._board
        if line[0] == "R":
            board.reset()
            self._echoes = True
        elif line[0] == "E":
            board.is_streaming = line[1:2] == "+"
        elif line.startswith("?E"):
            board.say(f"-E{board.event_format}\n")
        elif line.startswith("??S"):
            board.say(_listing(self._generation))
        elif line[0] == "?":
            board.say("Get: parsing error\n")
        elif line[0] != "!":
            board.say("?\n")
        elif not self._set(line[1:]):
            board.say("Set: parsing error\n")

    def _set(self, setting: str) -> bool:
        """Execute a command `!`, whatever follows it; whether it was understood."""
        board, is_second = self._board, self._generation.has_decay
        if match := re.match(r"U([0-2])", setting):
            self._echoes = match[1] != "0"
        elif match := re.match(r"M([+-])", setting):
            board.enable_motors(match[1] == "+")
        elif match := re.match(r"MV(D?)(\d+)=(-?\d+)" if is_second else r"MV()(\d+)=(-?\d+)", setting):
            if not board.drive(int(match[2]), int(match[3]), decays=bool(match[1])):
                board.say("Error setting motor speed\n")
        elif match := re.match(r"M(\d+)=%(-?\d+)", setting):
            # the first firmware takes percent without a sign, and reads a number that does not begin as 0
            if not board.set_duty(int(match[1]), int(match[2]) if is_second else 0):
                board.say(f"Error setting motor {'speed' if is_second else 'mode'}\n")
        elif match := re.match(r"P([ABC])=(\d+)", setting):
            board.set_period(match[1], int(match[2]))
        elif match := re.match(r"P([ABC][01])=(\d+)", setting):
            board.set_width(match[1], int(match[2]))
        elif setting.startswith("P"):
            board.say("Channel not recognized\n")
        elif match := re.match(rf"S\+{self._generation.sensor_prefix}(\d+),(\d+)", setting):
            if int(match[1]) >> self._generation.tick_bit & 1:
                board.report_ticks(int(match[2]))
        elif setting == "S-":
            board.report_ticks(0)
        else:
            match = re.match(r"E(\d)", setting)
            if match is None or int(match[1]) not in self._generation.formats.values():
                return False
            board.event_format = int(match[1])
        return True


_BITS_PER_BYTE = 10
LATE_SHARE = 0.03  # Share of received bytes parsed between a tick of the clock and the controllers' update
_MAX_GAP_S = 0.02  # A wire that was blocked for longer does not catch up


class PushbotFirmware:
    """A robot's firmware, for any link that waits for whoever reads it (RTS/CTS, TCP).

    `baud_rate` is that of the wire to the host or its radio [bit/s]. The seed decides which bytes are parsed
    just after a tick of the clock, see `Motor`.
    """

    def __init__(
        self, body: PushbotBody, generation: FirmwareGeneration, baud_rate: int = BAUD_RATE, seed: int = 0
    ) -> None:
        self.late_share = LATE_SHARE  # Share of bytes that are parsed just after a tick
        self._rng = np.random.default_rng(seed)
        self._body = body
        self.board = Board(body, generation)
        self._console = Console(self.board, generation)
        self._bytes_per_s = baud_rate / _BITS_PER_BYTE
        self._sent_ns = body.now_ns
        self._received = b""

    def millisecond(self) -> None:
        """A millisecond has passed in the world."""
        self.board.tick()
        self._work()
        self.board.run_controllers()

    def see(self, words: NDArray[np.uint16], times_us: IntArray) -> None:
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
