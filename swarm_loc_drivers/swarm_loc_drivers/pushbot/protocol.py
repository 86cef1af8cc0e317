"""Commands of a PushBot and the lines of text that it sends."""

from __future__ import annotations

import re
from dataclasses import dataclass

from swarm_loc_drivers.pushbot.hardware import GENERATIONS, FirmwareGeneration

RESET = b"\nR\n"
"""Reset the board: motors off, ticks and clock zero. The newline ends a previous line that was cut."""
NO_ECHO = b"!U0\n"
LIST_SENSORS = b"??S\n"
QUERY_FORMAT = b"?E\n"
EVENTS_ON = b"E+\n"
EVENTS_OFF = b"E-\n"
MOTORS_ON = b"!M+\n"
BRAKE = b"!M0=%0\n!M1=%0\n"  # Stop the wheels at once; the velocity controller forgets its remaining error
MOTORS_OFF = b"!M-\n"
STOP_SENSORS = b"!S-\n"


@dataclass(frozen=True)
class Lights:
    """Blink frequencies of a PushBot's lights [Hz]; 0 is off. Both LEDs share one timer."""

    laser: float  # Laser pointer
    leds: float  # LEDs on top, front and rear


def event_format(generation: FirmwareGeneration, timestamps: str) -> bytes:
    """Set the timestamps of events, a key of the generation's formats."""
    return b"!E%d\n" % generation.formats[timestamps]


def stream_ticks(generation: FirmwareGeneration, period_ms: int) -> bytes:
    """Stream the wheel ticks with a period [ms]."""
    return f"!S+{generation.sensor_prefix}{1 << generation.tick_bit},{period_ms}\n".encode()


def velocity(generation: FirmwareGeneration, left: int, right: int) -> bytes:
    """Drive the wheels; the unit is one tick in 21 ms.

    If the firmware supports it, the velocity holds for about 1 s and then decays by one unit every 0.1 s.
    """
    name = "MVD" if generation.has_decay else "MV"
    return f"!{name}0={left}\n!{name}1={right}\n".encode()


def lights(frequencies: Lights) -> bytes:
    """Blink laser and LEDs with a duty cycle of one half."""
    return _blink("A", (0,), frequencies.laser) + _blink("C", (0, 1), frequencies.leds)


def _blink(timer: str, outputs: tuple[int, ...], frequency: float) -> bytes:
    """Period before widths [us], since the firmware checks widths against the period."""
    period_us = round(1e6 / frequency) if frequency else 0
    lines = [f"!P{timer}={period_us}", *(f"!P{timer}{output}={period_us // 2}" for output in outputs)]
    return "".join(f"{line}\n" for line in lines).encode()


BANNER = re.compile(rb"EDVS-4337[^\n]*\n")  # Line of a board that has started
FORMAT = re.compile(rb"-E(\d)\n")  # The answer to `?E`
LAST_SENSORS = re.compile(rb"(?:EVENTS.RATE|MOTOR.SENSORS)[^\n]*\n\n")  # The end of the answer to `??S`

_TICK_SENSOR = re.compile(rb"^ *(\d{1,2}) [\d ]*MOTOR.SENSORS", re.MULTILINE)
_TICKS = re.compile(rb"-S(\d+) (-?\d{1,10}) (-?\d{1,10})\r?")
_REFUSALS = (b"?", b"Set: parsing error", b"Get: parsing error", b"Error ", b"Channel not recognized")


def generation_of(listing: bytes) -> FirmwareGeneration | None:
    """The firmware that answers `??S` with this list of sensors; None for one without wheels."""
    match = _TICK_SENSOR.search(listing)
    bits = {one.tick_bit: one for one in GENERATIONS.values()}
    return bits.get(int(match[1])) if match else None


def wheel_ticks(line: bytes, generation: FirmwareGeneration) -> tuple[int, int] | None:
    """Ticks of the left and the right wheel; None for another line."""
    match = _TICKS.fullmatch(line)
    if match is None or int(match[1]) != generation.tick_bit:
        return None
    return int(match[2]), int(match[3])


def is_refusal(line: bytes) -> bool:
    """Whether the robot has rejected a command."""
    return line.startswith(_REFUSALS)
