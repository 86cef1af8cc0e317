"""From what cameras report to measurements: whose marker it is, where it is in the plane, how sure.

A detection is a marker's pose in the camera's optical frame (x right, y down, z forward). It becomes a
measurement in the sensor frame of the plane: at the camera's place on the robot, turned by its yaw, with
the mount's pitch and roll taken out.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_estimator.core.gate import gate_threshold
from swarm_loc_estimator.core.measurements import MEASUREMENT_DTYPE, NOBODY, Kind, MeasurementArray
from swarm_loc_estimator.core.se2 import FloatArray
from swarm_loc_estimator.core.swarm import CameraMount, SensorModel, Swarm

CONTENT_POSITION = 1
"""Detection content: position only (MarkerDetection.CONTENT_POSITION)."""
CONTENT_POSE = 2
"""Detection content: position and orientation."""
CONTENT_POSE_TWO = 3
"""Detection content: likewise, with a mirrored second solution."""

_FARTHEST_M = 1e3
_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Conversion:
    """What became of detections.

    Attributes:
        measurements: (m,) of MEASUREMENT_DTYPE.
        dropped: Reason -> count, for `unknown_id`, `own_marker`, `no_camera`, `non_finite` and `absurd`.
    """

    measurements: MeasurementArray
    dropped: dict[str, int]


class SightingConverter:
    """Converts the detections of all cameras of a swarm at once.

    Args:
        swarm: Cameras, their calibration, and whose the markers are.
    """

    def __init__(self, swarm: Swarm) -> None:
        owners = sorted(swarm.owner_of.items())
        self._id = np.array([marker_id for marker_id, _ in owners], dtype=np.int64)
        self._owner = np.array([owner.robot_index for _, owner in owners], dtype=np.int64)
        markers = [owner.marker for _, owner in owners]
        yaw = [np.nan if m.yaw is None else m.yaw for m in markers]
        self._marker = np.array([[m.x, m.y, y] for m, y in zip(markers, yaw, strict=True)]).reshape(-1, 3)
        self._has_camera = np.array([robot.camera is not None for robot in swarm.robots])
        mounts = [robot.camera or CameraMount() for robot in swarm.robots]
        self._mount = np.array([[m.x, m.y, m.yaw] for m in mounts]).reshape(-1, 3)
        tilt = Rotation.from_euler("yx", [[m.pitch, m.roll] for m in mounts]) if mounts else None
        self._level = tilt.as_matrix() @ _FROM_OPTICAL if tilt else np.zeros((0, 3, 3))
        self._sensor = {
            f.name: np.array([getattr(robot.sensor, f.name) for robot in swarm.robots], dtype=float)
            for f in fields(SensorModel)
        }
        self._gate = gate_threshold(self._sensor["gate_probability"])

    def convert(
        self, robots: NDArray[np.int64], stamps_ns: NDArray[np.int64], detections: NDArray[np.void]
    ) -> Conversion:
        """Turn detections into measurements.

        Args:
            robots: (d,) index of the robot whose camera saw each.
            stamps_ns: (d,) exposure times.
            detections: (d,) with fields id, content, position (3,), orientation (4,) xyzw, covariance (6, 6),
                alternative_orientation (4,), as published in the optical frame.
        """
        dropped: dict[str, int] = {}
        place = np.clip(np.searchsorted(self._id, detections["id"]), 0, max(0, self._id.size - 1))
        known = (
            self._id[place] == detections["id"] if self._id.size else np.zeros(detections.size, dtype=bool)
        )
        checks = {
            "unknown_id": known,
            "own_marker": ~known | (self._owner[place] != robots) if self._id.size else known,
            "no_camera": self._has_camera[robots],
            "non_finite": _all_finite(detections),
            "absurd": ~(np.abs(detections["position"]).max(axis=1, initial=0.0) > _FARTHEST_M),
        }
        good = np.ones(detections.size, dtype=bool)
        for reason, passed in checks.items():
            dropped[reason] = int(np.sum(good & ~passed))
            good &= passed
        measurements = self._measure(robots[good], stamps_ns[good], detections[good], place[good])
        return Conversion(measurements, {reason: count for reason, count in dropped.items() if count})

    def _measure(
        self,
        robots: NDArray[np.int64],
        stamps_ns: NDArray[np.int64],
        detections: NDArray[np.void],
        place: NDArray[np.intp],
    ) -> MeasurementArray:
        result = np.zeros(robots.size, dtype=MEASUREMENT_DTYPE)
        sensor = {name: values[robots] for name, values in self._sensor.items()}
        result["stamp_ns"] = stamps_ns + np.rint(sensor["time_offset_s"] * 1e9).astype(np.int64)
        result["received_from"] = result["observer"] = robots
        result["target"] = np.where(self._owner[place] >= 0, self._owner[place], NOBODY)
        result["marker_id"] = self._id[place]
        result["sensor"] = self._mount[robots]
        result["marker"] = np.nan_to_num(self._marker[place])
        level = self._level[robots]
        position = np.einsum("dij,dj->di", level, detections["position"])
        with_heading = (detections["content"] != CONTENT_POSITION) & ~np.isnan(self._marker[place][:, 2])
        result["has_heading"] = with_heading
        result["kind"] = np.where(with_heading, Kind.CARTESIAN, Kind.POLAR)
        result["has_alternative"] = with_heading & (detections["content"] == CONTENT_POSE_TWO)
        self._fill_polar(result, position, sensor, ~with_heading)
        for name in ("value", "alternative"):
            orientation = "orientation" if name == "value" else "alternative_orientation"
            heading = _face_heading(level[with_heading], detections[orientation][with_heading])
            result[name][with_heading] = np.column_stack([position[with_heading, :2], heading])
        result["gate"] = self._gate[robots]
        result["covariance"][with_heading] = _pose_noise(
            detections["covariance"][with_heading],
            level[with_heading],
            {k: v[with_heading] for k, v in sensor.items()},
        )
        return result

    def _fill_polar(
        self,
        result: MeasurementArray,
        position: FloatArray,
        sensor: dict[str, FloatArray],
        rows: NDArray[np.bool_],
    ) -> None:
        """Calibrated range and bearing of detections without a heading."""
        logged_range = np.hypot(position[rows, 0], position[rows, 1])
        logged_bearing = np.arctan2(position[rows, 1], position[rows, 0])
        s = {name: values[rows] for name, values in sensor.items()}
        curve = s["range_log_scale"] + s["range_skew"] * logged_bearing + s["range_curve"] * logged_bearing**2
        distance = logged_range * np.exp(curve) + s["range_offset"]
        distance += s["robot_range_offset"] * (result["target"][rows] != NOBODY)
        bearing = (s["bearing_scale"] + s["bearing_curve"] * logged_bearing) * logged_bearing
        result["value"][rows, 0] = distance
        result["value"][rows, 1] = bearing + s["bearing_offset"]
        covariance = np.zeros((distance.size, 3, 3))
        covariance[:, 0, 0] = (s["range_sigma"] + s["range_sigma_per_m"] * np.abs(distance)) ** 2
        covariance[:, 1, 1] = s["bearing_sigma"] ** 2
        covariance[:, 2, 2] = 1.0
        result["covariance"][rows] = covariance


def _all_finite(detections: NDArray[np.void]) -> NDArray[np.bool_]:
    """Whether all numbers that the content promises are finite (d,); a zero quaternion is none."""
    with_pose = detections["content"] != CONTENT_POSITION
    with_two = detections["content"] == CONTENT_POSE_TWO
    finite: NDArray[np.bool_] = np.isfinite(detections["position"]).all(axis=1)
    finite &= ~with_pose | np.isfinite(detections["covariance"]).all(axis=(1, 2))
    for name, needed in (("orientation", with_pose), ("alternative_orientation", with_two)):
        quaternion = detections[name]
        finite &= ~needed | (
            np.isfinite(quaternion).all(axis=1) & (np.abs(quaternion).max(axis=1, initial=0.0) > 1e-6)
        )
    return finite


def _face_heading(level: FloatArray, quaternion: FloatArray) -> FloatArray:
    """Heading (d,) in the sensor's plane of the direction out of each face, its z axis."""
    if not quaternion.shape[0]:
        return np.zeros(0)
    out_of_face = Rotation.from_quat(quaternion).as_matrix()[:, :, 2]
    levelled = np.einsum("dij,dj->di", level, out_of_face)
    heading: FloatArray = np.arctan2(levelled[:, 1], levelled[:, 0])
    return heading


def _pose_noise(published: FloatArray, level: FloatArray, sensor: dict[str, FloatArray]) -> FloatArray:
    """Covariances (d, 3, 3) of forward, left, heading: as published, or the sensor's where unknown (-1)."""
    to_plane = np.zeros((published.shape[0], 3, 6))
    to_plane[:, :2, :3] = level[:, :2, :]
    to_plane[:, 2, 3:] = level[:, 2, :]  # the rotation about the vertical
    planar = to_plane @ published @ np.swapaxes(to_plane, 1, 2)
    unknown = published[:, 0, 0] < 0.0
    configured = np.zeros_like(planar)
    for i, name in enumerate(("forward_sigma", "left_sigma", "heading_sigma")):
        configured[:, i, i] = sensor[name] ** 2
    noise: FloatArray = np.where(unknown[:, None, None], configured, planar)
    return noise
