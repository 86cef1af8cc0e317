"""Commands of a PushBot: lines of ASCII, at most 127 characters each. A line must not begin with P or W."""

from __future__ import annotations

from dataclasses import dataclass

from swarm_loc_drivers.pushbot.hardware import FirmwareGeneration

RESET = b"\nR\n"
"""The board begins anew: motors off, ticks zero, its own clock zero. The line before may have been cut."""
NO_ECHO = b"!U0\n"
LIST_SENSORS = b"??S\n"
QUERY_FORMAT = b"?E\n"
EVENTS_ON = b"E+\n"
EVENTS_OFF = b"E-\n"
MOTORS_ON = b"!M+\n"
BRAKE = b"!M0=%0\n!M1=%0\n"
"""Wheels stand at once; what the velocity controller still had to catch up is forgotten."""
MOTORS_OFF = b"!M-\n"
STOP_SENSORS = b"!S-\n"


@dataclass(frozen=True)
class Lights:
    """Blinking of a PushBot's lights [Hz]; 0 is off. Both LEDs hang on one timer.

    Attributes:
        laser: Of the laser pointer.
        leds: Of the LEDs on its top, front and rear.
    """

    laser: float
    leds: float


def event_format(generation: FirmwareGeneration, timestamps: str) -> bytes:
    """Choose the timestamps of events, a key of the generation's formats."""
    return b"!E%d\n" % generation.formats[timestamps]


def stream_ticks(generation: FirmwareGeneration, period_ms: int) -> bytes:
    """Have the wheel ticks sent again and again."""
    return f"!S+{generation.sensor_prefix}{1 << generation.tick_bit},{period_ms}\n".encode()


def velocity(generation: FirmwareGeneration, left: int, right: int) -> bytes:
    """Drive the wheels; each unit is a tick in 21 ms.

    Where the firmware can, the velocity holds about a second and then decays by one unit every 0.1 s.
    """
    name = "MVD" if generation.has_decay else "MV"
    return f"!{name}0={left}\n!{name}1={right}\n".encode()


def lights(chosen: Lights) -> bytes:
    """Let laser and LEDs blink, half of each period lit."""
    return _blink("A", (0,), chosen.laser) + _blink("C", (0, 1), chosen.leds)


def _blink(timer: str, outputs: tuple[int, ...], frequency: float) -> bytes:
    """Period first: the firmware holds widths against it [us]."""
    period_us = round(1e6 / frequency) if frequency else 0
    lines = [f"!P{timer}={period_us}", *(f"!P{timer}{output}={period_us // 2}" for output in outputs)]
    return "".join(f"{line}\n" for line in lines).encode()
