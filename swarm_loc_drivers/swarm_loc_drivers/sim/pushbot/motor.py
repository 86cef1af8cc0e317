"""The motors of an emulated PushBot: the velocity controller, decaying velocities and duty cycles.

Source: motors.c and main.c of the board's firmware EDVSBoardOS (eDVS4337), version 0.7.1.
"""

from __future__ import annotations

from swarm_loc_drivers.pushbot.hardware import MAX_VELOCITY

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
