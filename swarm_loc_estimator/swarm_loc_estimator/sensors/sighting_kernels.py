"""Kernels that convert camera detections to measurements, see `camera`."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, inlined_njit
from swarm_loc_estimator.common.small_matrix import assign
from swarm_loc_estimator.filter.measurement_model import NOBODY, POLAR, MeasurementColumns
from swarm_loc_estimator.sensors.bearing import BEARING
from swarm_loc_estimator.sensors.lying_marker import CAST, FACE_DOWN, cast
from swarm_loc_estimator.sensors.optical_frame import (
    face_heading,
    is_rotation,
    scale,
    to_level_frame,
    write_rotation,
)
from swarm_loc_estimator.swarm.error_models import SensorModel

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
SENSOR_DTYPE = np.dtype([(f.name, np.float64) for f in fields(SensorModel)])


class Cameras(NamedTuple):
    """Cameras of robots (N), then fixed ones: has one, S (., 3), optical to level rotation (., 3, 3), errors.

    `height` is z of the mount, `variance` (., 3) that of a fixed camera's pose: x, y, yaw.
    """

    robots: int
    present: NDArray[np.bool_]
    mount: FloatArray
    height: FloatArray
    level: FloatArray
    sensor: NDArray[np.void]
    gate: FloatArray
    bearing_gate: FloatArray
    variance: FloatArray


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
    lies: NDArray[np.bool_]
    variance: FloatArray


class Detections(NamedTuple):
    """The used fields of detections (d,)."""

    id: NDArray[np.uint32]
    content: NDArray[np.uint8]
    position: FloatArray
    orientation: FloatArray
    covariance: FloatArray
    alternative_position: FloatArray
    alternative_orientation: FloatArray


@cached_njit
def convert_all(
    detections: Detections,
    cameras: Cameras,
    markers: Markers,
    out: MeasurementColumns,
    marker_id: IntArray,
    outcomes: IntArray,
) -> None:
    """Fill the measurements (d,) except stamps and observers, and write their outcomes (d,)."""
    for k in range(outcomes.size):
        camera = out.observer[k]
        place = min(np.searchsorted(markers.id, detections.id[k]), markers.id.size - 1)
        outcomes[k] = _outcome(detections, k, cameras, markers, camera, place)
        if outcomes[k] != MEASURED:
            continue
        marker_id[k] = markers.id[place]
        out.stamp_ns[k] += round(cameras.sensor[camera].time_offset_s * 1e9)
        out.target[k], out.landmark[k] = markers.owner[place], markers.landmark[place]
        assign(out.sensor[k], cameras.mount[camera])
        out.gate[k] = cameras.gate[camera]
        assign(out.marker[k], markers.pose[place])
        with_heading = detections.content[k] in (CONTENT_POSE, CONTENT_POSE_TWO)
        out.has_heading[k] = with_heading and not math.isnan(out.marker[k, 2])
        if detections.content[k] == CONTENT_BEARING:
            _measure_bearing(detections.position[k], k, cameras, out)
            continue
        if markers.lies[place]:
            outcomes[k] = _measure_lying(detections, k, cameras, markers, place, out)
        else:
            _measure_upright(detections, k, cameras, out)
        _add_common_noise(cameras.variance[camera], markers.variance[place], k, out)


@cached_njit
def _measure_bearing(optical: FloatArray, k: int, cameras: Cameras, out: MeasurementColumns) -> None:
    """Write value and covariance of measurement k of a direction (3,) in the optical frame."""
    camera, position = out.observer[k], np.empty(3)
    sensor = cameras.sensor[camera]
    to_level_frame(cameras.level[camera], optical, position)
    out.kind[k], out.gate[k], out.marker[k, 2] = BEARING, cameras.bearing_gate[camera], 0.0
    out.value[k, 0] = _calibrated_bearing(sensor, position)
    out.covariance[k, 0, 0] = sensor.bearing_sigma**2 + cameras.variance[camera, 2]
    out.covariance[k, 1, 1] = out.covariance[k, 2, 2] = 1.0


@cached_njit
def _measure_upright(detections: Detections, k: int, cameras: Cameras, out: MeasurementColumns) -> None:
    """Write value and covariance of measurement k of an upright marker."""
    sensor, level = cameras.sensor[out.observer[k]], cameras.level[out.observer[k]]
    position = np.empty(3)
    to_level_frame(level, detections.position[k], position)
    scale(position, 1.0 / sensor.distance_scale)
    if not out.has_heading[k]:
        out.kind[k], out.marker[k, 2] = POLAR, 0.0
        _calibrate(sensor, position, out.target[k], out.value[k], out.covariance[k])
        return
    out.value[k, 0], out.value[k, 1] = position[0], position[1]
    out.value[k, 2] = face_heading(level, detections.orientation[k])
    if detections.content[k] == CONTENT_POSE_TWO:
        out.has_alternative[k] = 1
        to_level_frame(level, detections.alternative_position[k], position)
        scale(position, 1.0 / sensor.distance_scale)
        out.alternative[k, 0], out.alternative[k, 1] = position[0], position[1]
        out.alternative[k, 2] = face_heading(level, detections.alternative_orientation[k])
    _pose_noise(sensor, level, detections.covariance[k], out.covariance[k])


@cached_njit
def _measure_lying(
    detections: Detections,
    k: int,
    cameras: Cameras,
    markers: Markers,
    place: int,
    out: MeasurementColumns,
) -> int:
    """Write value and covariance of measurement k of a lying marker; return its outcome."""
    camera = out.observer[k]
    sensor, level = cameras.sensor[camera], cameras.level[camera]
    spread, position, rotation = np.zeros((6, 6)), np.empty(3), np.empty((3, 3))
    _write_spread(sensor, detections.content[k], detections.covariance[k], spread)
    height, result = markers.height[place] - cameras.height[camera], CAST
    for solution in range(2 if detections.content[k] == CONTENT_POSE_TWO else 1):
        assign(position, detections.alternative_position[k] if solution else detections.position[k])
        if detections.content[k] == CONTENT_POSITION:
            rotation[:] = level.T  # as a marker that lies
        else:
            quaternion = detections.alternative_orientation[k] if solution else detections.orientation[k]
            write_rotation(quaternion, rotation)
        result = cast(
            level, position, rotation, spread, markers.size[place], height, out.value[k], out.covariance[k]
        )
        if result == CAST:
            break
    if result != CAST:
        return _FACE_DOWN if result == FACE_DOWN else _NOT_FLAT
    _add_residual(sensor, out.covariance[k])
    if not out.has_heading[k]:
        out.value[k, 2] = out.marker[k, 2] = 0.0
        out.covariance[k, 2, :] = out.covariance[k, :, 2] = 0.0
        out.covariance[k, 2, 2] = 1.0
    return MEASURED


@cached_njit
def _add_common_noise(of_camera: FloatArray, of_face: float, k: int, out: MeasurementColumns) -> None:
    """Add the variances of a fixed camera's pose (3,) and of a face's position to measurement k."""
    noise, distance2 = out.covariance[k], 1.0
    if out.kind[k] == POLAR:
        distance2 = max(out.value[k, 0] ** 2, 1e-6)
    noise[0, 0] += of_face + of_camera[0]
    noise[1, 1] += (of_face + of_camera[1]) / distance2
    if out.has_heading[k]:
        noise[2, 2] += of_camera[2]
    if out.kind[k] == POLAR:
        noise[1, 1] += of_camera[2]
    if of_camera[0] > 0.0:
        out.systematic_share[k, 0] = of_camera[0] / noise[0, 0]
        out.systematic_share[k, 1] = of_camera[1] / distance2 / noise[1, 1]
        out.systematic_share[k, 2] = of_camera[2] / noise[2, 2] if out.has_heading[k] else 0.0


@inlined_njit
def _outcome(
    detections: Detections, k: int, cameras: Cameras, markers: Markers, camera: int, place: int
) -> int:
    """Outcome of detection k with the marker at index `place`: valid, or a reason to drop it."""
    if place < 0 or markers.id[place] != detections.id[k]:
        return _UNKNOWN_ID
    if markers.owner[place] == camera:
        return _OWN_MARKER
    if not cameras.present[camera]:
        return _NO_CAMERA
    if camera >= cameras.robots and markers.owner[place] == NOBODY:
        return _FIXED_ON_FIXED
    content = detections.content[k]
    if not CONTENT_POSITION <= content <= CONTENT_BEARING or (
        content == CONTENT_BEARING and markers.lies[place]
    ):
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
    if detections.content[k] == CONTENT_POSE_TWO:
        valid = valid and is_rotation(detections.alternative_orientation[k])
        for i in range(3):
            valid = valid and math.isfinite(detections.alternative_position[k, i])
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
    _add_residual(sensor, noise)


@cached_njit
def _add_residual(sensor: SensorModel, noise: FloatArray) -> None:
    """Add the residual errors of a camera to the covariance (3, 3) of forward, left, heading."""
    noise[0, 0] += sensor.residual_position_sigma**2
    noise[1, 1] += sensor.residual_position_sigma**2
    noise[2, 2] += sensor.residual_heading_sigma**2


@cached_njit
def _write_spread(sensor: SensorModel, content: int, published: FloatArray, spread: FloatArray) -> None:
    """Write the covariance (6, 6) of a pose in the optical frame; from the sensor model if unknown (-1)."""
    if content != CONTENT_POSITION and published[0, 0] >= 0.0:
        spread[:] = published
        return
    spread[0, 0] = spread[1, 1] = sensor.left_sigma**2
    spread[2, 2] = sensor.forward_sigma**2
    for i in range(3, 6):
        spread[i, i] = sensor.heading_sigma**2
