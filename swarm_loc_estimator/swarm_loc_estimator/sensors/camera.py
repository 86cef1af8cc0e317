"""Camera detections to measurements: association by marker id, pose in the plane, covariance.

A detection is a marker's pose in the camera's optical frame (x right, y down, z forward). It is converted to
a measurement in the planar sensor frame: at the camera's position on the robot or, of a fixed camera, in
`map`, rotated by its yaw, with the mount's pitch and roll removed. A fixed camera has no observer, and the
error of its pose is the systematic share of its measurements.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.definitions import DETECTIONS as MESSAGE_TYPE
from swarm_loc_estimator.common.messages.definitions import SWARM_DETECTIONS
from swarm_loc_estimator.common.messages.detections import (
    DETECTION_DTYPE,
    SharedMessage,
    decode_shared_detections,
)
from swarm_loc_estimator.common.messages.message_batch import MessageBatch
from swarm_loc_estimator.common.messages.streams import DetectionColumns, DetectionReader
from swarm_loc_estimator.filter.measurement_model import (
    MEASUREMENT_DTYPE,
    MODELS,
    NOBODY,
    Kind,
    MeasurementArray,
    MeasurementColumns,
)
from swarm_loc_estimator.sensors.bearing import BEARING
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
from swarm_loc_estimator.sensors.sighting_kernels import (
    MEASURED,
    OUTCOMES,
    SENSOR_DTYPE,
    Cameras,
    Detections,
    Markers,
    convert_all,
)
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, FixedCamera, Robot, Swarm

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
    detection: NDArray[np.void]  #: (d,) structured, see `SightingConverter.convert`
    arrival_ns: IntArray  #: (d,) arrival times


NO_DETECTIONS = DetectionRows(NO_ROWS, NO_ROWS, np.zeros(0, dtype=DETECTION_DTYPE), NO_ROWS)


@dataclass(frozen=True)
class Conversion:
    """Result of converting detections."""

    measurements: MeasurementArray  # (m,) of MEASUREMENT_DTYPE
    measured: NDArray[np.bool_]  # (d,) True for detections that were converted
    # Robots or fixed cameras (k,) of the dropped detections by reason, see `OUTCOMES`
    dropped: dict[str, IntArray]


class SightingConverter:
    """Converts the detections of all cameras of a swarm.

    Args:
        swarm: Cameras, their calibration, and owners of markers.
    """

    def __init__(self, swarm: Swarm) -> None:
        fixed, robots = swarm.cameras, swarm.robots
        mounts: list[CameraMount | FixedCamera] = [robot.camera or CameraMount() for robot in robots]
        mounts += fixed
        models = [source.sensor for source in swarm.sources]
        tilts = [_tilt(mount.pitch, mount.roll) @ FROM_OPTICAL for mount in mounts]
        sensors = [tuple(getattr(model, name) for name in SENSOR_DTYPE.names or ()) for model in models]
        sigmas = [(0.0, 0.0)] * len(robots) + [(one.position_sigma, one.yaw_sigma) for one in fixed]
        self._cameras = Cameras(
            robots=len(robots),
            present=np.array([one.camera is not None for one in robots] + [True] * len(fixed), dtype=bool),
            mount=np.array([[m.x, m.y, m.yaw] for m in mounts]).reshape(-1, 3),
            height=np.array([m.z for m in mounts], dtype=np.float64),
            level=np.array(tilts).reshape(-1, 3, 3),
            sensor=np.array(sensors, dtype=SENSOR_DTYPE),
            gate=MODELS[Kind.POLAR].gate([model.gate_probability for model in models]),
            bearing_gate=MODELS[BEARING].gate([model.gate_probability for model in models]),
            variance=np.square([(position, position, yaw) for position, yaw in sigmas]).reshape(-1, 3),
        )
        owners = sorted(swarm.owner_of.items())
        markers = [owner.marker for _, owner in owners]
        number = {mark.id: k + 1 for k, mark in enumerate(swarm.landmarks)}
        self._markers = Markers(
            id=np.array([marker_id for marker_id, _ in owners], dtype=np.int64),
            owner=np.array([owner.robot_index for _, owner in owners], dtype=np.int64),
            landmark=np.array([number.get(marker_id, 0) for marker_id, _ in owners], dtype=np.int64),
            pose=np.array([[m.x, m.y, np.nan if m.yaw is None else m.yaw] for m in markers]).reshape(-1, 3),
            height=np.array([m.z for m in markers], dtype=float),
            size=np.array([m.size for m in markers], dtype=float),
            lies=np.array([isinstance(m, Face) and m.lies for m in markers], dtype=bool),
            variance=np.array([m.position_sigma**2 if isinstance(m, Face) else 0.0 for m in markers]),
        )

    def convert(self, robots: IntArray, stamps_ns: IntArray, detections: NDArray[np.void]) -> Conversion:
        """Convert detections to measurements.

        Args:
            robots: (d,) index of the robot with the camera, or of the fixed camera, see `DetectionRows`.
            stamps_ns: (d,) exposure times.
            detections: (d,) with fields id, content, position (3,), orientation (4,) xyzw, covariance (6, 6),
                alternative_position, alternative_orientation, as published in the optical frame.
        """
        measurements = np.zeros(robots.size, dtype=MEASUREMENT_DTYPE)
        measurements["stamp_ns"] = stamps_ns
        measurements["received_from"] = measurements["observer"] = robots
        outcomes = np.zeros(robots.size, dtype=np.int64)
        convert_all(
            Detections(*(detections[name] for name in Detections._fields)),
            self._cameras,
            self._markers,
            MeasurementColumns.views(measurements),
            measurements["marker_id"],
            outcomes,
        )
        found = np.flatnonzero(np.bincount(outcomes, minlength=len(OUTCOMES))).tolist()
        dropped = {OUTCOMES[k]: robots[outcomes == k] for k in found if k != MEASURED}
        measured: NDArray[np.bool_] = outcomes == MEASURED
        measurements = measurements[measured]
        measurements["observer"][measurements["observer"] >= self._cameras.robots] = NOBODY
        self._note_stamp_variance(measurements)
        return Conversion(measurements, measured, dropped)

    def _note_stamp_variance(self, measurements: MeasurementArray) -> None:
        """Write the variance of the stamps.

        All measurements of an image share the error of its stamp. The filter assumes independent errors, so
        each measurement gets the variance times their number.
        """
        variance = np.square(self._cameras.sensor["time_sigma_s"])[measurements["received_from"]]
        if variance.any():
            pictures = np.stack([measurements["received_from"], measurements["stamp_ns"]])
            _, picture, count = np.unique(pictures, axis=1, return_inverse=True, return_counts=True)
            measurements["stamp_variance"] = variance * count[picture]


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
    "detections",
    "detections",
    MESSAGE_TYPE,
    lambda n, _: DetectionReader(n),
    _columns,
    _has_camera,
    of_cameras=True,
)
_SHARED = shared_kind(
    _OWN, "swarm/detections", SWARM_DETECTIONS, decode_shared_detections, _shared_rows, NO_DETECTIONS
)
DETECTIONS = Sensor("detections", NO_DETECTIONS, (_OWN, _SHARED), _create_converter)
"""The sensor, see `registry.SENSORS`."""
