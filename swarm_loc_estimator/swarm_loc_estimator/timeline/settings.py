"""Settings of the estimator, and the sizes of swarms and batches at which its strategy changes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from swarm_loc_estimator.common.parameters import UserError, number, number_specs

if TYPE_CHECKING:
    from swarm_loc_estimator.swarm.swarm import Swarm


@dataclass(frozen=True)
class Policy:
    """Sizes at which the estimator changes its strategy; users set only `Settings.sparse_from`."""

    large_from: int = 16  # Minimum number of robots for batch updates; a smaller swarm has few measurements
    # Minimum number of measurements per fusion period for a batch update; sequential updates of fewer
    # measurements are faster
    batch_from: int = 64
    # Minimum number of robots to fuse a period only `fusion_delay_s` after its end; a smaller swarm fuses
    # late data again at little cost
    delay_from: int = 64
    # Maximum number of robots for which all parameters are re-estimated when several robots or landmarks are
    # contradicted; a larger swarm re-estimates only the contradicted ones
    reopen_all_up_to: int = 30
    # Default fusion period [s] by the minimum number of robots with calibrated odometry, largest number first
    fusion_periods_s: tuple[tuple[int, float], ...] = ((600, 0.5), (250, 0.4), (0, 0.2))

    def fusion_period_s(self, calibrated: int) -> float:
        """Default fusion period for a number of robots with calibrated odometry [s]."""
        return next(period_s for count, period_s in self.fusion_periods_s if calibrated >= count)


class SettingsError(UserError):
    """A setting is out of range; the message is one sentence."""


@dataclass(frozen=True)
class Settings:
    """Parameters of buffering, gating and fusion, with default, unit, range and description.

    `policy` holds the swarm sizes at which the fusion strategy changes; it is not a ROS parameter.

    Raises:
        SettingsError: A value is out of range.
    """

    horizon_s: float = number(
        2.0, "s", 0.05, 60.0, "maximum delay of data, fused at their own stamps; older data are dropped"
    )
    fusion_period_s: float = number(
        -1.0,
        "s",
        -1.0,
        1.0,
        "period in which many measurements of a large swarm are fused as one batch; 0: never; negative:"
        " 0.2, or 0.4 if the odometry of 250 robots or more is calibrated, 0.5 from 600 on",
    )
    fusion_delay_s: float = number(
        0.3,
        "s",
        0.0,
        1.0,
        "delay from the end of a period to its fusion, from 64 robots on; later data cause a re-fusion",
    )
    sparse_from: int = number(
        250,
        "1",
        2,
        1_000_000,
        "minimum number of robots for the sparse filter, which keeps only covariances of neighbours",
    )
    future_tolerance_s: float = number(
        0.1, "s", 0.0, 10.0, "maximum time of stamps ahead of the clock; data beyond it are dropped"
    )
    jump_back_s: float = number(
        0.5, "s", 0.0, 3600.0, "minimum backward jump of the clock that resets the filter"
    )
    lost_after: int = number(12, "1", 2, 1_000_000, "gated measurements in a row after which a robot is lost")
    lost_sigma: float = number(
        1.0, "m", 0.01, 1e3, "maximum standard deviation of the position; beyond it a robot is lost"
    )
    lost_heading_sigma: float = number(
        0.3,
        "rad",
        0.01,
        10.0,
        "maximum standard deviation of a known heading; positions that depend on unknown ones are lost",
    )
    max_fault_score: float = number(
        10.0,
        "1",
        2.0,
        1e9,
        "fault score from which a source is contradicted: estimated again or left out; 1e9: never",
    )
    fix_window_s: float = number(20.0, "s", 0.1, 600.0, "maximum age of sightings that initialize a robot")
    origin_after_s: float = number(
        10.0,
        "s",
        0.0,
        3600.0,
        "time without start, landmark and fix after which the best connected robot is the origin; 0: never",
    )

    aerial_probability: float = number(
        0.99, "1", 0.5, 0.999999, "minimum probability to identify a robot in aerial images"
    )
    aerial_detection_probability: float = number(
        0.95, "1", 0.1, 0.999, "probability that a robot in an aerial image is detected"
    )
    aerial_gate_probability: float = number(
        0.9999, "1", 0.5, 1.0, "share of good aerial detections that must pass the gate; 1 passes all"
    )
    aerial_scale_sigma: float = number(
        0.02, "1", 1e-4, 1.0, "relative standard deviation of the scale of aerial images"
    )
    aerial_scale_drift: float = number(
        0.0, "1/s^0.5", 0.0, 0.1, "relative random walk of the scale of aerial images, for a moving camera"
    )
    aerial_position_sigma: float = number(
        0.02, "m", 1e-4, 10.0, "standard deviation of x and y of aerial detections without covariance"
    )
    aerial_heading_sigma: float = number(
        0.1, "rad", 1e-4, 10.0, "standard deviation of the heading of such detections"
    )

    policy: Policy = field(default_factory=Policy, metadata={"is_internal": True})

    def __post_init__(self) -> None:
        for name, spec in number_specs(type(self)).items():
            value = getattr(self, name)
            if not spec.allows(value):
                raise SettingsError(f"parameter {name} = {value} must lie in {spec.range_text}.")

    def resolved_for(self, swarm: Swarm) -> Settings:
        """Settings with the default fusion period of a swarm if `fusion_period_s` is negative."""
        if self.fusion_period_s >= 0.0:
            return self
        calibrated = sum(robot.estimates_motion for robot in swarm.robots)
        return replace(self, fusion_period_s=self.policy.fusion_period_s(calibrated))

    def is_sparse(self, swarm: Swarm) -> bool:
        """Whether the sparse filter estimates a swarm: only covariances of neighbours are kept."""
        return self.fusion_period_s > 0.0 and len(swarm.robots) >= self.sparse_from
