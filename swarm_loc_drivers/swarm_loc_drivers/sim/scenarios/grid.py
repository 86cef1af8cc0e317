"""A large swarm: robots half a metre apart on a grid, each driving about in its own cell.

Every robot sees the neighbours in front of it, about three at a time, as poses; those at the border also see
the landmarks that stand around the grid, one pitch outside. Odometry comes at 20 Hz and images at 7.5 Hz,
each robot at its own phase.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from swarm_loc_drivers.sim.common.camera import Exposures, View, deliver, schedule_exposures
from swarm_loc_drivers.sim.common.differential_drive import Controller, Drive, drive, report_odometry
from swarm_loc_drivers.sim.common.record import SIGHTING_DTYPE, Records, SimulatedRun
from swarm_loc_drivers.sim.common.trajectories import Trajectories
from swarm_loc_drivers.sim.common.transport import ODOMETRY_LATENESS
from swarm_loc_estimator.core.description.swarm import (
    CameraMount,
    Face,
    Landmark,
    OdometryModel,
    Robot,
    SensorModel,
    StartSigma,
    Swarm,
)
from swarm_loc_estimator.numerics import se2
from swarm_loc_estimator.numerics.arrays import FloatArray

PITCH = 0.5
VIEW = View(field_of_view=math.radians(160.0), nearest=0.05, farthest=0.8, incidence=math.pi)
SENSOR = SensorModel(forward_sigma=0.020, left_sigma=0.020, heading_sigma=0.035)
ODOMETRY = OdometryModel(wheel_separation=0.053, wheel_noise=2e-5)
ODOMETRY_RATE_HZ = 20.0
CAMERA_RATE_HZ = 7.5
START_SIGMA = StartSigma(x=0.01, y=0.01, theta=0.02)
START_NS = 1_000 * 10**9
STEP_NS = 10_000_000

_SPEED = 0.06
_TURN_SPREAD = 0.6
_TURN_MEMORY_S = 1.0
_HOME_RADIUS = 0.08
_HOMING_GAIN = 2.0
_FIRST_LANDMARK_ID = 1_000_000


@dataclass(frozen=True)
class GridSettings:
    """What to simulate.

    Attributes:
        robots: N.
        seed: Two runs with the same settings are identical.
        duration_s: [s].
    """

    robots: int = 100
    seed: int = 1
    duration_s: float = 20.0


def simulate_grid(settings: GridSettings) -> SimulatedRun:
    """Drive the robots about and record what their sensors say."""
    rng = np.random.default_rng(settings.seed)
    steps = round(settings.duration_s * 1e9 / STEP_NS)
    stamp_ns = START_NS + STEP_NS * np.arange(steps + 1, dtype=np.int64)
    homes = cells(settings.robots)
    start = np.column_stack([homes, rng.uniform(-math.pi, math.pi, settings.robots)])
    model = Drive(ODOMETRY.wheel_separation, ODOMETRY.wheel_noise)
    control = wander(rng, homes, STEP_NS * 1e-9)
    driven = drive(rng, start, control, model, step_s=STEP_NS * 1e-9, steps=steps)
    truth = Trajectories(stamp_ns, driven.truth)
    every = round(1e9 / ODOMETRY_RATE_HZ / STEP_NS)
    odometry = report_odometry(rng, stamp_ns, driven.reported, every, ODOMETRY_LATENESS)
    swarm = describe(rng, start, homes)
    exposures = schedule_exposures(rng, settings.robots, CAMERA_RATE_HZ, int(stamp_ns[0]), int(stamp_ns[-1]))
    frames, sightings = observe_neighbours(rng, swarm, truth, exposures, homes)
    return SimulatedRun(swarm, truth, odometry, frames, sightings)


def cells(robots: int) -> FloatArray:
    """Where the robots live (N, 2) [m]: row by row on the squarest grid that holds them."""
    columns = math.ceil(math.sqrt(robots))
    index = np.arange(robots)
    return PITCH * np.column_stack([index % columns, index // columns]).astype(float)


def border(homes: FloatArray) -> FloatArray:
    """Places of the landmarks (L, 2) [m]: the ring of free cells around the occupied ones (N, 2)."""
    taken = {(round(x / PITCH), round(y / PITCH)) for x, y in homes}
    ring = {(i + a, j + b) for i, j in taken for a in (-1, 0, 1) for b in (-1, 0, 1)} - taken
    return PITCH * np.array(sorted(ring), dtype=float)


def describe(rng: np.random.Generator, start: FloatArray, homes: FloatArray) -> Swarm:
    """The swarm's description; robots are told their start (N, 3) with an error of START_SIGMA."""
    sigma = np.array([START_SIGMA.x, START_SIGMA.y, START_SIGMA.theta])
    told = start + sigma * rng.standard_normal(start.shape)
    told[:, 2] = se2.wrap_angle(told[:, 2])
    robots = tuple(
        Robot(
            name=f"robot{index:04d}",
            odometry=ODOMETRY,
            camera=CameraMount(),
            sensor=SENSOR,
            faces=(Face("centre", index, yaw=0.0),),
            start=(float(pose[0]), float(pose[1]), float(pose[2])),
            start_sigma=START_SIGMA,
        )
        for index, pose in enumerate(told)
    )
    places = border(homes)
    marks = tuple(
        Landmark(_FIRST_LANDMARK_ID + k, float(x), float(y), yaw=0.0) for k, (x, y) in enumerate(places)
    )
    return Swarm(robots, marks)


def wander(rng: np.random.Generator, homes: FloatArray, step_s: float) -> Controller:
    """A controller that turns N robots at random and sends those back that get too far from home (N, 2)."""
    keep = math.exp(-step_s / _TURN_MEMORY_S)
    excite = _TURN_SPREAD * math.sqrt(1.0 - keep * keep)
    turn = _TURN_SPREAD * rng.standard_normal(len(homes))
    speed = np.full(len(homes), _SPEED)

    def control(_step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        nonlocal turn
        turn = keep * turn + excite * rng.standard_normal(len(homes))
        to_home = homes - pose[:, :2]
        away = np.hypot(to_home[:, 0], to_home[:, 1]) > _HOME_RADIUS
        bearing = se2.wrap_angle(np.arctan2(to_home[:, 1], to_home[:, 0]) - pose[:, 2])
        return speed, np.where(away, np.clip(_HOMING_GAIN * bearing, -2.0, 2.0), turn)

    return control


def observe_neighbours(
    rng: np.random.Generator, swarm: Swarm, truth: Trajectories, exposures: Exposures, homes: FloatArray
) -> tuple[Records, Records]:
    """What the images show: frames of FRAME_DTYPE in order of arrival, and their sightings."""
    robot, stamp_ns = exposures
    landmarks = np.array([[mark.x, mark.y, mark.yaw] for mark in swarm.landmarks], dtype=float)
    ids = np.array([robot.faces[0].id for robot in swarm.robots] + [mark.id for mark in swarm.landmarks])
    candidates = _candidates(homes, landmarks[:, :2])
    frame, slot = np.nonzero(candidates[robot] >= 0)
    target = candidates[robot[frame], slot]
    target_pose = landmarks[np.maximum(target - len(homes), 0)]
    moving = target < len(homes)
    target_pose[moving] = truth.at(target[moving], stamp_ns[frame[moving]])
    exact = se2.between(truth.at(robot, stamp_ns)[frame], target_pose)
    seen = VIEW.sees(exact)
    sigma = np.array([SENSOR.forward_sigma, SENSOR.left_sigma, SENSOR.heading_sigma])
    value = exact[seen] + sigma * rng.standard_normal((int(seen.sum()), 3))
    value[:, 2] = se2.wrap_angle(value[:, 2])
    sightings = np.zeros(len(value), SIGHTING_DTYPE)
    sightings["marker_id"] = ids[target[seen]]
    sightings["value"] = value
    return deliver(rng, exposures, frame[seen], sightings, end_ns=int(truth.stamp_ns[-1]), loss=0.0)


def _candidates(homes: FloatArray, landmarks: FloatArray) -> NDArray[np.int64]:
    """Targets that may come into each robot's view (N, C), robots first, then landmarks; -1 fills up."""
    everything = cKDTree(np.concatenate([homes, landmarks]))
    reach = VIEW.farthest + 4.0 * _HOME_RADIUS
    near = everything.query_ball_point(homes, reach, return_sorted=True)
    width = max(len(found) for found in near)
    table = np.full((len(homes), width), -1, dtype=np.int64)
    for index, found in enumerate(near):
        others = [target for target in found if target != index]
        table[index, : len(others)] = others
    return table
