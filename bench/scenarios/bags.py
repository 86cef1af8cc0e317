"""Write simulated runs as bags, as a recorder of the real swarm would have left them.

Among them are e-pucks that wander at random, seen by a camera above that cannot tell them apart. They drive
and turn at speeds of their own, which change every now and then, turn back at the arena's edge, and stop and
turn before others. The camera sees all of it; it misses some robots, and takes other things for robots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.scenarios.droplets_run import FIX_HEADING_SIGMA, FIX_SIGMA, DropletRun
from bench.scenarios.eight_run import STEP_NS, EightSettings, ImageRun, drive_robots
from bench.scenarios.lived_run import CAMERA_LATENESS, LivedRun, Records, SimulatedRun, arrival_ns, survivors
from swarm_loc_drivers.common.calibration_file import CameraCalibration
from swarm_loc_drivers.sim.differential_drive import Controller
from swarm_loc_drivers.sim.run import START_NS
from swarm_loc_drivers.sim.scenarios.eight import ARENA
from swarm_loc_drivers.sim.worlds import W0
from swarm_loc_estimator import CONTENT_POSE
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.writer import Stream, write_streams
from swarm_loc_estimator.common.messages.cdr import (
    ANONYMOUS_DETECTIONS,
    BRIGHTNESS,
    DETECTIONS,
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    encode,
)
from swarm_loc_estimator.common.messages.detections import (
    ANONYMOUS_DTYPE,
    blank_detections,
    encode_brightness,
    encode_detections,
)
from swarm_loc_estimator.common.messages.poses import (
    encode_fix,
    encode_odometry,
    encode_pose_stamped,
)
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import save_swarm

PERIOD_NS = 500_000_000
_SIGMA = 0.008
_DETECTED = 0.95
_FALSE = 0.1  # Mean number of false detections of an image
_SPEEDS, _TURN_RATE = (0.03, 0.10), 0.8
_CHANGES_S = (0.5, 3.0)
_EDGE, _NEAR = 0.2, 0.13
_HOMING_GAIN = 3.0


@dataclass(frozen=True)
class AerialRun(LivedRun):
    """A simulated swarm with an overhead camera that cannot tell robots apart."""

    stamp_ns: IntArray  # (k,) exposure of each image, in order of arrival
    arrival_ns: IntArray  # (k,)
    images: tuple[np.typing.NDArray[np.void], ...]  # (k) of each the detections (n,) of ANONYMOUS_DTYPE


def simulate_wandering(settings: EightSettings) -> AerialRun:
    """Drive robots about at random and look at them from above; each robot has a speed of its own."""
    rng = np.random.default_rng(settings.seed)
    start = places(rng, settings.robots, ARENA)
    swarm, truth, odometry = drive_robots(rng, settings, start, wander(rng, settings.robots, ARENA))
    blind = Swarm(tuple(replace(robot, camera=None, faces=()) for robot in swarm.robots))
    stamp_ns = np.arange(START_NS + PERIOD_NS, int(truth.stamp_ns[-1]), PERIOD_NS)
    poses = truth.all_at(stamp_ns)
    images = [_overhead_image(rng, poses[k]) for k in range(stamp_ns.size)]
    arrivals_ns = arrival_ns(rng, stamp_ns, CAMERA_LATENESS)
    come = rng.random(stamp_ns.size) >= W0.frame_loss
    order = [
        int(k)
        for k in np.argsort(arrivals_ns, kind="stable")
        if come[k] and arrivals_ns[k] < truth.stamp_ns[-1]
    ]
    return AerialRun(
        blind, truth, odometry, stamp_ns[order], arrivals_ns[order], tuple(images[k] for k in order)
    )


def places(rng: np.random.Generator, robots: int, arena: tuple[float, float]) -> FloatArray:
    """Start poses (N, 3) in an arena [m] that are not too near to each other."""
    half = 0.5 * np.array(arena) - _EDGE
    chosen: list[FloatArray] = []
    while len(chosen) < robots:
        place = rng.uniform(-half, half)
        if all(np.hypot(*(place - other)) > 2.0 * _NEAR for other in chosen):
            chosen.append(place)
    return np.column_stack([np.array(chosen), rng.uniform(-np.pi, np.pi, robots)])


def wander(rng: np.random.Generator, robots: int, arena: tuple[float, float]) -> Controller:
    """Commands in an arena [m] that change at random, each robot's at times of its own."""
    speed, rate, left_s = np.zeros(robots), np.zeros(robots), np.zeros(robots)
    half = 0.5 * np.array(arena) - _EDGE

    def control(_step: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        new = left_s <= 0.0
        speed[new] = rng.uniform(*_SPEEDS, int(new.sum()))
        rate[new] = rng.uniform(-_TURN_RATE, _TURN_RATE, int(new.sum()))
        left_s[new] = rng.uniform(*_CHANGES_S, int(new.sum()))
        left_s[:] -= STEP_NS * 1e-9
        home = se2.wrap_angle(np.arctan2(-pose[:, 1], -pose[:, 0]) - pose[:, 2])
        out = (np.abs(pose[:, :2]) > half).any(axis=1)
        turn = np.where(out, np.clip(_HOMING_GAIN * home, -2.0, 2.0), rate)
        away = pose[None, :, :2] - pose[:, None, :2]
        ahead = away[..., 0] * np.cos(pose[:, 2])[:, None] + away[..., 1] * np.sin(pose[:, 2])[:, None]
        blocked = ((np.hypot(away[..., 0], away[..., 1]) < _NEAR) & (ahead > 0.0)).any(axis=1)
        return np.where(blocked, 0.0, speed), np.where(blocked, _TURN_RATE, turn)

    return control


def _overhead_image(rng: np.random.Generator, poses: FloatArray) -> np.typing.NDArray[np.void]:
    """Detections in an image of robots at poses (N, 3): positions in random order."""
    seen = poses[rng.random(len(poses)) < _DETECTED, :2]
    half = 0.5 * np.array(ARENA)
    false = rng.uniform(-half, half, (rng.poisson(_FALSE), 2))
    places = np.concatenate([seen + rng.normal(0.0, _SIGMA, seen.shape), false])
    image = np.zeros(len(places), dtype=ANONYMOUS_DTYPE)
    order = rng.permutation(len(places))
    image["x"], image["y"] = places[order].T
    image["theta"] = image["u_px"] = image["v_px"] = np.nan
    image["covariance"] = np.diag([_SIGMA**2, _SIGMA**2, np.pi**2])
    return image


TRUTH_PERIOD_NS = 100_000_000
SATURATION = 240  # As the drivers report it: full scale less the largest ambient light [count]
LOSS = 0.05  # Share of brightness matrices and fixes that never arrive
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JPEG_QUALITY = 85


def write_bag(run: SimulatedRun, folder: Path, comment: str) -> int:
    """Write `<robot>/odom`, `<robot>/detections` and `<robot>/ground_truth` of all robots to a new folder.

    Log times are times of arrival, so that lateness is real on replay. The comment, where the run comes from,
    is the beginning of `swarm.yaml`. Returns the number of messages.

    Raises:
        BagError: The folder exists already, or cannot be created.
    """
    detections = as_detections(run)
    return _write_run(run, folder, comment, lambda robot: [_detection_stream(run, robot, detections)])


def write_aerial_bag(run: AerialRun, folder: Path, comment: str) -> int:
    """Write `aerial/detections`, and per robot `odom` and `ground_truth`; see `write_bag`."""
    data = [
        encode_detections("map", stamp_ns, image)
        for stamp_ns, image in zip(run.stamp_ns.tolist(), run.images, strict=True)
    ]
    aerial = Stream("aerial/detections", ANONYMOUS_DETECTIONS, run.arrival_ns, data)
    return _write_run(run, folder, comment, lambda _: [], aerial)


def write_droplet_bag(run: DropletRun, folder: Path, comment: str, seed: int) -> int:
    """Write per robot `odom`, `brightness`, `fix` and `ground_truth`; see `write_bag`.

    The seed fixes what is late and what is lost.
    """

    def sensors(robot: int) -> list[Stream]:
        rng = np.random.default_rng([seed, robot])
        published = [_brightness(run, robot), _fixes(run, robot)]
        return [_arriving(rng, run, one) for one in published if one.data or one.type == BRIGHTNESS]

    return _write_run(run, folder, comment, sensors)


def write_image_bag(recorded: ImageRun, folder: Path, comment: str) -> int:
    """Write per robot `image_raw/compressed` (as image_transport), `camera_info`, `odom` and `ground_truth`.

    See `write_bag`.
    """
    run, frames = recorded.run, recorded.run.frames
    headers = [
        {"stamp": stamp_ns, "frame_id": f"{run.swarm.robots[robot].name}/camera_optical_frame"}
        for robot, stamp_ns in zip(frames["robot"].tolist(), frames["stamp_ns"].tolist(), strict=True)
    ]
    images = [_image(header, image) for header, image in zip(headers, recorded.images(), strict=True)]
    infos = [_info(header, recorded.camera.calibration) for header in headers]

    def sensors(robot: int) -> list[Stream]:
        name, own = run.swarm.robots[robot].name, np.flatnonzero(frames["robot"] == robot)
        arrival_ns = frames["arrival_ns"][own]
        return [
            Stream(f"{name}/camera_info", CAMERA_INFO, arrival_ns, [infos[k] for k in own]),
            Stream(f"{name}/image_raw/compressed", COMPRESSED_IMAGE, arrival_ns, [images[k] for k in own]),
        ]

    return _write_run(run, folder, comment, sensors)


def _write_run(
    run: LivedRun, folder: Path, comment: str, sensors: Callable[[int], Sequence[Stream]], *shared: Stream
) -> int:
    """Write topics of the swarm, and per robot odometry, `sensors(robot)` and ground truth."""
    streams = list(shared)
    for robot in range(len(run.swarm.robots)):
        streams += [odometry_stream(run, robot), *sensors(robot), truth_stream(run, robot)]
    return write_swarm_bag(streams, run.swarm, folder, comment)


def write_swarm_bag(streams: Sequence[Stream], swarm: Swarm, folder: Path, comment: str) -> int:
    """Write topics in order of arrival, and `swarm.yaml`; arguments and errors as for `write_bag`."""
    return write_streams(folder, streams, add=lambda part: save_swarm(swarm, part / "swarm.yaml", comment))


def odometry_stream(run: LivedRun, robot: int) -> Stream:
    """The robot's odometry; velocities are those of the step before each message."""
    name = run.swarm.robots[robot].name
    rows = run.odometry[run.odometry["robot"] == robot]
    by_stamp = np.argsort(rows["stamp_ns"], kind="stable")
    stamps_s = (rows["stamp_ns"][by_stamp] - run.start_ns) * 1e-9
    pose = rows["pose"][by_stamp]
    twist = np.zeros((len(rows), 3))
    motion = se2.log(se2.between(pose[:-1], pose[1:]))
    twist[by_stamp[1:]] = motion / np.diff(stamps_s)[:, None]
    data = encode_odometry(f"{name}/odom", f"{name}/base_link", rows["stamp_ns"], rows["pose"], twist)
    return Stream(f"{name}/odom", ODOMETRY, rows["arrival_ns"], data)


def truth_stream(run: LivedRun, robot: int) -> Stream:
    """The robot's true poses, ten times a second."""
    stamp_ns = np.arange(run.start_ns, run.end_ns + 1, TRUTH_PERIOD_NS)
    data = encode_pose_stamped("map", stamp_ns, run.truth.at(robot, stamp_ns))
    return Stream(f"{run.swarm.robots[robot].name}/ground_truth", POSE_STAMPED, stamp_ns, data)


def _detection_stream(run: SimulatedRun, robot: int, detections: Records) -> Stream:
    """The robot's images, including empty ones, which show that the camera works."""
    name = run.swarm.robots[robot].name
    frames = run.frames[run.frames["robot"] == robot]
    optical_frame = f"{name}/camera_optical_frame"
    data = [
        encode_detections(optical_frame, stamp_ns, detections[first : first + count])
        for _, stamp_ns, _, first, count in frames.tolist()
    ]
    return Stream(f"{name}/detections", DETECTIONS, frames["arrival_ns"], data)


def as_detections(run: SimulatedRun) -> Records:
    """All sightings (S,) of a run, of DETECTION_DTYPE; markers stand upright at their described heights."""
    markers = run.swarm.owner_of
    camera_height = np.array([0.0 if r.camera is None else r.camera.z for r in run.swarm.robots])
    observer = np.repeat(run.frames["robot"], run.frames["count"])
    height = np.array([markers[int(marker)].marker.z for marker in run.sightings["marker_id"]])
    forward, left, heading = run.sightings["value"].T
    detections = blank_detections(run.sightings["marker_id"], CONTENT_POSE)
    detections["position"] = np.column_stack([-left, camera_height[observer] - height, forward])
    detections["orientation"] = marker_orientation(heading)
    return detections


def marker_orientation(heading: np.typing.NDArray[np.float64]) -> np.typing.NDArray[np.float64]:
    """Quaternions (S, 4) x y z w, in the optical frame, of upright markers.

    `heading` (S,) is the direction out of the face [rad], 0 along the optical axis, positive to the left.
    """
    sin, cos, zero = np.sin(heading), np.cos(heading), np.zeros_like(heading)
    right = np.stack([-cos, zero, -sin], axis=-1)
    up = np.stack([zero, zero - 1.0, zero], axis=-1)
    out = np.stack([-sin, zero, cos], axis=-1)
    quaternions: np.typing.NDArray[np.float64] = Rotation.from_matrix(
        np.stack([right, up, out], axis=-1)
    ).as_quat()
    return quaternions


def _arriving(rng: np.random.Generator, run: DropletRun, stream: Stream) -> Stream:
    """The part of a stream that arrives, with times of arrival in place of times of publication."""
    late_ns = arrival_ns(rng, stream.log_ns, CAMERA_LATENESS)
    kept = np.flatnonzero(survivors(rng, len(stream.data), LOSS) & (late_ns <= run.end_ns))
    return stream._replace(log_ns=late_ns[kept], data=[stream.data[k] for k in kept])


def _brightness(run: DropletRun, robot: int) -> Stream:
    """The robot's brightness matrices, by time of publication."""
    name, board = run.swarm.robots[robot].name, run.swarm.robots[robot].ir
    assert board is not None  # noqa: S101 - all Droplets have one
    own = [one for one in run.matrices if one.receiver == robot]
    data = [
        encode_brightness(
            f"{name}/base_link",
            one.brightness.stamp_ns,
            (board.id, one.brightness.transmitter),
            one.brightness.readings,
            int(one.brightness.power),
            SATURATION,
        )
        for one in own
    ]
    published_ns = np.array([one.published_ns for one in own], dtype=np.int64)
    return Stream(f"{name}/brightness", BRIGHTNESS, published_ns, data)


def _fixes(run: DropletRun, robot: int) -> Stream:
    own = [fix for fix in run.fixes if fix.robot == robot]
    covariance = np.diag([FIX_SIGMA**2, FIX_SIGMA**2, FIX_HEADING_SIGMA**2])
    data = [encode_fix("map", fix.stamp_ns, fix.pose, covariance) for fix in own]
    stamps_ns = np.array([fix.stamp_ns for fix in own], dtype=np.int64)
    return Stream(f"{run.swarm.robots[robot].name}/fix", POSE_WITH_COVARIANCE, stamps_ns, data)


def _image(header: dict[str, Any], image: NDArray[np.uint8]) -> bytes:
    """A grey image as sensor_msgs/CompressedImage."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    message = {"header": header, "format": "mono8; jpeg compressed mono8", "data": data}
    return encode(message, COMPRESSED_IMAGE)


def _info(header: dict[str, Any], calibration: CameraCalibration) -> bytes:
    """The calibration as sensor_msgs/CameraInfo."""
    message = {
        "header": header,
        "height": calibration.height,
        "width": calibration.width,
        "distortion_model": calibration.model,
        "d": calibration.distortion,
        "k": calibration.matrix,
        "r": calibration.rectification,
        "p": calibration.projection,
    }
    return encode(message, CAMERA_INFO)
