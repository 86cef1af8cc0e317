"""Detector of one camera: converts CameraInfo and images to serialized detections.

Messages may be those of rclpy or of rosbags, whose fields have the same names.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swarm_loc_estimator import CONTENT_POSE, CONTENT_POSE_TWO
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.common.messages.detections import DETECTION_DTYPE, encode_detections
from swarm_loc_vision.common.calibrated_camera import CalibratedCamera, GrayOf
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.detector import Detections, MarkerDetector

CreateDetector = Callable[[Camera], MarkerDetector]


class CameraDetector(CalibratedCamera):
    """The detector of one camera; created when its calibration arrives.

    Args:
        create: Creates the detector for a camera.
        gray_of: Reads an image message, see `TRANSPORTS`.
        ambiguity: See `detection_rows`.

    Attributes:
        markers: Number of markers with a pose; `drops` also counts those without, and candidates.
        misfits: Number of them whose corners do not fit a square.
    """

    def __init__(self, create: CreateDetector, gray_of: GrayOf, ambiguity: float) -> None:
        super().__init__(gray_of)
        self.markers = self.misfits = 0
        self._create = create
        self._ambiguity = ambiguity
        self._detector: MarkerDetector  # set with the calibration, without which images are dropped

    def use(self, camera: Camera) -> None:
        """Create the detector for another calibration."""
        self._detector = self._create(camera)

    def found(self, message: Any) -> bytes:
        """The serialized swarm_loc_msgs/MarkerDetectionArray of an image."""
        gray = self.gray(message)
        detections = self._detector.detect(gray)
        rows = detection_rows(detections, self._ambiguity)
        self.drops["no_pose"] += len(detections) - len(rows)
        self.drops.update(detections.dropped)
        self.markers += len(rows)
        self.misfits += detections.misfits
        return encode_detections(message.header.frame_id, nanoseconds(message.header.stamp), rows)


_MIN_CHI2 = 1e-6


def detection_rows(detections: Detections, ambiguity: float) -> NDArray[np.void]:
    """Rows of `DETECTION_DTYPE`, one per marker that has a pose.

    Args:
        detections: Detections with poses.
        ambiguity: The mirrored pose is included if its chi square is higher by at most this.

    Raises:
        ValueError: The detector has no camera.
    """
    if detections.poses is None:
        raise ValueError("a detector without a camera finds no poses.")
    solved = np.isfinite(detections.poses.chi2[:, 0])
    rotation, position, covariance, chi2 = (column[solved] for column in detections.poses)
    is_two = chi2[:, 1] - chi2[:, 0] <= ambiguity
    rows = np.zeros(len(chi2), DETECTION_DTYPE)
    rows["id"] = detections.id[solved]
    rows["family"] = detections.family[solved]
    rows["content"] = np.where(is_two, CONTENT_POSE_TWO, CONTENT_POSE)
    rows["id_margin"] = detections.margin[solved]
    rows["corners_px"] = detections.corners[solved]
    rows["position"] = position[:, 0]
    rows["orientation"] = _quaternions(rotation[:, 0])
    rows["covariance"] = covariance[:, 0]
    rows["alternative_orientation"][:, 3] = 1.0
    rows["alternative_position"][is_two] = position[is_two, 1]
    rows["alternative_orientation"][is_two] = _quaternions(rotation[is_two, 1])
    rows["alternative_ratio"] = np.nan
    least = np.maximum(chi2[is_two], _MIN_CHI2)
    rows["alternative_ratio"][is_two] = np.sqrt(least[:, 1] / least[:, 0])
    return rows


def _quaternions(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4) x, y, z, w."""
    if not len(rotations):
        return np.zeros((0, 4))
    return np.asarray(Rotation.from_matrix(rotations).as_quat())
