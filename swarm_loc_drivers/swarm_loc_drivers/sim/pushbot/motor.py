"""The motors of an emulated PushBot: widths of pulses, the velocity controller, decaying commands.

Source: motors.c, sensors.c and main.c of the board's firmware EDVSBoardOS (eDVS4337), version 0.7.1.
"""

from __future__ import annotations

from enum import Enum

from swarm_loc_drivers.pushbot.hardware import MAX_VELOCITY

COUNTS_PER_US = 192  # The motors' timer runs at 192 MHz
_BOOT_PERIOD = 50 * COUNTS_PER_US
_BOOT_GAINS = 80, 0, 0
_BOOT_WINDUP = _BOOT_PERIOD // _BOOT_GAINS[0] * 20
_PRESCALER = 20
_DECAY_TENTHS = 10
_MAX_PERCENT = 100


class _Mode(Enum):
    DIRECT = "direct"
    VELOCITY = "velocity"


class Motor:
    """One motor: its command, and the resulting duty cycle.

    As on the board, a clock tick requests an update of the velocity controller, which the main loop executes
    after it has parsed the commands, whatever they have set: a width that is parsed in between is lost.

    Attributes:
        gains: Proportional, integral and derivative gain of the velocity controller [counts per tick]. The
            derivative one has no effect: the firmware takes the difference of an error to itself.
        width: Last width that was set, negative for backward [counts of the timer].
    """

    def __init__(self) -> None:
        self.gains = _BOOT_GAINS
        self.width = 0
        self._mode = _Mode.DIRECT
        self._needs_update = self._decays = False
        self._decay_left = self._decaying_width = 0
        self._velocity = self._position = self._integral = self._prescaled = 0
        self._period, self._match, self._windup = _BOOT_PERIOD, _BOOT_PERIOD, _BOOT_WINDUP

    @property
    def duty(self) -> float:
        """Share of the battery's voltage in [-1, 1]."""
        if self.width > 0:
            return max(0, self._period - self._match) / self._period
        return -min(self._match, self._period) / self._period if self.width else 0.0

    @property
    def percent(self) -> int:
        """Width in percent of the period, as the firmware reports it."""
        return int(int32(100 * self.width) / int32(self._period))

    def set_period(self, period_us: int) -> bool:
        """Set the period [us] and let the pulses as they are; whether the firmware takes it.

        The controller's error is limited much more closely from then on than after a reset.
        """
        period = period_us * COUNTS_PER_US
        if not 0 < period < 2**32:
            return False
        self._period = period
        self._windup = period // self.gains[0] if self.gains[0] > 0 else 0
        return True

    def set_percent(self, percent: int, *, decays: bool) -> None:
        """Drive by a duty cycle [percent]."""
        percent = max(-_MAX_PERCENT, min(_MAX_PERCENT, percent))
        self._set_direct(int(int32(percent * int32(self._period)) / 100), decays=decays)

    def set_width_us(self, width_us: int, *, decays: bool) -> bool:
        """Drive by the width of pulses [us]; whether the firmware takes it, which refuses negative ones.

        Without decay even a width that is refused ends the velocity control.
        """
        width = width_us * COUNTS_PER_US
        is_taken = 0 <= width < 2**32
        if is_taken:
            self._set_direct(int32(width), decays=decays)
        elif not decays:
            self._mode, self._decays = _Mode.DIRECT, False
        return is_taken

    def set_velocity(self, velocity: int, ticks: int, *, decays: bool) -> None:
        """Drive at a velocity [ticks per 21 ms]; `ticks` is where the wheel is now."""
        if self._mode is _Mode.DIRECT:
            self._position = ticks
        self._mode, self._decays, self._decay_left = _Mode.VELOCITY, decays, _DECAY_TENTHS
        self._velocity = max(-MAX_VELOCITY, min(MAX_VELOCITY, velocity))

    def decay(self) -> None:
        """Process a tick of a tenth of a second."""
        if not self._decays:
            return
        if self._decay_left:
            self._decay_left -= 1
        elif self._mode is _Mode.VELOCITY:
            self._velocity -= (self._velocity > 0) - (self._velocity < 0)
        elif self._decaying_width:
            self._decaying_width = int(self._decaying_width * 90 / 100)
            self._set_width(self._decaying_width)

    def request_update(self) -> None:
        """The clock ticks: request an update of the velocity controller."""
        self._needs_update = self._needs_update or self._mode is _Mode.VELOCITY

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
        self._position = int32(ticks + max(-self._windup, min(self._windup, error)))
        self._integral += error
        if self._integral > 0 or error < -self._windup:
            self._integral = 0
        self._set_width(int32(self.gains[0] * error + self.gains[1] * self._integral))

    def _set_direct(self, width: int, *, decays: bool) -> None:
        self._mode, self._decays, self._decay_left = _Mode.DIRECT, decays, _DECAY_TENTHS
        self._set_width(width)
        self._decaying_width = self.width

    def _set_width(self, width: int) -> None:
        limit = int32(self._period)
        self.width = limit if width > limit else max(-limit, width)
        self._match = self._period - self.width if self.width > 0 else -self.width


def int32(value: int) -> int:
    """What is left of a number in a signed integer of 32 bits."""
    return (value + 2**31) % 2**32 - 2**31
