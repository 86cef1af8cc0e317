"""The PushBot, an eDVS4337 board with two geared motors: firmware generations, commands and answers.

Sources: the firmware (EDVSBoardOS of eDVS4337, its first public revision and version 0.7.1) and the board's
user guide.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from swarm_loc_drivers.common.odometry import WheelGeometry

SENSOR_PX = 128  # Rows and columns of the event camera
MAX_VELOCITY = 100  # Largest velocity; larger ones are clamped silently [1]
VELOCITY_PERIOD_S = 0.021
"""A wheel at velocity v makes v ticks in this time: a counter from 20 to 0, once a millisecond."""
MAX_TICK_RATE = MAX_VELOCITY / VELOCITY_PERIOD_S  # [ticks/s]
TICK_SPAN = 1 << 32  # Wheel ticks are sent as signed integers of 32 bits
BAUD_RATE = 4_000_000  # Baud rate after every reset [bit/s]

TIMESTAMPS = {"none": 0, "delta": -1, "16bit": 2, "24bit": 3, "32bit": 4}
"""Names of the timestamps of events and their bytes; -1: difference to the last event, 1 to 4 bytes."""


@dataclass(frozen=True)
class FirmwareGeneration:
    """Differences between firmware generations."""

    name: str  # Name in messages
    tick_bit: int  # Number of the sensor of the wheel ticks; identifies the generation, see `??S`
    formats: dict[str, int]  # Names of timestamps -> digit of the command `!E`
    sensor_prefix: str  # Characters before the mask of `!S+`
    has_decay: bool  # Whether velocities decay, so that the robot stops by itself when commands end


FIRST_FIRMWARE = FirmwareGeneration(
    "first", 24, {"none": 0, "16bit": 1, "24bit": 2, "delta": 3}, ",", has_decay=False
)
"""The first public revision: `!S+,mask,period`, no 32-bit timestamps, no decaying velocities."""
SECOND_FIRMWARE = FirmwareGeneration(
    "second", 28, {"none": 0, "delta": 1, "16bit": 2, "24bit": 3, "32bit": 4}, "", has_decay=True
)
"""Version 0.7 and later."""
GENERATIONS = {one.name: one for one in (FIRST_FIRMWARE, SECOND_FIRMWARE)}


def wheel_velocities(geometry: WheelGeometry, speed: float, turn_rate: float) -> tuple[int, int]:
    """Velocities of the left and the right wheel [ticks per 21 ms]; speed [m/s], turn rate [rad/s]."""
    left, right = geometry.commands_for(speed, turn_rate, MAX_VELOCITY, VELOCITY_PERIOD_S)
    return round(left), round(right)


def tick_difference(before: int, after: int) -> int:
    """Ticks between two readings of a counter of 32 bits that wraps."""
    return (after - before + TICK_SPAN // 2) % TICK_SPAN - TICK_SPAN // 2


RESET = b"\nR\n"  # Motors off, ticks and clock zero. The newline ends a previous line that was cut
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
