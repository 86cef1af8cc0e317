"""Ceiling cameras: twenty robots with flat markers under four overlapping cameras, from pictures to poses.

Bounds: position 0.3 cm and heading 0.5 degrees (root mean square), no jump by more than 0.3 cm when one
camera takes over from another, and all detectors and the estimator on one core. Images arrive 150 to 300 ms
late.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.scenarios.bags import places, wander
from bench.scenarios.eight_run import EightSettings, drive_robots
from bench.scenarios.lived_run import CAMERA_LATENESS, LivedRun, arrival_ns
from bench.shared.common import ProgressLine, plot_curves, rms
from bench.shared.simulated_run import (
    errors_of,
    estimates_of,
    inputs_between,
    odometry_rows,
    position_rmse,
    ticks,
)
from bench.vision.ceiling import CeilingRig
from swarm_loc_drivers.sim.render.lens import CameraModel
from swarm_loc_drivers.sim.render.rigs import Arena
from swarm_loc_drivers.sim.run import START_NS, Trajectories
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE
from swarm_loc_estimator.offline.metrics import nees
from swarm_loc_estimator.sensors.camera import DetectionRows
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import Face, FixedCamera, Swarm
from swarm_loc_estimator.timeline.estimator import Status
from swarm_loc_vision.aerial.ground_control import AerialSettings, FloorMarker, Ground, located
from swarm_loc_vision.aerial.locate_camera import fixed_camera
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector, detection_rows
from swarm_loc_vision.markers.families import family_named
from swarm_loc_vision.markers.pose import robot_body, up_of

DURATION_S = 20.0
_SETTLED_NS = 3 * 10**9  # From here on errors count
_HAND_OVER_NS = 500_000_000
"""Jumps count as those of a hand-over so long after a camera sees a robot anew or for the last time."""
_NEW_NS = 10**9  # A camera that did not see a robot for so long sees it anew


class Tracked(NamedTuple):
    """What the estimator made of a run."""

    stamp_ns: IntArray  # (K,) of ticks
    poses: FloatArray  # (K, N, 3), NaN before a robot is located
    errors: FloatArray  # (K, N, 3)
    nees: FloatArray  # (K, N)
    jumps: FloatArray  # (K, N) how far a tick moved a robot besides its odometry [m]
    hands_over: NDArray[np.bool_]  # (K, N) whether one camera has just taken over from another
    tracked: NDArray[np.bool_]  # (K, N)
    cpu_s: float  # Time that the estimator took [s]
    drops: Mapping[str, int]  # Data not used, by reason

    @property
    def counts(self) -> NDArray[np.bool_]:
        """(K, N) where errors count."""
        return self.tracked & (self.stamp_ns >= START_NS + _SETTLED_NS)[:, None]


def measure(seeds: Sequence[int], say: ProgressLine) -> dict[str, float]:
    """Run all seeds; draw the last one; return the figures."""
    runs, shares = [], []
    track(simulate_overhead(seeds[0], 2.0, say))  # compiles or loads what is timed next
    for seed in seeds:
        run = simulate_overhead(seed, DURATION_S, say)
        found = track(run)
        runs.append(found)
        shares.append((run.cpu_s / run.images * 4e9 / PERIOD_NS, found.cpu_s / run.duration_s))
        say(f"seed {seed}: dropped {dict(found.drops)}")
    print()
    distance, heading = 100.0 * np.hypot(*found.errors[..., :2].T).T, np.degrees(np.abs(found.errors[..., 2]))
    seconds = (found.stamp_ns - START_NS) * 1e-9
    curves = (("position error [cm]", distance), ("heading error [deg]", heading))
    plot_curves("inputs-overhead", *(("time [s]", label, seconds, {"": rows}) for label, rows in curves))
    jumps = np.concatenate([one.jumps[one.counts & one.hands_over] for one in runs])
    steady = np.concatenate([one.jumps[one.counts & ~one.hands_over] for one in runs])
    detectors, estimator = np.mean(shares, axis=0)
    begun = [one.stamp_ns > START_NS + 10**9 for one in runs]
    errors = np.concatenate([one.errors[one.counts] for one in runs])
    return {
        "overhead.position_cm": 100.0 * position_rmse(errors),
        "overhead.heading_deg": math.degrees(rms(se2.wrap_angle(errors[:, 2]))),
        "overhead.handover_jump_cm": 100.0 * float(jumps.max()),
        "overhead.handover_jump_rms_cm": 100.0 * rms(jumps),
        "overhead.other_jump_cm": 100.0 * float(steady.max()),
        "overhead.nees": float(np.mean(np.concatenate([one.nees[one.counts] for one in runs]))),
        "overhead.tracked_share": float(
            np.mean([one.tracked[some].mean() for one, some in zip(runs, begun, strict=True)])
        ),
        "overhead.detectors_share": float(detectors),
        "overhead.core_share": float(detectors + estimator),
    }


def track(run: OverheadRun) -> Tracked:
    """Run the estimator over a run in order of arrival, with a tick every 0.1 s."""
    ticks_ns = ticks(run)
    inputs = inputs_between(ticks_ns, odometry=odometry_rows(run), detections=run.detections)
    begun_s = time.process_time()
    estimates, (*_, estimator) = zip(*estimates_of(run.swarm, inputs, ticks_ns), strict=True)
    cpu_s = time.process_time() - begun_s
    poses, covariances, transforms = (
        np.array([one[k] for one in estimates])
        for k in (1, 2, 3)  # poses, covariances, map_to_odom
    )
    errors = errors_of(poses, run, ticks_ns)
    squared = np.full(errors.shape[:2], np.nan)
    known = np.isfinite(errors).all(axis=2)
    squared[known] = nees(errors[known], covariances[known])
    tracked = np.array([one.status for one in estimates]) == Status.TRACKED
    on_odometry = se2.between(transforms[1:], poses[1:])
    before = se2.compose(transforms[:-1], on_odometry)
    jumps = np.zeros(errors.shape[:2])
    jumps[1:] = np.linalg.norm(poses[1:, :, :2] - before[..., :2], axis=2)
    return Tracked(
        ticks_ns, poses, errors, squared, jumps, _hand_overs(run, ticks_ns), tracked, cpu_s, estimator.drops
    )


def _hand_overs(run: OverheadRun, ticks_ns: IntArray) -> NDArray[np.bool_]:
    """(K, N) ticks just after the stamps of images of a camera that sees a robot anew or for the last time.

    Only where another camera saw it within a second, too.
    """
    rows, found = run.detections, np.zeros((len(ticks_ns), ROBOTS), dtype=bool)
    for robot in range(ROBOTS):
        mine = rows.detection["id"] == robot
        stamps = [np.sort(rows.stamp_ns[mine & (rows.robot == ROBOTS + k)]) for k in range(4)]
        for camera, of_one in enumerate(stamps):
            others = np.concatenate([one for k, one in enumerate(stamps) if k != camera])
            gaps = (
                np.diff(of_one, prepend=-_NEW_NS, append=of_one[-1:].max(initial=0) + 2 * _NEW_NS) > _NEW_NS
            )
            edges = [*of_one[gaps[:-1]].tolist(), *of_one[gaps[1:]].tolist()]
            for edge_ns in edges:
                if others.size and np.abs(others - edge_ns).min() < _NEW_NS:
                    late = ticks_ns - edge_ns
                    found[(late > 0) & (late <= _HAND_OVER_NS), robot] = True
    return found


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
