"""Hardware and firmware generations of the PushBot: an eDVS4337 board with two geared motors.

Sources: the firmware (EDVSBoardOS of eDVS4337, its first public revision and version 0.7.1) and the board's
user guide.
"""

from __future__ import annotations

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
