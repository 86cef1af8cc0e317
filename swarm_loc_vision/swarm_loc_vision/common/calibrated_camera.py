"""A camera as its messages tell of it: calibration and images in, whatever is made of them out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from swarm_loc_vision.common.camera import Camera, CameraError
from swarm_loc_vision.common.images import Gray, ImageError

GrayOf = Callable[[Any], Gray]


class CalibratedCamera:
    """The calibration of one camera, and its images as far as they belong to it.

    Args:
        gray_of: Reads an image's message.

    Attributes:
        images: How many came.
        drops: What was dropped, by reason.
        camera: The calibration; None: none has come, or it cannot be used.
        trouble: What is wrong with it, a sentence; empty: nothing.
    """

    def __init__(self, gray_of: GrayOf) -> None:
        self.images = 0
        self.drops: Counter[str] = Counter()
        self.camera: Camera | None = None
        self.trouble = ""
        self._gray_of = gray_of

    @property
    def is_calibrated(self) -> bool:
        """Whether images can be used."""
        return self.camera is not None

    def calibrate(self, message: Any) -> None:
        """Take over a sensor_msgs/CameraInfo.

        Raises:
            CameraError: The camera is not calibrated; its images are dropped from now on.
        """
        try:
            camera = camera_of(message)
        except CameraError as error:
            self.camera, self.trouble = None, str(error)
            raise
        self.take_over(camera)

    def take_over(self, camera: Camera) -> None:
        """Use a calibration from now on."""
        self.trouble = ""
        if camera != self.camera:
            self.camera = camera
            self.use(camera)

    def use(self, camera: Camera) -> None:
        """A calibration has come that is another one than before."""
        raise NotImplementedError

    def gray(self, message: Any) -> Gray:
        """An image (height, width) of this camera, counted.

        Raises:
            ImageError: It was dropped, and counted.
        """
        self.images += 1
        try:
            return self._usable(message)
        except ImageError as error:
            self.drops[error.reason] += 1
            raise

    def _usable(self, message: Any) -> Gray:
        """An image that has the size that was calibrated."""
        if self.camera is None:
            raise ImageError("no_calibration", self.trouble or "no camera_info has come yet.")
        gray = self._gray_of(message)
        height, width = gray.shape
        if (width, height) != (self.camera.width, self.camera.height):
            raise ImageError(
                "size",
                f"the image has {width} x {height} pixels, but the camera is calibrated for"
                f" {self.camera.width} x {self.camera.height}.",
            )
        return gray


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
