"""Parameters of robots that a batch estimates: where they stand in a description, and their priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.swarm.error_models import ImuModel, OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot, Swarm, UwbDevice

_SECTIONS = {
    "odometry": OdometryModel,
    "imu": ImuModel,
    "camera": CameraMount,
    "sensor": SensorModel,
    "uwb": UwbDevice,
}


class Parameter(NamedTuple):
    """A number of a robot's description."""

    section: str  # Of the description
    name: str  # In this section
    sigma: float  # Standard deviation of the prior

    @property
    def moves(self) -> bool:
        """Whether it changes the motion, not what the camera measures."""
        return self.section in {"odometry", "imu"}

    def of(self, robot: Robot) -> float:
        """The number of a robot; NaN: it has no such section."""
        return float(getattr(getattr(robot, self.section), self.name, np.nan))


SURVEY = (
    Parameter("odometry", "turn_bias", 0.01),
    Parameter("odometry", "distance_scale", 0.03),
    Parameter("odometry", "turn_scale", 0.05),
    Parameter("imu", "turn_bias", 0.01),
    Parameter("imu", "turn_scale", 0.05),
    Parameter("camera", "yaw", 0.05),
    Parameter("sensor", "distance_scale", 0.02),
    Parameter("sensor", "range_offset", 0.1),
)
"""What a survey corrects."""
_MOTION = (
    Parameter("odometry", "turn_bias", 0.02),
    Parameter("odometry", "distance_scale", 0.1),
    Parameter("odometry", "turn_scale", 0.1),
    Parameter("odometry", "delay_s", 0.1),
    Parameter("imu", "turn_bias", 0.01),
    Parameter("imu", "turn_scale", 0.05),
)
_BODY = (
    Parameter("odometry", "course_offset", 0.05),
    Parameter("odometry", "axle_offset", 0.05),
)
_MOUNT = (
    Parameter("camera", "x", 0.03),
    Parameter("camera", "y", 0.02),
    Parameter("sensor", "time_offset_s", 0.03),
)
_POLAR = (
    Parameter("sensor", "range_log_scale", 0.1),
    Parameter("sensor", "range_skew", 0.05),
    Parameter("sensor", "range_curve", 0.5),
    Parameter("sensor", "range_offset", 0.1),
    Parameter("sensor", "robot_range_offset", 0.05),
    Parameter("sensor", "bearing_offset", 0.1),
    Parameter("sensor", "bearing_scale", 0.1),
    Parameter("sensor", "bearing_curve", 0.1),
)
_POSES = (
    Parameter("camera", "yaw", 0.1),
    Parameter("sensor", "distance_scale", 0.05),
)
_RADIO = (
    Parameter("uwb", "range_bias", 0.2),
    Parameter("uwb", "range_scale", 0.02),
)


def calibrated_parameters(*, polar: bool, poses: bool, ranges: bool, truth: bool) -> tuple[Parameter, ...]:
    """What a calibration estimates of robots that see markers as ranges and bearings or poses, or anchors.

    Where base_link is on a robot only ground truth tells; without it, it is where odometry has it.
    """
    seen = (*(_POLAR if polar else ()), *(_POSES if poses else ()), *(_RADIO if ranges else ()))
    return (*_MOTION, *(_BODY if truth else ()), *_MOUNT, *seen)


def values_of(swarm: Swarm, parameters: Sequence[Parameter]) -> FloatArray:
    """The numbers (N, p) of all robots; NaN: it has no such section."""
    return np.array([[one.of(robot) for one in parameters] for robot in swarm.robots])


def all_changed(swarm: Swarm, parameters: Sequence[Parameter], change: FloatArray) -> Swarm:
    """The swarm with parameters of its robots changed by (N, p), within the ranges of a description."""
    robots = [_changed(robot, parameters, row) for robot, row in zip(swarm.robots, change, strict=True)]
    return replace(swarm, robots=tuple(robots))


def _changed(robot: Robot, parameters: Sequence[Parameter], change: FloatArray) -> Robot:
    new: dict[str, dict[str, float]] = {}
    for one, step in zip(parameters, change.tolist(), strict=True):
        if step and getattr(robot, one.section) is not None:
            spec = number_specs(_SECTIONS[one.section])[one.name]
            new.setdefault(one.section, {})[one.name] = min(max(one.of(robot) + step, spec.low), spec.high)
    return replace(robot, **{name: replace(getattr(robot, name), **values) for name, values in new.items()})
