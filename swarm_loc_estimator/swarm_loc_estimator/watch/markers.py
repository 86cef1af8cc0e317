"""Serialize visualization_msgs/MarkerArray of a swarm: a few lists of points and lines for all robots."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray
from swarm_loc_estimator.common.messages.cdr import MARKERS, encode
from swarm_loc_estimator.common.messages.poses import EstimateMessage
from swarm_loc_estimator.swarm.swarm import Pose2, Swarm
from swarm_loc_estimator.timeline.sightings import Sightings

LINE_LIST, CUBE_LIST, SPHERE_LIST, TEXT = 5, 6, 7, 9
_DELETE_ALL = 3
_COLOURS = np.array(
    [
        [0.48, 0.53, 0.56, 1.0],  # waiting
        [0.00, 0.45, 0.70, 1.0],  # tracked
        [0.48, 0.53, 0.56, 1.0],  # stale
        [0.90, 0.62, 0.00, 1.0],  # unconfirmed
        [0.84, 0.37, 0.00, 1.0],  # contradicted
        [0.90, 0.62, 0.00, 1.0],  # uncertain
    ]
)
_USED, _GATED, _KEPT = [0.0, 0.62, 0.45, 0.7], [0.84, 0.37, 0.0, 0.9], [0.9, 0.62, 0.0, 0.9]
_VERDICT_COLOURS = np.array([_KEPT, _USED, _GATED, _KEPT, _KEPT])
_INK = (0.2, 0.25, 0.3, 1.0)
_CHI2_95 = 5.991  # 95 % bound of the chi-square distribution with two degrees of freedom
_CORNERS = 24
_MAX_LABELS = 100
_HEIGHT = 0.01
_BODY_PER_WHEELS = 1.32  # Ratio of body diameter to wheel separation, as of an e-puck


Marker = dict[str, Any]  # Fields of a visualization_msgs/Marker; others are zero: it lasts until the next


class MarkersEncoder:
    """Serializes the markers of a swarm."""

    def __init__(self, swarm: Swarm, frame_id: str) -> None:
        self._frame_id = frame_id
        self._names = [robot.name for robot in swarm.robots]
        widths = [robot.odometry.wheel_separation for robot in swarm.robots]
        self._size = _BODY_PER_WHEELS * float(np.median(widths)) if widths else 0.07
        self._landmarks = np.array([[one.x, one.y, one.z] for one in swarm.landmarks]).reshape(-1, 3)
        # lines from landmarks to where they face
        facing = [(one.x, one.y, one.z, one.yaw) for one in swarm.landmarks if one.yaw is not None]
        x, y, z, yaw = np.array(facing).reshape(-1, 4).T
        ends = [x, y, z, x + self._size * np.cos(yaw), y + self._size * np.sin(yaw), z]
        self._faces = np.stack(ends, axis=1).reshape(-1, 3)
        self._cameras = np.array([[one.x, one.y, one.z] for one in swarm.cameras]).reshape(-1, 3)

    def encode(self, estimate: EstimateMessage, sightings: Sightings | None = None) -> bytes:
        """The message for poses and sightings; it deletes all markers before it."""
        located: BoolArray = ~np.isnan(estimate.pose[:, 0])
        pose, size = estimate.pose[located], self._size
        colours = _COLOURS[np.minimum(estimate.status[located], len(_COLOURS) - 1)]
        around = ellipses(pose, estimate.covariance[located])
        line, known = (0.15 * size, 0.0, 0.0), estimate.pose[estimate.heading_known]
        ahead = known[:, :2] + size * np.column_stack([np.cos(known[:, 2]), np.sin(known[:, 2])])
        headings = np.stack([known[:, :2], ahead], axis=1).reshape(-1, 2)
        headings = np.column_stack([headings, np.full(len(headings), size)])
        markers = [
            _marker("landmarks", CUBE_LIST, (0.4 * size,) * 3, self._landmarks),
            _marker("landmarks_facing", LINE_LIST, line, self._faces),
            _marker("cameras", CUBE_LIST, (0.6 * size,) * 3, self._cameras),
            _marker("robots", SPHERE_LIST, (size, size, 0.5 * size), _lifted(pose), colours),
            _marker("headings", LINE_LIST, line, headings),
            _marker("ellipses_95", LINE_LIST, (0.06 * size, 0.0, 0.0), around),
        ]
        if sightings is not None:
            markers.append(self._sightings(estimate, sightings))
        markers = [one for one in markers if len(one["points"])]
        if len(self._names) <= _MAX_LABELS:
            names = [name for name, there in zip(self._names, located.tolist(), strict=True) if there]
            above = _lifted(pose) + np.array([0.0, 0.0, size])
            for number, (name, at) in enumerate(zip(names, above, strict=True)):
                label = _marker("names", TEXT, (0.0, 0.0, 0.6 * size), above[:0])
                label["pose"]["position"] = _vector(at)
                markers.append({**label, "id": number, "text": name})
        header = {"stamp": estimate.stamp_ns, "frame_id": self._frame_id}
        delete_all = {"action": _DELETE_ALL}
        return encode({"markers": [{"header": header, **one} for one in (delete_all, *markers)]}, MARKERS)

    def _sightings(self, estimate: EstimateMessage, seen: Sightings) -> Marker:
        places = np.concatenate([estimate.pose[:, :2], self._landmarks[:, :2]])
        target = np.where(seen.target < 0, len(estimate.pose) - 1 - seen.target, seen.target)
        ends = np.stack([places[seen.observer], places[target]], axis=1)
        shown = np.isfinite(ends).all(axis=(1, 2)) & (seen.observer >= 0)
        colours = _VERDICT_COLOURS[np.minimum(seen.verdict[shown], len(_VERDICT_COLOURS) - 1)]
        scale = (0.05 * self._size, 0.0, 0.0)
        points = _lifted(ends[shown].reshape(-1, 2))
        return _marker("sightings", LINE_LIST, scale, points, np.repeat(colours, 2, axis=0))


def _marker(
    name: str, kind: int, scale: Pose2, points: FloatArray, colours: FloatArray | None = None
) -> Marker:
    """A marker of points (n, 3) in colours (n, 4), by default the ink."""
    return {
        "ns": name,
        "type": kind,
        "pose": {"orientation": {"w": 1.0}},
        "scale": _vector(scale),
        "color": dict(zip("rgba", _INK, strict=True)),
        "points": points,
        "colors": np.tile(_INK, (len(points), 1)) if colours is None else colours,
    }


def _vector(numbers: Iterable[float]) -> dict[str, float]:
    return dict(zip("xyz", numbers, strict=True))


def _lifted(points: FloatArray) -> FloatArray:
    """Points (n, 3) a little above the ground at x, y of rows (n, 2 or more)."""
    return np.column_stack([points[:, :2], np.full(len(points), _HEIGHT)])


def ellipses(pose: FloatArray, covariance: FloatArray) -> FloatArray:
    """Lines (n * 2 * corners, 3) around the 95 % ellipses of positions, of poses (n, 3) in map."""
    turn = 2.0 * np.pi * np.arange(_CORNERS + 1) / _CORNERS
    circle = np.stack([np.cos(turn), np.sin(turn)])
    values, vectors = np.linalg.eigh(covariance[:, :2, :2])
    axes = vectors * np.sqrt(_CHI2_95 * np.maximum(values, 0.0))[:, None, :]
    around: FloatArray = pose[:, :2, None] + axes @ circle
    lines = np.stack([around[..., :-1], around[..., 1:]], axis=-1)  # (n, 2, corners, 2 ends)
    return _lifted(np.moveaxis(lines, 1, -1).reshape(-1, 2))
