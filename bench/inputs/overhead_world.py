"""Twenty robots with markers on top under four ceiling cameras: drive, rendered images, detections.

Each camera hangs a little aside of where it was meant to and gets its pose from markers on the floor, whose
places have been measured with an error. The images of a camera come at 10 Hz, at a phase of its own, late
and out of order, and some are lost.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.vision.ceiling import CeilingRig
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena
from swarm_loc_drivers.sim.run import CAMERA_LATENESS, START_NS, LivedRun, Trajectories, arrival_ns
from swarm_loc_drivers.sim.scenarios.bags import places, wander
from swarm_loc_drivers.sim.scenarios.eight import EightSettings, drive_robots
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import Face, FixedCamera, Swarm
from swarm_loc_vision.aerial.ground_control import AerialSettings, FloorMarker, Ground, located
from swarm_loc_vision.aerial.locate_camera import fixed_camera
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector, detection_rows
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.pose import robot_body, up_of

ROBOTS, PERIOD_NS = 20, 100_000_000
ARENA = (4.6, 3.4)
FAMILY = family_named("aruco_mip_36h12")
MODEL = CameraModel(k1=-0.08, exposure_s=0.004)
TOP = Face("top", 0, 0.0, 0.0, 0.105, 0.0, size=0.05, lies=True)
PLACES = [(x, y) for x in (-1.1, 1.1) for y in (-0.8, 0.8)]  # Where the cameras are meant to hang
_HEIGHT = 2.5
_ASIDE, _TILT = 0.03, math.radians(1.5)
_FLOOR = [(x, y) for x in (-2.1, -1.1, 0.0, 1.1, 2.1) for y in (-1.5, 0.0, 1.5)]
"""Markers on the floor; those in the middle are seen by all cameras around, whose poses then agree there."""
_FIRST_FLOOR_ID, _SURVEY_SIGMA = 200, 0.001
_SHARED_BY_CORNERS = 2.0
"""The four corners of a marker share the error of its place, which counts as one of each."""
_CALIBRATION_IMAGES = 10
_LOSS = 0.02
_UNUSED_ID = 1000
_RESIDUAL = SensorModel(residual_position_sigma=0.0003, residual_heading_sigma=0.002)


@dataclass(frozen=True)
class OverheadRun(LivedRun):
    """A run under ceiling cameras."""

    hidden: tuple[FixedCamera, ...]  # Where the cameras truly hang
    detections: DetectionRows  # In order of arrival
    images: int  # Number of images
    cpu_s: float  # Time that the detectors took [s]
    picture: NDArray[np.uint8]  # An image


def simulate_overhead(seed: int, duration_s: float, say: Callable[[str], None]) -> OverheadRun:
    """Drive, render and detect."""
    # robots that drive around, with a marker on top
    rng = np.random.default_rng(seed)
    settings = EightSettings(seed, duration_s, ROBOTS, start_known=False)
    start = places(rng, ROBOTS, ARENA)
    driven, truth, odometry = drive_robots(rng, settings, start, wander(rng, ROBOTS, ARENA), _UNUSED_ID)
    robots = tuple(
        replace(robot, camera=None, faces=(replace(TOP, id=k),)) for k, robot in enumerate(driven.robots)
    )
    # cameras where they hang, and where locate_camera finds them
    hidden = tuple(_hung(f"ceiling{k + 1}", x, y, rng) for k, (x, y) in enumerate(PLACES))
    floor = [FloorMarker(_FIRST_FLOOR_ID + k, x, y, size=0.12) for k, (x, y) in enumerate(_FLOOR)]
    arena, begin_ns = Arena(ARENA, FAMILY), START_NS + PERIOD_NS
    cameras = _located(hidden, CeilingRig((), hidden, arena, MODEL, floor, seed), floor, truth, rng)
    rig = CeilingRig(robots, hidden, arena, MODEL, floor, seed)
    swarm = Swarm(robots, (), cameras)
    parts, stamps, cpu_s, images = [], [], 0.0, 0
    picture = rig.take(0, begin_ns, truth, rng)
    detectors = [_detector(swarm, camera) for camera in swarm.cameras]
    for detector in detectors[:1]:
        detector.detect(picture)  # compiled or loaded
    # images and what is detected in them
    phases = rng.integers(0, PERIOD_NS, len(cameras))
    end_ns = int(truth.stamp_ns[-1])
    for tick_ns in range(begin_ns, end_ns - 2 * PERIOD_NS, PERIOD_NS):
        say(f"seed {seed}, {(tick_ns - START_NS) * 1e-9:.0f} of {duration_s:.0f} s")
        for k, detector in enumerate(detectors):
            stamp_ns = tick_ns + int(phases[k])
            image = rig.take(k, stamp_ns, truth, rng)
            begun_s = time.process_time()
            found = detection_rows(detector.detect(image), DetectorSettings().ambiguity)
            cpu_s += time.process_time() - begun_s
            images += 1
            if rng.random() >= _LOSS:
                parts.append(found)
                stamps.append((ROBOTS + k, stamp_ns))
    # detections in order of arrival
    source, stamp_ns_of = np.array(stamps).T
    arrivals_ns = arrival_ns(rng, stamp_ns_of, CAMERA_LATENESS)
    order = [k for k in np.argsort(arrivals_ns, kind="stable").tolist() if arrivals_ns[k] <= end_ns]
    counts = [len(parts[k]) for k in order]
    rows = np.concatenate([parts[k] for k in order], dtype=DETECTION_DTYPE)
    robot, stamp, arrival = (np.repeat(one[order], counts) for one in (source, stamp_ns_of, arrivals_ns))
    seen = DetectionRows(robot, stamp, rows, arrival)
    return OverheadRun(swarm, truth, odometry, hidden, seen, images, cpu_s, picture)


def _located(
    hidden: Sequence[FixedCamera],
    rig: CeilingRig,
    floor: Sequence[FloorMarker],
    truth: Trajectories,
    rng: np.random.Generator,
) -> tuple[FixedCamera, ...]:
    """The cameras as described, from images of the empty arena."""
    ground = Ground(markers=tuple(_measured(one, rng) for one in floor), family=FAMILY)
    empty, cameras = Trajectories(truth.stamp_ns, truth.poses[:, :0]), []
    for k, camera in enumerate(hidden):
        stamps_ns = [START_NS + image * PERIOD_NS for image in range(1, _CALIBRATION_IMAGES + 1)]
        pictures = [rig.take(k, stamp_ns, empty, rng) for stamp_ns in stamps_ns]
        fit = located(ground, MODEL.camera, pictures, _CONTROL)
        cameras.append(replace(fixed_camera(camera.name, fit.ground, TOP.z), sensor=_RESIDUAL))
    return tuple(cameras)


_CONTROL = AerialSettings(control_sigma_px=0.1, control_sigma=_SHARED_BY_CORNERS * _SURVEY_SIGMA)


def _hung(name: str, x: float, y: float, rng: np.random.Generator) -> FixedCamera:
    """A camera near the place that it was meant for, and nearly straight down."""
    dx, dy, dz = (_ASIDE * rng.standard_normal(3)).tolist()
    pitch, roll = (_TILT * rng.standard_normal(2)).tolist()
    return FixedCamera(name, x + dx, y + dy, _HEIGHT + dz, 0.5 * math.pi, 0.5 * math.pi + pitch, roll)


def _measured(marker: FloorMarker, rng: np.random.Generator) -> FloorMarker:
    """A marker on the floor where it was measured to lie."""
    dx, dy = (_SURVEY_SIGMA * rng.standard_normal(2)).tolist()
    return replace(marker, x=marker.x + dx, y=marker.y + dy)


def _detector(swarm: Swarm, camera: FixedCamera) -> MarkerDetector:
    """The detector of a camera, as `marker_detector_node` creates it."""
    faces = [face for robot in swarm.robots for face in robot.faces]
    return MarkerDetector(
        DetectorSettings(),
        {FAMILY: np.array(sorted(face.id for face in faces))},
        MODEL.camera,
        lengths={face.id: face.size for face in faces},
        up=up_of(camera),
        lying=[face.id for face in faces],
        bodies=[robot_body(robot) for robot in swarm.robots],
    )
