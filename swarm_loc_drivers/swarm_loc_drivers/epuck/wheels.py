"""Inverse kinematics of the differential drive, for two stepper motors."""

from __future__ import annotations

import math
from dataclasses import dataclass

from swarm_loc_drivers.epuck.hardware import STEPS_PER_TURN, EpuckModel


@dataclass(frozen=True)
class WheelGeometry:
    """The two driven wheels.

    Attributes:
        wheel_diameter: [m].
        wheel_separation: [m].
    """

    wheel_diameter: float
    wheel_separation: float

    @property
    def metres_per_step(self) -> float:
        """Path of a wheel per step [m]."""
        return math.pi * self.wheel_diameter / STEPS_PER_TURN

    def commands_for(self, speed: float, turn_rate: float, model: EpuckModel) -> tuple[int, int]:
        """Commands [steps/s] for the left and the right wheel.

        Args:
            speed: Forward [m/s], finite.
            turn_rate: To the left [rad/s], finite.
            model: Whose limits hold; beyond them both wheels slow down alike, so that the curve stays.
        """
        half_turn = 0.5 * self.wheel_separation * turn_rate
        left, right = ((speed + side) / self.metres_per_step for side in (-half_turn, half_turn))
        slower = min(1.0, model.max_rate / max(abs(left), abs(right), 1.0))
        return model.command_for(slower * left), model.command_for(slower * right)
