"""A small world with known models, as a recording in memory."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.offline.calibration.recording import Recording
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Robot, Swarm

SECOND = 1_000_000_000
_MARGIN_S = 2.0
_ODOMETRY_S, _TRUTH_S, _PICTURE_S = 0.05, 0.02, 0.25
_VIEW = 0.6
_FARTHEST = 5.0
_FIRST_MARK = 100


@dataclass(frozen=True)
class World:
    """How the recording errs."""

    robots: tuple[Robot, ...]  # As they truly are; all of one type
    seed: int  # Of commands and noise
    duration_s: float = 150.0  # [s]
    range_sigma: float = 0.005  # Relative
    bearing_sigma: float = 0.005  # [rad]
    posed: bool = False  # Whether sightings have a heading
    turn_sigma: float = 0.0  # Of the true turn beside what the model says [rad/sqrt(s)]


def described(robots: tuple[Robot, ...]) -> Swarm:
    """What a user knows: names and markers, nothing of the models."""
    marks = tuple(
        Landmark(_FIRST_MARK + k, x, y, yaw=np.pi)
        for k, (x, y) in enumerate(itertools.product(np.arange(-24.0, 24.1, 3.0).tolist(), repeat=2))
    )
    plain = tuple(Robot(r.name, r.type, faces=r.faces, camera=CameraMount()) for r in robots)
    return Swarm(plain, marks)


def robot(number: int, true: Robot) -> Robot:
    """One of several robots with the same models."""
    return replace(true, name=f"robot{number}", type="rover", faces=(Face("body", number),))


def record(world: World) -> tuple[Recording, Swarm]:
    """Simulate a recording and the swarm as its user would describe it."""
    swarm = described(world.robots)
    marks = np.array([[mark.x, mark.y, mark.yaw or 0.0] for mark in swarm.landmarks])
    rng = np.random.default_rng(world.seed)
    truth: dict[str, Trajectory] = {}
    odometry, pictures = [], []
    for index, true in enumerate(world.robots):
        raw = _raw(rng, world.duration_s)
        truth[true.name] = _truth(rng, true, raw, world)
        odometry += [(index, s, pose[None]) for s, pose in zip(raw.stamp_ns.tolist(), raw.pose, strict=True)]
    for index, true in enumerate(world.robots):
        stamps = np.arange(3 * SECOND, int((world.duration_s - _MARGIN_S) * SECOND), int(_PICTURE_S * SECOND))
        relative = _marks_seen_from(truth[true.name], true, stamps, marks)
        for stamp, places in zip(stamps.tolist(), relative, strict=True):
            found = _seen(rng, world, places, true)
            if found.size:
                pictures.append((index, stamp, found))
    driven = OdometryRows.without_twist(*_columns(odometry, [1] * len(odometry)))
    seen = DetectionRows(*_columns(pictures, [len(found) for _, _, found in pictures]))
    return Recording("world", driven, seen, truth), swarm


def _columns(messages: Sequence[tuple[int, int, Any]], counts: Sequence[int]) -> Any:
    """Robots, stamps, rows and arrivals of messages, each with so many rows, in order of arrival."""
    order = sorted(range(len(messages)), key=lambda k: messages[k][1])
    repeats = [counts[k] for k in order]
    robot, stamp_ns = (np.repeat([messages[k][part] for k in order], repeats) for part in (0, 1))
    return robot, stamp_ns, np.concatenate([messages[k][2] for k in order]), stamp_ns


def _raw(rng: np.random.Generator, duration_s: float) -> Trajectory:
    """Integrated commands that change every few seconds, in place now and then."""
    count = int(duration_s / _ODOMETRY_S)
    speed, turn_rate = np.zeros(count), np.zeros(count)
    begin = 0
    while begin < count:
        end = begin + int(rng.uniform(1.0, 4.0) / _ODOMETRY_S)
        speed[begin:end] = rng.choice([0.0, 0.1, 0.2, 0.3], p=[0.1, 0.2, 0.3, 0.4])
        turn_rate[begin:end] = rng.choice([-0.6, -0.3, 0.0, 0.3, 0.6])
        begin = end
    heading = np.concatenate([[0.0], np.cumsum(turn_rate * _ODOMETRY_S)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(speed * _ODOMETRY_S * np.cos(middle))])
    y = np.concatenate([[0.0], np.cumsum(speed * _ODOMETRY_S * np.sin(middle))])
    stamps = np.arange(count + 1) * int(_ODOMETRY_S * SECOND) + SECOND
    return Trajectory(stamps, np.column_stack([x, y, se2.wrap_angle(heading)]))


def _truth(rng: np.random.Generator, true: Robot, raw: Trajectory, world: World) -> Trajectory:
    """Where the robot truly goes, by its motion model."""
    tracks = OdometryTracks([true])
    zeros = np.zeros(raw.stamp_ns.size, dtype=np.int64)
    tracks.extend(zeros, raw.stamp_ns, raw.pose)
    stamps = np.arange(int(raw.stamp_ns[0]), int(raw.stamp_ns[-1]), int(_TRUTH_S * SECOND))
    pose = tracks.at(np.zeros(stamps.size, dtype=np.int64), stamps).pose
    if world.turn_sigma:
        pose = _with_turn_noise(rng, pose, world.turn_sigma)
    pose[:, 2] = se2.wrap_angle(pose[:, 2])
    return Trajectory(stamps, pose)


def _with_turn_noise(rng: np.random.Generator, pose: FloatArray, sigma: float) -> FloatArray:
    """The path with a random walk in heading."""
    steps = se2.log(se2.between(pose[:-1], pose[1:]))
    steps[:, 2] += sigma * np.sqrt(_TRUTH_S) * rng.standard_normal(len(steps))
    heading = pose[0, 2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    moved = se2.exp(steps)[:, :2]
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    away = np.column_stack([cos * moved[:, 0] - sin * moved[:, 1], sin * moved[:, 0] + cos * moved[:, 1]])
    place = pose[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(away, axis=0)])
    return np.column_stack([place, heading])


def _marks_seen_from(truth: Trajectory, true: Robot, stamps_ns: IntArray, marks: FloatArray) -> FloatArray:
    """Poses (p, m, 3) of marks (m, 3) before the robot's camera at the stamps (p,) of its pictures."""
    camera = true.camera or CameraMount()
    own = _at(truth, stamps_ns + round(true.sensor.time_offset_s * 1e9))
    eye = se2.compose(own, [camera.x, camera.y, camera.yaw])
    return se2.between(eye[:, None], marks)


def _seen(
    rng: np.random.Generator, world: World, rel: FloatArray, true: Robot
) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    """Detections of one picture, before which marks have poses (m, 3)."""
    distance, bearing = np.hypot(rel[:, 0], rel[:, 1]), np.arctan2(rel[:, 1], rel[:, 0])
    near = np.flatnonzero((np.abs(bearing) < _VIEW) & (distance < _FARTHEST) & (distance > 0.3))
    rows = np.zeros(near.size, DETECTION_DTYPE)
    if not rows.size:
        return rows
    rows["id"], rows["content"] = _FIRST_MARK + near, 2 if world.posed else 1
    s = true.sensor
    logged = (bearing[near] - s.bearing_offset) / s.bearing_scale
    logged += world.bearing_sigma * rng.standard_normal(rows.size)
    reach = (distance[near] - s.range_offset) / np.exp(
        s.range_log_scale + s.range_skew * logged + s.range_curve * logged**2
    )
    reach *= 1.0 + world.range_sigma * rng.standard_normal(rows.size)
    rows["position"][:, 0], rows["position"][:, 2] = -reach * np.sin(logged), reach * np.cos(logged)
    heading = rel[near, 2] + 0.02 * rng.standard_normal(rows.size)
    rows["orientation"] = np.array([_facing(angle) for angle in heading])
    rows["covariance"] = -1.0 * np.eye(6)
    return rows


def _facing(heading: float) -> FloatArray:
    """Quaternion in the optical frame (x right, y down) of a face whose z axis points along a heading."""
    half = -0.5 * heading
    return np.array([0.0, np.sin(half), 0.0, np.cos(half)])


def _at(track: Trajectory, stamps_ns: IntArray) -> FloatArray:
    row = np.clip(np.searchsorted(track.stamp_ns, stamps_ns), 1, track.stamp_ns.size - 1)
    share = (stamps_ns - track.stamp_ns[row - 1]) / (track.stamp_ns[row] - track.stamp_ns[row - 1])
    step = se2.log(se2.between(track.pose[row - 1], track.pose[row]))
    return se2.compose(track.pose[row - 1], se2.exp(share[:, None] * step))
