"""Ground control of one camera: the pose by given points and floor markers, kept while it holds."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from swarm_loc_vision.aerial.ground.control_points import (
    MIN_POINTS,
    NO_POINTS,
    ControlPointError,
    ControlPoints,
    Noise,
    PoseFit,
    misfit,
    solve_pose,
)
from swarm_loc_vision.aerial.ground.floor_markers import FloorMarker, FloorMarkers
from swarm_loc_vision.aerial.ground.ground_camera import GroundCamera
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.common.gray import Gray
from swarm_loc_vision.markers.families import Family, family_named

NO_GROUND = "there are neither control points nor floor markers, without which nothing is published."
_SETTLING, _LATER_EVERY = 10, 10
"""Markers are looked for in so many first images, then in every so many-th: is the camera where it was?"""
_MOVED = 3.0
"""So many standard deviations of one point most of them are away when the camera has moved."""


@dataclass(frozen=True)
class Ground:
    """What is known of the floor.

    Attributes:
        points: Places whose pixels are known.
        markers: Fiducials on the floor.
        family: Their kind.
        camera: Intrinsics; None: they come with the images.
    """

    points: ControlPoints = NO_POINTS
    markers: tuple[FloorMarker, ...] = ()
    family: Family = field(default_factory=lambda: family_named("aruco_mip_36h12"))
    camera: Camera | None = None

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to tell a camera's pose by."""
        return not self.points.names and not self.markers


class GroundControl:
    """Keeps the pose of one camera.

    Args:
        ground: What is known of the floor.
        camera: What takes the images.
        noise: Of the control points.
        limit: Residual beyond which they are refused, in their standard deviations.

    Attributes:
        fit: The pose; None: not known.
        trouble: Why it is not known, a sentence; empty: it is, or no image has come yet.
        moves: How often the camera was found to have moved.
    """

    def __init__(self, ground: Ground, camera: Camera, noise: Noise, limit: float) -> None:
        self._ground, self._camera, self._noise, self._limit = ground, camera, noise, limit
        self._markers = FloorMarkers(ground.markers, ground.family, camera) if ground.markers else None
        self._images = self.moves = 0
        self.fit: PoseFit | None = None
        self.trouble = NO_GROUND if ground.is_empty else ""
        if len(ground.points) >= MIN_POINTS or (ground.points.names and not ground.markers):
            self._solve(ground.points)

    def look(self, gray: Gray) -> GroundCamera | None:
        """The camera that took an image (height, width), with its pose; None: see `trouble`."""
        if self._markers is not None:
            self._look_at(self._markers, gray)
        self._images += 1
        return self.fit.ground if self.fit else None

    def _look_at(self, markers: FloorMarkers, gray: Gray) -> None:
        """Solve for the pose by the first images' markers, then watch whether they stay where they are."""
        if self._images < _SETTLING:
            markers.look(gray)
            if self.fit is None or self._images == _SETTLING - 1:
                self._solve(self._ground.points.joined(markers.mean()))
        elif self.fit is None or self._images % _LATER_EVERY == 0:
            seen = markers.look(gray)
            if self.fit is None or self._has_moved(self.fit, seen):
                self.moves += self.fit is not None
                self._images = 0
                markers.forget()
                markers.look(gray)
                self._solve(self._ground.points.joined(markers.mean()))

    def _has_moved(self, fit: PoseFit, seen: ControlPoints) -> bool:
        """Whether most of what is seen is no longer where it was."""
        if not len(seen):
            return False
        away = np.linalg.norm(fit.ground.pixels(seen.places) - seen.pixels, axis=1)
        return not np.median(away) <= _MOVED * np.hypot(self._noise.pixel, fit.rms_px)

    def _solve(self, points: ControlPoints) -> None:
        """The pose by points."""
        try:
            fit = solve_pose(self._camera, points, self._noise)
            self.trouble = misfit(fit, points, self._noise, self._limit)
        except ControlPointError as error:
            fit, self.trouble = None, str(error)
        self.fit = None if self.trouble else fit
