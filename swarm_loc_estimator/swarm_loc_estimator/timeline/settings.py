"""Settings of the estimator, apart from the swarm itself."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from swarm_loc_estimator.common.parameters import UserError, number, number_specs
from swarm_loc_estimator.timeline.scheduling import Policy

if TYPE_CHECKING:
    from swarm_loc_estimator.swarm.swarm import Swarm


class SettingsError(UserError):
    """A setting outside its range; the message is one sentence."""


@dataclass(frozen=True)
class Settings:
    """How measurements are buffered, gated and fused; each number with its range beside it.

    `policy` holds the sizes from which on swarms are fused differently; it is no ROS parameter.

    Raises:
        SettingsError: A value is out of range.
    """

    horizon_s: float = number(
        2.0, "s", 0.05, 60.0, "data up to this late count at their own time; older are dropped"
    )
    fusion_period_s: float = number(
        -1.0,
        "s",
        -1.0,
        1.0,
        "where a large swarm has many measurements in such a period, they are fused together; 0: never;"
        " below: 0.2, or 0.4 where odometry of 250 robots and more is calibrated, 0.5 from 600 on",
    )
    fusion_delay_s: float = number(
        0.3,
        "s",
        0.0,
        1.0,
        "from 64 robots on a period is fused so long after its end; what comes later has it fused again",
    )
    sparse_from: int = number(
        250,
        "1",
        2,
        1_000_000,
        "from so many robots on only covariances of neighbours are kept",
    )
    state_period_s: float = number(
        0.0,
        "s",
        0.0,
        1.0,
        "period of stored states, measurements count at the closest (e-puck paper V-B); 0: exact",
    )
    future_tolerance_s: float = number(
        0.1, "s", 0.0, 10.0, "stamps further ahead of the clock than this are dropped"
    )
    jump_back_s: float = number(
        0.5, "s", 0.0, 3600.0, "a clock that goes back by more than this resets the filter"
    )
    lost_after: int = number(12, "1", 2, 1_000_000, "gated measurements in a row after which a robot is lost")
    lost_sigma: float = number(
        1.0, "m", 0.01, 1e3, "standard deviation of the position beyond which a robot is lost"
    )
    lost_heading_sigma: float = number(
        0.3, "rad", 0.01, 10.0, "standard deviation of the heading beyond which a robot is lost"
    )
    max_fault_score: float = number(
        10.0,
        "1",
        2.0,
        1e9,
        "fault score from which the description of a robot or landmark is re-estimated; 1e9: never",
    )
    fix_window_s: float = number(
        20.0, "s", 0.1, 600.0, "age up to which sightings initialize a robot without a pose"
    )

    aerial_probability: float = number(
        0.99, "1", 0.5, 0.999999, "probability from which a robot is identified in aerial images"
    )
    aerial_detection_probability: float = number(
        0.95, "1", 0.1, 0.999, "share of the robots in an aerial image that are detected"
    )
    aerial_scale_sigma: float = number(
        0.02, "1", 1e-4, 1.0, "relative standard deviation of the scale of aerial images"
    )
    aerial_scale_drift: float = number(
        0.0, "1/s^0.5", 0.0, 0.1, "relative random walk of that scale, as of a moving camera"
    )
    aerial_position_sigma: float = number(
        0.02, "m", 1e-4, 10.0, "noise of aerial detections without covariance, along x and y"
    )
    aerial_heading_sigma: float = number(0.1, "rad", 1e-4, 10.0, "noise of the headings of such detections")

    policy: Policy = field(default_factory=Policy, metadata={"is_internal": True})

    def __post_init__(self) -> None:
        for name, spec in number_specs(type(self)).items():
            value = getattr(self, name)
            if not spec.allows(value):
                raise SettingsError(f"parameter {name} = {value} must lie in {spec.range_text}.")

    def resolved_for(self, swarm: Swarm) -> Settings:
        """The settings with the default fusion period for a swarm where none is given."""
        if self.fusion_period_s >= 0.0:
            return self
        calibrated = sum(robot.odometry.is_calibrated for robot in swarm.robots)
        return replace(self, fusion_period_s=self.policy.fusion_period_s(calibrated))
