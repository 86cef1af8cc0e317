"""Hardware of Droplets: directions of motion, gaits, infrared elements and their timing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

BAUD_RATE = 115_200
ELEMENTS = 6
RADIUS_M = 0.022
FULL_POWER = 256  # Power of the infrared emitters; 0 is off

TURN_CLOCKWISE, TURN_COUNTERCLOCKWISE = 6, 7
WALKS = range(6)  # Direction d walks towards d times 60 degrees clockwise from the front
DIRECTIONS = range(8)

_TICK_S = 1.024e-3
_ON_TICKS, _OFF_TICKS, _TRIMS_PER_TICK = 20, 40, 32
_UNCALIBRATED = 0xFFFF - 1000  # An unwritten EEPROM holds 0xFFFF; values near it are uncalibrated
_UNCALIBRATED_WALK_MM, _UNCALIBRATED_TURN_DEG = 600, 2000  # The firmware then uses these, per 1000 steps


@dataclass(frozen=True)
class DropletModel:
    """Type of a Droplet."""

    name: str  # Name in parameters
    directions: tuple[int, ...]  # Directions in which it can move


DROPLET = DropletModel("droplet", tuple(DIRECTIONS))
AUDIO_DROPLET = DropletModel("audio_droplet", (0, 3, TURN_CLOCKWISE, TURN_COUNTERCLOCKWISE))
"""It has a speaker instead of one motor."""
DROPLET_MODELS = {model.name: model for model in (DROPLET, AUDIO_DROPLET)}


class Gait(NamedTuple):
    """Motion of one step in a direction."""

    step_s: float  # Duration [s]
    forward: float  # Path ahead [m]
    left: float  # Path to the left [m]
    turn: float  # Turn to the left [rad]

    @property
    def velocity(self) -> tuple[float, float, float]:
        """Mean velocity: forward [m/s], to the left [m/s], turning to the left [rad/s]."""
        return self.forward / self.step_s, self.left / self.step_s, self.turn / self.step_s


def gait(direction: int, trims: Sequence[int], per_kilostep: int) -> Gait | None:
    """The gait of a direction, by the calibrated path [mm] or turn [deg] of 1000 steps; None: no motor turns.

    In a step the motors of the direction run one after the other, 20 ticks each and a trim, and pause for 40.
    Trims [1/32 ticks] are signed by the sense of rotation; 0: does not turn.
    """
    ticks = sum(_ON_TICKS + _OFF_TICKS + abs(trim) / _TRIMS_PER_TICK for trim in trims if trim)
    if not ticks:
        return None
    if per_kilostep > _UNCALIBRATED:
        per_kilostep = _UNCALIBRATED_WALK_MM if direction in WALKS else _UNCALIBRATED_TURN_DEG
    if direction not in WALKS:
        turn = math.radians(per_kilostep * 1e-3)
        return Gait(ticks * _TICK_S, 0.0, 0.0, -turn if direction == TURN_CLOCKWISE else turn)
    bearing, path = -direction * math.pi / 3.0, per_kilostep * 1e-6
    return Gait(ticks * _TICK_S, path * math.cos(bearing), path * math.sin(bearing), 0.0)


_MS = 1_000_000
_BYTE_NS = 2_500_000  # From a comment in the firmware; ten bits at 3200 baud would be 3.1 ms
_HEADER = 7  # Sender, checksum, length and flags, target
MAX_MESSAGE = 40  # Longest message; receivers reject a longer one [bytes]

HANDLING_NS = 5 * _MS  # From the last byte of a command until its execution
SET_POWER_DELAY_NS = 10 * _MS  # From the command to change the power until it has changed
EMIT_DELAY_NS = 5 * _MS  # From the command to emit until the call
CALL_NS = (_HEADER + 1) * _BYTE_NS
LEAD_NS = 32 * _MS  # From the beginning of the call to the first flash
FLASH_NS, GAP_NS = 16 * _MS, 10 * _MS
EXCHANGE_NS = LEAD_NS + ELEMENTS * (FLASH_NS + GAP_NS)  # From the call until all robots listen again
PRINT_DELAY_NS = 10 * _MS  # From the end of the exchange until the matrix is printed


def message_ns(length: int) -> int:
    """Duration of a message of `length` bytes [ns]."""
    return (_HEADER + length) * _BYTE_NS


def flash_ns(emitter: int) -> int:
    """Middle of an emitter's flash after the beginning of the call [ns]."""
    return LEAD_NS + emitter * (FLASH_NS + GAP_NS) + FLASH_NS // 2


MIDDLE_NS = (flash_ns(0) + flash_ns(ELEMENTS - 1)) // 2  # Of the measurements, after the call began
PRINTED_AFTER_NS = EXCHANGE_NS + PRINT_DELAY_NS - MIDDLE_NS
"""From the middle of the measurements until the matrix is printed."""
EMITTED_AFTER_NS = EMIT_DELAY_NS + EXCHANGE_NS + PRINT_DELAY_NS
"""From the command to emit until the matrix is printed."""
