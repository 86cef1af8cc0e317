"""One camera by its messages: the calibration, and the images that fit it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from swarm_loc_vision.common.camera import Camera, CameraError
from swarm_loc_vision.common.images import Gray, ImageError, Size

GrayOf = Callable[[Any, Size], Gray]


class Calibration:
    """The calibration of one camera; subclasses use its images, or what was found in them."""

    def __init__(self) -> None:
        self.images = 0  # Number of images received
        self.drops: Counter[str] = Counter()  # Number of drops by reason
        self.camera: Camera | None = None  # The calibration; None: none was received, or it cannot be used
        self.trouble = ""  # What is wrong with the calibration, a sentence; empty: nothing

    def calibrate(self, message: Any) -> None:
        """Use a sensor_msgs/CameraInfo from now on.

        Raises:
            CameraError: The camera is not calibrated; its images are dropped from now on.
        """
        try:
            camera = self.read(message)
        except CameraError as error:
            self.camera, self.trouble = None, str(error)
            raise
        self.take_over(camera)

    def read(self, message: Any) -> Camera:
        """The camera of a sensor_msgs/CameraInfo, see `camera_of`."""
        return camera_of(message)

    def take_over(self, camera: Camera) -> None:
        """Use a calibration from now on."""
        self.trouble = ""
        if camera != self.camera:
            self.camera = camera
            self.use(camera)

    def use(self, camera: Camera) -> None:
        """Adapt to a calibration that differs from the previous one."""
        raise NotImplementedError

    def detect(self, message: Any) -> bytes:
        """The serialized detections of an image, or of what was found in it; both are counted.

        Raises:
            ImageError: The message was dropped and counted.
        """
        self.images += 1
        try:
            return self.found(message)
        except ImageError as error:
            self.drops[error.reason] += 1
            raise

    def found(self, message: Any) -> bytes:
        """The serialized detections of a message.

        Raises:
            ImageError: The message cannot be used.
        """
        raise NotImplementedError

    def known_camera(self) -> Camera:
        """The calibration.

        Raises:
            ImageError: There is none.
        """
        if self.camera is None:
            raise ImageError("no_calibration", self.trouble or "no camera_info was received yet.")
        return self.camera


class CalibratedCamera(Calibration):
    """The calibration of one camera, and its images; `gray_of` reads an image message, see `TRANSPORTS`."""

    def __init__(self, gray_of: GrayOf) -> None:
        super().__init__()
        self._gray_of = gray_of

    def gray(self, message: Any) -> Gray:
        """The brightness (height, width) of an image of this camera.

        Raises:
            ImageError: There is no calibration, or the image cannot be read or does not fit it.
        """
        camera = self.known_camera()
        return self._gray_of(message, (camera.width, camera.height))


def camera_of(message: Any, *, rectified: bool = False) -> Camera:
    """The camera of the images that a sensor_msgs/CameraInfo comes with, or of their rectified images.

    The calibration is that of the whole sensor. The images show its region of interest, and each of their
    pixels is the mean of `binning_x` x `binning_y` pixels of the sensor; what is left over at the right and
    lower rim is not shown.

    Raises:
        CameraError: It is not calibrated, or its region or binning do not fit its size.
    """
    matrix = np.reshape(message.p, (3, 4))[:, :3] if rectified else np.reshape(message.k, (3, 3))
    lens = ((), "") if rectified else (message.d, message.distortion_model)
    whole = Camera.from_matrix((message.width, message.height), matrix, *lens)
    roi = message.roi
    left, top, width, height = roi.x_offset, roi.y_offset, roi.width, roi.height
    if not any((left, top, width, height)):
        width, height = whole.width, whole.height
    if not (0 < width <= whole.width - left and 0 < height <= whole.height - top):
        raise CameraError(
            f"the camera's roi has {width} x {height} pixels at ({left}, {top}),"
            f" but must lie within its {whole.width} x {whole.height} pixels."
        )
    across, down = max(message.binning_x, 1), max(message.binning_y, 1)
    if across > width or down > height:
        raise CameraError(
            f"the camera's binning_x and binning_y are {across} and {down},"
            f" but must be at most the {width} x {height} pixels of its images."
        )
    return replace(
        whole,
        width=width // across,
        height=height // down,
        fx=whole.fx / across,
        fy=whole.fy / down,
        cx=(whole.cx - left - 0.5 * (across - 1)) / across,
        cy=(whole.cy - top - 0.5 * (down - 1)) / down,
    )
