"""A robot's infrared board: which one, how readings become poses, and the gains of its elements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

from swarm_loc_estimator.common.parameters import number
from swarm_loc_estimator.swarm.ir_board import IrGains, IrPlatform


class IrMethod(Enum):
    """How brightness becomes a relative pose."""

    LIKELIHOOD = "likelihood"  # the most likely pose of all readings of all powers
    CLOSED_FORM = "closed_form"  # eqs (9)-(18) of the Droplet paper, corrected


@dataclass(frozen=True)
class RobotIr:
    """The infrared board of one robot.

    Attributes:
        id: By which its exchanges name it, 1 to 65535, unique in the swarm.
        platform: What the board is.
        source: Name of a packaged platform, or absolute path of the file that it comes from.
        estimator: How what it reads becomes a pose.
        gains: What is known of its elements; None: never calibrated.
        dead_sensors: Numbers of sensors whose readings mean nothing.
        dead_emitters: Likewise of emitters.
    """

    id: int
    platform: IrPlatform
    source: str
    estimator: IrMethod = IrMethod.LIKELIHOOD
    gains: IrGains | None = None
    dead_sensors: tuple[int, ...] = ()
    dead_emitters: tuple[int, ...] = ()
    gate_probability: float = number(
        0.9999, "1", 0.5, 1.0, "share of good measurements that must pass the gate; 1 passes all"
    )

    @property
    def believed_gains(self) -> IrGains:
        """The gains to reckon with."""
        gains = self.gains or IrGains.unknown(self.platform)
        return replace(gains, dead_sensors=self.dead_sensors, dead_emitters=self.dead_emitters)
