"""The firmware's motor control: duty cycles, and velocities by a position controller at 1 kHz."""

from __future__ import annotations

from enum import Enum

_PWM_LIMIT = 9600
"""Counts of a PWM period of 50 us at 192 MHz."""
_GAIN = 80
_WINDUP = _PWM_LIMIT // _GAIN * 20
"""The wanted position runs ahead of the wheel by no more ticks."""
_PRESCALER = 20
_DECAY_TENTHS = 10
_MAX = 100


class _Mode(Enum):
    DIRECT = "direct"
    VELOCITY = "velocity"


class Motor:
    """One motor: what it was told, and the duty cycle that follows from it."""

    def __init__(self) -> None:
        self._mode = _Mode.DIRECT
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
        """A tenth of a second has passed."""
        if not self._decays:
            return
        if self._decay_left:
            self._decay_left -= 1
        elif self._mode is _Mode.DIRECT:
            self._width = int(0.9 * self._width)
        else:
            self._velocity -= (self._velocity > 0) - (self._velocity < 0)

    def control(self, ticks: int) -> None:
        """A millisecond has passed; `ticks` is where the wheel is now."""
        if self._mode is _Mode.DIRECT:
            return
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
