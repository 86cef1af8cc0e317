"""Calibrate cameras: mount, range and bearing models, time offset of the exposure.

Every robot is fitted alone first; what the robots of a type have in common is then the prior of each, so
that a robot with little ground truth gains from the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.offline.calibration.motion_and_camera.robust import (
    fit_with_prior,
    population,
    spread,
)
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.offline.calibration.sightings import (
    OFFSET_REACH_NS,
    Sightings,
    sightings_of,
    true_values,
)
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot, Swarm

MIN_SIGHTINGS = 100
"""Fewer sightings with ground truth do not calibrate a camera."""

_OF_CAMERA = ("x", "y", "yaw")
_WIDE = {
    "x": 0.03,
    "y": 0.02,
    "yaw": 0.1,
    "range_log_scale": 0.1,
    "range_skew": 0.05,
    "range_curve": 1.0,
    "range_offset": 0.1,
    "robot_range_offset": 0.05,
    "bearing_offset": 0.1,
    "bearing_scale": 0.1,
    "bearing_curve": 0.1,
    "time_offset_s": 0.1,
}
"""How far a number may be from what the swarm description says, one standard deviation."""
_POLAR = tuple(name for name in _WIDE if name != "yaw")
_POSE = ("x", "y", "yaw", "time_offset_s")
_FIRST_SPREAD = np.array([[0.1, 0.05, 1.0], [0.05, 0.05, 0.2]])
"""To begin with, of polar sightings (range per metre, bearing) and of poses (forward, left, heading)."""
_ROUNDS = 2


@dataclass(frozen=True)
class CameraFit:
    """What became of one robot's camera.

    Attributes:
        robot: Calibrated.
        count: Sightings used; 0 when there was too little to fit to.
        before: (m, 3) measured minus true: range [m] and bearing [rad], or forward, left [m], heading [rad].
        after: (m, 3) likewise, calibrated.
        sightings: What was used.
    """

    robot: Robot
    count: int
    before: FloatArray
    after: FloatArray
    sightings: Sightings


class _Camera:
    """One robot's camera during the fit."""

    def __init__(self, recording: Recording, swarm: Swarm, observer: int) -> None:
        self.robot = swarm.robots[observer]
        self.sightings = sightings_of(recording, swarm, observer)
        self._context = (recording, swarm, observer)
        polar = self.sightings.polar
        used = {*(_POLAR if polar.any() else ()), *(_POSE if (~polar).any() else ())}
        robots_seen = bool(np.any(polar & (self.sightings.target >= 0)))
        self.active = np.array([n in used and (robots_seen or n != "robot_range_offset") for n in _WIDE])
        self.spread = _FIRST_SPREAD
        self.value = numbers_of(self.robot)
        self.sigma = np.array([*_WIDE.values()])

    @property
    def usable(self) -> bool:
        return self.sightings.stamp_ns.size >= MIN_SIGHTINGS

    def errors(self, values: FloatArray) -> FloatArray:
        """Measured minus true (m, 3) with numbers (p,)."""
        calibrated = with_numbers(self.robot, values)
        camera, offset_s = calibrated.camera or CameraMount(), calibrated.sensor.time_offset_s
        mount = np.array([camera.x, camera.y, camera.yaw])
        true = true_values(self.sightings, *self._context, mount, offset_s)
        error = calibrated_values(calibrated, self.sightings) - true
        for column in (1, 2):
            rows = self.sightings.polar == (column == 1)
            error[rows, column] = wrap_angle(error[rows, column])
        return error

    def in_sigmas(self, values: FloatArray) -> FloatArray:
        """Errors (3 m,) by their spread, thinned to what is independent."""
        error = self._relative(self.errors(values))
        error /= np.where(self.sightings.polar[:, None], self.spread[0], self.spread[1])
        return np.asarray(error * np.sqrt(self.sightings.independent_share)).ravel()

    def fit(self, mean: FloatArray, sigma: FloatArray) -> None:
        """Fit all active numbers about a prior (p,); the spread of the errors is found along."""
        self.value, self.sigma = mean.copy(), sigma.copy()
        for _ in range(_ROUNDS):

            def residuals(active: FloatArray) -> FloatArray:
                full = mean.copy()
                full[self.active] = active
                return self.in_sigmas(full)

            found = fit_with_prior(residuals, mean[self.active], sigma[self.active])
            self.value[self.active], self.sigma[self.active] = found
            error = self._relative(self.errors(self.value))
            polar = self.sightings.polar
            self.spread = np.array(
                [
                    [max(1e-4, spread(error[rows, column])) if rows.any() else 1.0 for column in range(3)]
                    for rows in (polar, ~polar)
                ]
            )

    def _relative(self, error: FloatArray) -> FloatArray:
        """Range errors per metre: far ranges err more."""
        per_metre = np.where(self.sightings.polar, np.maximum(self.sightings.value[:, 0], 0.1), 1.0)
        return np.column_stack([error[:, 0] / per_metre, error[:, 1:]])


def fit_cameras(recording: Recording, swarm: Swarm, members: Sequence[int]) -> list[CameraFit]:
    """Calibrate the cameras of the robots of one type; those with too little get the type's mean."""
    cameras = [
        _Camera(recording, swarm, index) for index in members if swarm.robots[index].camera is not None
    ]
    usable = [camera for camera in cameras if camera.usable]
    if not usable:
        return []
    wide = np.array([*_WIDE.values()])
    starts = [numbers_of(camera.robot) for camera in cameras]
    for camera in usable:
        camera.fit(numbers_of(camera.robot), wide)
    mean, sigma = population(np.array([c.value for c in usable]), np.array([c.sigma for c in usable]), wide)
    sigma[[*_WIDE].index("time_offset_s")] = 1e-3  # one make of camera has one delay
    result = []
    for camera, start in zip(cameras, starts, strict=True):
        if camera.usable:
            camera.fit(mean, sigma)
        else:
            camera.value = mean
        camera.value = np.round(camera.value, 5)
        robot = with_numbers(camera.robot, camera.value)
        count = camera.sightings.stamp_ns.size
        if not count:
            result.append(CameraFit(robot, 0, np.zeros((0, 3)), np.zeros((0, 3)), camera.sightings))
            continue
        before, after = camera.errors(start), camera.errors(camera.value)
        result.append(CameraFit(robot, count if camera.usable else 0, before, after, camera.sightings))
    return result


def calibrated_values(robot: Robot, sightings: Sightings) -> FloatArray:
    """Logged values (m, 3) as the robot's sensor model reads them."""
    s = robot.sensor
    value: FloatArray = sightings.value.copy()
    rows = sightings.polar
    logged_range, bearing = value[rows, 0].copy(), value[rows, 1].copy()
    curve = s.range_log_scale + s.range_skew * bearing + s.range_curve * bearing**2
    value[rows, 0] = logged_range * np.exp(curve) + s.range_offset
    value[rows, 0] += s.robot_range_offset * (sightings.target[rows] >= 0)
    value[rows, 1] = (s.bearing_scale + s.bearing_curve * bearing) * bearing + s.bearing_offset
    return value


def numbers_of(robot: Robot) -> FloatArray:
    """The numbers that the fit may change (p,)."""
    camera = robot.camera or CameraMount()
    return np.array([getattr(camera if name in _OF_CAMERA else robot.sensor, name) for name in _WIDE])


def with_numbers(robot: Robot, values: FloatArray) -> Robot:
    """The robot with other numbers (p,)."""
    numbers = {name: float(value) for name, value in zip(_WIDE, values, strict=True)}
    reach_s = OFFSET_REACH_NS * 1e-9
    numbers["time_offset_s"] = min(reach_s, max(-reach_s, numbers["time_offset_s"]))
    mount = {name: numbers.pop(name) for name in _OF_CAMERA}
    camera = replace(robot.camera or CameraMount(), **mount)
    return replace(robot, camera=camera, sensor=replace(robot.sensor, **numbers))
