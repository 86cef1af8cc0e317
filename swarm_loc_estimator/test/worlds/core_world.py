"""Small simulated swarms for the tests of the core, written independently of the code under test."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from core_geometry import homogeneous, marker_frame, seen
from core_messages import POSE, POSITION, SECOND, T0, Event, detection, joined, quaternion
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.error_models import OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Robot, StartSigma, Swarm


@dataclass(frozen=True)
class World:
    """A simulated run."""

    swarm: Swarm  # Its description
    stamp_ns: NDArray[np.int64]  # (T,) instants of the truth
    truth: FloatArray  # (T, N, 3)
    events: tuple[Event, ...]  # In order of their stamps

    def at(self, stamp_ns: int) -> FloatArray:
        """The true poses (N, 3) at an instant of the truth."""
        poses: FloatArray = self.truth[int(np.searchsorted(self.stamp_ns, stamp_ns))]
        return poses


@dataclass(frozen=True)
class Plan:
    """What to simulate."""

    robots: int = 3  # N
    duration_s: float = 6.0  # [s]
    speed: float = 0.1  # Of every robot [m/s]
    turn_rate: float = 0.8  # Largest [rad/s]; each robot changes its own every second
    arena: float = 1.2  # Half the width of the square in which the landmarks stand [m]
    landmarks: int = 8  # How many, on a circle
    start_known: Sequence[bool] = (True,)  # Per robot, or one for all
    content: int = POSE  # Of the detections
    noise: float = 1.0  # Scale of all noise; 0: none
    flips: float = 0.0  # Share of pose sightings whose first solution is the mirrored one
    outliers: float = 0.0  # Share of sightings that are off by a metre
    reach: float = 2.5  # How far cameras see [m]
    camera_hz: float = 5.0  # Pictures per second
    standing: Sequence[int] = ()  # Robots that do not move
    # Robots that are put elsewhere, with their backs to where they looked, at half time
    carried: Sequence[int] = ()
    # Scale of the errors that last, of the motion and of the camera; 0: neither are there any, nor are they
    # estimated
    lasting: float = 0.0
    survey: float = 0.0  # Scale of the errors of the landmarks' places, likewise
    watching: bool = False  # Whether every robot begins with its camera on the landmark farthest from it


ODOMETRY = OdometryModel(wheel_separation=0.053, wheel_noise=2e-5)
SENSOR = SensorModel(
    forward_sigma=0.02, left_sigma=0.01, heading_sigma=0.1, range_sigma=0.03, bearing_sigma=0.03
)
MOUNT = CameraMount(x=0.03, y=0.01, z=0.05, yaw=0.1, pitch=0.1)
START_SIGMA = StartSigma(0.02, 0.02, 0.05)
BIAS_SIGMA, BIAS_TIME_S, SCALE_SIGMA, YAW_SIGMA, STRETCH_SIGMA = 0.05, 4.0, 0.05, 0.05, 0.05
SURVEY_SIGMA, SURVEY_YAW_SIGMA = 0.05, 0.1
_STEP_NS = 50_000_000
_SIDES = {"front": 0.0, "left": math.pi / 2, "back": math.pi, "right": -math.pi / 2}
_LEVEL = homogeneous(0, 0, 0, 0, MOUNT.pitch, MOUNT.roll)[:3, :3] @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
_FACE_FRAMES = np.array(
    [marker_frame(0.03 * math.cos(yaw), 0.03 * math.sin(yaw), 0.04, yaw) for yaw in _SIDES.values()]
)


def simulate(plan: Plan, seed: int) -> World:
    """A world of robots that drive arcs, see each other and the landmarks."""
    rng = np.random.default_rng(seed)
    steps = round(plan.duration_s * SECOND / _STEP_NS)
    stamps = T0 + _STEP_NS * np.arange(steps + 1, dtype=np.int64)
    start = np.column_stack(
        [rng.uniform(-0.5, 0.5, (plan.robots, 2)) * plan.arena, rng.uniform(-3.1, 3.1, plan.robots)]
    )
    if plan.watching:
        start[:, 2] = _towards_the_farthest(start, plan)
    lasting = lasting_errors(plan, seed)
    truth, odometry = _drive(rng, plan, start, steps, lasting)
    swarm = _describe(rng, plan, start)
    events = [
        Event(robot, int(stamps[k]), (float(x), float(y), float(theta)))
        for k in range(steps + 1)
        for robot, (x, y, theta) in enumerate(odometry[k])
    ]
    for robot in range(plan.robots):
        every = round(SECOND / plan.camera_hz / _STEP_NS)
        for k in range(int(rng.integers(1, every + 1)), steps + 1, every):
            mount = replace(MOUNT, yaw=MOUNT.yaw + float(lasting.yaw[robot]))
            detections = _picture(rng, plan, swarm, robot, truth[k], mount, 1.0 + lasting.stretch[robot])
            if detections.size:
                events.append(Event(robot, int(stamps[k]), None, detections))
    swarm = replace(swarm, landmarks=_surveyed(swarm.landmarks, plan, np.random.default_rng([seed, 2])))
    return World(swarm, stamps, truth, tuple(sorted(events, key=lambda e: e.stamp_ns)))


def _surveyed(landmarks: Sequence[Landmark], plan: Plan, rng: np.random.Generator) -> tuple[Landmark, ...]:
    """The landmarks where a survey with errors has them."""
    sigma, yaw_sigma = plan.survey * SURVEY_SIGMA, plan.survey * SURVEY_YAW_SIGMA
    return tuple(
        replace(
            mark,
            x=mark.x + sigma * float(rng.standard_normal()),
            y=mark.y + sigma * float(rng.standard_normal()),
            yaw=(mark.yaw or 0.0) + yaw_sigma * float(rng.standard_normal()),
            position_sigma=sigma,
            yaw_sigma=yaw_sigma,
        )
        for mark in landmarks
    )


def lasting_errors(plan: Plan, seed: int) -> _Lasting:
    return _Lasting(plan, np.random.default_rng([seed, 1]), round(plan.duration_s * SECOND / _STEP_NS))


class _Lasting:
    """Errors that last: scales of path and turn, the camera's yaw and scale (N,), the turn's bias (T, N)."""

    def __init__(self, plan: Plan, rng: np.random.Generator, steps: int) -> None:
        drawn = plan.lasting * rng.standard_normal((4, plan.robots))
        self.distance_scale, self.turn_scale = SCALE_SIGMA * drawn[0], SCALE_SIGMA * drawn[1]
        self.yaw, self.stretch = YAW_SIGMA * drawn[2], STRETCH_SIGMA * drawn[3]
        kept = math.exp(-_STEP_NS * 1e-9 / BIAS_TIME_S)
        self.turn_bias = plan.lasting * BIAS_SIGMA * rng.standard_normal((steps, plan.robots))
        for k in range(1, steps):
            fresh = math.sqrt(1.0 - kept**2) * self.turn_bias[k]
            self.turn_bias[k] = kept * self.turn_bias[k - 1] + fresh


def _drive(
    rng: np.random.Generator, plan: Plan, start: FloatArray, steps: int, lasting: _Lasting
) -> tuple[FloatArray, FloatArray]:
    """True poses and reported odometry (T, N, 3); the report begins anywhere, the truth has the noise."""
    n, dt = plan.robots, _STEP_NS * 1e-9
    speed = np.where(np.isin(np.arange(n), list(plan.standing)), 0.0, plan.speed)
    truth, report = np.zeros((steps + 1, n, 3)), np.zeros((steps + 1, n, 3))
    truth[0], report[0] = start, rng.uniform(-3.0, 3.0, (n, 3))
    rate = np.zeros(n)
    for k in range(steps):
        if k % 20 == 0:
            rate = rng.uniform(-plan.turn_rate, plan.turn_rate, n)
        homing = _homing(truth[k], plan)
        turn = np.where(speed > 0.0, np.where(np.isnan(homing), rate, homing), 0.0) * dt
        path = speed * dt
        right, left = (
            path + 0.5 * ODOMETRY.wheel_separation * turn,
            path - 0.5 * ODOMETRY.wheel_separation * turn,
        )
        slip = (
            plan.noise * np.sqrt(ODOMETRY.wheel_noise * np.abs([right, left])) * rng.standard_normal((2, n))
        )
        report[k + 1] = _arc(report[k], path, turn)
        true_right, true_left = right + slip[0], left + slip[1]
        true_turn = (true_right - true_left) / ODOMETRY.wheel_separation
        true_path = 0.5 * (true_right + true_left) * (1.0 + lasting.distance_scale)
        true_turn += turn * lasting.turn_scale + np.where(speed > 0.0, lasting.turn_bias[k] * dt, 0.0)
        truth[k + 1] = _arc(truth[k], true_path, true_turn)
        if k == steps // 2:
            truth[k + 1, list(plan.carried)] *= -1.0
    return truth, report


def _landmark_angles(plan: Plan) -> FloatArray:
    """Where on their circle the landmarks stand (L,)."""
    angles: FloatArray = 2.0 * np.pi * np.arange(plan.landmarks) / max(1, plan.landmarks)
    return angles


def _towards_the_farthest(start: FloatArray, plan: Plan) -> FloatArray:
    """Headings (N,) with which the robots' cameras look at the landmark that is farthest from their start."""
    angles = _landmark_angles(plan)
    marks = plan.arena * np.column_stack([np.cos(angles), np.sin(angles)])
    away = marks - start[:, None, :2]
    farthest = away[np.arange(plan.robots), np.linalg.norm(away, axis=2).argmax(axis=1)]
    headings: FloatArray = np.arctan2(farthest[:, 1], farthest[:, 0]) - MOUNT.yaw
    return headings


def _homing(pose: FloatArray, plan: Plan) -> FloatArray:
    """Turn rate (N,) of robots that have come too far out; NaN for others."""
    away = np.arctan2(-pose[:, 1], -pose[:, 0]) - pose[:, 2]
    away = np.arctan2(np.sin(away), np.cos(away))
    out = np.hypot(pose[:, 0], pose[:, 1]) > 0.7 * plan.arena
    return np.where(out, np.clip(3.0 * away, -1.5, 1.5), np.nan)


def _arc(pose: FloatArray, path: FloatArray, turn: FloatArray) -> FloatArray:
    """Poses (N, 3) after arcs of constant curvature."""
    half = 0.5 * turn
    chord = path * np.sinc(half / np.pi)
    heading = pose[:, 2] + half
    return np.column_stack(
        [pose[:, 0] + chord * np.cos(heading), pose[:, 1] + chord * np.sin(heading), pose[:, 2] + turn]
    )


def _describe(rng: np.random.Generator, plan: Plan, start: FloatArray) -> Swarm:
    known = [plan.start_known[i % len(plan.start_known)] for i in range(plan.robots)]
    sigma = plan.noise * np.array([START_SIGMA.x, START_SIGMA.y, START_SIGMA.theta])
    believed = start + sigma * rng.standard_normal(start.shape)
    odometry = replace(
        ODOMETRY,
        distance_scale_sigma=plan.lasting * SCALE_SIGMA,
        turn_scale_sigma=plan.lasting * SCALE_SIGMA,
        turn_bias_sigma=plan.lasting * BIAS_SIGMA,
        turn_bias_time_s=BIAS_TIME_S,
    )
    return Swarm(
        tuple(
            Robot(
                name=f"robot_{i}",
                odometry=odometry,
                camera=replace(MOUNT, yaw_sigma=plan.lasting * YAW_SIGMA),
                sensor=replace(SENSOR, distance_scale_sigma=plan.lasting * STRETCH_SIGMA),
                faces=tuple(
                    Face(side, 10 * i + j, 0.03 * math.cos(yaw), 0.03 * math.sin(yaw), 0.04, yaw)
                    for j, (side, yaw) in enumerate(_SIDES.items())
                ),
                start=(float(believed[i, 0]), float(believed[i, 1]), float(believed[i, 2]))
                if known[i]
                else None,
                start_sigma=START_SIGMA,
            )
            for i in range(plan.robots)
        ),
        tuple(
            Landmark(1000 + i, plan.arena * math.cos(a), plan.arena * math.sin(a), 0.1, a + math.pi)
            for i, a in enumerate(_landmark_angles(plan).tolist())
        ),
    )


def _picture(
    rng: np.random.Generator,
    plan: Plan,
    swarm: Swarm,
    robot: int,
    poses: FloatArray,
    mount: CameraMount,
    stretch: float,
) -> NDArray[np.void]:
    """What the robot's camera, mounted like this, sees (d,), at distances that it stretches."""
    ids = [mark.id for mark in swarm.landmarks]
    frames = [marker_frame(mark.x, mark.y, mark.z, mark.yaw or 0.0) for mark in swarm.landmarks]
    for other, pose in enumerate(poses):
        if other != robot:
            ids += [face.id for face in swarm.robots[other].faces]
            frames += list(homogeneous(pose[0], pose[1], 0.0, pose[2]) @ _FACE_FRAMES)
    relative = seen(poses[robot], mount, np.array(frames).reshape(-1, 4, 4))
    place = relative[:, :3, 3]
    facing = np.einsum("mi,mi->m", relative[:, :3, 2], place) < -0.3 * np.linalg.norm(place, axis=1)
    ahead = (
        (place[:, 2] > 0.05) & (place[:, 2] < plan.reach) & (np.abs(place[:, :2]).max(axis=1) < place[:, 2])
    )
    relative[:, :3, 3] *= stretch
    found = [_sighting(rng, plan, ids[m], relative[m]) for m in np.flatnonzero(facing & ahead)]
    return joined(found)


def _sighting(rng: np.random.Generator, plan: Plan, marker_id: int, relative: FloatArray) -> NDArray[np.void]:
    """A noisy detection (1,): the noise lies in the plane, along and across the line of sight or the axis."""
    place, turn = _LEVEL @ relative[:3, 3], plan.noise * SENSOR.heading_sigma * rng.standard_normal()
    if plan.content == POSITION:
        distance = math.hypot(place[0], place[1]) + plan.noise * SENSOR.range_sigma * rng.standard_normal()
        bearing = math.atan2(place[1], place[0]) + plan.noise * SENSOR.bearing_sigma * rng.standard_normal()
        place[:2] = distance * math.cos(bearing), distance * math.sin(bearing)
    else:
        place[:2] += plan.noise * np.array([SENSOR.forward_sigma, SENSOR.left_sigma]) * rng.standard_normal(2)
    if rng.uniform() < plan.outliers:
        place[:2] += rng.choice([-1.0, 1.0], 2)
    noisy, flipped = np.eye(4), np.eye(4)
    noisy[:3, 3] = flipped[:3, 3] = _LEVEL.T @ place
    noisy[:3, :3] = _LEVEL.T @ _about_z(turn) @ _LEVEL @ relative[:3, :3]
    flipped[:3, :3] = _LEVEL.T @ _about_z(turn + rng.choice([-0.8, 0.8])) @ _LEVEL @ relative[:3, :3]
    if rng.uniform() < plan.flips:
        noisy, flipped = flipped, noisy
    one = detection(marker_id, noisy, plan.content)
    one["alternative_orientation"] = quaternion(flipped[:3, :3])
    return one


def _about_z(angle: float) -> FloatArray:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
