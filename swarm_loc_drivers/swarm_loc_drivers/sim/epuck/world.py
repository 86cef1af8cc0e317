"""One world of e-pucks, stepped in simulated time: motors turn wheels, wheels slip, cameras look.

The seed and the times of the robots' commands determine the result. Images are rendered on demand and do not
depend on the time of rendering. The parameters of `epuck_world_node` are at the end. No ROS here.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.common.odometry import WheelGeometry
from swarm_loc_drivers.epuck.hardware import EPUCK2, EPUCK_MODELS, wheel_geometry
from swarm_loc_drivers.sim.differential_drive import Drive, LastingNoise, roll
from swarm_loc_drivers.sim.epuck.parts import proximity_values
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena, CameraRig, OverheadRig, OverheadSettings
from swarm_loc_drivers.sim.run import START_NS, Trajectories
from swarm_loc_drivers.sim.scenarios.eight import ARENA, CAMERA_RATE_HZ, FAMILY
from swarm_loc_drivers.sim.worlds import (
    WORLDS,
    ErrorModel,
    LinkedWorldParameters,
    WorldError,
    hidden_geometry,
    start_of,
)
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.parameters import ParameterError, choice, number, text
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_vision.aerial.ground_control import FloorMarker, load_ground
from swarm_loc_vision.markers.families import families

GrayImage = NDArray[np.uint8]

STEP_NS = 5_000_000
OVERHEAD = -1  # In place of a robot: the overhead camera, which stamps its images in the middle of exposure
_SLIP_S = 0.05  # How long a slip of a wheel lasts: 3 mm of its way at 0.06 m/s
_KEPT_NS = 400_000_000  # An image can be drawn for this time after its camera has taken the next one
_PHASES, _EXPOSURES, _SENSOR, _PROXIMITY, _OVERHEAD_SENSOR = range(5)
"""Streams of random numbers, each a function of the seed, the stream, and what it is for."""


@dataclass(frozen=True)
class EpuckWorldSettings:
    """Settings of a world."""

    seed: int  # Fixes its systematic errors and its noise
    # Which errors there are; those of sightings themselves (noise, flips) are up to the images
    errors: ErrorModel
    arena: Arena  # Arena around the robots
    camera: CameraModel  # Of all robots, as calibrated
    wheels: WheelGeometry  # Of all robots
    camera_rate_hz: float  # [1/s]
    start_ns: int  # First moment
    overhead: OverheadSettings = field(default_factory=OverheadSettings)  # A camera above all, and the light
    floor_markers: tuple[FloorMarker, ...] = ()  # Fiducials on the floor, which that camera sees


@dataclass(frozen=True)
class Exposure:
    """An image that a camera has taken."""

    robot: int  # Index of the robot, or OVERHEAD
    number: int  # Counts the robot's images
    stamp_ns: int  # When its camera says it was taken
    middle_ns: int  # When it was taken: the middle of the exposure


class EpuckWorld:
    """The robots of a swarm in their arena; each needs a start pose and a camera, every marker a heading.

    Raises WorldError if the swarm cannot be simulated.
    """

    def __init__(self, swarm: Swarm, settings: EpuckWorldSettings) -> None:
        check_swarm(swarm)
        self._settings = settings
        self._drive = Drive(
            settings.wheels.wheel_separation, settings.errors.wheel_noise, settings.errors.turn_slip
        )
        # true geometry and cameras
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
        # motion
        count = len(swarm.robots)
        self._slip = LastingNoise(rng, (count, 2), STEP_NS * 1e-9, _SLIP_S)
        self.now_ns = settings.start_ns
        self.poses: FloatArray = np.array([robot.start for robot in swarm.robots], dtype=float)
        """(N, 3) true poses of the robots in map."""
        self.rates: FloatArray = np.zeros((count, 2))
        """(N, 2) of the left and the right wheel, as commanded [steps/s]."""
        self.steps: FloatArray = np.zeros((count, 2))
        """(N, 2) that the left and the right motor have done since the start."""
        # images: past poses for their exposures, and the next exposure of each camera
        self._period_ns = round(1e9 / settings.camera_rate_hz)
        early_ns = round(1e9 * settings.errors.exposure_early_s)
        remembered_ns = self._period_ns + early_ns + 2 * self._half_exposure_ns + _KEPT_NS
        self._past = deque([(self.now_ns, self.poses)], maxlen=remembered_ns // STEP_NS)
        first_ns = settings.start_ns + early_ns + self._half_exposure_ns
        phases = self._random(_PHASES).integers(0, self._period_ns, count)
        self._first_ns: list[int] = (first_ns + phases).tolist()
        self._next = [self._exposure(robot, 0) for robot in range(count)]
        self.newest: list[Exposure | None] = [None] * count  # The last image that each camera has taken

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
        # those that have ended and whose stamp has passed
        ends_ns = [max(one.stamp_ns, one.middle_ns + self._half_exposure_ns) for one in self._next]
        taken = [self._take(robot) for robot, end_ns in enumerate(ends_ns) if self.now_ns >= end_ns]
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

    def proximity(self, robot: int) -> IntArray:
        """Raw values (8,) of a robot's proximity sensors now."""
        rng = self._random(_PROXIMITY, robot, self.now_ns)
        return proximity_values(self.poses, robot, self._settings.arena.size, rng)

    def _take(self, robot: int) -> Exposure:
        """Take the due image and schedule the next one."""
        exposure = self._next[robot]
        self.newest[robot] = exposure
        self._next[robot] = self._exposure(robot, exposure.number + 1)
        return exposure

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

    def _random(self, *what: int) -> np.random.Generator:
        """Random numbers of their own for one purpose."""
        return np.random.default_rng([self._settings.seed, *what])

    @property
    def _half_exposure_ns(self) -> int:
        return round(0.5e9 * self._settings.camera.exposure_s)


class SimulatedEpuck:
    """One robot of a world as seen by its firmware; see `EpuckBody`."""

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

    def proximity(self) -> IntArray:
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
    """Check that a swarm can be simulated; raises WorldError if a robot or a marker lacks something."""
    for robot in swarm.robots:
        start_of(robot)
        if robot.camera is None:
            raise WorldError(f"robot '{robot.name}' has no camera, and a simulated e-puck needs one.")
    for marker_id, owner in swarm.owner_of.items():
        if owner.marker.yaw is None:
            raise WorldError(f"marker {marker_id} has no yaw, and a simulated marker needs one.")


@dataclass(frozen=True)
class EpuckWorldParameters(LinkedWorldParameters):
    """Parameters of `epuck_world_node`; the cameras' are those of `CameraModel` and `OverheadSettings`."""

    world: str = choice("w2", tuple(WORLDS), "which errors robots and cameras have; see sim/worlds.py")
    answer_within: float = number(
        0.0, "s", 0.0, 10.0, "simulated time waits for <robot>/detections of images older than this; 0: never"
    )
    first_port: int = number(0, "1", 0, 65000, "TCP port of the first robot on WiFi, the others follow")
    model: str = choice("epuck2", tuple(EPUCK_MODELS), "generation of the robots; only epuck2 has WiFi")
    wheel_diameter: float = number(0.041, "m", 0.001, 1.0, "diameter of the wheels")
    wheel_separation: float = number(
        OdometryModel().wheel_separation, "m", 0.001, 10.0, "distance between the two wheels"
    )
    arena_x: float = number(ARENA[0], "m", 0.1, 1000.0, "size of the arena along x, around the origin")
    arena_y: float = number(ARENA[1], "m", 0.1, 1000.0, "size of the arena along y")
    family: str = choice(FAMILY, tuple(families()), "kind of the markers")
    camera_rate: float = number(CAMERA_RATE_HZ, "1/s", 2.0, 60.0, "images of each camera")
    control_points_file: str = text(
        "", "path of the floor markers that the overhead camera sees; empty: none are on the floor"
    )
    camera: CameraModel = field(default_factory=CameraModel, metadata={"numbers_of": CameraModel})
    overhead: OverheadSettings = field(
        default_factory=OverheadSettings, metadata={"numbers_of": OverheadSettings}
    )


def _floor_markers(parameters: EpuckWorldParameters) -> tuple[FloorMarker, ...]:
    path = parameters.control_points_file
    if not path:
        return ()
    ground = load_ground(Path(path))
    if ground.markers and ground.family.name != parameters.family:
        raise ParameterError(
            f"parameter family = '{parameters.family}' must be that of the floor markers in '{path}':"
            f" {ground.family.name}."
        )
    return ground.markers


def make_world(parameters: EpuckWorldParameters) -> tuple[Swarm, EpuckWorld]:
    """The swarm as described, and its world.

    Raises:
        ParameterError: A parameter cannot be used.
        SwarmFileError: The swarm description cannot be used.
    """
    if not parameters.link_folder and EPUCK_MODELS[parameters.model] is not EPUCK2:
        raise ParameterError(
            f"parameter model = '{parameters.model}' needs the parameter link_folder: only epuck2 has WiFi."
        )
    swarm = load_swarm(Path(parameters.swarm_file))
    try:
        arena = Arena((parameters.arena_x, parameters.arena_y), families()[parameters.family])
        settings = EpuckWorldSettings(
            seed=parameters.seed,
            errors=WORLDS[parameters.world],
            arena=arena,
            camera=parameters.camera,
            wheels=wheel_geometry(parameters.wheel_diameter, parameters.wheel_separation),
            camera_rate_hz=parameters.camera_rate,
            start_ns=START_NS,
            overhead=parameters.overhead,
            floor_markers=_floor_markers(parameters),
        )
        return swarm, EpuckWorld(swarm, settings)
    except WorldError as error:
        raise ParameterError(f"parameter swarm_file = '{parameters.swarm_file}': {error}") from error
    except ValueError as error:
        raise ParameterError(f"parameter family = '{parameters.family}': {error}") from error
