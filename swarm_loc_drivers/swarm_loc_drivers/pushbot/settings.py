"""What a PushBot's driver has to know, and what it hands on."""

from __future__ import annotations

from dataclasses import dataclass

from swarm_loc_drivers.common.link import Address
from swarm_loc_drivers.pushbot.commands import Lights
from swarm_loc_drivers.pushbot.hardware import MAX_VELOCITY, VELOCITY_PERIOD_S


@dataclass(frozen=True)
class WheelGeometry:
    """The two driven wheels.

    Attributes:
        metres_per_tick: Path of a wheel per tick [m].
        wheel_separation: [m].
    """

    metres_per_tick: float
    wheel_separation: float

    def velocities(self, speed: float, turn_rate: float) -> tuple[int, int]:
        """Commands for the left and the right wheel [ticks per 21 ms].

        Args:
            speed: Forward [m/s], finite.
            turn_rate: To the left [rad/s], finite. Beyond the limits both wheels slow down alike.
        """
        half_turn = 0.5 * self.wheel_separation * turn_rate
        unit = self.metres_per_tick / VELOCITY_PERIOD_S
        left, right = (speed - half_turn) / unit, (speed + half_turn) / unit
        slower = min(1.0, MAX_VELOCITY / max(abs(left), abs(right), 1.0))
        return round(slower * left), round(slower * right)


@dataclass(frozen=True)
class PushbotSettings:
    """How to reach a robot and what it is to do.

    Attributes:
        address: Where it answers.
        baud_rate: Of a serial port [bit/s].
        geometry: Its wheels.
        wheel_noise: Variance of each wheel's path per metre it rolls [m^2/m].
        command_timeout_s: How long a velocity counts [s].
        reply_timeout_s: How long an answer, or the next wheel ticks, may take [s].
        tick_period_s: Between two readings of the wheel ticks [s].
        timestamps: Of events, a key of `protocols.pushbot.hardware.TIMESTAMPS`; "" for no events at all.
        on_bit: The polarity bit of pixels that became brighter.
        packet_period_s: Of packets of events [s].
        lights: Frequencies of laser and LEDs.
    """

    address: Address
    baud_rate: int
    geometry: WheelGeometry
    wheel_noise: float
    command_timeout_s: float
    reply_timeout_s: float
    tick_period_s: float
    timestamps: str
    on_bit: int
    packet_period_s: float
    lights: Lights


@dataclass(frozen=True)
class WheelTicks:
    """A reading of the wheels' counters.

    Attributes:
        stamp_ns: Acquisition, as well as it can be known [ns].
        left: Ticks of the left wheel, 32 bits, wrapping.
        right: Likewise of the right wheel.
    """

    stamp_ns: int
    left: int
    right: int
