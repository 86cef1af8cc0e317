"""State behind the commands of the emulated firmware: clock, motors, timers, biases, sensors, events.

Source: uart.c, pwm.c, sensors.c, DVS128Chip.c and main.c of the board's firmware EDVSBoardOS (eDVS4337),
version 0.7.1.

The ring of events that an emulated PushBot has still to send, and their bytes.

Sensors of an emulated PushBot: their numbers, what they report at rest, and when they are due.

Source: sensors.c, mpu9150.c and uart.c of the board's firmware EDVSBoardOS (eDVS4337), version 0.7.1.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime, timedelta, timezone
from enum import Enum
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.hardware import TIMESTAMPS, FirmwareGeneration
from swarm_loc_drivers.sim.pushbot.event_camera import Blinking
from swarm_loc_drivers.sim.pushbot.motor import COUNTS_PER_US, Motor, int32

RING = 4092  # Events that wait; with four places left the oldest is dropped
_DELTA_LIMITS = (0x7F, 0x3FFF, 0x1FFFFF)


class EventRing:
    """Ring buffer of events to be sent.

    Attributes:
        dropped: Events that were overwritten, unnoticed by the board.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._words = np.zeros(0, np.uint16)
        self._times = np.zeros(0, np.int64)
        self._last = 0

    def __len__(self) -> int:
        return len(self._words)

    def put(self, words: NDArray[np.uint16], times_us: NDArray[np.int64], room: int) -> None:
        """Take events `0yyyyyyy pxxxxxxx`, in order, with their board's time.

        Args:
            words: (N,).
            times_us: (N,) [us].
            room: Events that are sent while these come, which leave their places.
        """
        self._words = np.concatenate([self._words, words])
        self._times = np.concatenate([self._times, times_us])
        self._forget(RING + room)

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


def _fixed(words: NDArray[np.uint16], times: NDArray[np.int64], stamp_bytes: int) -> bytes:
    """Events with timestamps of one length, the most significant byte first."""
    table = np.empty((len(words), 2 + stamp_bytes), np.uint8)
    table[:, 0] = words >> 8 | 0x80
    table[:, 1] = words & 0xFF
    for k in range(stamp_bytes):
        table[:, 2 + k] = times >> 8 * (stamp_bytes - 1 - k) & 0xFF
    return table.tobytes()


def _differences(words: NDArray[np.uint16], deltas: NDArray[np.int64], sizes: NDArray[np.int64]) -> bytes:
    """Events with the time since the last one, seven bits a byte, the last byte marked."""
    ends = np.cumsum(sizes)
    data = np.zeros(int(ends[-1]) if len(ends) else 0, np.uint8)
    data[ends - sizes] = words >> 8 | 0x80
    data[ends - sizes + 1] = words & 0xFF
    for k in range(4):
        has = sizes >= 3 + k
        data[ends[has] - 1 - k] = (deltas[has] >> 7 * k & 0x7F) | (0x80 if k == 0 else 0)
    return data.tobytes()


_NAMES = (
    *("BATTERY", *(f"ADC CHANNEL{channel}" for channel in range(6))),
    *("RAW GYRO", "RAW ACCEL", "RAW COMPASS", "CAL GYRO", "CAL ACCEL", "CAL COMPASS", "QUARTERNION"),
    *("EULER ANGLES", "ROTATION MATRIX", "HEADING", "LINEAR ACCEL", "IMU STATUS"),
    *("PWM SIGNALS", "MOTOR CURRENTS", "EVENTS RATE"),
)
"""Sensors of the second firmware by their numbers from 0; the wheels' number is apart."""
_WHEELS = "MOTOR SENSORS"
_UNIT, _G = "40000000", 16384
"""1 in Q30, and the acceleration of gravity of the raw sensor, which measures up to 2 g in 16 bits."""
_AT_REST = {
    "BATTERY": "7399",
    "RAW GYRO": "0 0 0",
    "RAW ACCEL": f"0 0 {_G}",
    "RAW COMPASS": "0 67 147",
    "CAL GYRO": "0 0 0 {ms}",
    "CAL ACCEL": "0 0 10000",
    "CAL COMPASS": "140000 0 FFD40000",
    "QUARTERNION": f"{_UNIT} 0 0 0",
    "EULER ANGLES": "0 0 0 0",
    "ROTATION MATRIX": f"{_UNIT} 0 0 0 {_UNIT} 0 0 0 {_UNIT}",
    "LINEAR ACCEL": "0 0 0",
    "IMU STATUS": "250 {ms}",
    "MOTOR CURRENTS": "0 0",
}
"""Values of a robot that stands level and looks north in a field of 20 uT ahead and 44 uT down; others are 0.

Calibrated values are hexadecimal: Q16 of deg/s, g and uT, Q30 of quaternion and matrix. The temperature has
one decimal and no point.
"""
_FIRST_NAMES = {0: "BATTERY", 14: "EVENTS RATE"}


class Sensors:
    """Which sensors a board has, and which of them are due.

    Args:
        generation: Which firmware it is.
    """

    def __init__(self, generation: FirmwareGeneration) -> None:
        self._is_first = not generation.has_decay
        names = _FIRST_NAMES if self._is_first else dict(enumerate(_NAMES))
        self._names = {**names, generation.tick_bit: _WHEELS}
        self._reloads: dict[int, int] = {}
        self._counters: dict[int, int] = {}
        self._places: dict[int, int] = {}
        self._queue: list[int] = []
        self._due: set[int] = set()

    def start(self, mask: int, period_ms: int) -> None:
        """Report sensors periodically; with a period of 0 ms a counter wraps before it reports."""
        for bit in self.bits(mask):
            self._reloads[bit] = period_ms
            if bit not in self._places:
                self._counters[bit], self._places[bit] = period_ms, len(self._queue)
                self._queue.append(bit)

    def stop(self, mask: int) -> None:
        """Stop reports.

        As on the board, the others keep their old places in the queue, by which they are taken away later:
        after that one can go on in place of another.
        """
        for bit in self.bits(mask):
            if (place := self._places.pop(bit, None)) is not None:
                del self._queue[min(place, len(self._queue) - 1)]
                self._due.discard(bit)

    def tick(self) -> None:
        """A millisecond has passed."""
        for bit in self._queue:
            self._counters[bit] = (self._counters[bit] - 1) % 2**32
            if self._counters[bit] == 0:
                self._counters[bit] = self._reloads[bit]
                self._due.add(bit)

    def take_due(self) -> list[int]:
        """Numbers of the sensors that have become due since the last call."""
        due = [bit for bit in dict.fromkeys(self._queue) if bit in self._due]
        self._due.difference_update(due)
        return due

    def bits(self, mask: int) -> list[int]:
        """The numbers in a mask of sensors that the board has."""
        return [bit for bit in self._names if mask >> bit & 1]

    def name(self, bit: int) -> str:
        """Name of a sensor, which the second firmware also lists."""
        return self._names[bit]

    def at_rest(self, bit: int, time_ms: int) -> str:
        """Values of a sensor of a robot at rest; the time [ms] is that of the last sample."""
        return _AT_REST.get(self._names[bit], "0").format(ms=time_ms)

    def listing(self) -> str:
        """Answer to `??S`; the second firmware adds a description to each row."""
        if self._is_first:
            rows = (f" {bit} {name.replace(' ', '_')} {self._size(bit)}" for bit, name in self._names.items())
            return "\n".join([" Bit Name Values", *rows, "", ""])
        rows = (f" {bit:<3} {1 << bit:<9} {name:<15} {self._size(bit)}" for bit, name in self._names.items())
        title = " Bit Dec-Value Name     # Values"
        return "\n".join(["Bitlist for available sensors:", title, *rows, "", ""])

    def _size(self, bit: int) -> int:
        """How many values a sensor has."""
        sizes = {_WHEELS: 2, "PWM SIGNALS": 4, "EVENTS RATE": 1 if self._is_first else 3, "CAL GYRO": 3}
        name = self._names[bit]
        return sizes.get(name, len(_AT_REST.get(name, "0").split()))


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


class ClockMode(Enum):
    """Where the clock of the events comes from; only the own one leaves the laser its timer."""

    INTERNAL = "I"
    SLAVE = "S"
    """Another board's pulses, which do not come here: the clock stands."""
    ARMED = "M0"
    MASTER = "M+"


TX_BUFFER = 4096
"""Capacity of the text buffer [bytes]; when full, it blocks the main loop with commands and motor control."""
_IMU_MS = 25
BIAS_SETS = (
    (1067, 12316, 16777215, 5579732, 151, 427594, 0, 16777215, 296253, 3624, 39, 4),
    (1067, 12316, 16777215, 5579731, 60, 427594, 0, 16777215, 567391, 6831, 39, 4),
    (1966, 1137667, 16777215, 8053457, 133, 160712, 944, 16777215, 205255, 3207, 278, 217),
    (1966, 1135792, 16769632, 8061894, 133, 160703, 935, 16769632, 205244, 3207, 267, 217),
    (1966, 1137667, 16777215, 8053458, 62, 160712, 944, 16777215, 480988, 3207, 278, 217),
    (1067, 12316, 16777215, 5579731, 60, 427594, 0, 16777215, 567391, 19187, 39, 4),
)
"""Bias currents of the camera by their numbers, in the sets of `!BD`; a board starts with the last one."""
RELEASED = 2014, 10, 9, 16, 49, 39  # When version 0.7.1 was built, where its calendar clock begins


class Board:
    """State of a board since its last reset.

    Args:
        body: The robot.
        generation: Which firmware it is.
    """

    def __init__(self, body: PushbotBody, generation: FirmwareGeneration) -> None:
        self._body = body
        self._generation = generation
        self.reset()

    def reset(self) -> None:
        """Reset: all off, ticks and clock at zero."""
        self.ring = EventRing()
        self.texts: deque[tuple[int, bytes]] = deque()
        self.sensors = Sensors(self._generation)
        self.motors = Motor(), Motor()
        self.biases = list(BIAS_SETS[-1])
        self.is_streaming = self._motors_on = False
        self.event_format = 0
        self.was_reset, self.is_halted = True, False
        self._periods = dict.fromkeys("ABC", 0)
        self._widths: dict[str, int] = {}
        self._origin = self._body.wheel_ticks()
        self._clock_mode, self._boot_us = ClockMode.INTERNAL, self._body.now_ns // 1000
        self._date: list[int] = []
        self._date_ns, self._date_runs = 0, False
        self._rate, self._seen = 0, 0
        self._milliseconds = 0
        self._light_up()
        self._body.set_duties(0.0, 0.0)
        self.say_version()

    def enter_bootloader(self) -> None:
        """Run the firmware no longer: all is off, and nothing is said until the power is switched."""
        self.reset()
        self.texts.clear()
        self.was_reset, self.is_halted = False, True

    @property
    def stamp_bytes(self) -> int:
        """Bytes of an event's timestamp."""
        names = {digit: name for name, digit in self._generation.formats.items()}
        return TIMESTAMPS[names[self.event_format]]

    def board_us(self, time_us: int) -> int:
        """The board's clock at a time of the world [us]."""
        return 0 if self._clock_mode is ClockMode.SLAVE else time_us - self._boot_us

    def set_time(self, time_us: int) -> None:
        """Set the board's clock [us]."""
        self._boot_us = self._body.now_ns // 1000 - time_us

    def set_clock_mode(self, mode: ClockMode) -> None:
        """Choose the source of the events' clock; return to the own one switches the laser off."""
        before, self._clock_mode = self._clock_mode, mode
        if mode in (ClockMode.SLAVE, ClockMode.MASTER):
            self.ring.clear()
        if mode in (ClockMode.SLAVE, ClockMode.MASTER) or before is ClockMode.SLAVE:
            self.set_time(0)
        if mode is ClockMode.INTERNAL and before is not mode:
            self.set_period("A", 0)

    @property
    def date(self) -> list[int]:
        """Year, month, day, hour, minute, second of the calendar clock; [] before it is enabled."""
        with suppress(ValueError):  # a date that does not exist stands
            year, month, day, hour, minute, second = self._date
            passed = timedelta(microseconds=(self._body.now_ns - self._date_ns) // 1000 * self._date_runs)
            now = datetime(year, month, day, hour, minute, second, tzinfo=timezone.utc) + passed
            return [now.year, now.month, now.day, now.hour, now.minute, now.second]
        return self._date

    def set_date(self, date: Sequence[int]) -> None:
        """Set the calendar clock."""
        self._date, self._date_ns = list(date), self._body.now_ns

    def run_date(self, on: bool) -> None:
        """Let the calendar clock run from the firmware's release, or stop it where it is."""
        self.set_date(RELEASED if on else self.date)
        self._date_runs = on

    def say(self, text: str) -> None:
        """Send text, now."""
        self.texts.append((self._body.now_ns, text.encode("latin-1")))

    @property
    def is_blocked(self) -> bool:
        """Whether the main loop waits for room to say something."""
        return sum(len(text) for _, text in self.texts) >= TX_BUFFER

    def say_version(self) -> None:
        """Send the version."""
        second = "EDVS-4337, RELEASE V0.7.1 IMU PBOT SD Oct  9 2014, 16:49:39"
        banner = second if self._generation.has_decay else "EDVS-4337, V0.1_MROB"
        self.say(f"\n{banner}\nSystem Clock: 192MHz; 1us event time resolution\n")

    def stream_events(self, on: bool) -> None:
        """Start or stop sending events."""
        self.is_streaming = on

    def enable_motors(self, on: bool) -> None:
        """Switch the motor driver; the controllers go on without it."""
        self._motors_on = on
        self._apply_duties()

    def drive(
        self, motor: int, value: int, unit: Literal["velocity", "percent", "us"], *, decays: bool
    ) -> bool:
        """Command a motor by a velocity [ticks per 21 ms], a duty cycle [%] or a width of pulses [us].

        Returns:
            Whether there is such a motor and it takes the value.
        """
        if motor >= len(self.motors):
            return False
        one, is_taken = self.motors[motor], True
        if unit == "velocity":
            one.set_velocity(value, self.ticks()[motor], decays=decays)
        elif unit == "percent":
            one.set_percent(value, decays=decays)
        else:
            is_taken = one.set_width_us(value, decays=decays)
        self._apply_duties()
        return is_taken

    def set_motor_period(self, motor: int, period_us: int) -> bool:
        """Set the period of a motor's pulses [us]; whether there is such a motor and it takes the period."""
        is_taken = motor < len(self.motors) and self.motors[motor].set_period(period_us)
        self._apply_duties()
        return is_taken

    def ticks(self) -> tuple[int, int]:
        """Wheel ticks since the reset, in 32 bits."""
        left, right = (
            int32(now - then) for now, then in zip(self._body.wheel_ticks(), self._origin, strict=True)
        )
        return left, right

    def period(self, timer: str) -> int:
        """Period of a timer [us]."""
        return self._periods[timer]

    def set_period(self, timer: str, period_us: int) -> bool:
        """Let a timer run; a period of 0 forgets its widths. Whether the timer is free, see `ClockMode`."""
        if not self._is_free(timer):
            return False
        self._periods[timer] = period_us
        if not period_us:
            self._widths = {output: width for output, width in self._widths.items() if output[0] != timer}
        self._light_up()
        return True

    def set_width(self, timer: str, output: str, width_us: int) -> bool:
        """How long an output is lit in each period; without a period, or with a shorter one, always.

        Returns:
            Whether the timer is free.
        """
        if self._is_free(timer):
            self._widths[timer + output] = width_us
            self._light_up()
        return self._is_free(timer)

    def _is_free(self, timer: str) -> bool:
        return timer != "A" or self._clock_mode is ClockMode.INTERNAL

    def report(self, mask: int) -> None:
        """Report sensors once."""
        for bit in self.sensors.bits(mask):
            self._report(bit)

    def see(self, words: NDArray[np.uint16], times_us: NDArray[np.int64], room: int) -> None:
        """Take the camera's events (N,) with times of the world [us]; see `EventRing.put`."""
        self._seen += len(words)
        if self.is_streaming:
            stands = self._clock_mode is ClockMode.SLAVE
            self.ring.put(words, 0 * times_us if stands else times_us - self._boot_us, room)
        else:
            self.ring.clear()

    def tick(self) -> None:
        """The firmware's clock ticks, once a millisecond, even while the main loop is blocked."""
        self._milliseconds += 1
        for motor in self.motors:
            if self._milliseconds % 100 == 0:
                motor.decay()
            motor.request_update()
        self._apply_duties()
        if self._milliseconds % 1000 == 0:
            self._rate, self._seen = self._seen, 0
        self.sensors.tick()

    def run_controllers(self) -> None:
        """The main loop does what the clock has requested."""
        if self.is_blocked:
            return
        for motor, ticks in zip(self.motors, self.ticks(), strict=True):
            motor.update(ticks)
        self._apply_duties()
        for bit in self.sensors.take_due():
            self._report(bit)

    def _report(self, bit: int) -> None:
        self.say(f"-S{bit} {self._values(self.sensors.name(bit), bit)}\n")

    def _values(self, name: str, bit: int) -> str:
        """Values of a sensor."""
        left, right = self.motors
        if name == "MOTOR SENSORS":
            return "{} {}".format(*self.ticks())
        if name == "PWM SIGNALS":
            widths = (int(motor.width / COUNTS_PER_US) for motor in self.motors)
            return "{} {} ".format(*widths) + f"{left.percent} {right.percent}"
        if name == "EVENTS RATE":  # of the card, which is missing, too
            return f"{self._rate} 0 0" if self._generation.has_decay else f"{self._rate}"
        return self.sensors.at_rest(bit, self._milliseconds // _IMU_MS * _IMU_MS)

    def _apply_duties(self) -> None:
        left, right = (motor.duty if self._motors_on else 0.0 for motor in self.motors)
        self._body.set_duties(left, right)

    def _light_up(self) -> None:
        self._body.set_lights(self._blinking("A0"), self._blinking("C0"), self._blinking("C1"))

    def _blinking(self, output: str) -> Blinking:
        """How an output is lit; one that is always lit has a period as long as its light."""
        period, width = self._periods[output[0]], self._widths.get(output, 0)
        return Blinking(max(period, width), width)
