"""Lines of text that a PushBot sends, alone or between events."""

from __future__ import annotations

import re

from swarm_loc_drivers.pushbot.hardware import GENERATIONS, FirmwareGeneration

BANNER = re.compile(rb"EDVS-4337[^\n]*\n")
"""What a board says when it has started."""
FORMAT = re.compile(rb"-E(\d)\n")
"""The answer to `?E`."""
LAST_SENSORS = re.compile(rb"(?:EVENTS.RATE|MOTOR.SENSORS)[^\n]*\n\n")
"""The end of the answer to `??S`."""

_TICK_SENSOR = re.compile(rb"^ *(\d+) [\d ]*MOTOR.SENSORS", re.MULTILINE)
_TICKS = re.compile(rb"-S(\d+) (-?\d{1,10}) (-?\d{1,10})\r?")
_REFUSALS = (b"?", b"Set: parsing error", b"Get: parsing error", b"Error ", b"Channel not recognized")


def generation_of(listing: bytes) -> FirmwareGeneration | None:
    """The firmware that lists such sensors in answer to `??S`; None: none that has wheels."""
    match = _TICK_SENSOR.search(listing)
    bits = {one.tick_bit: one for one in GENERATIONS.values()}
    return bits.get(int(match[1])) if match else None


def wheel_ticks(line: bytes, generation: FirmwareGeneration) -> tuple[int, int] | None:
    """Ticks of the left and the right wheel; None when the line tells something else."""
    match = _TICKS.fullmatch(line)
    if match is None or int(match[1]) != generation.tick_bit:
        return None
    return int(match[2]), int(match[3])


def is_refusal(line: bytes) -> bool:
    """Whether the robot has not understood, or not done, a command."""
    return line.startswith(_REFUSALS)
