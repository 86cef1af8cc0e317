"""What the commands of the emulated firmware act on: motors, timers, sensors, the stream of events."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.hardware import TIMESTAMPS, FirmwareGeneration
from swarm_loc_drivers.sim.common.body import Blinking, PushbotBody
from swarm_loc_drivers.sim.pushbot.firmware.event_stream import EventRing
from swarm_loc_drivers.sim.pushbot.firmware.motors import Motor

TX_BUFFER = 4096
"""Bytes of text that may wait; then the main loop waits, and with it commands and motor control."""
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
        """Begin anew: all off, ticks and clock at zero."""
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
        """Tell what it is."""
        banner = "EDVS-4337, RELEASE V0.7.1 PBOT" if self._generation.has_decay else "EDVS-4337, V0.1_MROB"
        self.say(f"\n{banner}\nSystem Clock: 192MHz; 1us event time resolution\n")

    def list_sensors(self) -> None:
        """Tell the numbers of the sensors."""
        rate, ticks = _EVENT_RATE_BITS[self._generation.name], self._generation.tick_bit
        gap = " " if self._generation.has_decay else "_"
        names = {_BATTERY_BIT: "BATTERY", rate: f"EVENTS{gap}RATE", ticks: f"MOTOR{gap}SENSORS"}
        values = {bit: f"{1 << bit} " if self._generation.has_decay else "" for bit in names}
        rows = [f" {bit} {values[bit]}{name} {1 + (bit == ticks)}\n" for bit, name in names.items()]
        self.say("".join([" Bit Name Values\n", *rows, "\n"]))

    def stream_events(self, on: bool) -> None:
        """Send events from now on, or no more."""
        self.is_streaming = on

    def enable_motors(self, on: bool) -> None:
        """Switch the motor driver; the controllers go on without it."""
        self._motors_on = on
        self._apply_duties()

    def drive(self, motor: int, value: int, kind: str, *, decays: bool) -> None:
        """Tell a motor a velocity or a duty cycle."""
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
        """Report sensors again and again; a period of 0 wraps to never."""
        for bit in self._bits(mask):
            count = self._sensors.get(bit, (0, period_ms))[1]
            self._sensors[bit] = (period_ms, count)

    def stop_sensors(self, mask: int) -> None:
        """Report them no more."""
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

    def millisecond(self) -> None:
        """The firmware's clock ticks."""
        if self.is_blocked:
            return
        self._milliseconds += 1
        for motor, ticks in zip(self._motors, self.ticks(), strict=True):
            if self._milliseconds % 100 == 0:
                motor.decay()
            motor.control(ticks)
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
