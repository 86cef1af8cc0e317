"""Overhead camera: CameraInfo and images in, serialized anonymous detections out.

Messages may be those of rclpy or of rosbags, whose fields have the same names.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.detections import ANONYMOUS_DTYPE, encode_anonymous
from swarm_loc_vision.aerial.detector import AerialDetections, AerialDetector
from swarm_loc_vision.aerial.ground_camera import GroundCamera
from swarm_loc_vision.aerial.ground_control import NO_GROUND, Ground, GroundControl
from swarm_loc_vision.aerial.parameters import AerialSettings
from swarm_loc_vision.aerial.rectification import RectificationError
from swarm_loc_vision.common.calibrated_camera import CalibratedCamera, GrayOf
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.common.images import Gray, ImageError

MAP = "map"


class AerialCamera(CalibratedCamera):
    """Finds robots in the images of one overhead camera.

    Args:
        settings: Numbers of the detector.
        polarity: One of `POLARITIES`.
        ground: Control points; its intrinsics, if any, replace camera_info.
        gray_of: Reads an image message, see `TRANSPORTS`.

    Attributes:
        used: Number of images that were searched.
        robots: Number of detections.
        headings: Number of detections with a heading.
        control: The camera's pose; None before the calibration.
    """

    def __init__(self, settings: AerialSettings, polarity: str, ground: Ground, gray_of: GrayOf) -> None:
        super().__init__(gray_of)
        self.used = self.robots = self.headings = 0
        self.control: GroundControl | None = None
        self._settings, self._polarity, self._ground = settings, polarity, ground
        self._detector: tuple[GroundCamera, AerialDetector] | None = None
        self._seeing_trouble = ""
        if ground.camera is not None:
            self.take_over(ground.camera)

    @property
    def diameter(self) -> float:
        """Diameter of the robots [m]; 0: not known yet."""
        return self._detector[1].diameter if self._detector else 0.0

    @property
    def why_nothing(self) -> str:
        """Why no robots can be found, a sentence; empty: they can."""
        if self.control is None:
            return self.trouble or (NO_GROUND if self._ground.is_empty else "")
        return self.control.trouble or self._seeing_trouble

    def use(self, camera: Camera) -> None:
        """Solve for the camera's pose again."""
        self.control = GroundControl(self._ground, camera, self._settings)
        self._detector = None

    def found(self, message: Any) -> bytes:
        """The serialized swarm_loc_msgs/AnonymousDetectionArray of an image, in map."""
        detections = self._seen(self.gray(message))
        self.drops.update(detections.dropped)
        self.used += 1
        self.robots += len(detections)
        self.headings += int(np.isfinite(detections.theta).sum())
        return encode_anonymous(MAP, nanoseconds(message.header.stamp), anonymous_rows(detections))

    def _seen(self, gray: Gray) -> AerialDetections:
        """The robots in an image."""
        ground = self.control.look(gray) if self.control else None
        if ground is None:
            raise ImageError("no_control_points", self.why_nothing)
        try:
            detections = self._detector_for(ground).detect(gray)
        except RectificationError as error:
            self._seeing_trouble = str(error)
            raise ImageError("not_visible", str(error)) from error
        self._seeing_trouble = ""
        return detections

    def _detector_for(self, ground: GroundCamera) -> AerialDetector:
        """The detector for a pose of the camera."""
        if self._detector is None or self._detector[0] is not ground:
            known = self.diameter
            detector = AerialDetector(self._settings, ground, self._polarity)
            detector.diameter = detector.diameter or known
            self._detector = ground, detector
        return self._detector[1]


def anonymous_rows(detections: AerialDetections) -> NDArray[np.void]:
    """Rows of `ANONYMOUS_DTYPE`."""
    rows = np.zeros(len(detections), ANONYMOUS_DTYPE)
    rows["x"], rows["y"] = detections.place.T
    rows["theta"] = detections.theta
    rows["covariance"] = detections.covariance
    rows["u_px"], rows["v_px"] = detections.pixel.T
    return rows
