"""Small simulated swarms for the tests of the core, written independently of the code under test."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.core.arrivals import DetectionRows, Messages, OdometryRows
from swarm_loc_estimator.core.estimator import SwarmEstimate, SwarmEstimator
from swarm_loc_estimator.core.fusion import Verdict
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.swarm import (
    CameraMount,
    Face,
    Landmark,
    OdometryModel,
    Robot,
    SensorModel,
    StartSigma,
    Swarm,
)
from swarm_loc_estimator.io.cdr import DETECTION_DTYPE

SECOND = 10**9
T0 = 1_000 * SECOND
POSITION, POSE, POSE_TWO = 1, 2, 3


def homogeneous(
    x: float, y: float, z: float, yaw: float, pitch: float = 0.0, roll: float = 0.0
) -> FloatArray:
    """The matrix (4, 4) of a frame at x, y, z turned by Rz(yaw) Ry(pitch) Rx(roll)."""
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def marker_frame(x: float, y: float, z: float, yaw: float) -> FloatArray:
    """The matrix (4, 4) of a marker: z out of its face towards yaw, y down."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[sin, 0.0, cos, x], [-cos, 0.0, sin, y], [0.0, -1.0, 0.0, z], [0.0, 0.0, 0.0, 1.0]])


def optical_frame(mount: CameraMount) -> FloatArray:
    """The matrix (4, 4) from base_link to the camera's optical frame: x right, y down, z forward."""
    to_optical = np.eye(4)
    to_optical[:3, :3] = np.column_stack([(0, -1, 0), (0, 0, -1), (1, 0, 0)])
    return homogeneous(mount.x, mount.y, mount.z, mount.yaw, mount.pitch, mount.roll) @ to_optical


def seen(base: ArrayLike, mount: CameraMount, marker_in_map: FloatArray) -> FloatArray:
    """Markers (..., 4, 4) in the optical frame of a camera on a robot at `base` (3,)."""
    x, y, theta = np.asarray(base, dtype=float)
    camera = homogeneous(x, y, 0.0, theta) @ optical_frame(mount)
    relative: FloatArray = np.linalg.inv(camera) @ marker_in_map
    return relative


def detection(marker_id: int, pose: FloatArray, content: int = POSE) -> NDArray[np.void]:
    """A detection (1,) of a marker whose pose in the optical frame is (4, 4); its noise is the sensor's."""
    one = np.zeros(1, dtype=DETECTION_DTYPE)
    one["id"], one["content"], one["position"] = marker_id, content, pose[:3, 3]
    one["orientation"] = Rotation.from_matrix(pose[:3, :3]).as_quat()
    one["alternative_position"], one["alternative_orientation"] = one["position"], one["orientation"]
    one["covariance"][0, 0, 0] = -1.0
    return one


def joined(detections: Sequence[NDArray[np.void]]) -> NDArray[np.void]:
    """All detections in one array of the same dtype, which numpy's own concatenation would not keep."""
    together: NDArray[np.void] = np.frombuffer(
        b"".join(one.tobytes() for one in detections), dtype=DETECTION_DTYPE
    ).copy()
    return together


@dataclass(frozen=True)
class Event:
    """One message: odometry when `pose` is given, else detections."""

    robot: int
    stamp_ns: int
    pose: tuple[float, float, float] | None = None
    detections: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, dtype=DETECTION_DTYPE))

    def give(self, estimator: SwarmEstimator, now_ns: int) -> None:
        """Hand the message in."""
        rows = 0 if self.pose is None else 1
        poses = np.array([self.pose or ()], dtype=float).reshape(rows, 3)
        robot, stamp_ns, arrival_ns = np.array([[self.robot], [self.stamp_ns], [now_ns]], dtype=np.int64)
        odometry = OdometryRows(robot[:rows], stamp_ns[:rows], poses, arrival_ns[:rows])
        each = np.zeros(self.detections.size, dtype=np.int64)
        seen = DetectionRows(robot[each], stamp_ns[each], self.detections, arrival_ns[each])
        estimator.receive(Messages(now_ns, now_ns, odometry, seen))


@dataclass(frozen=True)
class World:
    """A simulated run.

    Attributes:
        swarm: Its description.
        stamp_ns: (T,) instants of the truth.
        truth: (T, N, 3).
        events: In order of their stamps.
    """

    swarm: Swarm
    stamp_ns: NDArray[np.int64]
    truth: FloatArray
    events: tuple[Event, ...]

    def at(self, stamp_ns: int) -> FloatArray:
        """The true poses (N, 3) at an instant of the truth."""
        poses: FloatArray = self.truth[int(np.searchsorted(self.stamp_ns, stamp_ns))]
        return poses


@dataclass(frozen=True)
class Plan:
    """What to simulate.

    Attributes:
        robots: N.
        duration_s: [s].
        speed: Of every robot [m/s].
        turn_rate: Largest [rad/s]; each robot changes its own every second.
        arena: Half the width of the square in which the landmarks stand [m].
        landmarks: How many, on a circle.
        start_known: Per robot, or one for all.
        content: Of the detections.
        noise: Scale of all noise; 0: none.
        flips: Share of pose sightings whose first solution is the mirrored one.
        outliers: Share of sightings that are off by a metre.
        reach: How far cameras see [m].
        camera_hz: Pictures per second.
        standing: Robots that do not move.
        carried: Robots that are put elsewhere, with their backs to where they looked, at half time.
        lasting: Scale of the errors that last, of the motion and of the camera; 0: neither are there any,
            nor are they estimated.
        survey: Scale of the errors of the landmarks' places, likewise.
    """

    robots: int = 3
    duration_s: float = 6.0
    speed: float = 0.1
    turn_rate: float = 0.8
    arena: float = 1.2
    landmarks: int = 8
    start_known: Sequence[bool] = (True,)
    content: int = POSE
    noise: float = 1.0
    flips: float = 0.0
    outliers: float = 0.0
    reach: float = 2.5
    camera_hz: float = 5.0
    standing: Sequence[int] = ()
    carried: Sequence[int] = ()
    lasting: float = 0.0
    survey: float = 0.0


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
    """Those of a world's robots."""
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
    angles = 2.0 * np.pi * np.arange(plan.landmarks) / max(1, plan.landmarks)
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
            for i, a in enumerate(angles)
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
    one["alternative_orientation"] = Rotation.from_matrix(flipped[:3, :3]).as_quat()
    return one


def _about_z(angle: float) -> FloatArray:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def play(
    estimator: SwarmEstimator,
    events: Iterable[tuple[int, Event]],
    ticks_ns: Iterable[int],
    resting_ns: Container[int] = (),
) -> list[SwarmEstimate]:
    """Hand in events (arrival, event) as they arrive, and tick, not fusing at some; return all estimates."""
    waiting = sorted(events, key=lambda pair: pair[0])
    estimates, k = [], 0
    for now_ns in ticks_ns:
        while k < len(waiting) and waiting[k][0] <= now_ns:
            waiting[k][1].give(estimator, waiting[k][0])
            k += 1
        estimates.append(estimator.tick(now_ns, fuse=now_ns not in resting_ns))
    return estimates


def on_time(world: World) -> list[tuple[int, Event]]:
    """The world's events, each arriving at its stamp."""
    return [(event.stamp_ns, event) for event in world.events]


def ticks(begin_ns: int, end_ns: int, period_s: float = 0.1) -> list[int]:
    """Instants of ticks, the last one at `end_ns`."""
    return [*range(begin_ns, end_ns, round(period_s * SECOND)), end_ns]


def settled(estimator: SwarmEstimator) -> dict[str, int]:
    """How many measurements ended with which verdict."""
    counts = estimator._timeline.verdict_counts()
    return {verdict.name: int(counts[verdict]) for verdict in Verdict}


def planar(pose: FloatArray) -> FloatArray:
    """The homogeneous matrix (3, 3) of a pose (3,) in the plane."""
    x, y, theta = pose
    cos, sin = math.cos(theta), math.sin(theta)
    return np.array([[cos, -sin, x], [sin, cos, y], [0.0, 0.0, 1.0]])


def pose_of(matrix: FloatArray) -> FloatArray:
    """The pose (3,) of a homogeneous matrix (3, 3)."""
    return np.array([matrix[0, 2], matrix[1, 2], math.atan2(matrix[1, 0], matrix[0, 0])])


def wrapped(error: FloatArray) -> FloatArray:
    """Errors (..., 3) with their headings in [-pi, pi]."""
    result: FloatArray = error.copy()
    result[..., 2] = np.arctan2(np.sin(error[..., 2]), np.cos(error[..., 2]))
    return result


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised squared errors (...) of errors (..., 3), headings wrapped."""
    normal = wrapped(error)
    weighted = np.linalg.solve(covariance, normal[..., None])[..., 0]
    squared: FloatArray = np.einsum("...i,...i->...", normal, weighted)
    return squared
