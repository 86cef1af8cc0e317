"""Error models of motion besides odometry: IMUs, and robots without odometry."""

from __future__ import annotations

import math
from dataclasses import dataclass

from swarm_loc_estimator.common.parameters import number


@dataclass(frozen=True)
class ImuModel:
    """Error model of the gyroscope of a robot's IMU, which measures the turns in place of the wheels.

    The turn rate w about the vertical becomes turn_scale * w + turn_bias. Errors that last are estimated
    along with the pose where their sigma is not zero; those of the wheels' turns are then not estimated.
    """

    turn_noise_density: float = number(
        0.0, "rad/s/Hz^0.5", 0.0, 1.0, "white noise of the turn rate; 0: the robot has no IMU"
    )
    turn_scale: float = number(1.0, "1", -10.0, 10.0, "true turn per measured turn; -1: mounted upside down")
    turn_scale_sigma: float = number(
        0.0, "1", 0.0, 1.0, "relative standard deviation of turn_scale; 0: exact, else estimated"
    )
    turn_bias: float = number(0.0, "rad/s", -1.0, 1.0, "true minus scaled turn rate")
    turn_bias_sigma: float = number(
        0.0, "rad/s", 0.0, 10.0, "standard deviation of the variable part of turn_bias, estimated; 0: none"
    )
    turn_bias_time_s: float = number(
        600.0, "s", 0.1, 1e6, "time constant of this variable part (Gauss-Markov)"
    )
    roll: float = number(
        0.0, "rad", -math.pi, math.pi, "mount: the IMU turned about base_link's x axis, before pitch"
    )
    pitch: float = number(0.0, "rad", -math.pi, math.pi, "mount: turned about base_link's y axis")
    delay_s: float = number(0.0, "s", -2.0, 2.0, "the turn happens this much after its stamp")
    timeout_s: float = number(
        0.25, "s", 0.001, 10.0, "time between two messages from which the turn of the wheels is used"
    )

    @property
    def is_used(self) -> bool:
        """Whether the robot has an IMU."""
        return self.turn_noise_density > 0.0


@dataclass(frozen=True)
class RandomWalk:
    """Random walk of a robot without odometry, given by the growth of its pose variance."""

    position: float = number(0.0, "m^2/s", 0.0, 1e3, "variance of x and of y per second; 0: stationary")
    heading: float = number(0.0, "rad^2/s", 0.0, 1e3, "variance of the heading per second")

    @property
    def moves(self) -> bool:
        """Whether the pose changes at all."""
        return self.position > 0.0 or self.heading > 0.0
