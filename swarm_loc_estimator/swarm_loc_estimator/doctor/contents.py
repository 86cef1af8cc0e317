"""Contents of messages: pictures, odometry and sightings, and what the estimator drops or contradicts.

Odometry is compared with sightings of static landmarks: scales, mounts and signs that cannot both be right.
A landmark stands at l = R (A d + m) + p in the odometry frame of a robot with pose (p, R), camera at m and
sighting d. A is a scale and a rotation, which commute with R, so R d = B l - B (p + R m) with B = 1 / A. This
is linear in B and, per landmark, in B l, which differences to the mean remove. The noisy sightings are on
the left, so their noise does not bias B. If B fits a mirrored track better than the true one, a sign is
wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import combinations, product
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.doctor.evidence import Evidence, Finding, Heard, decoded
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.offline.recorded_bag import same_type
from swarm_loc_estimator.sensors.camera import CONTENT_BEARING, FROM_OPTICAL
from swarm_loc_estimator.sensors.inputs import SENSORS
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.swarm.swarm import CameraMount, Robot
from swarm_loc_estimator.timeline.estimate import GYROSCOPE_OF, Contradicted, Contradiction, Status

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_GREY = "mono8 8UC1 rgb8 bgr8 8UC3 rgba8 bgra8 8UC4 bayer_rggb8 bayer_bggr8 bayer_gbrg8 bayer_grbg8"
_YUV = "yuv422 uyvy yuv422_yuy2 yuyv nv12 nv21 nv24"
IMAGE_ENCODINGS = frozenset(f"{_GREY} {_GREY.replace('8', '16')} {_YUV}".split())
"""Encodings that the detectors of swarm_loc_vision read."""


def check_pictures(evidence: Evidence) -> Iterator[Finding]:
    """Cameras with images have intrinsics, and an encoding that the detectors read."""
    cameras = tuple(f"{robot.name}/" for robot in evidence.swarm.robots if robot.camera is not None)
    for name, heard in evidence.topics.items():
        is_compressed = same_type(heard.type, COMPRESSED_IMAGE)
        is_raw = name.removesuffix("/compressed").endswith("image_raw") and "depth" not in name
        if not (is_compressed or same_type(heard.type, IMAGE)) or not (is_raw and name.startswith(cameras)):
            continue
        images, malformed = decoded(heard)
        if malformed:
            yield Finding(name, f"has {malformed} messages that are no {heard.type}", "Rebuild its publisher")
        if not images:
            continue
        image = images[-1][1]
        if not is_compressed and not {image.encoding, image.encoding.lower()} & IMAGE_ENCODINGS:
            problem = f"has the encoding '{image.encoding}', which the detectors cannot read"
            yield Finding(name, problem, f"Publish one of {', '.join(sorted(IMAGE_ENCODINGS))}")
        # image_raw/compressed is a transport of image_raw, which has a camera_info, too
        namespace = name.removesuffix("/compressed").rpartition("/")[0]
        info_name = f"{namespace}/camera_info".lstrip("/")
        found = evidence.topics.get(info_name, Heard(""))
        infos = decoded(found)[0] if same_type(found.type, CAMERA_INFO) else []
        info = infos[-1][1] if infos else None
        calibrate = "Calibrate the camera (camera_calibration) and let its driver load the file"
        if info is None:
            yield Finding(name, f"has no intrinsics: no message on {info_name}", calibrate)
        elif not info.k[0] > 0.0 or not info.k[4] > 0.0:
            yield Finding(info_name, "has intrinsics of zeros: the camera is not calibrated", calibrate)
        elif not is_compressed and (info.width, info.height) != (image.width, image.height):
            sizes = f"{info.width} x {info.height} pixels but images have {image.width} x {image.height}"
            remedy = "Calibrate at the resolution that the driver publishes"
            yield Finding(info_name, f"is of {sizes}", remedy)


# Limits of the doctor are checked by test_doctor.py with the set-ups of wrong_setups.py.
_MIN_SIGHTINGS = 5  # Fewer sightings of an unknown marker are misread ones
_MIN_SHARE = 0.05  # Smaller shares of dropped readings are not named
_MIN_ROWS = 20
_AWAY_M, _TURNED, _AWAY_SIGMAS = 0.1, 0.35, 5.0  # Least ones named [m, rad], and multiple of start sigmas
_REASONS = MappingProxyType(
    {
        "no_camera": ("sees markers but has no camera in the description", "Describe its camera"),
        "no_odometry": ("publishes odometry but has none in the description", "Remove odometry: null"),
        "odometry_non_finite": ("publishes odometry that is not finite", "Look for NaN in its driver"),
        "odometry_absurd": ("publishes odometry beyond 1000 km", "Look at its driver and its units"),
        "imu_no_rate": (
            "says by a covariance of -1 that its IMU measures no turn rates",
            "Set it in the driver if there is a gyroscope; else remove imu from the description",
        ),
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
    # markers that nobody describes
    ids, counts = np.unique(evidence.rows("detections").detection["id"], return_counts=True)
    is_unknown = ~np.isin(ids, [*evidence.swarm.owner_of]) & (counts >= _MIN_SIGHTINGS)
    ids, counts = ids[is_unknown], counts[is_unknown]
    if ids.size:
        which = listed([f"{ids[k]} ({counts[k]} times)" for k in np.argsort(-counts, kind="stable")])
        remedy = "Describe them under landmarks, or ids of a robot; survey finds the places of landmarks"
        yield Finding(f"marker {which}", "was seen, but is in no description", remedy)
    # two robots with the same odometry: one driver for two names
    rows = evidence.rows("odometry")
    poses = {robot: rows.pose[rows.robot == robot] for robot in np.unique(rows.robot).tolist()}
    long = {robot: pose for robot, pose in poses.items() if len(pose) > _MIN_ROWS}
    moving = {robot: pose for robot, pose in long.items() if np.ptp(pose[:, :2], axis=0).max() > 0.01}
    for one, other in combinations(moving, 2):
        count = min(len(moving[one]), len(moving[other]))
        if np.array_equal(moving[one][:count], moving[other][:count]):
            names = f"{evidence.source_name(one)} and {evidence.source_name(other)}"
            yield Finding(names, "have the same odometry", "Start a driver of its own for each robot")
    # odometry whose usual speed is impossible, as in other units
    rows = evidence.odometry
    for index, robot in enumerate(evidence.swarm.robots):
        pose, stamp_ns = rows.pose[rows.robot == index], rows.stamp_ns[rows.robot == index]
        passed_s = 1e-9 * np.diff(stamp_ns)
        speed = np.hypot(*np.diff(pose[:, :2], axis=0).T)[passed_s > 0.0] / passed_s[passed_s > 0.0]
        if speed.size > _MIN_ROWS and np.median(speed) > robot.odometry.max_speed:
            problem = f"moves at {np.median(speed):.2g} m/s by its odometry, beyond max_speed"
            yield Finding(robot.name, problem, "Publish odometry in metres, or raise max_speed")
    # readings that the estimator drops
    readings = _readings(evidence)
    for index, source in enumerate(evidence.swarm.sources):
        for reason, count in evidence.converted[1].of_robot[index].items():
            if reason in _REASONS and count > _MIN_SHARE * readings[:, index].sum():
                problem, remedy = _REASONS[reason]
                yield Finding(source.name, f"{problem} ({count} times)", remedy)


def check_estimate(evidence: Evidence) -> Iterator[Finding]:
    """The estimator locates all robots, where they should be, and contradicts nothing."""
    yield from _contradicted(evidence, {*Contradicted} - {Contradicted.GYROSCOPE} - _OUTER)
    yield from _other_starts(evidence)
    estimated = evidence.estimated
    measures = [name not in ("odometry", "imu") for name in SENSORS]
    measured = _readings(evidence)[measures].sum(axis=0)
    seen, is_overlooked = evidence.rows("detections").detection["id"], evidence.rows("aerial").stamp_ns.size
    for index, robot in enumerate(evidence.swarm.robots):
        is_seen = is_overlooked or np.isin([face.id for face in robot.faces], seen).any()
        is_helpless = robot.start is None and not measured[index] and not is_seen
        if estimated.status[index] == Status.WAITING and is_helpless:
            problem = "cannot be located: it has no start, measures nothing, and nobody sees it"
            yield Finding(robot.name, problem, "Give it a start, or a sensor and something to see")


_OUTER = {Contradicted.SUSPENDED, Contradicted.REPEATED, Contradicted.LATE, Contradicted.BACKWARDS}
"""Faults of sources apart from their robots."""


def check_sources(evidence: Evidence) -> Iterator[Finding]:
    """Fixed cameras, fixes, lidars and radios agree with the rest, whatever else is wrong."""
    return _contradicted(evidence, _OUTER)


def _contradicted(evidence: Evidence, kinds: set[Contradicted]) -> Iterator[Finding]:
    """What the estimator contradicts, a finding for each kind."""
    groups: dict[tuple[Contradicted, bool], list[Contradiction]] = {}
    for one in evidence.estimated.contradictions:
        if one.kind in kinds:
            groups.setdefault((one.kind, one.about.startswith("landmark")), []).append(one)
    for (kind, _), some in groups.items():
        problem, remedy = _CONTRADICTED[kind]
        verb = "is" if len(some) == 1 else "are"
        yield Finding(listed([one.about for one in some]), f"{verb} {problem}: {some[0].text}", remedy)


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
        begin_ns, end_ns = rows.stamp_ns[own].min(), rows.stamp_ns[own].max()
        stamps_ns = np.array([begin_ns, min(estimated.begin_ns[index], end_ns)])
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
        Contradicted.REPEATED: ("repeated", "Let its driver publish each range once"),
        Contradicted.LATE: ("late", "Set its delay_s as it says, then run doctor again"),
        Contradicted.BACKWARDS: ("backwards in time", "Correct its driver; poses are right meanwhile"),
        Contradicted.SUSPENDED: ("at odds with the rest", "Correct it, then run doctor again"),
    }
)
"""What is contradicted, and what to do about it."""


_WINDOW_NS = 6_000_000_000  # Odometry is trusted this long
_MIN_MOTION_ROWS, _MIN_MOTION_M = 30, 0.03  # Least sightings, and spread around means, for a verdict
_MIN_WINDOWS = 4  # For a verdict on scale and yaw: in a window, the drift of odometry is common to all
_ROUNDS = 8
_CLEARER = 0.75  # Residual of a mirrored track over that of the true one, below which the sign is wrong
_STANDS_M = 1e-4
_TINY = 1e-12  # Added to B, which is zero without any data
_SCALE, _YAW, _SIGNIFICANT = 0.15, math.radians(30.0), 8.0
"""Least errors of scale and yaw that are named, and multiple of their sigma: of 120 s of real robots without
these errors, one in ten is off by three sigmas, and the worst of 140 by seven."""
_DEGREES, _SLACK = 20.0, 0.3  # Ratios of a wrong gyroscope to wheels from which units or sign are named
_TURNED_RAD, _SHARE_TURNED = 1.0, 0.5  # Least turn by twists for a verdict, and share of it by headings
_AHEAD = 0.4  # Least usual share of the optical z axis in the directions of markers

Change = Callable[[FloatArray], FloatArray]
_WRONG: MappingProxyType[str, Change] = MappingProxyType(
    {
        "turns the other way than what its camera sees": lambda pose: pose * [1.0, -1.0, -1.0],
        "has headings of the wrong sign": lambda pose: pose * [1.0, 1.0, -1.0],
        "moves to the wrong side": lambda pose: pose * [1.0, -1.0, 1.0],
        "has x and y swapped": lambda pose: pose[:, [1, 0, 2]],
    }
)
"""What odometry may do wrong, and how it is undone for poses (k, 3)."""


def _check_turns(evidence: Evidence, index: int, own: OdometryRows) -> Iterator[Finding]:
    """What a gyroscope measures that the wheels contradict."""
    robot, kind = evidence.swarm.robots[index], Contradicted.GYROSCOPE
    about = [one.about for one in evidence.estimated.contradictions if one.kind is kind]
    if GYROSCOPE_OF + robot.name not in about:
        return
    tracks, rates = OdometryTracks([robot]), evidence.turn_rates
    rates = select(rates, rates.robot == index)
    tracks.extend_turns(np.zeros_like(rates.robot), rates.stamp_ns, rates.rate)
    tracks.extend(np.zeros_like(own.robot), own.stamp_ns, own.pose, own.twist)
    ratio = tracks.turn_ratio(0)
    remedy = "Look at its driver: is angular_velocity set, and its z axis vertical?"
    if ratio > _DEGREES:
        remedy = "Publish radians per second"
    elif ratio < -_SLACK:
        remedy = "Turns are positive to the left: correct its driver or mount (imu.roll)"
    yield Finding(f"{robot.name}'s gyroscope", f"measures {ratio:.2g} times the turns of the wheels", remedy)


def _check_headings(robot: Robot, own: OdometryRows) -> Iterator[Finding]:
    """Headings of odometry that do not turn as its twists say, in both halves of the recording."""
    own = select(own, np.argsort(own.stamp_ns, kind="stable"))
    second = (own.stamp_ns[1:] - own.stamp_ns[:1]) // 1_000_000_000  # in which headings and twists may lag
    seconds, second = np.unique(second, return_inverse=True)
    passed_s = 1e-9 * np.diff(own.stamp_ns)
    turns = se2.wrap_angle(np.diff(own.pose[:, 2])), np.nan_to_num(own.twist[1:, 2]) * passed_s
    turned, wanted = (np.bincount(second, weights, minlength=seconds.size) for weights in turns)
    shares = [
        float(turned[half] @ wanted[half] / (wanted[half] @ wanted[half]))
        for half in np.array_split(np.arange(seconds.size), 2)
        if np.abs(wanted[half]).sum() > _TURNED_RAD
    ]
    moves = own.robot.size > 0 and bool((np.ptp(own.pose[:, :2], axis=0) > _STANDS_M).any())
    if moves and len(shares) == 2 and max(shares) < _SHARE_TURNED:
        problem = f"has headings that turn {max(shares):.2g} times as its twists"
        remedy = "Correct the driver: it publishes the orientation, and angular.z in radians per second"
        yield Finding(f"{robot.name}'s odometry", problem, remedy)


class _Sightings(NamedTuple):
    """Landmarks that a robot saw."""

    position: FloatArray  # (k, 3) in the optical frame of its camera
    landmark: IntArray  # (k,) their ids
    stamp_ns: IntArray  # (k,) exposures
    window: IntArray  # (k,) numbers of the windows of time

    @property
    def halves(self) -> tuple[_Sightings, _Sightings]:
        """The first and the second half of them."""
        is_late = self.stamp_ns > np.median(self.stamp_ns)
        return select(self, ~is_late), select(self, is_late)

    @property
    def group(self) -> IntArray:
        """Number (k,) of the landmark and window of each."""
        return np.unique(np.stack([self.landmark, self.window]), axis=1, return_inverse=True)[1].ravel()


class _Alignment(NamedTuple):
    """What odometry is to be multiplied by to be as sightings, as complex numbers."""

    factor: complex  # Logarithm of the scale, and yaw [rad]
    sigma: complex  # Standard deviations of both
    residual: float  # [m]


def check_motion(evidence: Evidence) -> Iterator[Finding]:
    """Sightings of landmarks agree with odometry."""
    rows = evidence.odometry
    for index, robot in enumerate(evidence.swarm.robots):
        own, camera = select(rows, rows.robot == index), robot.camera
        yield from _check_turns(evidence, index, own)
        yield from _check_headings(robot, own)
        if camera is None:
            continue
        seen = _sightings(evidence, index, robot)
        if seen.stamp_ns.size < _MIN_MOTION_ROWS:
            continue
        if np.median(seen.position[:, 2] - _AHEAD * np.linalg.norm(seen.position, axis=1)) <= 0.0:
            problem = "publishes positions of markers that are not in front of it"
            remedy = "Publish them in the optical frame: x right, y down, z forward"
            yield Finding(robot.name, problem, remedy)
        elif own.robot.size > _MIN_MOTION_ROWS and not robot.stands:
            yield from _of_robot(robot, camera, own, seen)


def _sightings(evidence: Evidence, index: int, robot: Robot) -> _Sightings:
    rows = evidence.rows("detections")
    ids = [mark.id for mark in evidence.swarm.landmarks]
    mine = (rows.robot == index) & np.isin(rows.detection["id"], ids)
    mine &= rows.detection["content"] != CONTENT_BEARING
    mine &= np.isfinite(rows.detection["position"]).all(axis=1)
    seen, stamp_ns = rows.detection[mine], rows.stamp_ns[mine] + round(1e9 * robot.sensor.time_offset_s)
    window = (stamp_ns - stamp_ns.min(initial=np.iinfo(np.int64).max)) // _WINDOW_NS
    return _Sightings(seen["position"], seen["id"].astype(np.int64), stamp_ns, window)


def _of_robot(robot: Robot, camera: CameraMount, own: OdometryRows, seen: _Sightings) -> Iterator[Finding]:
    """What is wrong between the odometry and the camera of one robot, by both halves of the recording."""
    # odometry that stands
    twist_moves = np.nan_to_num(own.twist[:, [0, 2]]).any()
    if np.ptp(own.pose[:, :2], axis=0).max() < _STANDS_M and np.ptp(own.pose[:, 2]) < _STANDS_M:
        # how far landmarks move in the view, root mean square [m]
        away = _centred(seen.position, seen.group, np.ones(seen.stamp_ns.size))
        if not twist_moves and np.sqrt(np.mean(np.sum(away**2, axis=1))) > _MIN_MOTION_M:
            problem = "has odometry that stands while landmarks move in its camera"
            yield Finding(robot.name, problem, "Check its encoders, and that its driver reads them")
        return
    # signs: a changed track fits better
    worst = dict.fromkeys(_WRONG, 0.0)  # of both halves, the residual over that of the true track
    for what, half in product(_WRONG, seen.halves):
        true, other = (_fitted(robot, own, half, one, by_ranges=False) for one in (unchanged, _WRONG[what]))
        ratio = math.inf if true is None or other is None else other.residual / true.residual
        worst[what] = max(worst[what], ratio)
    best = min(worst, key=lambda what: worst[what])
    if worst[best] < _CLEARER:
        remedy = "Correct the driver: x forward, y left, angles counter-clockwise (REP 103)"
        yield Finding(f"{robot.name}'s odometry", best, remedy)
        return
    # scale and yaw
    fits = [_fitted(robot, own, some, unchanged, by_ranges=True) for some in (seen, *seen.halves)]
    found = [one for one in fits if one is not None]
    if len(found) < len(fits) or np.unique(seen.window).size < _MIN_WINDOWS:
        return
    factor, sigma = np.array([one.factor for one in found]), found[0].sigma
    if _is_clear(factor.real, sigma.real, _SCALE):
        scale = math.exp(factor[0].real)
        problem = f"sees landmarks {1.0 / scale:.2f} times as far as its odometry says"
        markers = f"the markers, whose size may be {scale:.2f} times what the detector assumes"
        yield Finding(robot.name, problem, f"Measure {markers}, and the robot's wheels")
    if _is_clear(factor.imag, sigma.imag, _YAW):
        yaw = float(factor[0].imag)
        problem = f"has a camera that is turned by {math.degrees(yaw):+.0f} deg from its description"
        yield Finding(robot.name, problem, f"Set camera.yaw to {camera.yaw + yaw:.3f}")


def unchanged(pose: FloatArray) -> FloatArray:
    """Poses (k, 3) as they are."""
    return pose


def _is_clear(values: FloatArray, sigma: float, least: float) -> bool:
    """Whether errors of the whole and of both halves exceed the least one to the same side."""
    is_same = bool(np.all(values[0] * values > least * np.abs(values[0])))
    return is_same and abs(values[0]) > _SIGNIFICANT * sigma


def _centred(values: FloatArray, group: IntArray, weight: FloatArray) -> FloatArray:
    """Values (k, c) less the weighted means of their groups."""
    total = np.maximum(np.bincount(group, weight), 1e-12)
    means = np.stack([np.bincount(group, weight * column) / total for column in values.T], axis=1)
    return np.asarray(values - means[group])


def _fitted(
    robot: Robot, own: OdometryRows, seen: _Sightings, undo: Change, *, by_ranges: bool
) -> _Alignment | None:
    """The fit with odometry whose poses are changed; None: the robot moves too little.

    With `by_ranges` a distance that all sightings have in addition is free. It takes up the distance from
    robot to landmark, and so what headings drift in a window, which turns sightings and looks like a yaw.
    """
    # sightings while there is odometry
    tracks = OdometryTracks([robot])
    tracks.extend(np.zeros(own.robot.size, dtype=np.int64), own.stamp_ns, undo(own.pose), None)
    zeros = np.zeros(seen.stamp_ns.size, dtype=np.int64)
    seen = select(seen, tracks.has_started(zeros, seen.stamp_ns) & (seen.stamp_ns <= own.stamp_ns.max()))
    camera, count = robot.camera, seen.stamp_ns.size
    if count < _MIN_MOTION_ROWS or camera is None:
        return None
    # R d, p + R m and the latter turned by a quarter, see the equation at the top
    pose = tracks.at(zeros[:count], seen.stamp_ns).pose
    level = Rotation.from_euler("ZYX", [camera.yaw, camera.pitch, camera.roll]).as_matrix() @ FROM_OPTICAL
    heading = pose * [0.0, 0.0, 1.0]
    view = (seen.position @ level.T)[:, :2] * robot.sensor.distance_scale
    sighted = se2.transform_points(heading, view)
    place = se2.transform_points(pose, np.tile([camera.x, camera.y], (count, 1)))
    columns = [sighted, place, np.stack([-place[:, 1], place[:, 0]], axis=1)]
    if by_ranges:
        columns.append(sighted / np.maximum(np.linalg.norm(sighted, axis=1), 1e-6)[:, None])
    # B = a + b i by weighted least squares on differences to the means, robustly
    group, window = seen.group, np.unique(seen.window, return_inverse=True)[1]
    weight, best, residual = np.ones(count), np.zeros(len(columns) - 1), 0.0
    products = np.zeros((window.max() + 1, len(columns), len(columns)))
    for _ in range(_ROUNDS):
        centred = np.stack([_centred(column, group, weight) for column in columns])
        products[:] = 0.0
        np.add.at(products, window, np.einsum("k,ikc,jkc->kij", weight, centred, centred))
        whole = products.sum(axis=0)
        if math.sqrt(whole[1, 1] / weight.sum()) < _MIN_MOTION_M:
            return None
        best = _solved(whole)
        error = np.linalg.norm(centred[0] + np.tensordot(best, centred[1:], axes=1), axis=1)
        residual = max(float(np.median(error)), 1e-4)
        weight = 1.0 / (1.0 + (error / (3.0 * residual)) ** 2)
    # without one window after the other (jackknife): errors of a window, as of headings, last
    count = len(products)
    solutions = best, _solved(whole - products)
    factor, others = (-np.log(one[..., 0] + _TINY + 1j * one[..., 1]) for one in solutions)
    away = (others - factor) * math.sqrt((count - 1) / count)
    sigma = complex(np.linalg.norm(away.real), np.linalg.norm(away.imag))
    return _Alignment(complex(factor), sigma, residual)


def _solved(products: FloatArray) -> FloatArray:
    """Coefficients (..., n) of columns whose sum with the first is least, by products (..., n + 1, n + 1)."""
    inverse = np.linalg.pinv(products[..., 1:, 1:])
    return np.asarray(-np.einsum("...ij,...j->...i", inverse, products[..., 1:, 0]))
