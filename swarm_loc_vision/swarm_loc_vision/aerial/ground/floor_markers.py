"""Ground control by fiducials that lie on the floor: markers of known id, place and size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.number_spec import number
from swarm_loc_vision.aerial.ground.control_points import ControlPoints
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.common.gray import Gray
from swarm_loc_vision.markers.detector import MarkerDetector
from swarm_loc_vision.markers.detector_settings import DetectorSettings
from swarm_loc_vision.markers.families import Family

_UNIT_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])
"""Clockwise from a marker's upper left, x right and y up as seen by one who faces it."""
_CORNER_NAMES = ("upper left", "upper right", "lower right", "lower left")


@dataclass(frozen=True)
class FloorMarker:
    """A marker that lies on the floor, or level above it, and looks up."""

    id: int
    x: float = number(0.0, "m", -1e4, 1e4, "its centre in map")
    y: float = number(0.0, "m", -1e4, 1e4, "likewise")
    z: float = number(0.0, "m", -10.0, 10.0, "likewise")
    yaw: float = number(0.0, "rad", -6.3, 6.3, "to its own right, from map's x")
    size: float = number(0.1, "m", 0.001, 10.0, "side of its black square")

    @property
    def corners(self) -> FloatArray:
        """(4, 3) in map [m], clockwise from its own upper left."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        flat = self.size * _UNIT_CORNERS @ np.array([[cos, sin], [-sin, cos]]) + [self.x, self.y]
        return np.concatenate([flat, np.full((4, 1), self.z)], axis=1)


class FloorMarkers:
    """Finds floor markers, and means their corners over the images of a camera that stands still.

    Args:
        markers: Those that there are.
        family: Their kind.
        camera: What takes the images.
    """

    def __init__(self, markers: Sequence[FloorMarker], family: Family, camera: Camera) -> None:
        self._markers = {marker.id: marker for marker in markers}
        ids = np.array(sorted(self._markers), np.int64)
        self._detector = MarkerDetector(DetectorSettings(), [(family, ids)], camera)
        self._sums: dict[int, FloatArray] = {}
        self._counts: dict[int, int] = {}

    def look(self, gray: Gray) -> ControlPoints:
        """Control points by one image (height, width), which counts for the mean, too."""
        found = self._detector.detect(gray)
        seen = dict(zip(found.id.tolist(), found.corners, strict=True))
        for marker_id, corners in seen.items():
            self._sums[marker_id] = self._sums.get(marker_id, np.zeros((4, 2))) + corners
            self._counts[marker_id] = self._counts.get(marker_id, 0) + 1
        return self._points(seen)

    def mean(self) -> ControlPoints:
        """Control points by all images so far."""
        return self._points({i: self._sums[i] / self._counts[i] for i in self._sums})

    def _points(self, corners: Mapping[int, FloatArray]) -> ControlPoints:
        """The corners (4, 2) of markers as control points."""
        return ControlPoints(
            [f"{corner} of marker {marker_id}" for marker_id in corners for corner in _CORNER_NAMES],
            np.array([self._markers[marker_id].corners for marker_id in corners]).reshape(-1, 3),
            np.array(list(corners.values())).reshape(-1, 2),
        )

    def forget(self) -> None:
        """Begin anew: the camera has moved."""
        self._sums.clear()
        self._counts.clear()
