"""Camera detections to measurements: association by marker id, pose in the plane, covariance.

A detection is a marker's pose in the camera's optical frame (x right, y down, z forward). It is converted to
a measurement in the planar sensor frame: at the camera's position on the robot, rotated by its yaw, with the
mount's pitch and roll removed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.messages.definitions import DETECTIONS as MESSAGE_TYPE
from swarm_loc_estimator.common.messages.definitions import SWARM_DETECTIONS
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    SharedMessage,
    decode_shared_detections,
)
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.common.messages.streams import DetectionColumns, DetectionReader
from swarm_loc_estimator.common.small_matrix import assign
from swarm_loc_estimator.filter.measurement_model import (
    MEASUREMENT_DTYPE,
    MODELS,
    NOBODY,
    POLAR,
    Kind,
    MeasurementArray,
    MeasurementColumns,
)
from swarm_loc_estimator.sensors.bearing import BEARING
from swarm_loc_estimator.sensors.optical_frame import face_heading, is_rotation, scale, to_level_frame
from swarm_loc_estimator.sensors.sensor import (
    NO_ROWS,
    Converter,
    DropCounts,
    InputKind,
    Known,
    Measured,
    Sensor,
    SensorSettings,
)
from swarm_loc_estimator.sensors.shared_topics import shared_kind
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Robot, SensorModel, Swarm

CONTENT_POSITION = 1
"""Detection content: position only (MarkerDetection.CONTENT_POSITION)."""
CONTENT_POSE = 2
"""Detection content: position and orientation."""
CONTENT_POSE_TWO = 3
"""Detection content: position and orientation, with a mirrored second solution."""
CONTENT_BEARING = 4
"""Detection content: only the direction of the position."""

_OUTCOMES = ("measured", "unknown_id", "own_marker", "no_camera", "bad_content", "non_finite", "absurd")
_MEASURED, _UNKNOWN_ID, _OWN_MARKER, _NO_CAMERA, _BAD_CONTENT, _NON_FINITE, _ABSURD = range(len(_OUTCOMES))
_MAX_DISTANCE_M = 1e3
_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_SENSOR_DTYPE = np.dtype([(f.name, np.float64) for f in fields(SensorModel)])


class DetectionRows(NamedTuple):
    """Detections of cameras, a row per detection (d,).

    Attributes:
        robot: (d,) index of the robot that carries the camera.
        stamp_ns: (d,) exposure times.
        detection: (d,) structured, see `SightingConverter.convert`.
        arrival_ns: (d,) arrival times.
    """

    robot: IntArray
    stamp_ns: IntArray
    detection: NDArray[np.void]
    arrival_ns: IntArray


NO_DETECTIONS = DetectionRows(NO_ROWS, NO_ROWS, np.zeros(0, dtype=DETECTION_DTYPE), NO_ROWS)


@dataclass(frozen=True)
class Conversion:
    """Result of converting detections.

    Attributes:
        measurements: (m,) of MEASUREMENT_DTYPE.
        measured: (d,) True for detections that were converted.
        dropped: Robots (k,) of the dropped detections by reason: `unknown_id`, `own_marker`, `no_camera`,
            `bad_content`, `non_finite` and `absurd`.
    """

    measurements: MeasurementArray
    measured: NDArray[np.bool_]
    dropped: dict[str, IntArray]


class _Cameras(NamedTuple):
    """Cameras by robot: has one (N,), S (N, 3), optical to level rotation (N, 3, 3), errors, gates."""

    present: NDArray[np.bool_]
    mount: FloatArray
    level: FloatArray
    sensor: NDArray[np.void]
    gate: FloatArray
    bearing_gate: FloatArray


class _Markers(NamedTuple):
    """All markers by ascending id (k,): robot, landmark, M (k, 3) with heading NaN if there is none.

    `variance` (k,) is that of a face's position on its robot; the filter adds that of a landmark.
    """

    id: IntArray
    owner: IntArray
    landmark: IntArray
    pose: FloatArray
    variance: FloatArray


class _Detections(NamedTuple):
    """The used fields of detections (d,)."""

    id: NDArray[np.uint32]
    content: NDArray[np.uint8]
    position: FloatArray
    orientation: FloatArray
    covariance: FloatArray
    alternative_position: FloatArray
    alternative_orientation: FloatArray


class SightingConverter:
    """Converts the detections of all cameras of a swarm.

    Args:
        swarm: Cameras, their calibration, and owners of markers.
    """

    def __init__(self, swarm: Swarm) -> None:
        mounts = [robot.camera or CameraMount() for robot in swarm.robots]
        tilts = [Rotation.from_euler("YX", [m.pitch, m.roll]).as_matrix() @ _FROM_OPTICAL for m in mounts]
        sensors = [
            tuple(getattr(robot.sensor, name) for name in _SENSOR_DTYPE.names or ()) for robot in swarm.robots
        ]
        self._cameras = _Cameras(
            present=np.array([robot.camera is not None for robot in swarm.robots], dtype=bool),
            mount=np.array([[m.x, m.y, m.yaw] for m in mounts]).reshape(-1, 3),
            level=np.array(tilts).reshape(-1, 3, 3),
            sensor=np.array(sensors, dtype=_SENSOR_DTYPE),
            gate=MODELS[Kind.POLAR].gate([robot.sensor.gate_probability for robot in swarm.robots]),
            bearing_gate=MODELS[BEARING].gate([robot.sensor.gate_probability for robot in swarm.robots]),
        )
        owners = sorted(swarm.owner_of.items())
        markers = [owner.marker for _, owner in owners]
        number = {mark.id: k + 1 for k, mark in enumerate(swarm.landmarks)}
        self._markers = _Markers(
            id=np.array([marker_id for marker_id, _ in owners], dtype=np.int64),
            owner=np.array([owner.robot_index for _, owner in owners], dtype=np.int64),
            landmark=np.array([number.get(marker_id, 0) for marker_id, _ in owners], dtype=np.int64),
            pose=np.array([[m.x, m.y, np.nan if m.yaw is None else m.yaw] for m in markers]).reshape(-1, 3),
            variance=np.array([m.position_sigma**2 if isinstance(m, Face) else 0.0 for m in markers]),
        )

    def convert(self, robots: IntArray, stamps_ns: IntArray, detections: NDArray[np.void]) -> Conversion:
        """Convert detections to measurements.

        Args:
            robots: (d,) index of the robot with the camera.
            stamps_ns: (d,) exposure times.
            detections: (d,) with fields id, content, position (3,), orientation (4,) xyzw, covariance (6, 6),
                alternative_position, alternative_orientation, as published in the optical frame.
        """
        measurements = np.zeros(robots.size, dtype=MEASUREMENT_DTYPE)
        measurements["stamp_ns"] = stamps_ns
        measurements["received_from"] = measurements["observer"] = robots
        outcomes = np.zeros(robots.size, dtype=np.int64)
        _convert_all(
            _Detections(*(detections[name] for name in _Detections._fields)),
            self._cameras,
            self._markers,
            MeasurementColumns.views(measurements),
            measurements["marker_id"],
            outcomes,
        )
        found = np.flatnonzero(np.bincount(outcomes, minlength=len(_OUTCOMES))).tolist()
        dropped = {_OUTCOMES[k]: robots[outcomes == k] for k in found if k != _MEASURED}
        measured: NDArray[np.bool_] = outcomes == _MEASURED
        measurements = measurements[measured]
        self._note_stamp_variance(measurements)
        return Conversion(measurements, measured, dropped)

    def _note_stamp_variance(self, measurements: MeasurementArray) -> None:
        """Write the variance of the stamps.

        All measurements of an image share the error of its stamp. The filter assumes independent errors, so
        each measurement gets the variance times their number.
        """
        variance = np.square(self._cameras.sensor["time_sigma_s"])[measurements["observer"]]
        if variance.any():
            pictures = np.stack([measurements["observer"], measurements["stamp_ns"]])
            _, picture, count = np.unique(pictures, axis=1, return_inverse=True, return_counts=True)
            measurements["stamp_variance"] = variance * count[picture]


@cached_njit
def _convert_all(
    detections: _Detections,
    cameras: _Cameras,
    markers: _Markers,
    out: MeasurementColumns,
    marker_id: IntArray,
    outcomes: IntArray,
) -> None:
    """Fill the measurements (d,) except stamps and observers, and write their outcomes (d,)."""
    position, other_position = np.empty(3), np.empty(3)
    for k in range(outcomes.size):
        robot = out.observer[k]
        place = min(np.searchsorted(markers.id, detections.id[k]), markers.id.size - 1)
        outcomes[k] = _outcome(detections, k, cameras, markers, robot, place)
        if outcomes[k] != _MEASURED:
            continue
        sensor, level, marker = cameras.sensor[robot], cameras.level[robot], markers.pose[place]
        marker_id[k] = markers.id[place]
        out.stamp_ns[k] += round(sensor.time_offset_s * 1e9)
        out.target[k], out.landmark[k] = markers.owner[place], markers.landmark[place]
        assign(out.sensor[k], cameras.mount[robot])
        out.gate[k] = cameras.gate[robot]
        out.marker[k, 0], out.marker[k, 1] = marker[0], marker[1]
        to_level_frame(level, detections.position[k], position)
        if detections.content[k] == CONTENT_BEARING:
            out.kind[k], out.gate[k] = BEARING, cameras.bearing_gate[robot]
            out.value[k, 0] = _calibrated_bearing(sensor, position)
            out.covariance[k, 0, 0] = sensor.bearing_sigma**2
            out.covariance[k, 1, 1] = out.covariance[k, 2, 2] = 1.0
            continue
        scale(position, 1.0 / sensor.distance_scale)
        if detections.content[k] == CONTENT_POSITION or math.isnan(marker[2]):
            out.kind[k] = POLAR
            _calibrate(sensor, position, out.target[k], out.value[k], out.covariance[k])
            out.covariance[k, 0, 0] += markers.variance[place]
            out.covariance[k, 1, 1] += markers.variance[place] / max(out.value[k, 0] ** 2, 1e-6)
            continue
        out.has_heading[k], out.marker[k, 2] = 1, marker[2]
        out.value[k, 0], out.value[k, 1] = position[0], position[1]
        out.value[k, 2] = face_heading(level, detections.orientation[k])
        if detections.content[k] == CONTENT_POSE_TWO:
            out.has_alternative[k] = 1
            to_level_frame(level, detections.alternative_position[k], other_position)
            scale(other_position, 1.0 / sensor.distance_scale)
            out.alternative[k, 0], out.alternative[k, 1] = other_position[0], other_position[1]
            out.alternative[k, 2] = face_heading(level, detections.alternative_orientation[k])
        _pose_noise(sensor, level, detections.covariance[k], out.covariance[k])
        out.covariance[k, 0, 0] += markers.variance[place]
        out.covariance[k, 1, 1] += markers.variance[place]


@inlined_njit
def _outcome(
    detections: _Detections, k: int, cameras: _Cameras, markers: _Markers, robot: int, place: int
) -> int:
    """Outcome of detection k with the marker at index `place`: valid, or a reason to drop it."""
    if place < 0 or markers.id[place] != detections.id[k]:
        return _UNKNOWN_ID
    if markers.owner[place] == robot:
        return _OWN_MARKER
    if not cameras.present[robot]:
        return _NO_CAMERA
    content = detections.content[k]
    if not CONTENT_POSITION <= content <= CONTENT_BEARING:
        return _BAD_CONTENT
    position, valid = detections.position[k], True
    for i in range(3):
        valid = valid and math.isfinite(position[i])
    if content == CONTENT_BEARING:
        valid = valid and (position[0] != 0.0 or position[1] != 0.0 or position[2] != 0.0)
    if content in (CONTENT_POSE, CONTENT_POSE_TWO):
        valid = valid and is_rotation(detections.orientation[k])
        for i in range(6):
            for j in range(6):
                valid = valid and math.isfinite(detections.covariance[k, i, j])
    if content == CONTENT_POSE_TWO:
        valid = valid and is_rotation(detections.alternative_orientation[k])
        for i in range(3):
            valid = valid and math.isfinite(detections.alternative_position[k, i])
    if not valid:
        return _NON_FINITE
    farthest = max(abs(position[0]), abs(position[1]), abs(position[2]))
    if farthest > _MAX_DISTANCE_M and content != CONTENT_BEARING:
        return _ABSURD
    return _MEASURED


@cached_njit
def _calibrated_bearing(sensor: SensorModel, position: FloatArray) -> float:
    """Calibrated bearing of a position (3,); see `SensorModel`."""
    logged = math.atan2(position[1], position[0])
    return (sensor.bearing_scale + sensor.bearing_curve * logged) * logged + sensor.bearing_offset


@cached_njit
def _calibrate(
    sensor: SensorModel, position: FloatArray, target: int, value: FloatArray, noise: FloatArray
) -> None:
    """Write calibrated range and bearing (3,) and their covariance (3, 3); see `SensorModel`."""
    logged = math.atan2(position[1], position[0])
    curve = sensor.range_log_scale + sensor.range_skew * logged + sensor.range_curve * logged * logged
    distance = math.hypot(position[0], position[1]) * math.exp(curve) + sensor.range_offset
    if target != NOBODY:
        distance += sensor.robot_range_offset
    value[0] = distance
    value[1] = _calibrated_bearing(sensor, position)
    noise[0, 0] = (sensor.range_sigma + sensor.range_sigma_per_m * abs(distance)) ** 2
    noise[1, 1] = sensor.bearing_sigma**2
    noise[2, 2] = 1.0


@cached_njit
def _pose_noise(sensor: SensorModel, level: FloatArray, published: FloatArray, noise: FloatArray) -> None:
    """Write the covariance (3, 3) of forward, left, heading; from the sensor model if unknown (-1)."""
    if published[0, 0] < 0.0:
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
    noise[0, 0] += sensor.residual_position_sigma**2
    noise[1, 1] += sensor.residual_position_sigma**2
    noise[2, 2] += sensor.residual_heading_sigma**2


def _columns(
    found: DetectionColumns, batch: MessageBatch, robot: IntArray, _known: Known
) -> tuple[DetectionRows, Mapping[str, int]]:
    columns = (robot, found.stamp_ns, batch.log_ns)
    robots, stamps_ns, arrivals_ns = (np.repeat(column, found.count) for column in columns)
    return DetectionRows(robots, stamps_ns, found.detection, arrivals_ns), {}


def _shared_rows(message: SharedMessage, arrival_ns: IntArray) -> DetectionRows:
    return DetectionRows(message.robot, message.reading_ns, message.columns[0], arrival_ns)


def _create_converter(swarm: Swarm, _settings: SensorSettings, drops: DropCounts) -> Converter:
    converter = SightingConverter(swarm)

    def convert(rows: DetectionRows) -> Measured:
        found = converter.convert(rows.robot, rows.stamp_ns, rows.detection)
        for reason, robots in found.dropped.items():
            drops.add(reason, robots)
        return Measured(found.measurements, rows.arrival_ns[found.measured])

    return convert


def _has_camera(robot: Robot) -> bool:
    return robot.camera is not None


_OWN = InputKind(
    "detections", "detections", MESSAGE_TYPE, lambda n, _: DetectionReader(n), _columns, _has_camera
)
_SHARED = shared_kind(
    _OWN, "swarm/detections", SWARM_DETECTIONS, decode_shared_detections, _shared_rows, NO_DETECTIONS
)
DETECTIONS = Sensor("detections", NO_DETECTIONS, (_OWN, _SHARED), _create_converter)
"""The sensor, see `registry.SENSORS`."""
