"""Detector of one camera: CameraInfo and images in, serialized detections out, live or from a bag.

Messages are those of rclpy or of a bag's type store: the fields have the same names.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.io.messages.encoders import encode_detections
from swarm_loc_vision.core.detection.detector import MarkerDetector
from swarm_loc_vision.core.detection.rows import detection_rows
from swarm_loc_vision.core.imaging.camera import Camera, CameraError
from swarm_loc_vision.core.imaging.gray import ImageError, decoded_image, gray_image

Gray = NDArray[np.uint8]
CreateDetector = Callable[[Camera], MarkerDetector]

_SECOND = 1_000_000_000


class CameraDetector:
    """The detector of one camera, made as soon as the calibration has come.

    Args:
        create: Makes the detector for a camera.
        gray_of: Reads an image's message, see `TRANSPORTS`.
        ambiguity: See `rows.detection_rows`.

    Attributes:
        images: How many came.
        markers: How many were found in them.
        misfits: How many of these had corners that fit no square by far.
        drops: Images and calibrations that were dropped, markers without a pose, and candidates, by reason.
        trouble: What is wrong with the calibration, a sentence; empty: nothing.
    """

    def __init__(self, create: CreateDetector, gray_of: Callable[[Any], Gray], ambiguity: float) -> None:
        self.images = self.markers = self.misfits = 0
        self.drops: Counter[str] = Counter()
        self.trouble = ""
        self._create = create
        self._gray_of = gray_of
        self._ambiguity = ambiguity
        self._camera: Camera | None = None
        self._detector: MarkerDetector | None = None

    @property
    def is_calibrated(self) -> bool:
        """Whether images can be used."""
        return self._camera is not None

    def calibrate(self, message: Any) -> None:
        """Take over a sensor_msgs/CameraInfo; the detector is made anew only when it has changed.

        Raises:
            CameraError: The camera is not calibrated; its images are dropped from now on.
        """
        try:
            camera = camera_of(message)
        except CameraError as error:
            self._camera, self._detector, self.trouble = None, None, str(error)
            raise
        self.trouble = ""
        if camera != self._camera:
            self._camera, self._detector = camera, self._create(camera)

    def detect(self, message: Any) -> bytes:
        """The serialized swarm_loc_msgs/MarkerDetectionArray of an image, with its stamp and frame.

        Raises:
            ImageError: The image was dropped, and counted.
        """
        self.images += 1
        try:
            detector, gray = self._usable(message)
        except ImageError as error:
            self.drops[error.reason] += 1
            raise
        detections = detector.detect(gray)
        rows = detection_rows(detections, self._ambiguity)
        self.drops["no_pose"] += len(detections) - len(rows)
        self.drops.update(detections.dropped)
        self.markers += len(rows)
        self.misfits += detections.misfits
        stamp = message.header.stamp
        return encode_detections(message.header.frame_id, stamp.sec * _SECOND + stamp.nanosec, rows)

    def _usable(self, message: Any) -> tuple[MarkerDetector, Gray]:
        """The detector and an image for it."""
        if self._detector is None or self._camera is None:
            raise ImageError("no_calibration", self.trouble or "no camera_info has come yet.")
        gray = self._gray_of(message)
        height, width = gray.shape
        if (width, height) != (self._camera.width, self._camera.height):
            raise ImageError(
                "size",
                f"the image has {width} x {height} pixels, but the camera is calibrated for"
                f" {self._camera.width} x {self._camera.height}.",
            )
        return self._detector, gray


def camera_of(message: Any) -> Camera:
    """The camera that a sensor_msgs/CameraInfo describes.

    Raises:
        CameraError: It is not calibrated, or its images are cut or binned.
    """
    roi = message.roi
    is_cut = (roi.width, roi.height) not in ((0, 0), (message.width, message.height))
    if is_cut or max(message.binning_x, message.binning_y) > 1:
        raise CameraError("the camera's images are cut or binned; only whole ones can be read.")
    return Camera.from_matrix(
        (message.width, message.height),
        np.reshape(message.k, (3, 3)),
        tuple(message.d),
        message.distortion_model,
    )


def gray_of_image(message: Any) -> Gray:
    """The image of a sensor_msgs/Image.

    Raises:
        ImageError: It cannot be read.
    """
    return gray_image(
        message.encoding,
        message.width,
        message.height,
        message.step,
        message.data,
        is_bigendian=bool(message.is_bigendian),
    )


def gray_of_compressed(message: Any) -> Gray:
    """The image of a sensor_msgs/CompressedImage.

    Raises:
        ImageError: It cannot be read.
    """
    return decoded_image(message.format, message.data)


@dataclass(frozen=True)
class Transport:
    """A way that images come, as image_transport has it.

    Attributes:
        suffix: Of the topic, behind that of the images as they are.
        message_type: Of its messages.
        gray_of: Reads one of them.
    """

    suffix: str
    message_type: str
    gray_of: Callable[[Any], Gray]


TRANSPORTS = {
    "raw": Transport("", "sensor_msgs/msg/Image", gray_of_image),
    "compressed": Transport("/compressed", "sensor_msgs/msg/CompressedImage", gray_of_compressed),
}
"""By the names of image_transport."""
