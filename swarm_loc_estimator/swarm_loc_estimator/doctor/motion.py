"""Odometry beside sightings of static landmarks: scales, mounts and signs that cannot both be right.

A landmark stands at l = R (A d + m) + p in the odometry frame of a robot with pose (p, R), camera at m and
sighting d. A is a scale and a rotation, which commute with R, so R d = B l - B (p + R m) with B = 1 / A. This
is linear in B and, per landmark, in B l, which differences to the mean remove. The noisy sightings are on
the left, so their noise does not bias B. If B fits a mirrored track better than the true one, a sign is
wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.doctor.evidence import Evidence, Finding
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.camera import CONTENT_BEARING, FROM_OPTICAL
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot

_WINDOW_NS = 6_000_000_000  # Odometry is trusted this long
_MIN_ROWS, _MIN_MOTION_M = 30, 0.03
"""Least sightings of landmarks, and least spread of places around their means, for a verdict."""
_MIN_WINDOWS = 3
"""Least windows for a verdict on scale and yaw: in a window, the drift of odometry is common to all."""
_ROUNDS = 8
_CLEARER = 0.5  # Residual of a mirrored track over that of the true one, below which the sign is wrong
_STANDS_M = 1e-4
_SCALE, _YAW, _SIGNIFICANT = 0.15, math.radians(30.0), 5.0
"""Least errors of scale and yaw that are named, and least multiple of their sigma."""
_TURN_NS, _MIN_TURN = 500_000_000, 2.0
"""Turns of gyroscopes are compared over this time, and if wheels turn by this much in all [rad]."""
_DEGREES, _SLACK = 20.0, 0.3  # Ratios of gyroscope to wheels from which units, sign or silence are named
_AHEAD = 0.4  # Least usual share of the optical z axis in the directions of markers

Change = Callable[[FloatArray], FloatArray]
_WRONG: MappingProxyType[str, Change] = MappingProxyType(
    {
        "turns the other way than what its camera sees": lambda pose: pose * [1.0, -1.0, -1.0],
        "has headings of the wrong sign": lambda pose: pose * [1.0, 1.0, -1.0],
        "moves to the wrong side": lambda pose: pose * [1.0, -1.0, 1.0],
        "has x and y swapped": lambda pose: pose[:, [1, 0, 2]],
    }
)
"""What odometry may do wrong, and how it is undone for poses (k, 3)."""


def _check_turns(evidence: Evidence, index: int, own: OdometryRows) -> Iterator[Finding]:
    """Turns of a gyroscope beside those of the wheels."""
    rates = select(evidence.turn_rates, evidence.turn_rates.robot == index)
    if rates.stamp_ns.size < _MIN_ROWS or own.robot.size < _MIN_ROWS:
        return
    order, by = np.argsort(own.stamp_ns, kind="stable"), np.argsort(rates.stamp_ns, kind="stable")
    own, rates = select(own, order), select(rates, by)
    passed_s = 1e-9 * np.diff(rates.stamp_ns)
    turned = np.append(0.0, np.cumsum(0.5 * (rates.rate[1:] + rates.rate[:-1]) * passed_s))
    begin_ns = max(own.stamp_ns[0], rates.stamp_ns[0])
    at_ns = np.arange(begin_ns, min(own.stamp_ns[-1], rates.stamp_ns[-1]), _TURN_NS)
    by_wheels = np.diff(np.interp(at_ns, own.stamp_ns, np.unwrap(own.pose[:, 2])))
    by_gyroscope = np.diff(np.interp(at_ns, rates.stamp_ns, turned))
    if np.abs(by_wheels).sum() < _MIN_TURN:
        return
    ratio = float(by_gyroscope @ by_wheels / (by_wheels @ by_wheels))
    name = f"{evidence.source_name(index)}'s gyroscope"
    problem = f"measures {ratio:.2g} times the turns of the wheels"
    if ratio > _DEGREES:
        yield Finding(name, problem, "Publish radians per second")
    elif ratio < -_SLACK:
        yield Finding(name, problem, "Turns are positive to the left: correct its driver or mount (imu.roll)")
    elif abs(ratio) < _SLACK:
        yield Finding(name, problem, "Look at its driver: is angular_velocity set, and its z axis vertical?")


class _Alignment(NamedTuple):
    """Scale and yaw [rad] between sightings and odometry, their sigma, and the residual [m]."""

    scale: float
    yaw: float
    sigma: float
    residual: float


def check_motion(evidence: Evidence) -> Iterator[Finding]:
    """Sightings of landmarks agree with odometry."""
    rows = evidence.odometry
    for index, robot in enumerate(evidence.swarm.robots):
        own, camera = select(rows, rows.robot == index), robot.camera
        yield from _check_turns(evidence, index, own)
        if camera is None:
            continue
        seen, landmark, stamp_ns = _sightings(evidence, index, robot)
        if len(seen) < _MIN_ROWS:
            continue
        if np.median(seen[:, 2] - _AHEAD * np.linalg.norm(seen, axis=1)) <= 0.0:
            problem = "publishes positions of markers that are not in front of it"
            remedy = "Publish them in the optical frame: x right, y down, z forward"
            yield Finding(robot.name, problem, remedy)
        elif own.robot.size > _MIN_ROWS and not robot.stands:
            yield from _of_robot(robot, camera, own, seen, landmark, stamp_ns)


def _sightings(evidence: Evidence, index: int, robot: Robot) -> tuple[FloatArray, IntArray, IntArray]:
    """Positions (k, 3) of landmarks in the camera's optical frame, their ids and stamps."""
    rows = evidence.rows("detections")
    ids = [mark.id for mark in evidence.swarm.landmarks]
    mine = (rows.robot == index) & np.isin(rows.detection["id"], ids)
    mine &= (rows.detection["content"] != CONTENT_BEARING) & np.isfinite(rows.detection["position"]).all(
        axis=1
    )
    delay_ns = round(1e9 * robot.sensor.time_offset_s)
    return (
        rows.detection["position"][mine],
        rows.detection["id"][mine].astype(np.int64),
        rows.stamp_ns[mine] + delay_ns,
    )


def _of_robot(
    robot: Robot,
    camera: CameraMount,
    own: OdometryRows,
    seen: FloatArray,
    landmark: IntArray,
    stamp_ns: IntArray,
) -> Iterator[Finding]:
    """What is wrong between the odometry and the camera of one robot."""
    fit = _fitted(robot, own, seen, landmark, stamp_ns, lambda pose: pose)
    twist_moves = np.nan_to_num(own.twist[:, [0, 2]]).any()
    if np.ptp(own.pose[:, :2], axis=0).max() < _STANDS_M and np.ptp(own.pose[:, 2]) < _STANDS_M:
        if not twist_moves and _spread(seen, landmark, stamp_ns) > _MIN_MOTION_M:
            problem = "has odometry that stands while landmarks move in its camera"
            yield Finding(robot.name, problem, "Check its encoders, and that its driver reads them")
        return
    if fit is None:
        return
    others = {what: _fitted(robot, own, seen, landmark, stamp_ns, undo) for what, undo in _WRONG.items()}
    residuals = {what: other.residual for what, other in others.items() if other is not None}
    best = min(residuals, key=lambda what: residuals[what], default="")
    if best and residuals[best] < _CLEARER * fit.residual:
        remedy = "Correct the driver: x forward, y left, angles counter-clockwise (REP 103)"
        yield Finding(f"{robot.name}'s odometry", best, remedy)
        return
    if np.ptp(stamp_ns) < _MIN_WINDOWS * _WINDOW_NS:
        return
    if abs(math.log(fit.scale)) > max(_SCALE, _SIGNIFICANT * fit.sigma):
        problem = f"sees landmarks {1.0 / fit.scale:.2f} times as far as its odometry says"
        remedy = (
            f"Measure the markers, whose size may be {fit.scale:.2f} times what the detector assumes,"
            " and the robot's wheels"
        )
        yield Finding(robot.name, problem, remedy)
    if abs(fit.yaw) > max(_YAW, _SIGNIFICANT * fit.sigma):
        problem = f"has a camera that is turned by {math.degrees(fit.yaw):+.0f} deg from its description"
        yield Finding(robot.name, problem, f"Set camera.yaw to {camera.yaw + fit.yaw:.3f}")


def _groups(landmark: IntArray, stamp_ns: IntArray) -> IntArray:
    """Number of the landmark and window of each sighting (k,)."""
    window = (stamp_ns - stamp_ns.min()) // _WINDOW_NS
    return np.unique(np.stack([landmark, window]), axis=1, return_inverse=True)[1].ravel()


def _centred(values: FloatArray, group: IntArray, weight: FloatArray) -> FloatArray:
    """Values (k, c) less the weighted means of their groups."""
    total = np.maximum(np.bincount(group, weight), 1e-12)
    means = np.stack([np.bincount(group, weight * column) / total for column in values.T], axis=1)
    return np.asarray(values - means[group])


def _spread(seen: FloatArray, landmark: IntArray, stamp_ns: IntArray) -> float:
    """Root mean square motion of landmarks in the view [m]."""
    away = _centred(seen, _groups(landmark, stamp_ns), np.ones(len(seen)))
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def _fitted(
    robot: Robot, own: OdometryRows, seen: FloatArray, landmark: IntArray, stamp_ns: IntArray, undo: Change
) -> _Alignment | None:
    """The fit with odometry whose poses are changed; None: the robot moves too little."""
    tracks = OdometryTracks([robot])
    tracks.extend(np.zeros(own.robot.size, dtype=np.int64), own.stamp_ns, undo(own.pose), None)
    zeros = np.zeros(stamp_ns.size, dtype=np.int64)
    begun = tracks.has_started(zeros, stamp_ns) & (stamp_ns <= own.stamp_ns.max())
    camera = robot.camera
    if begun.sum() < _MIN_ROWS or camera is None:
        return None
    pose = tracks.at(zeros[begun], stamp_ns[begun]).pose
    level = Rotation.from_euler("ZYX", [camera.yaw, camera.pitch, camera.roll]).as_matrix() @ FROM_OPTICAL
    view = (seen[begun] @ level.T)[:, :2] * robot.sensor.distance_scale
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])

    def turned(vector: FloatArray) -> FloatArray:
        return np.stack(
            [cos * vector[:, 0] - sin * vector[:, 1], sin * vector[:, 0] + cos * vector[:, 1]], axis=1
        )

    place = turned(np.tile([camera.x, camera.y], (len(view), 1))) + pose[:, :2]
    columns = [turned(view), place, np.stack([-place[:, 1], place[:, 0]], axis=1)]
    group, weight = _groups(landmark[begun], stamp_ns[begun]), np.ones(len(view))
    scale = yaw = sigma = residual = 0.0
    for _ in range(_ROUNDS):
        sighted, along, across = (_centred(column, group, weight) for column in columns)
        information = float(np.sum(weight[:, None] * along**2))
        if math.sqrt(information / weight.sum()) < _MIN_MOTION_M:
            return None
        a, b = (-float(np.sum(weight[:, None] * one * sighted)) / information for one in (along, across))
        error = np.linalg.norm(sighted + a * along + b * across, axis=1)
        residual = max(float(np.median(error)), 1e-4)
        weight = 1.0 / (1.0 + (error / (3.0 * residual)) ** 2)
        size = max(math.hypot(a, b), 1e-3)
        scale, yaw = 1.0 / size, -math.atan2(b, a)
        # errors of a landmark's sightings last, so the landmarks of each window are the independent samples
        push = (weight[:, None] * along * (sighted + a * along + b * across)).sum(axis=1)
        sigma = math.sqrt(float(np.sum(np.bincount(group, push) ** 2))) / (size * information)
    return _Alignment(scale, yaw, sigma, residual)
