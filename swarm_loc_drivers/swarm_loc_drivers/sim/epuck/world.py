"""One world of e-pucks, stepped in simulated time: motors turn wheels, wheels slip, cameras look.

The seed and the times of the robots' commands fix what happens; images are drawn only on demand, and look
the same whenever that is.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.common.odometry import WheelGeometry
from swarm_loc_drivers.epuck.hardware import (
    FIELD_OF_VIEW,
    PROXIMITY_BEARINGS,
    PROXIMITY_RADIUS_M,
    raw_of_distance,
)
from swarm_loc_drivers.sim.differential_drive import Drive, LastingNoise, roll
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena, CameraRig, OverheadRig, OverheadSettings
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_drivers.sim.worlds import ErrorModel, WorldError, hidden_geometry, start_of
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_vision.aerial.ground_control import FloorMarker

_LARGEST = 4095
_NOISE = 6.0
_RAYS = np.array([-0.5, 0.0, 0.5]) * FIELD_OF_VIEW
"""A sensor reports the nearest of what these rays of its cone meet."""


def proximity_values(
    poses: FloatArray, robot: int, arena: tuple[float, float], rng: np.random.Generator
) -> NDArray[np.int64]:
    """Raw values (8,) of one robot.

    Args:
        poses: (N, 3) of all robots in map.
        robot: Index of the one.
        arena: Its size along x and y, around map's origin [m].
        rng: Source of the noise.
    """
    x, y, heading = poses[robot]
    outwards = heading + np.array(PROXIMITY_BEARINGS)
    origins = np.array([x, y]) + PROXIMITY_RADIUS_M * np.column_stack([np.cos(outwards), np.sin(outwards)])
    angles = outwards[:, None] + _RAYS
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    others = np.delete(poses[:, :2], robot, axis=0)
    distance = np.minimum(_to_walls(origins, rays, arena), _to_discs(origins, rays, others)).min(axis=1)
    raw = raw_of_distance(distance) + _NOISE * rng.standard_normal(len(distance))
    return np.clip(np.rint(raw), 0, _LARGEST).astype(np.int64)


def _to_walls(origins: FloatArray, rays: FloatArray, arena: tuple[float, float]) -> FloatArray:
    """Along rays (S, R, 2) from origins (S, 2) to the walls (S, R) [m]; 0 from outside of them."""
    half = 0.5 * np.array(arena)
    with np.errstate(divide="ignore"):
        along = (half - np.sign(rays) * origins[:, None]) / np.abs(rays)
    nearest: FloatArray = np.maximum(along.min(axis=-1), 0.0)
    return nearest


def _to_discs(origins: FloatArray, rays: FloatArray, centres: FloatArray) -> FloatArray:
    """Along rays (S, R, 2) to robots at (M, 2) (S, R) [m]; infinite where they meet none."""
    if not len(centres):
        return np.full(rays.shape[:2], math.inf)
    to_centre = centres - origins[:, None, None]
    along = (to_centre * rays[:, :, None]).sum(axis=-1)
    beside = (to_centre**2).sum(axis=-1) - along**2
    depth = np.sqrt(np.maximum(PROXIMITY_RADIUS_M**2 - beside, 0.0))
    met = (beside < PROXIMITY_RADIUS_M**2) & (along > 0.0)
    nearest: FloatArray = np.where(met, np.maximum(along - depth, 0.0), math.inf).min(axis=-1)
    return nearest


GrayImage = NDArray[np.uint8]

STEP_NS = 5_000_000
OVERHEAD = -1
"""In place of a robot: the overhead camera, which stamps its images with the middle of the exposure."""
_SLIP_S = 0.05
"""How long a slip of a wheel lasts: 3 mm of its way at 0.06 m/s."""
_KEPT_NS = 400_000_000
"""An image can be drawn for this time after its camera has taken the next one."""
_PHASES, _EXPOSURES, _SENSOR, _PROXIMITY, _OVERHEAD_SENSOR = range(5)
"""Streams of random numbers, each a function of the seed, the stream, and what it is for."""


@dataclass(frozen=True)
class EpuckWorldSettings:
    """Settings of a world.

    Attributes:
        seed: Fixes its systematic errors and its noise.
        errors: Which errors there are; those of sightings themselves (noise, flips) are up to the images.
        arena: Arena around the robots.
        camera: Of all robots, as calibrated.
        wheels: Of all robots.
        camera_rate_hz: [1/s].
        start_ns: First moment.
        overhead: A camera above all, and the light.
        floor_markers: Fiducials on the floor, which that camera sees.
    """

    seed: int
    errors: ErrorModel
    arena: Arena
    camera: CameraModel
    wheels: WheelGeometry
    camera_rate_hz: float
    start_ns: int
    overhead: OverheadSettings = field(default_factory=OverheadSettings)
    floor_markers: tuple[FloorMarker, ...] = ()


@dataclass(frozen=True)
class Exposure:
    """An image that a camera has taken.

    Attributes:
        robot: Index of the robot, or OVERHEAD.
        number: Counts the robot's images.
        stamp_ns: When its camera says it was taken.
        middle_ns: When it was taken: the middle of the exposure.
    """

    robot: int
    number: int
    stamp_ns: int
    middle_ns: int


class EpuckWorld:
    """The robots of a swarm in their arena.

    Args:
        swarm: As described; every robot needs a start pose and a camera, every marker a heading.
        settings: How the world is.

    Raises:
        WorldError: The swarm cannot be simulated.
    """

    def __init__(self, swarm: Swarm, settings: EpuckWorldSettings) -> None:
        check_swarm(swarm)
        self._settings = settings
        self._drive = Drive(
            settings.wheels.wheel_separation, settings.errors.wheel_noise, settings.errors.turn_slip
        )
        rng = np.random.default_rng(settings.seed)
        truth = hidden_geometry(rng, swarm, settings.errors)
        self.rig = CameraRig(swarm, truth, settings.arena, settings.camera, settings.seed)
        """The robots' cameras."""
        overhead = settings.overhead
        self._overhead = (
            OverheadRig(self.rig.scene, overhead, settings.floor_markers, settings.arena.family)
            if overhead.is_there
            else None
        )
        self._overhead_images = 0
        count = len(swarm.robots)
        self._slip = LastingNoise(rng, (count, 2), STEP_NS * 1e-9, _SLIP_S)
        self.now_ns = settings.start_ns
        self.poses: FloatArray = np.array([robot.start for robot in swarm.robots], dtype=float)
        """(N, 3) where the robots truly are now, in map."""
        self.rates: FloatArray = np.zeros((count, 2))
        """(N, 2) of the left and the right wheel, as commanded [steps/s]."""
        self.steps: FloatArray = np.zeros((count, 2))
        """(N, 2) that the left and the right motor have done since the start."""
        self._period_ns = round(1e9 / settings.camera_rate_hz)
        early_ns = round(1e9 * settings.errors.exposure_early_s)
        remembered_ns = self._period_ns + early_ns + 2 * self._half_exposure_ns + _KEPT_NS
        self._past = deque([(self.now_ns, self.poses)], maxlen=remembered_ns // STEP_NS)
        first_ns = settings.start_ns + early_ns + self._half_exposure_ns
        phases = self._random(_PHASES).integers(0, self._period_ns, count)
        self._first_ns: list[int] = (first_ns + phases).tolist()
        self._next = [self._exposure(robot, 0) for robot in range(count)]
        self.newest: list[Exposure | None] = [None] * count
        """The last image that each camera has taken."""

    def step(self) -> list[Exposure]:
        """Step by STEP_NS; returns the images taken meanwhile, by stamp."""
        step_s = STEP_NS * 1e-9
        left, right = (self._settings.wheels.metres_per_step * self.rates).T
        noise = np.sqrt(self._drive.wheel_noise) * self._slip.next()
        turn_rate = (right - left) / self._drive.wheel_separation
        self.poses = roll(self.poses, 0.5 * (left + right), turn_rate, self._drive, step_s, noise)
        self.steps += self.rates * step_s
        self.now_ns += STEP_NS
        self._past.append((self.now_ns, self.poses))
        taken = [self._take(robot) for robot in range(len(self._next)) if self._is_due(self._next[robot])]
        return sorted([*taken, *self._seen_from_above()], key=lambda exposure: exposure.stamp_ns)

    def image(self, exposure: Exposure) -> GrayImage:
        """Draw what a camera took (height, width).

        Raises:
            ValueError: The image was taken too long ago.
        """
        track = Trajectories(
            np.array([stamp_ns for stamp_ns, _ in self._past]), np.array([poses for _, poses in self._past])
        )
        if exposure.robot == OVERHEAD and self._overhead is not None:
            rng = self._random(_OVERHEAD_SENSOR, exposure.number)
            return self._overhead.take(exposure.middle_ns, track, rng)
        rng = self._random(_SENSOR, exposure.robot, exposure.number)
        return self.rig.take(exposure.robot, exposure.middle_ns, track, rng)

    def proximity(self, robot: int) -> NDArray[np.int64]:
        """Raw values (8,) of a robot's proximity sensors now."""
        rng = self._random(_PROXIMITY, robot, self.now_ns)
        return proximity_values(self.poses, robot, self._settings.arena.size, rng)

    def _take(self, robot: int) -> Exposure:
        """Take the due image and schedule the next one."""
        exposure = self._next[robot]
        self.newest[robot] = exposure
        self._next[robot] = self._exposure(robot, exposure.number + 1)
        return exposure

    def exposure_of(self, robot: int, stamp_ns: int) -> Exposure:
        """The exposure of a camera nearest to a stamp, at any time."""
        return self._exposure(robot, round((stamp_ns - self._first_ns[robot]) / self._period_ns))

    def _exposure(self, robot: int, number: int) -> Exposure:
        """The exposure of a number; it happens before its stamp, by the world's error."""
        stamp_ns = self._first_ns[robot] + number * self._period_ns
        early_s = self._settings.errors.exposure_early_s * self._random(_EXPOSURES, robot, number).random()
        return Exposure(robot, number, stamp_ns, stamp_ns - round(1e9 * early_s))

    def _seen_from_above(self) -> list[Exposure]:
        """The image that the overhead camera has just finished, if any."""
        overhead, number = self._settings.overhead, self._overhead_images
        if not overhead.is_there:
            return []
        half_ns = round(0.5e9 * overhead.aerial_exposure_s)
        middle_ns = self._settings.start_ns + half_ns + round((number + 1) * 1e9 / overhead.aerial_rate)
        if self.now_ns < middle_ns + half_ns:
            return []
        self._overhead_images += 1
        return [Exposure(OVERHEAD, number, middle_ns, middle_ns)]

    def _is_due(self, exposure: Exposure) -> bool:
        """Whether the exposure has ended and its stamp has passed."""
        return self.now_ns >= max(exposure.stamp_ns, exposure.middle_ns + self._half_exposure_ns)

    def _random(self, *what: int) -> np.random.Generator:
        """Random numbers of their own for one purpose."""
        return np.random.default_rng([self._settings.seed, *what])

    @property
    def _half_exposure_ns(self) -> int:
        return round(0.5e9 * self._settings.camera.exposure_s)


class SimulatedEpuck:
    """One robot of a world as its firmware finds it; see `EpuckBody`.

    Args:
        world: Where it lives.
        robot: Its index.
    """

    def __init__(self, world: EpuckWorld, robot: int) -> None:
        self._world, self._robot = world, robot
        self._drawn: tuple[int, GrayImage] | None = None

    def set_wheel_speeds(self, left: float, right: float) -> None:
        """Turn the wheels at these rates [steps/s] until the next call."""
        self._world.rates[self._robot] = left, right

    def wheel_steps(self) -> tuple[int, int]:
        """Whole steps done since the start, left and right."""
        left, right = self._world.steps[self._robot].tolist()
        return int(left), int(right)

    def proximity(self) -> NDArray[np.int64]:
        """Raw values, ps0..ps7 clockwise from the front."""
        return self._world.proximity(self._robot)

    def image(self) -> tuple[GrayImage, int] | None:
        """The newest image (height, width) and its stamp [ns]; None before the first."""
        newest = self._world.newest[self._robot]
        if newest is None:
            return None
        if self._drawn is None or self._drawn[0] != newest.stamp_ns:
            self._drawn = newest.stamp_ns, self._world.image(newest)
        return self._drawn[1], newest.stamp_ns

    @property
    def now_ns(self) -> int:
        """The world's time [ns]."""
        return self._world.now_ns


def check_swarm(swarm: Swarm) -> None:
    """Check that a swarm can be simulated.

    Raises:
        WorldError: A robot or a marker lacks something.
    """
    for robot in swarm.robots:
        start_of(robot)
        if robot.camera is None:
            raise WorldError(f"robot '{robot.name}' has no camera, and a simulated e-puck needs one.")
    for marker_id, owner in swarm.owner_of.items():
        if owner.marker.yaw is None:
            raise WorldError(f"marker {marker_id} has no yaw, and a simulated marker needs one.")
