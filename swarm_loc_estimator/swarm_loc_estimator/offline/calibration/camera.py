"""Calibrate cameras: mount, range and bearing models, time offset of the exposure.

Each robot is first fitted separately. The distribution of the parameters over the robots of a type is then
the prior of each, so that a robot with little ground truth benefits from the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.filter.models import POLAR
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.offline.calibration.robust import fit_with_prior, population, spread
from swarm_loc_estimator.sensors.camera import SightingConverter
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot, Swarm

DENSE_GAP_NS = 200_000_000  # Longest gap of ground truth that is interpolated
OFFSET_REACH_NS = 250_000_000  # Largest time offset of a camera

_SAME_NS = 3_000_000  # A true pose this near to a sighting is taken for that of its exposure
_SAME_VIEW_NS = 4_000_000_000  # Errors of sightings of one marker are correlated for about this long
_MAX_SIGHTINGS = 2000


class CameraSightings(NamedTuple):
    """Uncalibrated sightings of one robot's camera where the ground truth is known."""

    stamp_ns: IntArray  # (m,)
    polar: BoolArray  # (m,) whether values are range and bearing, else forward, left and heading
    value: FloatArray  # (m, 3) in the frame of a camera at the origin of base_link
    marker_id: IntArray  # (m,)
    marker: FloatArray  # (m, 3) pose of the marker in `map`, or in the base_link of the target robot
    target: IntArray  # (m,) index of the target robot; -1 for a landmark
    lone: FloatArray  # (m, 3) true pose of the observer where it is known only at the stamp, else NaN

    @property
    def independent_share(self) -> float:
        """Share of independent sightings, at most 1."""
        views = np.unique(np.column_stack([self.marker_id, self.stamp_ns // _SAME_VIEW_NS]), axis=0)
        return len(views) / max(1, self.stamp_ns.size)


def sightings_of(recording: Recording, swarm: Swarm, observer: int) -> CameraSightings:
    """A robot's sightings with ground truth of observer and target, at most `_MAX_SIGHTINGS`."""
    logged = _logged(recording, swarm, observer)
    truth = recording.truth.get(swarm.robots[observer].name)
    if truth is None:
        return select(logged, slice(0))
    known, lone = _observer_known(truth, logged.stamp_ns)
    for target in np.unique(logged.target[logged.target >= 0]).tolist():
        rows = logged.target == target
        other = recording.truth.get(swarm.robots[target].name)
        known[rows] &= other is not None and _dense_around(other, logged.stamp_ns[rows])
    known &= np.isnan(lone[:, 0]) | (logged.target < 0)  # a lone pose gives no time of exposure
    used = select(logged._replace(lone=lone), known)
    return select(used, slice(None, None, max(1, -(-used.stamp_ns.size // _MAX_SIGHTINGS))))


def true_values(
    sightings: CameraSightings,
    recording: Recording,
    swarm: Swarm,
    observer: int,
    mount: FloatArray,
    offset_s: float,
) -> FloatArray:
    """True values of sightings (m, 3): range and bearing, or forward, left and heading.

    Args:
        sightings: Of the robot `observer`.
        recording: With ground truth.
        swarm: The robots.
        observer: Index of the robot.
        mount: (3,) the camera's x [m], y [m], yaw [rad] in base_link.
        offset_s: From the stamps to the exposures.
    """
    stamp_ns = sightings.stamp_ns + round(offset_s * 1e9)
    own, _ = interpolate(recording.truth[swarm.robots[observer].name], stamp_ns, DENSE_GAP_NS)
    lone = np.isfinite(sightings.lone[:, 0])
    own = np.where(lone[:, None], sightings.lone, own)
    marker = sightings.marker.copy()
    for target in np.unique(sightings.target[sightings.target >= 0]).tolist():
        rows = sightings.target == target
        pose, _ = interpolate(recording.truth[swarm.robots[target].name], stamp_ns[rows], DENSE_GAP_NS)
        marker[rows] = se2.compose(pose, sightings.marker[rows])
    seen = se2.between(se2.compose(own, np.broadcast_to(mount, own.shape)), marker)
    polar = sightings.polar
    seen[polar] = np.column_stack(
        [
            np.hypot(seen[polar, 0], seen[polar, 1]),
            np.arctan2(seen[polar, 1], seen[polar, 0]),
            np.zeros(int(polar.sum())),
        ]
    )
    return seen


def _logged(recording: Recording, swarm: Swarm, observer: int) -> CameraSightings:
    """All sightings of known markers by a robot."""
    # with an ideal sensor and a camera at the origin; the tilt and height of the mount are kept
    mounts = [
        one.camera and CameraMount(z=one.camera.z, pitch=one.camera.pitch, roll=one.camera.roll)
        for one in swarm.robots
    ]
    robots = [
        replace(one, camera=mount, sensor=SensorModel())
        for one, mount in zip(swarm.robots, mounts, strict=True)
    ]
    ideal = replace(swarm, robots=tuple(robots))
    rows = select(recording.detections, recording.detections.robot == observer)
    if not rows.robot.size:
        empty = np.zeros(0, dtype=np.int64)
        return CameraSightings(
            empty, empty == 0, np.zeros((0, 3)), empty, np.zeros((0, 3)), empty, np.zeros((0, 3))
        )
    m = SightingConverter(ideal).convert(rows)
    return CameraSightings(
        stamp_ns=m.stamp_ns,
        polar=m.model == POLAR,
        value=m.value,
        marker_id=m.reading,
        marker=m.marker,
        target=m.target,
        lone=np.full((m.size, 3), np.nan),
    )


def _observer_known(truth: Trajectory, stamp_ns: IntArray) -> tuple[BoolArray, FloatArray]:
    """Whether the observer's pose is known (m,), and the poses (m, 3) that are known only at the stamp.

    An isolated true pose with the stamp of an image belongs to its exposure, whatever the time offset is.
    """
    lone = np.full((stamp_ns.size, 3), np.nan)
    known = _dense_around(truth, stamp_ns)
    nearest = np.clip(np.searchsorted(truth.stamp_ns, stamp_ns - _SAME_NS), 0, truth.stamp_ns.size - 1)
    same = ~known & (np.abs(truth.stamp_ns[nearest] - stamp_ns) <= _SAME_NS)
    lone[same] = truth.pose[nearest[same]]
    return known | same, lone


def _dense_around(truth: Trajectory, stamp_ns: IntArray) -> BoolArray:
    """Whether the ground truth is dense around stamps, for all time offsets up to `OFFSET_REACH_NS`."""
    times = truth.stamp_ns
    first = np.searchsorted(times, stamp_ns - OFFSET_REACH_NS, side="right") - 1
    last = np.searchsorted(times, stamp_ns + OFFSET_REACH_NS, side="left")
    inside = (first >= 0) & (last < times.size)
    gaps = np.concatenate([[0], np.cumsum(np.diff(times) > DENSE_GAP_NS)])  # long gaps before each time
    known: BoolArray = inside & (gaps[np.minimum(last, times.size - 1)] == gaps[np.maximum(first, 0)])
    return known


MIN_SIGHTINGS = 100  # Sightings with ground truth needed to calibrate a camera

_OF_CAMERA = ("x", "y", "yaw")
# Checked by test_calibration.py and make bench-mrclam.
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
"""Standard deviations of the prior about the swarm description."""
_POLAR = tuple(name for name in _WIDE if name != "yaw")
_POSE = ("x", "y", "yaw", "time_offset_s")
_FIRST_SPREAD = np.array([[0.1, 0.05, 1.0], [0.05, 0.05, 0.2]])
"""Initial spread of polar sightings (range per metre, bearing) and of poses (forward, left, heading)."""
_ROUNDS = 2


@dataclass(frozen=True)
class CameraFit:
    """Calibration of one robot's camera."""

    robot: Robot  # Calibrated
    count: int  # Sightings used; 0 if there were too few
    # (m, 3) measured minus true: range [m] and bearing [rad], or forward, left [m], heading [rad]
    before: FloatArray
    after: FloatArray  # (m, 3) the same errors, calibrated
    sightings: CameraSightings  # All that were used


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
        """Measured minus true (m, 3) with parameters (p,)."""
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
        """Errors (3 m,) in sigmas, weighted by the share of independent sightings."""
        error = self._relative(self.errors(values))
        error /= np.where(self.sightings.polar[:, None], self.spread[0], self.spread[1])
        return np.asarray(error * np.sqrt(self.sightings.independent_share)).ravel()

    def fit(self, mean: FloatArray, sigma: FloatArray) -> None:
        """Fit all active parameters about a prior (p,), and the spread of the errors."""
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
        """Errors with those of ranges per metre, since they grow with the range."""
        per_metre = np.where(self.sightings.polar, np.maximum(self.sightings.value[:, 0], 0.1), 1.0)
        return np.column_stack([error[:, 0] / per_metre, error[:, 1:]])


def fit_cameras(recording: Recording, swarm: Swarm, members: Sequence[int]) -> list[CameraFit]:
    """Calibrate the cameras of robots of one type; those with too few sightings get the mean of the type."""
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
    sigma[[*_WIDE].index("time_offset_s")] = 1e-3  # cameras of one type have one delay
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


def calibrated_values(robot: Robot, sightings: CameraSightings) -> FloatArray:
    """Logged values (m, 3) corrected by the robot's sensor model."""
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
    """The parameters of the fit (p,)."""
    camera = robot.camera or CameraMount()
    return np.array([getattr(camera if name in _OF_CAMERA else robot.sensor, name) for name in _WIDE])


def with_numbers(robot: Robot, values: FloatArray) -> Robot:
    """The robot with other parameters (p,)."""
    numbers = {name: float(value) for name, value in zip(_WIDE, values, strict=True)}
    reach_s = OFFSET_REACH_NS * 1e-9
    numbers["time_offset_s"] = min(reach_s, max(-reach_s, numbers["time_offset_s"]))
    mount = {name: numbers.pop(name) for name in _OF_CAMERA}
    camera = replace(robot.camera or CameraMount(), **mount)
    return replace(robot, camera=camera, sensor=replace(robot.sensor, **numbers))
