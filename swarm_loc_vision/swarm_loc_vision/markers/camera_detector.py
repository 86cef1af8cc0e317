"""Detector of one camera: CameraInfo and images in, serialized detections out, live or from a bag.

Messages are those of rclpy or of a bag's type store: the fields have the same names.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from swarm_loc_estimator.common.messages.encoders import encode_detections
from swarm_loc_vision.common.calibrated_camera import CalibratedCamera, GrayOf, stamp_ns_of
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.detector import MarkerDetector
from swarm_loc_vision.markers.rows import detection_rows

CreateDetector = Callable[[Camera], MarkerDetector]


class CameraDetector(CalibratedCamera):
    """The detector of one camera, made as soon as the calibration has come.

    Args:
        create: Makes the detector for a camera.
        gray_of: Reads an image's message, see `TRANSPORTS`.
        ambiguity: See `rows.detection_rows`.

    Attributes:
        markers: How many were found; `drops` counts those without a pose, too, and candidates.
        misfits: How many of these had corners that fit no square by far.
    """

    def __init__(self, create: CreateDetector, gray_of: GrayOf, ambiguity: float) -> None:
        super().__init__(gray_of)
        self.markers = self.misfits = 0
        self._create = create
        self._ambiguity = ambiguity
        self._detector: MarkerDetector  # with the calibration, without which there is no image

    def use(self, camera: Camera) -> None:
        """Make the detector anew."""
        self._detector = self._create(camera)

    def detect(self, message: Any) -> bytes:
        """The serialized swarm_loc_msgs/MarkerDetectionArray of an image, with its stamp and frame.

        Raises:
            ImageError: The image was dropped, and counted.
        """
        gray = self.gray(message)
        detections = self._detector.detect(gray)
        rows = detection_rows(detections, self._ambiguity)
        self.drops["no_pose"] += len(detections) - len(rows)
        self.drops.update(detections.dropped)
        self.markers += len(rows)
        self.misfits += detections.misfits
        return encode_detections(message.header.frame_id, stamp_ns_of(message), rows)
