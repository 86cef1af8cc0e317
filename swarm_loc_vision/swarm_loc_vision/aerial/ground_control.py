"""Pose of an overhead camera from given points and floor markers, kept while it holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import number
from swarm_loc_vision.aerial.control_points import (
    MIN_POINTS,
    NO_POINTS,
    ControlPointError,
    ControlPoints,
    PoseFit,
    misfit,
    solve_pose,
)
from swarm_loc_vision.aerial.ground_camera import GroundCamera
from swarm_loc_vision.aerial.parameters import AerialSettings
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.common.images import Gray
from swarm_loc_vision.markers.detector import DetectorSettings, MarkerDetector
from swarm_loc_vision.markers.families import Family, family_named

_UNIT_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])
"""Clockwise from the upper left of a marker, x right and y up when facing it."""
_CORNER_NAMES = ("upper left", "upper right", "lower right", "lower left")


@dataclass(frozen=True)
class FloorMarker:
    """A marker that lies on the floor, or level above it, face up."""

    id: int
    x: float = number(0.0, "m", -1e4, 1e4, "x of its centre in map")
    y: float = number(0.0, "m", -1e4, 1e4, "y of its centre in map")
    z: float = number(0.0, "m", -10.0, 10.0, "z of its centre in map")
    yaw: float = number(0.0, "rad", -6.3, 6.3, "direction to its right, from the x axis of map")
    size: float = number(0.1, "m", 0.001, 10.0, "side of its black square")

    @property
    def corners(self) -> FloatArray:
        """(4, 3) in map [m], clockwise from its own upper left."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        flat = self.size * _UNIT_CORNERS @ np.array([[cos, sin], [-sin, cos]]) + [self.x, self.y]
        return np.concatenate([flat, np.full((4, 1), self.z)], axis=1)


class FloorMarkers:
    """Finds floor markers of a family, and averages their corners over the images of a static camera."""

    def __init__(self, markers: Sequence[FloorMarker], family: Family, camera: Camera) -> None:
        self._markers = {marker.id: marker for marker in markers}
        ids = np.array(sorted(self._markers), np.int64)
        self._detector = MarkerDetector(DetectorSettings(), {family: ids}, camera)
        self._sums: dict[int, FloatArray] = {}
        self._counts: dict[int, int] = {}

    def look(self, gray: Gray) -> ControlPoints:
        """Control points from one image (height, width), which also adds to the mean."""
        found = self._detector.detect(gray)
        seen = dict(zip(found.id.tolist(), found.corners, strict=True))
        for marker_id, corners in seen.items():
            self._sums[marker_id] = self._sums.get(marker_id, np.zeros((4, 2))) + corners
            self._counts[marker_id] = self._counts.get(marker_id, 0) + 1
        return self._points(seen)

    def mean(self) -> ControlPoints:
        """Control points from all images so far."""
        return self._points({i: self._sums[i] / self._counts[i] for i in self._sums})

    def _points(self, corners: Mapping[int, FloatArray]) -> ControlPoints:
        """The corners (4, 2) of markers as control points."""
        return ControlPoints(
            [f"{corner} of marker {marker_id}" for marker_id in corners for corner in _CORNER_NAMES],
            np.array([self._markers[marker_id].corners for marker_id in corners]).reshape(-1, 3),
            np.array(list(corners.values())).reshape(-1, 2),
        )

    def forget(self) -> None:
        """Reset the mean after the camera has moved."""
        self._sums.clear()
        self._counts.clear()


NO_GROUND = "there are neither control points nor floor markers, without which nothing is published."
_SETTLING, _LATER_EVERY = 10, 10
"""Markers are searched in this many first images, then in every n-th to detect motion of the camera."""
_MOVED = 3.0
"""Median displacement of markers that shows a motion of the camera, in standard deviations of a point."""


@dataclass(frozen=True)
class Ground:
    """Known references on the floor."""

    points: ControlPoints = NO_POINTS  # Control points
    markers: tuple[FloorMarker, ...] = ()  # Floor markers
    # Family of the floor markers
    family: Family = field(default_factory=lambda: family_named("aruco_mip_36h12"))
    camera: Camera | None = None  # Intrinsics; None: those of camera_info

    @property
    def is_empty(self) -> bool:
        """Whether there is neither a point nor a marker."""
        return not self.points.names and not self.markers


class GroundControl:
    """Keeps the pose of one camera, by known references on the floor.

    The settings are the noise of the control points, and the limit of their residuals.
    """

    def __init__(self, ground: Ground, camera: Camera, settings: AerialSettings) -> None:
        self._ground, self._camera, self._settings = ground, camera, settings
        self._markers = FloorMarkers(ground.markers, ground.family, camera) if ground.markers else None
        self._images = 0
        self.moves = 0  # Number of detected motions of the camera
        self.fit: PoseFit | None = None  # The pose; None: unknown
        # Why it is unknown, a sentence; empty: it is known, or there was no image yet
        self.trouble = NO_GROUND if ground.is_empty else ""
        if len(ground.points) >= MIN_POINTS or (ground.points.names and not ground.markers):
            self._solve(ground.points)

    def look(self, gray: Gray) -> GroundCamera | None:
        """The camera with its pose at an image (height, width); None: see `trouble`."""
        if self._markers is not None:
            self._look_at(self._markers, gray)
        self._images += 1
        return self.fit.ground if self.fit else None

    def _look_at(self, markers: FloorMarkers, gray: Gray) -> None:
        """Solve for the pose with the markers of the first images, then detect motions of the camera."""
        if self._images < _SETTLING:
            markers.look(gray)
            if self.fit is None or self._images == _SETTLING - 1:
                self._solve(self._ground.points.concatenate(markers.mean()))
        elif self.fit is None or self._images % _LATER_EVERY == 0:
            seen = markers.look(gray)
            if self.fit is None or self._has_moved(self.fit, seen):
                self.moves += self.fit is not None
                self._images = 0
                markers.forget()
                markers.look(gray)
                self._solve(self._ground.points.concatenate(markers.mean()))

    def _has_moved(self, fit: PoseFit, seen: ControlPoints) -> bool:
        """Whether most markers have moved in the image."""
        if not len(seen):
            return False
        away = np.linalg.norm(fit.ground.pixels(seen.places) - seen.pixels, axis=1)
        return not np.median(away) <= _MOVED * np.hypot(self._settings.control_sigma_px, fit.rms_px)

    def _solve(self, points: ControlPoints) -> None:
        try:
            self.fit, self.trouble = _solved(self._camera, points, self._settings), ""
        except ControlPointError as error:
            self.fit, self.trouble = None, str(error)


def located(ground: Ground, camera: Camera, pictures: Sequence[Gray], settings: AerialSettings) -> PoseFit:
    """The pose by all points and by the corners of the markers, averaged over all pictures (height, width).

    Raises:
        ControlPointError: The points do not determine a pose, or contradict each other.
    """
    points = ground.points
    if ground.markers:
        markers = FloorMarkers(ground.markers, ground.family, camera)
        for gray in pictures:
            markers.look(gray)
        points = points.concatenate(markers.mean())
    return _solved(camera, points, settings)


def _solved(camera: Camera, points: ControlPoints, settings: AerialSettings) -> PoseFit:
    """The pose with points; raises ControlPointError if they do not fit."""
    fit = solve_pose(camera, points, settings)
    if why := misfit(fit, points, settings):
        raise ControlPointError(why)
    return fit
