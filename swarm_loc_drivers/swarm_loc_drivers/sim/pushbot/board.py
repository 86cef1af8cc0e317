"""State behind the commands of the emulated firmware: motors, timers, sensors, the event stream."""

from __future__ import annotations

from collections import deque
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.hardware import TIMESTAMPS, FirmwareGeneration
from swarm_loc_drivers.sim.pushbot.event_camera import Blinking


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


RING = 4092
"""Events that wait; with four places left the oldest is dropped."""
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


_PWM_LIMIT = 9600
"""Counts of a PWM period of 50 us at 192 MHz."""
_GAIN = 80
_WINDUP = _PWM_LIMIT // _GAIN * 20
"""Maximum lead of the target position over the wheel [ticks]."""
_PRESCALER = 20
_DECAY_TENTHS = 10
_MAX = 100


class _Mode(Enum):
    DIRECT = "direct"
    VELOCITY = "velocity"


class Motor:
    """One motor: its command, and the resulting duty cycle.

    As on the board, a clock tick requests an update of the velocity controller, which the main loop executes
    after it has parsed the commands, whatever they have set: a duty cycle that is parsed in between is lost.
    """

    def __init__(self) -> None:
        self._mode = _Mode.DIRECT
        self._needs_update = False
        self._decays = False
        self._decay_left = 0
        self._velocity = self._position = self._prescaled = 0
        self._width = 0

    @property
    def duty(self) -> float:
        """Share of the battery's voltage in [-1, 1]."""
        return self._width / _PWM_LIMIT

    def set_duty(self, percent: int, *, decays: bool = False) -> None:
        """Drive by a duty cycle [percent]."""
        self._mode, self._decays, self._decay_left = _Mode.DIRECT, decays, _DECAY_TENTHS
        self._width = _PWM_LIMIT * _clamped(percent) // _MAX

    def set_velocity(self, velocity: int, ticks: int, *, decays: bool = False) -> None:
        """Drive at a velocity [ticks per 21 ms]; `ticks` is where the wheel is now."""
        if self._mode is _Mode.DIRECT:
            self._position = ticks
        self._mode, self._decays, self._decay_left = _Mode.VELOCITY, decays, _DECAY_TENTHS
        self._velocity = _clamped(velocity)

    def decay(self) -> None:
        """Process a tick of a tenth of a second."""
        if not self._decays:
            return
        if self._decay_left:
            self._decay_left -= 1
        elif self._mode is _Mode.DIRECT:
            self._width = int(0.9 * self._width)
        else:
            self._velocity -= (self._velocity > 0) - (self._velocity < 0)

    def request_update(self) -> None:
        """The clock ticks: request an update of the velocity controller."""
        self._needs_update = self._mode is _Mode.VELOCITY

    def update(self, ticks: int) -> None:
        """Update the velocity controller if it was requested; `ticks` is where the wheel is now."""
        if not self._needs_update:
            return
        self._needs_update = False
        if self._prescaled == 0:
            self._prescaled = _PRESCALER
            self._position += self._velocity
        else:
            self._prescaled -= 1
        error = self._position - ticks
        self._position = ticks + max(-_WINDUP, min(_WINDUP, error))
        self._width = max(-_PWM_LIMIT, min(_PWM_LIMIT, _GAIN * error))


def _clamped(value: int) -> int:
    return max(-_MAX, min(_MAX, value))


TX_BUFFER = 4096
"""Capacity of the text buffer [bytes]; when full, it blocks the main loop with commands and motor control."""
_BATTERY_MV, _BATTERY_BIT = 7400, 0
_EVENT_RATE_BITS = {"first": 14, "second": 21}


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
        self.is_streaming = False
        self.event_format = 0
        self.was_reset = True
        self._motors = Motor(), Motor()
        self._motors_on = False
        self._timers = {name: [0, 0, 0] for name in "ABC"}
        self._sensors: dict[int, tuple[int, int]] = {}
        self._origin = self._body.wheel_ticks()
        self._boot_us = self._body.now_ns // 1000
        self._rate, self._seen = 0, 0
        self._milliseconds = 0
        self._light_up()
        self._body.set_duties(0.0, 0.0)
        self.say_version()

    @property
    def stamp_bytes(self) -> int:
        """Bytes of an event's timestamp."""
        names = {digit: name for name, digit in self._generation.formats.items()}
        return TIMESTAMPS[names[self.event_format]]

    def board_us(self, time_us: int) -> int:
        """The board's clock at a time of the world [us]."""
        return time_us - self._boot_us

    def set_time(self, time_us: int) -> None:
        """Set the board's clock [us]."""
        self._boot_us = self._body.now_ns // 1000 - time_us

    def say(self, text: str) -> None:
        """Send text, now."""
        self.texts.append((self._body.now_ns, text.encode("latin-1")))

    @property
    def is_blocked(self) -> bool:
        """Whether the main loop waits for room to say something."""
        return sum(len(text) for _, text in self.texts) >= TX_BUFFER

    def say_version(self) -> None:
        """Send the version."""
        banner = "EDVS-4337, RELEASE V0.7.1 PBOT" if self._generation.has_decay else "EDVS-4337, V0.1_MROB"
        self.say(f"\n{banner}\nSystem Clock: 192MHz; 1us event time resolution\n")

    def list_sensors(self) -> None:
        """Send the numbers of the sensors."""
        rate, ticks = _EVENT_RATE_BITS[self._generation.name], self._generation.tick_bit
        gap = " " if self._generation.has_decay else "_"
        names = {_BATTERY_BIT: "BATTERY", rate: f"EVENTS{gap}RATE", ticks: f"MOTOR{gap}SENSORS"}
        values = {bit: f"{1 << bit} " if self._generation.has_decay else "" for bit in names}
        rows = [f" {bit} {values[bit]}{name} {1 + (bit == ticks)}\n" for bit, name in names.items()]
        self.say("".join([" Bit Name Values\n", *rows, "\n"]))

    def stream_events(self, on: bool) -> None:
        """Start or stop sending events."""
        self.is_streaming = on

    def enable_motors(self, on: bool) -> None:
        """Switch the motor driver; the controllers go on without it."""
        self._motors_on = on
        self._apply_duties()

    def drive(self, motor: int, value: int, kind: str, *, decays: bool) -> None:
        """Command a motor by a velocity or a duty cycle."""
        if kind == "velocity":
            self._motors[motor].set_velocity(value, self.ticks()[motor], decays=decays)
        else:
            self._motors[motor].set_duty(value, decays=decays)
        self._apply_duties()

    def ticks(self) -> tuple[int, int]:
        """Wheel ticks since the reset, in 32 bits."""
        left, right = (
            (now - then + 2**31) % 2**32 - 2**31
            for now, then in zip(self._body.wheel_ticks(), self._origin, strict=True)
        )
        return left, right

    def period(self, timer: str) -> int:
        """Period of a timer [us]."""
        return self._timers[timer][0]

    def set_period(self, timer: str, period_us: int) -> None:
        """Let a timer run; a period of 0 forgets its widths."""
        self._timers[timer] = [period_us, *(self._timers[timer][1:] if period_us else [0, 0])]
        self._light_up()

    def set_width(self, timer: str, output: int, width_us: int) -> None:
        """How long an output is lit in each period."""
        self._timers[timer][1 + output] = width_us
        self._light_up()

    def start_sensors(self, mask: int, period_ms: int) -> None:
        """Report sensors periodically; a period of 0 wraps to never."""
        for bit in self._bits(mask):
            count = self._sensors.get(bit, (0, period_ms))[1]
            self._sensors[bit] = (period_ms, count)

    def stop_sensors(self, mask: int) -> None:
        """Stop the reports."""
        for bit in self._bits(mask):
            self._sensors.pop(bit, None)

    def report(self, mask: int) -> None:
        """Report sensors once."""
        for bit in self._bits(mask):
            self._report(bit)

    def see(self, words: NDArray[np.uint16], times_us: NDArray[np.int64], room: int) -> None:
        """Take the camera's events (N,) with times of the world [us]; see `EventRing.put`."""
        self._seen += len(words)
        if self.is_streaming:
            self.ring.put(words, times_us - self._boot_us, room)
        else:
            self.ring.clear()

    def request_updates(self) -> None:
        """The firmware's clock ticks, once a millisecond."""
        for motor in self._motors:
            motor.request_update()

    def millisecond(self) -> None:
        """The main loop does what is due after a tick of the clock."""
        if self.is_blocked:
            return
        self._milliseconds += 1
        for motor, ticks in zip(self._motors, self.ticks(), strict=True):
            if self._milliseconds % 100 == 0:
                motor.decay()
            motor.update(ticks)
        self._apply_duties()
        if self._milliseconds % 1000 == 0:
            self._rate, self._seen = self._seen, 0
        for bit, (period, count) in list(self._sensors.items()):
            self._sensors[bit] = (period, count - 1 if count > 1 else period)
            if count == 1:
                self._report(bit)

    def _report(self, bit: int) -> None:
        if bit == self._generation.tick_bit:
            left, right = self.ticks()
            self.say(f"-S{bit} {left} {right}\n")
        else:
            self.say(f"-S{bit} {_BATTERY_MV if bit == _BATTERY_BIT else self._rate}\n")

    def _bits(self, mask: int) -> list[int]:
        known = (_BATTERY_BIT, _EVENT_RATE_BITS[self._generation.name], self._generation.tick_bit)
        return [bit for bit in known if mask >> bit & 1]

    def _apply_duties(self) -> None:
        left, right = (motor.duty if self._motors_on else 0.0 for motor in self._motors)
        self._body.set_duties(left, right)

    def _light_up(self) -> None:
        laser, leds = self._timers["A"], self._timers["C"]
        self._body.set_lights(
            Blinking(laser[0], min(laser[1], laser[0])),
            Blinking(leds[0], min(leds[1], leds[0])),
            Blinking(leds[0], min(leds[2], leds[0])),
        )
