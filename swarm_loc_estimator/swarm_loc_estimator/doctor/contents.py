"""Contents of messages: what the estimator drops or contradicts, unknown markers, other starts.

Images of the robots' cameras: calibration and encoding.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations
from types import MappingProxyType
from typing import Any

import numpy as np

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.doctor.evidence import Evidence, Finding, Heard, decoded, same_type
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.registry import SENSORS
from swarm_loc_estimator.timeline.contradictions import Contradicted, Contradiction
from swarm_loc_estimator.timeline.estimate import Status

CAMERA_INFO, IMAGE, COMPRESSED_IMAGE = (
    f"sensor_msgs/msg/{name}" for name in ("CameraInfo", "Image", "CompressedImage")
)
_EIGHT_BITS = (
    *("mono8", "8UC1", "rgb8", "bgr8", "8UC3", "rgba8", "bgra8", "8UC4"),
    *("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"),
)
IMAGE_ENCODINGS = frozenset(
    [
        *_EIGHT_BITS,
        *(name.replace("8", "16") for name in _EIGHT_BITS),
        *("yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21", "nv24"),
    ]
)
"""Encodings that the detectors of swarm_loc_vision read."""


def check_pictures(evidence: Evidence) -> Iterator[Finding]:
    """Cameras with images have intrinsics, and an encoding that the detectors read."""
    cameras = tuple(f"{robot.name}/" for robot in evidence.swarm.robots if robot.camera is not None)
    for name, heard in evidence.topics.items():
        is_compressed = same_type(heard.type, COMPRESSED_IMAGE)
        if not is_compressed and not same_type(heard.type, IMAGE):
            continue
        if not name.startswith(cameras) or not name.removesuffix("/compressed").endswith("image_raw"):
            continue
        if "depth" in name:
            continue
        images, malformed = decoded(heard)
        if malformed:
            yield Finding(name, f"has {malformed} messages that are no {heard.type}", "Rebuild its publisher")
        if not images:
            continue
        image = images[-1]
        if not is_compressed and not {image.encoding, image.encoding.lower()} & IMAGE_ENCODINGS:
            remedy = f"Publish one of {', '.join(sorted(IMAGE_ENCODINGS))}"
            yield Finding(
                name, f"has the encoding '{image.encoding}', which the detectors cannot read", remedy
            )
        # image_raw/compressed is a transport of image_raw, which has camera_info beside it
        namespace = name.removesuffix("/compressed").rpartition("/")[0]
        info_name = f"{namespace}/camera_info".lstrip("/")
        found = evidence.topics.get(info_name, Heard(""))
        infos = decoded(found)[0] if same_type(found.type, CAMERA_INFO) else []
        yield from _of_intrinsics(
            name, info_name, infos[-1] if infos else None, None if is_compressed else image
        )


def _of_intrinsics(name: str, info_name: str, info: Any, image: Any) -> Iterator[Finding]:
    """What is wrong with the newest CameraInfo beside an image, which may be None."""
    calibrate = "Calibrate the camera (camera_calibration) and let its driver load the file"
    if info is None:
        yield Finding(name, f"has no intrinsics: no message on {info_name}", calibrate)
    elif not info.k[0] > 0.0 or not info.k[4] > 0.0:
        yield Finding(info_name, "has intrinsics of zeros: the camera is not calibrated", calibrate)
    elif image is not None and (info.width, info.height) != (image.width, image.height):
        problem = f"is of {info.width} x {info.height} pixels but images have {image.width} x {image.height}"
        yield Finding(info_name, problem, "Calibrate at the resolution that the driver publishes")


_MIN_SIGHTINGS = 5  # Fewer sightings of an unknown marker are misread ones
_MIN_SHARE = 0.05  # Smaller shares of dropped readings are not named
_MIN_ROWS = 20
_AWAY_M, _TURNED, _AWAY_SIGMAS = 0.1, 0.35, 5.0
"""Least distance [m] and angle [rad] from a start that are named, and least multiple of its sigmas."""
_REASONS = MappingProxyType(
    {
        "no_camera": ("sees markers but has no camera in the description", "Describe its camera"),
        "no_odometry": ("publishes odometry but has none in the description", "Remove odometry: null"),
        "odometry_non_finite": ("publishes odometry that is not finite", "Look for NaN in its driver"),
        "odometry_absurd": ("publishes odometry beyond 1000 km", "Look at its driver and its units"),
        "imu_non_finite": (
            "publishes turn rates that are not finite",
            "Look for NaN in the driver of the IMU",
        ),
        "imu_absurd": ("publishes absurd turn rates", "Publish them in radians per second"),
        "non_finite": ("publishes measurements that are not finite", "Look for NaN in its detector"),
        "absurd": ("publishes measurements of absurd size", "Publish them in metres"),
        "bad_covariance": ("publishes invalid covariances", "Publish symmetric, positive ones, or zeros"),
        "bad_content": ("publishes detections with an unknown content", "Set content to one of CONTENT_*"),
        "own_marker": ("sees markers of its own", "Check the ids of the description"),
        "fix_without_covariance": (
            "gets fixes without covariance",
            "Publish one, or describe fix.position_sigma",
        ),
        "face_down": ("sees lying markers from below", "Check the pose of this camera in the description"),
        "not_flat": ("sees lying markers askew", "Check size and z of the markers, and the camera's pose"),
        "uwb_unknown_address": ("measures ranges to unknown addresses", "Describe these radios"),
    }
)
"""Reasons of drops -> what a robot or camera does, and what to do about it."""


def check_contents(evidence: Evidence) -> Iterator[Finding]:
    """Readings can be used."""
    yield from _unknown_markers(evidence)
    yield from _same_odometry(evidence)
    yield from _too_fast(evidence)
    readings = _readings(evidence)
    for index, source in enumerate(evidence.swarm.sources):
        for reason, count in evidence.converted[1].of_robot[index].items():
            if reason in _REASONS and count > _MIN_SHARE * readings[:, index].sum():
                problem, remedy = _REASONS[reason]
                yield Finding(source.name, f"{problem} ({count} times)", remedy)


def check_estimate(evidence: Evidence) -> Iterator[Finding]:
    """The estimator locates all robots, where they should be, and contradicts nothing."""
    estimated = evidence.estimated
    groups: dict[tuple[Contradicted, bool], list[Contradiction]] = {}
    for one in estimated.contradictions:
        groups.setdefault((one.kind, one.about.startswith("landmark")), []).append(one)
    for (kind, _), some in groups.items():
        problem, remedy = _CONTRADICTED[kind]
        verb = "is" if len(some) == 1 else "are"
        yield Finding(listed([one.about for one in some]), f"{verb} {problem}: {some[0].text}", remedy)
    yield from _other_starts(evidence)
    measures = [name not in ("odometry", "imu") for name in SENSORS]
    measured = _readings(evidence)[measures].sum(axis=0)
    seen = evidence.rows("detections").detection["id"]
    for index, robot in enumerate(evidence.swarm.robots):
        is_seen = (
            np.isin([face.id for face in robot.faces], seen).any() or evidence.rows("aerial").stamp_ns.size
        )
        is_helpless = robot.start is None and not measured[index] and not is_seen
        if estimated.status[index] == Status.WAITING and is_helpless:
            problem = "cannot be located: it has no start, measures nothing, and nobody sees it"
            yield Finding(robot.name, problem, "Give it a start, or a sensor and something to see")


def _other_starts(evidence: Evidence) -> Iterator[Finding]:
    """Robots that were not where their start is, by the first pose that was tracked."""
    tracks, estimated = OdometryTracks(evidence.swarm.robots), evidence.estimated
    rows = evidence.odometry
    tracks.extend(rows.robot, rows.stamp_ns, rows.pose, rows.twist)
    for index, robot in enumerate(evidence.swarm.robots):
        own = rows.robot == index
        if robot.start is None or estimated.begin_ns[index] < 0 or not own.any():
            continue
        if not evidence.is_at_start(index):
            continue
        stamps_ns = np.array(
            [rows.stamp_ns[own].min(), min(estimated.begin_ns[index], rows.stamp_ns[own].max())]
        )
        first, then = tracks.at(np.array([index, index]), stamps_ns).pose
        began = se2.compose(estimated.begin_pose[index], se2.between(then, first))
        away = math.hypot(*(began[:2] - np.array(robot.start[:2])))
        turned, spread = abs(float(se2.wrap_angle(began[2] - robot.start[2]))), robot.start_sigma
        is_away = away > max(_AWAY_M, _AWAY_SIGMAS * max(spread.x, spread.y))
        if is_away or turned > max(_TURNED, _AWAY_SIGMAS * spread.theta):
            problem = f"began at {began[0]:.2f}, {began[1]:.2f}, {began[2]:.2f} rad"
            problem += f", which is {away:.2f} m and {math.degrees(turned):.0f} deg from its start"
            yield Finding(robot.name, problem, "Put it there, correct start, or leave start out")


def _readings(evidence: Evidence) -> IntArray:
    """Number of readings (S, N) by sensor, of robots and cameras."""
    count = len(evidence.swarm.sources)
    robots = [evidence.rows(sensor).robot for sensor in SENSORS]
    return np.stack([np.bincount(one[one >= 0], minlength=count) for one in robots])


_CONTRADICTED = MappingProxyType(
    {
        Contradicted.ODOMETRY: ("contradicted by all else in odometry", "Check its driver and wheels"),
        Contradicted.RESET: ("reset in odometry", "Keep its driver running"),
        Contradicted.CONSTANT: (
            "constant in the pose of odometry",
            "Nothing, if twists are right: they are used",
        ),
        Contradicted.UNMOVED: (
            "moving with constant odometry",
            "Look at its driver and encoders; where it has none, describe a random_walk",
        ),
        Contradicted.POSE: ("elsewhere than expected", "Check its start, and the places of the landmarks"),
        Contradicted.SIGHTINGS: (
            "contradicted by sightings",
            "Check the mount of its camera, the size and ids of markers, and places of landmarks",
        ),
        Contradicted.DESCRIPTION: ("other than described", "Measure it again, or use survey or calibrate"),
        Contradicted.NOISE: ("noisier than described", "Use calibrate, or describe more noise"),
    }
)
"""What is contradicted, and what to do about it."""


def _unknown_markers(evidence: Evidence) -> Iterator[Finding]:
    """Markers that nobody describes."""
    detected = evidence.rows("detections").detection["id"]
    ids, counts = np.unique(detected, return_counts=True)
    unknown = {
        int(i): int(n)
        for i, n in zip(ids, counts, strict=True)
        if int(i) not in evidence.swarm.owner_of and n >= _MIN_SIGHTINGS
    }
    if unknown:
        most = sorted(unknown, key=lambda marker: -unknown[marker])
        which = listed([f"{marker} ({unknown[marker]} times)" for marker in most])
        remedy = "Describe them under landmarks, or ids of a robot; survey finds the places of landmarks"
        yield Finding(f"marker {which}", "was seen, but is in no description", remedy)


def _too_fast(evidence: Evidence) -> Iterator[Finding]:
    """Odometry whose usual speed is impossible, as in other units."""
    rows = evidence.odometry
    for index, robot in enumerate(evidence.swarm.robots):
        pose, stamp_ns = rows.pose[rows.robot == index], rows.stamp_ns[rows.robot == index]
        passed_s = 1e-9 * np.diff(stamp_ns)
        speed = np.hypot(*np.diff(pose[:, :2], axis=0).T)[passed_s > 0.0] / passed_s[passed_s > 0.0]
        if speed.size > _MIN_ROWS and np.median(speed) > robot.odometry.max_speed:
            problem = f"moves at {np.median(speed):.2g} m/s by its odometry, beyond max_speed"
            yield Finding(robot.name, problem, "Publish odometry in metres, or raise max_speed")


def _same_odometry(evidence: Evidence) -> Iterator[Finding]:
    """Two robots with the same odometry: one driver for two names."""
    rows = evidence.rows("odometry")
    poses = {robot: rows.pose[rows.robot == robot] for robot in np.unique(rows.robot).tolist()}
    moving = {
        robot: pose for robot, pose in poses.items() if len(pose) > _MIN_ROWS and np.ptp(pose[:, :2]) > 0.01
    }
    for one, other in combinations(moving, 2):
        count = min(len(moving[one]), len(moving[other]))
        if np.array_equal(moving[one][:count], moving[other][:count]):
            names = f"{evidence.source_name(one)} and {evidence.source_name(other)}"
            yield Finding(names, "have the same odometry", "Start a driver of its own for each robot")
