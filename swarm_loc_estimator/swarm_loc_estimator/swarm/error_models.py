"""Error models of odometry, IMUs, lidars, clocks, robots without odometry, sightings and absolute fixes."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from swarm_loc_estimator.common.codec import (
    EntrySpec,
    Tree,
    TreeChecks,
    entry,
    entry_specs,
    listed,
    properties,
)
from swarm_loc_estimator.common.parameters import estimated, gate, number, positive


class MotionResponseError(ValueError):
    """An inconsistent response."""


def _rows(checks: TreeChecks, tree: object, key: str) -> tuple[tuple[float, ...], ...]:
    rows = enumerate(checks.items(tree, key))
    return tuple(checks.list_of_numbers(row, f"{key}[{index}]") for index, row in rows)


_NUMBERS = listed("a list of numbers")
_AXIS = entry(_NUMBERS)
_TABLE = entry(EntrySpec(_rows, {"type": "array", "items": _NUMBERS.schema}, _NUMBERS.wanted))


@dataclass(frozen=True)
class MotionResponse:
    """True shares of the reported speed and turn rate, for odometry from commands or with slip.

    Shares are interpolated between the points of the grid and constant beyond its border.

    Raises:
        MotionResponseError: Sizes differ, an axis does not ascend, or a share is not in [0, 10].
    """

    speeds: tuple[float, ...] = field(metadata=_AXIS)  #: (V,) reported speeds [m/s], ascending from 0
    #: (W,) absolute reported turn rates [rad/s], ascending from 0
    turn_rates: tuple[float, ...] = field(metadata=_AXIS)
    #: (V, W) true speed per reported speed
    speed_share: tuple[tuple[float, ...], ...] = field(metadata=_TABLE)
    #: (V, W) true turn rate per reported turn rate
    turn_share: tuple[tuple[float, ...], ...] = field(metadata=_TABLE)

    def __post_init__(self) -> None:
        for name in ("speeds", "turn_rates"):
            at = getattr(self, name)
            ascends = all(low < high for low, high in itertools.pairwise(at))
            if not at or not all(0.0 <= v <= 1e3 for v in at) or not ascends:
                raise MotionResponseError(f"response.{name} is {list(at)} but must ascend within [0, 1000].")
        for name in ("speed_share", "turn_share"):
            table = getattr(self, name)
            if len(table) != len(self.speeds) or any(len(row) != len(self.turn_rates) for row in table):
                raise MotionResponseError(
                    f"response.{name} must have {len(self.speeds)} rows, one per speed,"
                    f" of {len(self.turn_rates)} numbers, one per turn rate."
                )
            if not all(0.0 <= v <= 10.0 for row in table for v in row):
                raise MotionResponseError(f"response.{name} must hold numbers in [0, 10] only.")


TURN = 6.2832  # Maximum absolute angle in descriptions: a full turn [rad]


@dataclass(frozen=True)
class OdometryModel:
    """Error model of a robot's odometry: process noise, and calibration of the reported motion.

    The reported speed v and turn rate w of a step become distance_scale * v and turn_scale * w, further
    scaled by the robot's `MotionResponse` if it has one; turn_bias is added while the robot moves. They take
    effect `delay_s` after their stamp, through a first-order lag `lag_s`. base_link moves along
    `course_offset` and lies `axle_offset` ahead of the wheels' axle. Errors that last - a varying bias of the
    turn rate, scales that are not quite known - are estimated along with the pose where their sigma is not
    zero.
    """

    wheel_separation: float = number(0.053, "m", 0.001, 10.0, "distance between the two wheels")
    wheel_noise: float = number(2e-4, "m", 0.0, 1.0, "variance of a wheel's path per metre it rolls [m^2/m]")
    distance_noise: float = number(0.0, "m", 0.0, 1.0, "added variance of the path per metre driven [m^2/m]")
    distance_turn_noise: float = number(0.0, "m^2/rad", 0.0, 1.0, "added variance of path per radian turned")
    lateral_noise: float = number(0.0, "m", 0.0, 1.0, "variance across the path per metre driven [m^2/m]")
    turn_noise: float = number(0.0, "rad", 0.0, 10.0, "added variance of turn per radian turned [rad^2/rad]")
    turn_change_noise: float = number(0.0, "rad s", 0.0, 10.0, "added variance per change of the turn rate")
    distance_drift: float = number(0.0, "m^2/s", 0.0, 1.0, "variance of the path per second while moving")
    lateral_drift: float = number(0.0, "m^2/s", 0.0, 1.0, "variance across the path per second while moving")
    turn_drift: float = number(0.0, "rad^2/s", 0.0, 10.0, "variance of the turn per second while moving")
    distance_scale: float = number(1.0, "1", 0.1, 10.0, "true path per reported path")
    distance_scale_sigma: float = estimated(0.0, "1", 1.0, "distance_scale")
    turn_scale: float = number(1.0, "1", 0.1, 10.0, "true turn per reported turn")
    turn_scale_sigma: float = estimated(0.0, "1", 1.0, "turn_scale")
    turn_bias: float = number(0.0, "rad/s", -1.0, 1.0, "true minus scaled turn rate while moving")
    turn_bias_sigma: float = estimated(0.0, "rad/s", 10.0, "the variable part of turn_bias")
    turn_bias_time_s: float = number(60.0, "s", 0.1, 1e6, "time constant of that part (Gauss-Markov)")
    course_offset: float = number(0.0, "rad", -math.pi, math.pi, "course relative to base_link's x axis")
    axle_offset: float = number(0.0, "m", -1.0, 1.0, "base_link ahead of the wheels' axle")
    delay_s: float = number(0.0, "s", -2.0, 2.0, "the motion happens this much after its stamp")
    lag_s: float = number(0.0, "s", 0.0, 10.0, "time constant with which the motion follows the report")
    timeout_s: float = number(1.0, "s", 0.01, 60.0, "time without messages after which the motion is unknown")
    max_speed: float = number(1.0, "m/s", 0.001, 100.0, "steps that imply more are dropped")
    max_turn_rate: float = number(10.0, "rad/s", 0.01, 1000.0, "steps that imply more are dropped")
    speed_change: float = number(0.1, "m/s/s^0.5", 0.0, 100.0, "random walk of speed past the newest message")
    turn_rate_change: float = number(2.0, "rad/s/s^0.5", 0.0, 1000.0, "the same of the turn rate")


@dataclass(frozen=True)
class ImuModel:
    """Error model of the gyroscope of a robot's IMU, which measures the turns in place of the wheels.

    The turn rate w about the vertical becomes turn_scale * w + turn_bias. Errors that last are estimated
    along with the pose where their sigma is not zero; those of the wheels' turns are then not estimated.
    """

    turn_noise_density: float = number(0.0, "rad/s/Hz^0.5", 0.0, 1.0, "white noise of turn rates; 0: no IMU")
    turn_scale: float = number(1.0, "1", 0.1, 10.0, "true turn per measured turn")
    turn_scale_sigma: float = estimated(0.0, "1", 1.0, "turn_scale")
    turn_bias: float = number(0.0, "rad/s", -1.0, 1.0, "true minus scaled turn rate")
    turn_bias_sigma: float = estimated(0.0, "rad/s", 10.0, "the variable part of turn_bias")
    turn_bias_time_s: float = number(600.0, "s", 0.1, 1e6, "time constant of that part (Gauss-Markov)")
    roll: float = number(0.0, "rad", -math.pi, math.pi, "mount: turned about the x axis; 3.1416: upside down")
    pitch: float = number(0.0, "rad", -math.pi, math.pi, "mount: then turned about the y axis")
    delay_s: float = number(0.0, "s", -2.0, 2.0, "the turn happens this much after its stamp")
    timeout_s: float = number(0.25, "s", 0.001, 10.0, "gap between messages that the wheels' turns fill")

    @property
    def is_used(self) -> bool:
        """Whether the robot has an IMU."""
        return self.turn_noise_density > 0.0


@dataclass(frozen=True)
class SingleLidar:
    """Mount and noise of a 2-D lidar."""

    range_sigma: float = number(0.0, "m", 0.0, 1.0, "noise of a range; 0: the robot has no lidar")
    range_sigma_per_m: float = number(0.01, "1", 0.0, 1.0, "growth of this noise with the range [m per m]")
    x: float = number(0.0, "m", -10.0, 10.0, "forward of base_link")
    y: float = number(0.0, "m", -10.0, 10.0, "left of base_link")
    yaw: float = number(0.0, "rad", -TURN, TURN, "turned to the left; 3.1416: its zero is backwards")
    roll: float = number(0.0, "rad", -TURN, TURN, "turned about its zero before; 3.1416: upside down")
    delay_s: float = number(0.0, "s", -2.0, 2.0, "beams are measured this much after their stamps")
    min_range: float = number(0.0, "m", 0.0, 10.0, "nearer ranges are dropped, as those below range_min")
    max_range: float = number(12.0, "m", 0.2, 50.0, "greatest range, up to which space is free", above=True)
    map_sigma: float = number(0.05, "m", 0.0, 1.0, "error of the map's walls, added to that of its cells")
    robot_radius: float = number(0.0, "m", 0.0, 5.0, "of bodies of other robots that it sees; 0: sees none")

    @property
    def is_used(self) -> bool:
        """Whether the robot has it."""
        return self.range_sigma > 0.0


_LIDAR_TOPIC = r"[a-zA-Z_]\w*(/[a-zA-Z_]\w*)*"


def _read_others(checks: TreeChecks, tree: Tree, key: str) -> dict[str, dict[str, float]]:
    """Read `LidarModel.others`."""
    lidars = checks.mapping(tree, key)
    for topic in lidars:
        if not isinstance(topic, str) or not re.fullmatch(_LIDAR_TOPIC, topic, re.ASCII) or topic == "scan":
            raise checks.error(f"a name in {key}", topic, "must be a topic other than scan, such as rear")
    specs = entry_specs(SingleLidar)
    return {topic: checks.values(values, f"{key}.{topic}", specs) for topic, values in lidars.items()}


_OTHERS = {
    "type": "object",
    "additionalProperties": {
        "type": "object",
        "properties": properties(entry_specs(SingleLidar)),
        "additionalProperties": False,
    },
}


@dataclass(frozen=True)
class LidarModel(SingleLidar):
    """The lidar of a robot, for mapping and for localization in a map, and others for localization.

    Raises ValueError if there are others but no first one.
    """

    #: Topic of another lidar -> its mount, and what else differs from this one
    others: Mapping[str, Mapping[str, float]] = field(
        default_factory=dict, metadata=entry(EntrySpec(_read_others, _OTHERS))
    )

    def __post_init__(self) -> None:
        if self.others and not self.is_used:
            raise ValueError("range_sigma is 0 but must be greater, since there are others.")

    @property
    def all(self) -> dict[str, SingleLidar]:
        """Topic -> lidar of all lidars of the robot, this one first."""
        common = {one.name: getattr(self, one.name) for one in fields(SingleLidar)}
        common |= dict.fromkeys(("x", "y", "yaw", "roll"), 0.0)
        others = {topic: SingleLidar(**{**common, **own}) for topic, own in self.others.items()}
        return {"scan": self, **{topic: one for topic, one in others.items() if one.is_used}}

    @property
    def sees_robots(self) -> bool:
        """Whether it sees other robots, so that it is of use without a map, too."""
        return self.is_used and any(one.robot_radius > 0.0 for one in self.all.values())


@dataclass(frozen=True)
class RandomWalk:
    """Random walk of a robot without odometry, given by the growth of its pose variance."""

    position: float = number(0.0, "m^2/s", 0.0, 1e3, "variance of x and of y per second; 0: stationary")
    heading: float = number(0.0, "rad^2/s", 0.0, 1e3, "variance of the heading per second")

    @property
    def moves(self) -> bool:
        """Whether the pose changes at all."""
        return self.position > 0.0 or self.heading > 0.0


MAX_OFFSET_S = 1e9  # Greatest offset of a clock [s]


@dataclass(frozen=True)
class ClockModel:
    """Clock of a robot, by which its odometry, detections, turn rates, ranges and brightness are stamped."""

    offset_s: float = number(0.0, "s", -MAX_OFFSET_S, MAX_OFFSET_S, "its time minus that of the estimator")


@dataclass(frozen=True)
class SensorModel:
    """Error model of a robot's sightings: noise, calibration and gate.

    Measured distances are multiplied by distance_scale. A sighting without heading has a range r [m] and a
    bearing b [rad], positive to the left, which become
    distance = r * exp(range_log_scale + range_skew * b + range_curve * b^2) + range_offset, to a robot's
    marker with robot_range_offset more, and
    bearing = bearing_scale * b + bearing_curve * b^2 + bearing_offset, taken `time_offset_s` after the stamp.
    """

    forward_sigma: float = positive(0.02, "m", 10.0, "noise along the optical axis, sightings with heading")
    left_sigma: float = positive(0.01, "m", 10.0, "noise across the optical axis, sightings with heading")
    heading_sigma: float = positive(0.1, "rad", 10.0, "noise of the marker's heading")
    residual_position_sigma: float = number(0.0, "m", 0.0, 10.0, "additional error forward and left")
    residual_heading_sigma: float = number(0.0, "rad", 0.0, 10.0, "additional error of the marker's heading")
    range_sigma: float = positive(0.15, "m", 10.0, "noise of range, sightings without heading")
    range_sigma_per_m: float = number(0.0, "1", 0.0, 10.0, "growth of range noise with distance [m per m]")
    bearing_sigma: float = positive(0.05, "rad", 10.0, "noise of the bearing, sightings without heading")
    distance_scale: float = number(1.0, "1", 0.1, 10.0, "measured per true distance")
    distance_scale_sigma: float = estimated(0.0, "1", 1.0, "distance_scale")
    range_log_scale: float = number(0.0, "1", -2.0, 2.0, "a of the range curve")
    range_skew: float = number(0.0, "1/rad", -10.0, 10.0, "c of the range curve")
    range_curve: float = number(0.0, "1/rad^2", -10.0, 10.0, "q of the range curve; 0.5: ranges are depths")
    range_offset: float = number(0.0, "m", -5.0, 5.0, "added to the scaled range")
    range_offset_sigma: float = estimated(0.0, "m", 5.0, "range_offset")
    robot_range_offset: float = number(0.0, "m", -5.0, 5.0, "also added to the range of a robot's marker")
    bearing_curve: float = number(0.0, "1/rad", -10.0, 10.0, "quadratic term of the bearing")
    bearing_offset: float = number(0.0, "rad", -TURN, TURN, "added to the scaled bearing")
    bearing_scale: float = number(1.0, "1", 0.1, 10.0, "true bearing per logged bearing")
    time_offset_s: float = number(0.0, "s", -2.0, 2.0, "exposure time minus stamp of the image")
    time_sigma_s: float = number(0.0, "s", 0.0, 2.0, "noise of an image's stamp, common to its detections")
    gate_probability: float = gate("sightings")


@dataclass(frozen=True)
class FixModel:
    """Error model of a robot's absolute fixes, in addition to or in place of the covariance of each."""

    systematic_share: float = number(0.0, "1", 0.0, 1.0, "variance shared by earlier fixes; 1: of a mapper")
    position_sigma: float = number(0.0, "m", 0.0, 1e3, "of x and y, for fixes without covariance; 0: dropped")
    heading_sigma: float = number(0.0, "rad", 0.0, 10.0, "of the heading, for such fixes; 0: it is not used")
    gate_probability: float = gate("fixes")
