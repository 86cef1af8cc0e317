"""Camera detections to measurements: association by marker id, pose in the plane, covariance.

A detection is a marker's pose in the camera's optical frame (x right, y down, z forward). It is converted to
a measurement in the planar sensor frame: at the camera's position on the robot or, of a fixed camera, in
`map`, rotated by its yaw, with the mount's pitch and roll removed. A fixed camera is no robot, but the
mount of its measurements.

The tilt and the distance of a small marker in an image are uncertain, and the error of one is that of the
other. But a marker that lies flat has neither: its corners, projected by its measured pose into the image and
from there onto the plane in which it lies, tell its position and the direction of its x axis. These depend on
the pixels only, whichever of the two mirrored poses was measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.messages.cdr import DETECTIONS as MESSAGE_TYPE
from swarm_loc_estimator.common.messages.cdr import SWARM_DETECTIONS
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    SharedMessage,
    decode_shared_detections,
)
from swarm_loc_estimator.common.messages.streams import DetectionColumns, DetectionReader
from swarm_loc_estimator.common.numerics import assign
from swarm_loc_estimator.filter.measurements import NOBODY, Measurements, select
from swarm_loc_estimator.filter.models import BEARING, MODELS, POLAR, gate_threshold
from swarm_loc_estimator.sensors.sensor import (
    NO_ROWS,
    DropCounts,
    Known,
    Reader,
    Sensor,
    SensorSettings,
    SharedTopic,
    fill,
)
from swarm_loc_estimator.swarm.error_models import SensorModel
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, FixedCamera, Robot, Swarm


@cached_njit
def is_rotation(quaternion: FloatArray) -> bool:
    """Whether a quaternion (4,) is finite and not zero."""
    norm = 0.0
    for i in range(4):
        norm += quaternion[i] * quaternion[i]
    return math.isfinite(norm) and norm > 1e-12


@cached_njit
def to_level_frame(level: FloatArray, optical: FloatArray, factor: float, out: FloatArray) -> None:
    """Write a vector (3,) of the optical frame along the level axes forward, left, up, times a factor."""
    for i in range(3):
        out[i] = (level[i, 0] * optical[0] + level[i, 1] * optical[1] + level[i, 2] * optical[2]) * factor


@cached_njit
def write_rotation(quaternion: FloatArray, out: FloatArray) -> None:
    """Write the rotation matrix (3, 3) of a quaternion xyzw (4,) of any length."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    out[0, 0], out[1, 1] = w * w + x * x - y * y - z * z, w * w - x * x + y * y - z * z
    out[2, 2] = w * w - x * x - y * y + z * z
    out[0, 1], out[0, 2], out[1, 2] = 2.0 * (x * y - w * z), 2.0 * (x * z + w * y), 2.0 * (y * z - w * x)
    out[1, 0], out[2, 0], out[2, 1] = 2.0 * (x * y + w * z), 2.0 * (x * z - w * y), 2.0 * (y * z + w * x)
    out /= x * x + y * y + z * z + w * w


@cached_njit
def face_heading(level: FloatArray, quaternion: FloatArray) -> float:
    """Heading in the sensor plane of the z axis of an orientation xyzw (4,), the normal of a face."""
    rotation, axes = np.empty((3, 3)), np.empty(3)
    write_rotation(quaternion, rotation)
    to_level_frame(level, rotation[:, 2], 1.0, axes)
    return math.atan2(axes[1], axes[0])


CAST, FACE_DOWN, NOT_FLAT = range(3)
"""Results of `cast`: a pose in the plane; a marker that shows the floor; one that lies not as described."""
_GATE = float(gate_threshold(1.0 - 1e-6, 3))
_TILT_SIGMA = 0.05  # Standard deviation of the tilt of what lies, besides its measurement [rad]
_HEIGHT_SHARE, _HEIGHT_SIGMA = 0.02, 0.005
"""Standard deviation of a distance by the size of a marker: share of it, and [m]."""


@cached_njit
def cast(
    level: FloatArray,
    position: FloatArray,
    rotation: FloatArray,
    spread: FloatArray,
    size: float,
    height: float,
    value: FloatArray,
    noise: FloatArray,
) -> int:
    """Write the pose of a lying marker in the level frame of a camera, which `level` (3, 3) rotates to.

    Its position (3,), its rotation (3, 3) and their covariance (6, 6) are in the optical frame, its height is
    above the camera [m]. Written are forward, left [m] and the direction of the marker's x axis [rad], and
    the covariance (3, 3) of these.

    Returns:
        CAST; or FACE_DOWN or NOT_FLAT, and nothing is written.
    """
    # Does it lie face up in its plane?
    middle, axes = np.dot(level, position), np.dot(level, rotation)
    if not axes[2, 2] > 0.0:
        return FACE_DOWN
    if not _lies(level, middle, axes, spread, height):
        return NOT_FLAT
    # Cast rays through its corners to the plane of its height, with their Jacobians.
    ahead, aside, slopes = 0.0, 0.0, np.zeros((3, 6))
    along, across = np.zeros(6), np.zeros(6)
    value[0], value[1] = 0.0, 0.0
    for corner in range(4):
        a = 0.5 * size if corner in (1, 2) else -0.5 * size
        b = 0.5 * size if corner < 2 else -0.5 * size
        arm = rotation[:, 0] * a + rotation[:, 1] * b
        place = middle + axes[:, 0] * a + axes[:, 1] * b
        stretch = height / place[2]
        if not stretch > 0.0:
            return NOT_FLAT
        x, y = stretch * place[0], stretch * place[1]
        value[0] += 0.25 * x
        value[1] += 0.25 * y
        ahead += a * x + b * y
        aside += a * y - b * x
        for j in range(6):
            moved = level[:, j] if j < 3 else _turned(level, arm, j - 3)
            dx = stretch * moved[0] - x / place[2] * moved[2]
            dy = stretch * moved[1] - y / place[2] * moved[2]
            slopes[0, j] += 0.25 * dx
            slopes[1, j] += 0.25 * dy
            along[j] += a * dx + b * dy
            across[j] += a * dy - b * dx
    value[2] = math.atan2(aside, ahead)
    slopes[2] = (ahead * across - aside * along) / (ahead * ahead + aside * aside)
    noise[:] = np.dot(slopes, np.dot(spread, slopes.T))
    return CAST


@cached_njit
def _lies(level: FloatArray, middle: FloatArray, axes: FloatArray, spread: FloatArray, height: float) -> bool:
    """Whether a measured pose agrees with a level marker at a height, by its tilt and its distance."""
    slopes, rest, noise = np.zeros((3, 6)), np.empty(3), np.zeros((3, 3))
    slopes[0, 3:], slopes[1, 3:], slopes[2, :3] = level[1], -level[0], level[2]
    rest[0], rest[1], rest[2] = axes[0, 2], axes[1, 2], middle[2] - height
    noise[0, 0] = noise[1, 1] = _TILT_SIGMA * _TILT_SIGMA
    noise[2, 2] = (_HEIGHT_SHARE * height) ** 2 + _HEIGHT_SIGMA**2
    noise += np.dot(slopes, np.dot(spread, slopes.T))
    for i in range(3):
        if not noise[i, i] > 0.0:
            return False
    distance: float = np.dot(rest, np.linalg.solve(noise, rest))
    return 0.0 <= distance <= _GATE


@cached_njit
def _turned(level: FloatArray, arm: FloatArray, axis: int) -> FloatArray:
    """Motion (3,) in the level frame of the end of an arm (3,) turned about an axis of the optical frame."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    moved: FloatArray = level[:, k] * arm[j] - level[:, j] * arm[k]
    return moved


CONTENT_POSITION = 1  # Detection content: position only (MarkerDetection.CONTENT_POSITION)
CONTENT_POSE = 2  #: Detection content: position and orientation
CONTENT_POSE_TWO = 3  #: Detection content: position and orientation, with a mirrored second solution
CONTENT_BEARING = 4  # Detection content: only the direction of the position

OUTCOMES = (
    *("measured", "unknown_id", "own_marker", "no_camera", "bad_content", "non_finite", "absurd"),
    *("fixed_on_fixed", "face_down", "not_flat"),
)
MEASURED, _UNKNOWN_ID, _OWN_MARKER, _NO_CAMERA, _BAD_CONTENT, _NON_FINITE, _ABSURD = range(7)
_FIXED_ON_FIXED, _FACE_DOWN, _NOT_FLAT = range(7, len(OUTCOMES))
_MAX_DISTANCE_M = 1e3
_FLOOR_M, _FLOOR_SHARE, _FLOOR_RAD = 3e-4, 5e-4, 2e-3
"""Least standard deviation of a pose, whatever a message claims: [m], share of the distance, [rad]."""
SENSOR_DTYPE = np.dtype([(f.name, np.float64) for f in fields(SensorModel)])


class Cameras(NamedTuple):
    """Cameras of robots (N), then fixed ones: has one, S (., 3), optical to level rotation (., 3, 3), errors.

    `height` is z of the mount.
    """

    robots: int
    present: BoolArray
    mount: FloatArray
    height: FloatArray
    level: FloatArray
    sensor: NDArray[np.void]
    gate: FloatArray
    bearing_gate: FloatArray


class Markers(NamedTuple):
    """All markers by ascending id (k,): robot, landmark, M (k, 3) with heading NaN if there is none.

    `variance` (k,) is that of a face's position on its robot; the filter adds that of a landmark.
    """

    id: IntArray
    owner: IntArray
    landmark: IntArray
    pose: FloatArray
    height: FloatArray
    size: FloatArray
    lies: BoolArray
    variance: FloatArray


@cached_njit
def convert_all(
    detections: NDArray[np.void], cameras: Cameras, markers: Markers, out: Measurements, outcomes: IntArray
) -> None:
    """Fill the measurements (d,) except stamps and observers, and write their outcomes (d,)."""
    for k in range(outcomes.size):
        camera = out.observer[k]
        place = min(np.searchsorted(markers.id, detections[k].id), markers.id.size - 1)
        outcomes[k] = _outcome(detections, k, cameras, markers, camera, place)
        if outcomes[k] != MEASURED:
            continue
        out.reading[k] = markers.id[place]
        out.stamp_ns[k] += round(cameras.sensor[camera].time_offset_s * 1e9)
        out.target[k], out.landmark[k] = markers.owner[place], markers.landmark[place]
        assign(out.sensor[k], cameras.mount[camera])
        out.gate[k] = cameras.gate[camera]
        assign(out.marker[k], markers.pose[place])
        with_heading = detections[k].content in (CONTENT_POSE, CONTENT_POSE_TWO)
        out.has_heading[k] = with_heading and not math.isnan(out.marker[k, 2])
        if detections[k].content == CONTENT_BEARING:
            sensor, position = cameras.sensor[camera], np.empty(3)
            to_level_frame(cameras.level[camera], detections[k].position, 1.0, position)
            out.model[k], out.gate[k], out.marker[k, 2] = BEARING, cameras.bearing_gate[camera], 0.0
            out.value[k, 0] = _calibrated_bearing(sensor, position)
            out.covariance[k, 0, 0] = sensor.bearing_sigma**2
            out.covariance[k, 1, 1] = out.covariance[k, 2, 2] = 1.0
            continue
        if markers.lies[place]:
            outcomes[k] = _measure_lying(detections, k, cameras, markers, place, out)
        else:
            _measure_upright(detections, k, cameras, out)
        # the variance of the position of its face
        distance2 = max(out.value[k, 0] ** 2, 1e-6) if out.model[k] == POLAR else 1.0
        out.covariance[k, 0, 0] += markers.variance[place]
        out.covariance[k, 1, 1] += markers.variance[place] / distance2


@cached_njit
def _measure_upright(detections: NDArray[np.void], k: int, cameras: Cameras, out: Measurements) -> None:
    """Write value and covariance of measurement k of an upright marker."""
    sensor, level = cameras.sensor[out.observer[k]], cameras.level[out.observer[k]]
    position, noise = np.empty(3), out.covariance[k]
    to_level_frame(level, detections[k].position, 1.0 / sensor.distance_scale, position)
    # Without heading: calibrated range and bearing, see `SensorModel`.
    if not out.has_heading[k]:
        out.model[k], out.marker[k, 2] = POLAR, 0.0
        logged = math.atan2(position[1], position[0])
        curve = sensor.range_log_scale + sensor.range_skew * logged + sensor.range_curve * logged * logged
        distance = math.hypot(position[0], position[1]) * math.exp(curve) + sensor.range_offset
        if out.target[k] != NOBODY:
            distance += sensor.robot_range_offset
        out.value[k, 0], out.value[k, 1] = distance, _calibrated_bearing(sensor, position)
        noise[0, 0] = (sensor.range_sigma + sensor.range_sigma_per_m * abs(distance)) ** 2
        noise[1, 1], noise[2, 2] = sensor.bearing_sigma**2, 1.0
        return
    # Position and heading, of a second solution, too.
    out.value[k, 0], out.value[k, 1] = position[0], position[1]
    out.value[k, 2] = face_heading(level, detections[k].orientation)
    if detections[k].content == CONTENT_POSE_TWO:
        out.has_second[k] = True
        to_level_frame(level, detections[k].alternative_position, 1.0 / sensor.distance_scale, position)
        out.second[k, 0], out.second[k, 1] = position[0], position[1]
        out.second[k, 2] = face_heading(level, detections[k].alternative_orientation)
    # Covariance of forward, left, heading, by the model if unknown (-1, 0).
    published = detections[k].covariance
    if published[0, 0] <= 0.0:
        noise[0, 0], noise[1, 1] = sensor.forward_sigma**2, sensor.left_sigma**2
        noise[2, 2] = sensor.heading_sigma**2
        return
    to_plane = np.zeros((3, 6))
    for i in range(3):
        to_plane[0, i], to_plane[1, i] = level[0, i], level[1, i]
        to_plane[2, 3 + i] = level[2, i]  # the rotation about the vertical
    for i in range(3):
        for j in range(3):
            for a in range(6):
                for b in range(6):
                    noise[i, j] += to_plane[i, a] * published[a, b] * to_plane[j, b]
    _add_residual(sensor, math.hypot(out.value[k, 0], out.value[k, 1]), noise)


@cached_njit
def _measure_lying(
    detections: NDArray[np.void], k: int, cameras: Cameras, markers: Markers, place: int, out: Measurements
) -> int:
    """Write value and covariance of measurement k of a lying marker; return its outcome."""
    camera = out.observer[k]
    sensor, level = cameras.sensor[camera], cameras.level[camera]
    spread, position, rotation = np.zeros((6, 6)), np.empty(3), np.empty((3, 3))
    # Covariance of the pose in the optical frame, by the model if unknown (-1, 0).
    if detections[k].content != CONTENT_POSITION and detections[k].covariance[0, 0] > 0.0:
        spread[:] = detections[k].covariance
    else:
        spread[0, 0] = spread[1, 1] = sensor.left_sigma**2
        spread[2, 2] = sensor.forward_sigma**2
        for i in range(3, 6):
            spread[i, i] = sensor.heading_sigma**2
    # The solution that lies.
    height, result = markers.height[place] - cameras.height[camera], CAST
    for solution in range(2 if detections[k].content == CONTENT_POSE_TWO else 1):
        assign(position, detections[k].alternative_position if solution else detections[k].position)
        if detections[k].content == CONTENT_POSITION:
            rotation[:] = level.T  # as a marker that lies
        else:
            quaternion = detections[k].alternative_orientation if solution else detections[k].orientation
            write_rotation(quaternion, rotation)
        result = cast(
            level, position, rotation, spread, markers.size[place], height, out.value[k], out.covariance[k]
        )
        if result == CAST:
            break
    if result != CAST:
        return _FACE_DOWN if result == FACE_DOWN else _NOT_FLAT
    _add_residual(sensor, abs(height), out.covariance[k])
    if not out.has_heading[k]:
        out.value[k, 2] = out.marker[k, 2] = 0.0
        out.covariance[k, 2, :] = out.covariance[k, :, 2] = 0.0
        out.covariance[k, 2, 2] = 1.0
    return MEASURED


@inlined_njit
def _outcome(
    detections: NDArray[np.void], k: int, cameras: Cameras, markers: Markers, camera: int, place: int
) -> int:
    """Outcome of detection k with the marker at index `place`: valid, or a reason to drop it."""
    # Whose marker is it, and does the camera see it?
    if place < 0 or markers.id[place] != detections[k].id:
        return _UNKNOWN_ID
    if markers.owner[place] == camera:
        return _OWN_MARKER
    if not cameras.present[camera]:
        return _NO_CAMERA
    if camera >= cameras.robots and markers.owner[place] == NOBODY:
        return _FIXED_ON_FIXED
    # Is its content known and finite?
    content = detections[k].content
    if not CONTENT_POSITION <= content <= CONTENT_BEARING or (
        content == CONTENT_BEARING and markers.lies[place]
    ):
        return _BAD_CONTENT
    position, valid = detections[k].position, True
    for i in range(3):
        valid = valid and math.isfinite(position[i])
    if content == CONTENT_BEARING:
        valid = valid and (position[0] != 0.0 or position[1] != 0.0 or position[2] != 0.0)
    if content in (CONTENT_POSE, CONTENT_POSE_TWO):
        valid = valid and is_rotation(detections[k].orientation)
        for i in range(6):
            for j in range(6):
                valid = valid and math.isfinite(detections[k].covariance[i, j])
    if detections[k].content == CONTENT_POSE_TWO:
        valid = valid and is_rotation(detections[k].alternative_orientation)
        for i in range(3):
            valid = valid and math.isfinite(detections[k].alternative_position[i])
    if not valid:
        return _NON_FINITE
    farthest = max(abs(position[0]), abs(position[1]), abs(position[2]))
    if farthest > _MAX_DISTANCE_M and content != CONTENT_BEARING:
        return _ABSURD
    return MEASURED


@cached_njit
def _calibrated_bearing(sensor: SensorModel, position: FloatArray) -> float:
    """Calibrated bearing of a position (3,); see `SensorModel`."""
    logged = math.atan2(position[1], position[0])
    return (sensor.bearing_scale + sensor.bearing_curve * logged) * logged + sensor.bearing_offset


@cached_njit
def _add_residual(sensor: SensorModel, distance: float, noise: FloatArray) -> None:
    """Add the residual errors of a camera to the covariance (3, 3) of the planar pose, and the floor."""
    floor = _FLOOR_M + _FLOOR_SHARE * distance
    noise[0, 0] += sensor.residual_position_sigma**2 + floor**2
    noise[1, 1] += sensor.residual_position_sigma**2 + floor**2
    noise[2, 2] += sensor.residual_heading_sigma**2 + _FLOOR_RAD**2


_UNKNOWN_VARIANCE = -1.0  # First element of an unknown covariance
FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from the optical frame to x forward, y left, z up."""


def _tilt(pitch: float, roll: float) -> FloatArray:
    """Rotation (3, 3) of the axes of a camera that is turned down, and about its optical axis [rad].

    SciPy's `Rotation` has this, too, but takes as long to import as numpy.
    """
    down, level, across, upright = math.sin(pitch), math.cos(pitch), math.sin(roll), math.cos(roll)
    rows = [[level, down * across, down * upright], [0.0, upright, -across]]
    return np.array([*rows, [-down, level * across, level * upright]])


class DetectionRows(NamedTuple):
    """Detections of cameras, a row per detection (d,)."""

    robot: IntArray  #: (d,) index of the robot or fixed camera into `Swarm.sources`
    stamp_ns: IntArray  #: (d,) exposure times
    #: (d,) structured, with fields id, content, position (3,), orientation (4,) xyzw, covariance (6, 6),
    #: alternative_position, alternative_orientation, as published in the optical frame
    detection: NDArray[np.void]
    arrival_ns: IntArray  #: (d,) arrival times


NO_DETECTIONS = DetectionRows(NO_ROWS, NO_ROWS, np.zeros(0, dtype=DETECTION_DTYPE), NO_ROWS)


class SightingConverter:
    """Converts the detections of all cameras of a swarm; dropped ones are counted by `OUTCOMES`."""

    def __init__(self, swarm: Swarm, drops: DropCounts | None = None) -> None:
        self._drops = drops or DropCounts(len(swarm.sources))
        # Cameras: mounts, calibration, gates.
        fixed, robots = swarm.cameras, swarm.robots
        self._first_mount = len(swarm.surveyed) - len(fixed)
        mounts: list[CameraMount | FixedCamera] = [robot.camera or CameraMount() for robot in robots]
        mounts += fixed
        models = [source.sensor for source in swarm.sources]
        tilts = [_tilt(mount.pitch, mount.roll) @ FROM_OPTICAL for mount in mounts]
        sensors = [tuple(getattr(model, name) for name in SENSOR_DTYPE.names or ()) for model in models]
        self._cameras = Cameras(
            robots=len(robots),
            present=np.array([one.camera is not None for one in robots] + [True] * len(fixed), dtype=bool),
            mount=np.array([[m.x, m.y, m.yaw] for m in mounts]).reshape(-1, 3),
            height=np.array([m.z for m in mounts], dtype=np.float64),
            level=np.array(tilts).reshape(-1, 3, 3),
            sensor=np.array(sensors, dtype=SENSOR_DTYPE),
            gate=MODELS[POLAR].gate([model.gate_probability for model in models]),
            bearing_gate=MODELS[BEARING].gate([model.gate_probability for model in models]),
        )
        # Markers by id: on whom, where, how large.
        owners = sorted(swarm.owner_of.items())
        markers = [owner.marker for _, owner in owners]
        number = {mark.id: k for k, mark in enumerate(swarm.landmarks)}
        self._markers = Markers(
            id=np.array([marker_id for marker_id, _ in owners], dtype=np.int64),
            owner=np.array([owner.robot_index for _, owner in owners], dtype=np.int64),
            landmark=np.array([number.get(marker_id, NOBODY) for marker_id, _ in owners], dtype=np.int64),
            pose=np.array([[m.x, m.y, np.nan if m.yaw is None else m.yaw] for m in markers]).reshape(-1, 3),
            height=np.array([m.z for m in markers], dtype=float),
            size=np.array([m.size for m in markers], dtype=float),
            lies=np.array([isinstance(m, Face) and m.lies for m in markers], dtype=bool),
            variance=np.array([m.position_sigma**2 if isinstance(m, Face) else 0.0 for m in markers]),
        )

    def convert(self, rows: DetectionRows) -> Measurements:
        """Convert detections (d,) to measurements (m,); count the others in `drops`."""
        out, outcomes = Measurements.empty(rows.robot.size), np.zeros(rows.robot.size, dtype=np.int64)
        out.stamp_ns[:], out.arrival_ns[:] = rows.stamp_ns, rows.arrival_ns
        out.received_from[:] = out.observer[:] = rows.robot
        out.covariance[:] = 0.0
        convert_all(rows.detection, self._cameras, self._markers, out, outcomes)
        found = np.flatnonzero(np.bincount(outcomes, minlength=len(OUTCOMES))).tolist()
        for k in found:
            if k != MEASURED:
                self._drops.add(OUTCOMES[k], rows.robot[outcomes == k])
        if found != [MEASURED]:
            out = select(out, outcomes == MEASURED)
        fixed = out.observer >= self._cameras.robots
        out.mount[fixed] = out.observer[fixed] - self._cameras.robots + self._first_mount
        out.observer[fixed] = NOBODY
        # All measurements of an image share the error of its stamp. The filter assumes independent errors, so
        # each measurement gets the variance times their number.
        variance = np.square(self._cameras.sensor["time_sigma_s"])[out.received_from]
        if variance.any():
            pictures = np.stack([out.received_from, out.stamp_ns])
            _, picture, count = np.unique(pictures, axis=1, return_inverse=True, return_counts=True)
            out.stamp_variance[:] = variance * count[picture]
        return out


def _shared_rows(message: SharedMessage, arrival_ns: IntArray) -> DetectionRows:
    return DetectionRows(message.robot, message.reading_ns, message.columns[0], arrival_ns)


class CameraSensor(Sensor):
    """Cameras on robots, and fixed ones."""

    name, topic, message_type = "detections", "detections", MESSAGE_TYPE
    shared = SharedTopic("swarm/detections", SWARM_DETECTIONS, decode_shared_detections, _shared_rows)
    of_cameras = True

    def __init__(self, swarm: Swarm, settings: SensorSettings, drops: DropCounts) -> None:
        super().__init__(swarm, settings, drops)
        self.measure = SightingConverter(swarm, drops).convert  # type: ignore[method-assign]

    @classmethod
    def create_reader(cls, topics: int, _known: Known) -> Reader:
        """Create a reader that decodes all messages of a batch at once."""
        return DetectionReader(topics)

    @classmethod
    def rows(cls, columns: Mapping[str, Any]) -> DetectionRows:
        """Create readings from columns: those of `DetectionRows`, or the fields of a detection.

        `id` and `position` are needed; without `orientation` a detection is a position, and without
        `covariance` its noise is that of the camera.
        """
        if "detection" in columns:
            as_given: DetectionRows = super().rows(columns)
            return as_given
        detection = np.zeros(len(columns["robot"]), dtype=DETECTION_DTYPE)
        detection["content"] = CONTENT_POSE if "orientation" in columns else CONTENT_POSITION
        detection["orientation"][:, 3], detection["covariance"][:, 0, 0] = 1.0, _UNKNOWN_VARIANCE
        fields = {*columns} & {*(detection.dtype.names or ())}
        if missing := {"id", "position"} - fields:
            raise TypeError(f"{cls.name}: the column '{min(missing)}' is missing")
        for name in fields:
            fill(detection[name], columns[name], f"{cls.name}: {name}")
        others = {name: columns[name] for name in {*columns} - fields}
        made: DetectionRows = super().rows({**others, "detection": detection})
        return made

    @classmethod
    def nothing(cls) -> DetectionRows:
        """Empty readings."""
        return NO_DETECTIONS

    @classmethod
    def columns(cls, messages: DetectionColumns) -> DetectionRows:
        """Convert decoded messages (n,) to a row per detection."""
        columns = (messages.robot, messages.stamp_ns, messages.arrival_ns)
        robot, stamp_ns, arrival_ns = (np.repeat(column, messages.count) for column in columns)
        return DetectionRows(robot, stamp_ns, messages.detection, arrival_ns)

    @classmethod
    def expected_of(cls, robot: Robot) -> bool:
        """Whether the description says that the robot has a camera."""
        return robot.camera is not None
