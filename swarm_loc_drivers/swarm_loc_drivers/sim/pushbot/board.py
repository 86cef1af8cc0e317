"""State behind the commands of the emulated firmware: clock, motors, timers, biases, sensors, events.

Source: uart.c, pwm.c, sensors.c, DVS128Chip.c and main.c of the board's firmware EDVSBoardOS (eDVS4337),
version 0.7.1.
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
from swarm_loc_drivers.sim.pushbot.event_ring import EventRing
from swarm_loc_drivers.sim.pushbot.motor import COUNTS_PER_US, Motor, int32
from swarm_loc_drivers.sim.pushbot.sensor_lines import Sensors


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
