"""Five e-pucks that drive the eight among twenty wall markers, as a run without ROS.

A marker every 0.4 m of wall; five faces per robot, cameras at 7.5 Hz. Also with rendered images in place of
sightings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.scenarios.lived_run import SIGHTING_DTYPE, Records, SimulatedRun, record_drive
from bench.scenarios.sightings import Exposures, View, deliver, observe_markers, schedule_exposures
from swarm_loc_drivers.sim.differential_drive import Controller, Drive
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena, CameraRig
from swarm_loc_drivers.sim.run import Trajectories
from swarm_loc_drivers.sim.scenarios.eight import (
    ARENA,
    CAMERA_RATE_HZ,
    FAMILY,
    HALF_WIDTH,
    Lemniscate,
    _offsets,
    eight_starts,
    follow,
    rounded,
)
from swarm_loc_drivers.sim.worlds import W0, ErrorModel, HiddenGeometry, hidden_geometry
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.error_models import OdometryModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Robot, StartSigma, Swarm
from swarm_loc_vision.markers.families import family_named

WALL_MARKER_PITCH = 0.4
MARKER_HEIGHT = 0.08
FACE_DISTANCE = 0.033
FACE_NAMES = ("front_left", "left", "back", "right", "front_right")
CAMERA = CameraMount(x=0.03, z=0.08)
VIEW = View(field_of_view=math.radians(60.0), nearest=0.12, farthest=1.5, incidence=math.radians(65.0))

WHEEL_SEPARATION = 0.053
STEP_NS = 5_000_000
_FIRST_FACE_ID, _FIRST_LANDMARK_ID = 10, 100


@dataclass(frozen=True)
class EightSettings:
    """Settings of a run."""

    seed: int = 1  # Two runs with the same settings are identical
    duration_s: float = 54.0  # [s]
    # How many, evenly spread over the eight; 5 or another odd number never meet in its middle
    robots: int = 5
    speed: float = 0.06  # [m/s]
    errors: ErrorModel = W0  # The imperfections
    odometry_rate_hz: float = 20.0  # 20, 25, 40 or 50 are multiples of the simulation's step
    start_known: bool = True  # Whether the description has the start poses


def simulate_eight(
    settings: EightSettings,
    as_it_is: Callable[[Swarm], Swarm] = lambda described: described,
    moved: Callable[[Trajectories], Trajectories] = lambda truth: truth,
) -> SimulatedRun:
    """Drive the eight and record odometry and sightings.

    Args:
        settings: Of the run.
        as_it_is: From the described swarm to the one that cameras see.
        moved: Changes true poses without any odometry.
    """
    rng = np.random.default_rng(settings.seed)
    swarm, driven, odometry = drive_eight(rng, settings)
    truth = moved(driven)
    exposures = camera_exposures(rng, settings.robots, truth)
    frames, sightings = observe_markers(rng, as_it_is(swarm), truth, exposures, VIEW, settings.errors)
    return SimulatedRun(swarm, truth, odometry, frames, sightings)


def camera_exposures(rng: np.random.Generator, robots: int, truth: Trajectories) -> Exposures:
    """When the cameras expose; late enough that images may be older than their stamps."""
    return schedule_exposures(
        rng, robots, CAMERA_RATE_HZ, int(truth.stamp_ns[0]) + 200_000_000, int(truth.stamp_ns[-1])
    )


def drive_eight(rng: np.random.Generator, settings: EightSettings) -> tuple[Swarm, Trajectories, Records]:
    """Drive the eight; results as of `drive_robots`."""
    path, offset = Lemniscate(HALF_WIDTH), _offsets(settings.robots)
    control = follow(path, offset, settings.speed, STEP_NS * 1e-9)
    return drive_robots(rng, settings, eight_starts(settings.robots), control)


def drive_robots(
    rng: np.random.Generator, settings: EightSettings, start: FloatArray, control: Controller
) -> tuple[Swarm, Trajectories, Records]:
    """Drive robots from `start` (N, 3): the swarm as described, where it went, and its odometry."""
    model = Drive(WHEEL_SEPARATION, settings.errors.wheel_noise, settings.errors.turn_slip)
    duration_s, rate_hz = settings.duration_s, settings.odometry_rate_hz
    truth, odometry = record_drive(
        rng, start, control, model, step_ns=STEP_NS, duration_s=duration_s, odometry_rate_hz=rate_hz
    )
    return describe(settings, start), truth, odometry


def describe(settings: EightSettings, start: FloatArray, first_face_id: int = _FIRST_FACE_ID) -> Swarm:
    """The swarm description; `start` is (N, 3) in map, each robot has ten ids."""
    odometry = OdometryModel(wheel_separation=WHEEL_SEPARATION, wheel_noise=settings.errors.wheel_noise)
    robots = tuple(
        Robot(
            name=f"epuck{index + 1}",
            type="epuck",
            odometry=odometry,
            camera=CAMERA,
            sensor=settings.errors.described,
            faces=faces(first_face_id + 10 * index),
            start=rounded(pose) if settings.start_known else None,
            start_sigma=StartSigma(),
        )
        for index, pose in enumerate(start)
    )
    return Swarm(robots, wall_markers())


def faces(first_id: int) -> tuple[Face, ...]:
    """Five markers around a robot; the camera looks out to the front between two of them."""
    directions = [math.radians(angle) for angle in (36.0, 108.0, 180.0, -108.0, -36.0)]
    places = [(FACE_DISTANCE * math.cos(yaw), FACE_DISTANCE * math.sin(yaw), yaw) for yaw in directions]
    return tuple(
        Face(name, first_id + k, x, y, MARKER_HEIGHT, yaw)
        for k, (name, (x, y, yaw)) in enumerate(zip(FACE_NAMES, map(rounded, places), strict=True))
    )


def wall_markers() -> tuple[Landmark, ...]:
    """The landmarks: one every 0.4 m along each wall, facing inwards."""
    half_x, half_y = 0.5 * ARENA[0], 0.5 * ARENA[1]
    along_x = np.arange(-half_x + 0.5 * WALL_MARKER_PITCH, half_x, WALL_MARKER_PITCH)
    along_y = np.arange(-half_y + 0.5 * WALL_MARKER_PITCH, half_y, WALL_MARKER_PITCH)
    places = [(x, -half_y, 0.5 * math.pi) for x in along_x] + [(half_x, y, math.pi) for y in along_y]
    places += [(x, half_y, -0.5 * math.pi) for x in along_x[::-1]] + [
        (-half_x, y, 0.0) for y in along_y[::-1]
    ]
    return tuple(
        Landmark(_FIRST_LANDMARK_ID + k, x, y, MARKER_HEIGHT, yaw)
        for k, (x, y, yaw) in enumerate(map(rounded, places))
    )


@dataclass(frozen=True)
class ImageRun:
    """A simulated run whose cameras deliver images."""

    # Swarm, truth and odometry; its frames say which images arrive when, and have no sightings
    run: SimulatedRun
    settings: EightSettings  # Settings of the run
    camera: CameraModel  # Of all robots, as calibrated
    hidden: HiddenGeometry  # Where cameras and markers truly are

    def images(self) -> Iterator[NDArray[np.uint8]]:
        """The images (height, width) in the order of `run.frames`, drawn one by one."""
        arena = Arena(ARENA, family_named(FAMILY))
        seed = self.settings.seed
        rig = CameraRig(self.run.swarm, self.hidden, arena, self.camera, seed)
        for frame in self.run.frames:
            robot, stamp_ns = int(frame["robot"]), int(frame["stamp_ns"])
            rng = np.random.default_rng([seed, robot, stamp_ns])
            early_ns = round(1e9 * self.settings.errors.exposure_early_s * rng.random())
            yield rig.take(robot, stamp_ns - early_ns, self.run.truth, rng)


def simulate_eight_images(settings: EightSettings, camera: CameraModel) -> ImageRun:
    """Drive the eight with rendered images, which are delayed and lost as in `simulate_eight`."""
    rng = np.random.default_rng(settings.seed)
    swarm, truth, odometry = drive_eight(rng, settings)
    exposures = camera_exposures(rng, settings.robots, truth)
    hidden = hidden_geometry(rng, swarm, settings.errors)
    frames, nothing = deliver(
        rng,
        exposures,
        np.empty(0, np.int64),
        np.empty(0, SIGHTING_DTYPE),
        end_ns=int(truth.stamp_ns[-1]),
        loss=settings.errors.frame_loss,
    )
    return ImageRun(SimulatedRun(swarm, truth, odometry, frames, nothing), settings, camera, hidden)
