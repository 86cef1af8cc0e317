"""A large swarm: robots half a metre apart on a grid, each driving about in its own cell, or another shape.

Every robot sees the neighbours in front of it, about three at a time, as poses; those at the border also see
the landmarks that stand around the grid, one pitch outside. Odometry comes at 20 Hz and images at 7.5 Hz,
each robot at its own phase.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bench.scenarios.lived_run import SIGHTING_DTYPE, Records, SimulatedRun, record_drive
from bench.scenarios.sightings import Exposures, View, deliver, schedule_exposures
from swarm_loc_drivers.sim.differential_drive import Controller, Drive
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.error_models import OdometryModel, SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Robot, StartSigma, Swarm

PITCH = 0.5
HOME_RADIUS = 0.08
_SPEED = 0.06
_TURN_SPREAD = 0.6
_TURN_MEMORY_S = 1.0
_HOMING_GAIN = 2.0
_BRIDGE_M = 0.6
_LANDMARK_OFFSET_M = 0.3
_REACHED_M = 0.3
ROAMING_SPEED = (0.1, 0.3)
_ROAMING_TURN = 1.5


class Shape(Enum):
    """How a swarm is laid out.

    Robots keep to cells of their own, or wander about all cells and meet ever new neighbours. Landmarks stand
    all around, or there is one at a corner, which only the robot of that corner sees, or whoever passes by.
    """

    BORDER = "border"
    CORNER = "corner"
    WANDER = "wander"
    WANDER_CORNER = "wander_corner"
    CHAIN = "chain"
    CLUSTERS = "clusters"

    @property
    def wanders(self) -> bool:
        """Whether robots leave their cells."""
        return self in {Shape.WANDER, Shape.WANDER_CORNER}

    @property
    def one_sees(self) -> bool:
        """Whether only the first robot sees the landmark."""
        return self in {Shape.CORNER, Shape.CHAIN, Shape.CLUSTERS}

    def homes(self, robots: int) -> FloatArray:
        """Where the robots live (N, 2) [m]."""
        if self is Shape.CHAIN:
            return PITCH * np.column_stack([np.arange(robots), np.zeros(robots)]).astype(float)
        if self is not Shape.CLUSTERS or robots < 3:
            return cells(robots)
        left, right = cells(robots // 2), cells(robots - 1 - robots // 2)
        bridge = np.array([left[:, 0].max() + _BRIDGE_M, PITCH * (round(left[:, 1].max() / PITCH) // 2)])
        return np.concatenate([left, right + np.array([bridge[0] + _BRIDGE_M, 0.0]), bridge[None]])

    def landmarks(self, homes: FloatArray) -> FloatArray:
        """Places of the landmarks (L, 2) [m]: free cells around homes (N, 2), or one next to the first."""
        if self in {Shape.BORDER, Shape.WANDER}:
            return _border(homes)
        return homes[:1] - [_LANDMARK_OFFSET_M, 0.0 if self is Shape.CHAIN else _LANDMARK_OFFSET_M]


def cells(robots: int) -> FloatArray:
    """Cells (N, 2) [m], row by row on the squarest grid that holds them."""
    columns = math.ceil(math.sqrt(robots))
    index = np.arange(robots)
    return PITCH * np.column_stack([index % columns, index // columns]).astype(float)


def _border(homes: FloatArray) -> FloatArray:
    taken = {(round(x / PITCH), round(y / PITCH)) for x, y in homes}
    ring = {(i + a, j + b) for i, j in taken for a in (-1, 0, 1) for b in (-1, 0, 1)} - taken
    return PITCH * np.array(sorted(ring), dtype=float)


def stay(rng: np.random.Generator, homes: FloatArray, step_s: float) -> Controller:
    """A controller that turns N robots at random and sends those back that get too far from home (N, 2)."""
    keep = math.exp(-step_s / _TURN_MEMORY_S)
    excite = _TURN_SPREAD * math.sqrt(1.0 - keep * keep)
    turn = _TURN_SPREAD * rng.standard_normal(len(homes))
    speed = np.full(len(homes), _SPEED)

    def control(_step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        nonlocal turn
        turn = keep * turn + excite * rng.standard_normal(len(homes))
        to_home = homes - pose[:, :2]
        away = np.hypot(to_home[:, 0], to_home[:, 1]) > HOME_RADIUS
        bearing = se2.wrap_angle(np.arctan2(to_home[:, 1], to_home[:, 0]) - pose[:, 2])
        return speed, np.where(away, np.clip(_HOMING_GAIN * bearing, -2.0, 2.0), turn)

    return control


def roam(rng: np.random.Generator, homes: FloatArray) -> Controller:
    """A controller that sends N robots to one place after the other among all homes (N, 2)."""
    low, high = homes.min(axis=0), homes.max(axis=0)
    goal = rng.uniform(low, high, homes.shape)
    speed = rng.uniform(*ROAMING_SPEED, len(homes))

    def control(_step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        way = goal - pose[:, :2]
        reached = np.hypot(way[:, 0], way[:, 1]) < _REACHED_M
        goal[reached] = rng.uniform(low, high, (int(reached.sum()), 2))
        bearing = se2.wrap_angle(np.arctan2(way[:, 1], way[:, 0]) - pose[:, 2])
        return speed, np.clip(_HOMING_GAIN * bearing, -_ROAMING_TURN, _ROAMING_TURN)

    return control


VIEW = View(field_of_view=math.radians(160.0), nearest=0.05, farthest=0.8, incidence=math.pi)
SENSOR = SensorModel(forward_sigma=0.020, left_sigma=0.020, heading_sigma=0.035)
ODOMETRY = OdometryModel(wheel_separation=0.053, wheel_noise=2e-5)
ODOMETRY_RATE_HZ = 20.0
CAMERA_RATE_HZ = 7.5
START_SIGMA = StartSigma(x=0.01, y=0.01, theta=0.02)
STEP_NS = 10_000_000

_FIRST_LANDMARK_ID = 1_000_000
_NEAR_FOR_NS = 250_000_000  # So long the robots near a wandering one are those at the middle of that time


@dataclass(frozen=True)
class GridSettings:
    """Settings of a run."""

    robots: int = 100  # N
    seed: int = 1  # Two runs with the same settings are identical
    duration_s: float = 20.0  # [s]
    shape: Shape = Shape.BORDER  # Layout and motion


def simulate_grid(settings: GridSettings) -> SimulatedRun:
    """Drive the robots and record odometry and sightings."""
    rng = np.random.default_rng(settings.seed)
    homes = settings.shape.homes(settings.robots)
    start = np.column_stack([homes, rng.uniform(-math.pi, math.pi, settings.robots)])
    model = Drive(ODOMETRY.wheel_separation, ODOMETRY.wheel_noise)
    control = roam(rng, homes) if settings.shape.wanders else stay(rng, homes, STEP_NS * 1e-9)
    duration_s, rate_hz = settings.duration_s, ODOMETRY_RATE_HZ
    truth, odometry = record_drive(
        rng, start, control, model, step_ns=STEP_NS, duration_s=duration_s, odometry_rate_hz=rate_hz
    )
    swarm = describe(rng, start, settings.shape.landmarks(homes))
    begin_ns, end_ns = truth.stamp_ns[[0, -1]].tolist()
    exposures = schedule_exposures(rng, settings.robots, CAMERA_RATE_HZ, begin_ns, end_ns)
    frames, sightings = observe_neighbours(rng, swarm, truth, exposures, settings.shape)
    return SimulatedRun(swarm, truth, odometry, frames, sightings)


def describe(rng: np.random.Generator, start: FloatArray, places: FloatArray) -> Swarm:
    """The swarm, with landmarks at places (L, 2); the described starts (N, 3) err by START_SIGMA."""
    sigma = np.array([START_SIGMA.x, START_SIGMA.y, START_SIGMA.theta])
    described = start + sigma * rng.standard_normal(start.shape)
    described[:, 2] = se2.wrap_angle(described[:, 2])
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
        for index, pose in enumerate(described)
    )
    marks = tuple(
        Landmark(_FIRST_LANDMARK_ID + k, float(x), float(y), yaw=0.0) for k, (x, y) in enumerate(places)
    )
    return Swarm(robots, marks)


def observe_neighbours(
    rng: np.random.Generator,
    swarm: Swarm,
    truth: Trajectories,
    exposures: Exposures,
    shape: Shape,
    view: View = VIEW,
) -> tuple[Records, Records]:
    """What the images show: frames of FRAME_DTYPE in order of arrival, and their sightings."""
    robot, stamp_ns = exposures
    count = len(swarm.robots)
    landmarks = np.array([[mark.x, mark.y, mark.yaw] for mark in swarm.landmarks], dtype=float)
    ids = np.array([robot.faces[0].id for robot in swarm.robots] + [mark.id for mark in swarm.landmarks])
    if shape.wanders:
        candidates = _passing(robot, stamp_ns, truth, landmarks[:, :2], view)
    else:
        reach = view.farthest + 4.0 * HOME_RADIUS
        candidates = _candidates(shape.homes(count), landmarks[:, :2], reach)[robot]
    if shape.one_sees:
        candidates[(candidates >= count) & (robot > 0)[:, None]] = -1
    frame, slot = np.nonzero(candidates >= 0)
    target = candidates[frame, slot]
    target_pose = landmarks[np.maximum(target - count, 0)]
    moving = target < count
    target_pose[moving] = truth.at(target[moving], stamp_ns[frame[moving]])
    exact = se2.between(truth.at(robot, stamp_ns)[frame], target_pose)
    seen = view.sees(exact)
    sigma = np.array([SENSOR.forward_sigma, SENSOR.left_sigma, SENSOR.heading_sigma])
    value = exact[seen] + sigma * rng.standard_normal((int(seen.sum()), 3))
    value[:, 2] = se2.wrap_angle(value[:, 2])
    sightings = np.zeros(len(value), SIGHTING_DTYPE)
    sightings["marker_id"] = ids[target[seen]]
    sightings["value"] = value
    return deliver(rng, exposures, frame[seen], sightings, end_ns=int(truth.stamp_ns[-1]), loss=0.0)


def _passing(
    robot: NDArray[np.int64],
    stamp_ns: NDArray[np.int64],
    truth: Trajectories,
    landmarks: FloatArray,
    view: View,
) -> NDArray[np.int64]:
    """Targets that may come into view in each image (E, C), as `_candidates`."""
    part = (stamp_ns - truth.stamp_ns[0]) // _NEAR_FOR_NS
    reach = view.farthest + ROAMING_SPEED[1] * _NEAR_FOR_NS * 1e-9
    tables = {}
    for which in np.unique(part).tolist():
        middle_ns = int(truth.stamp_ns[0]) + which * _NEAR_FOR_NS + _NEAR_FOR_NS // 2
        middle_ns = min(middle_ns, int(truth.stamp_ns[-1]))
        places = truth.all_at(np.array([middle_ns]))[0, :, :2]
        tables[which] = _candidates(places, landmarks, reach)
    candidates = np.full((robot.size, max(table.shape[1] for table in tables.values())), -1, dtype=np.int64)
    for which, table in tables.items():
        images = np.flatnonzero(part == which)
        candidates[images, : table.shape[1]] = table[robot[images]]
    return candidates


def _candidates(places: FloatArray, landmarks: FloatArray, reach: float) -> NDArray[np.int64]:
    """Targets within reach of each robot (N, C), robots first, then landmarks; -1 fills up."""
    everything = cKDTree(np.concatenate([places, landmarks]))
    near = everything.query_ball_point(places, reach, return_sorted=True)
    width = max(len(found) for found in near)
    table = np.full((len(places), width), -1, dtype=np.int64)
    for index, found in enumerate(near):
        others = [target for target in found if target != index]
        table[index, : len(others)] = others
    return table
