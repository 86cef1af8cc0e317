"""Camera model: intrinsics, optics and sensor noise of a simulated camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.common.calibration_file import CameraCalibration
from swarm_loc_drivers.sim.render.raster import Image
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.parameters import number
from swarm_loc_vision.common.camera import Camera

_REACH_MARGIN = 1.1


@dataclass(frozen=True)
class CameraModel:
    """A global-shutter camera; the principal point is the middle of the image.

    The auto-exposure keeps white at `white_level`: a shorter exposure means less blur and more noise.
    """

    width: int = number(1280, "px", 16, 8192, "columns")
    height: int = number(960, "px", 16, 8192, "rows")
    field_of_view: float = number(math.radians(60.0), "rad", 0.05, 2.6, "across, without distortion")
    k1: float = number(0.0, "1", -1.0, 1.0, "radial distortion, as OpenCV defines it")
    k2: float = number(0.0, "1", -1.0, 1.0, "radial distortion, as OpenCV defines it")
    p1: float = number(0.0, "1", -0.1, 0.1, "tangential distortion, as OpenCV defines it")
    p2: float = number(0.0, "1", -0.1, 0.1, "tangential distortion, as OpenCV defines it")
    k3: float = number(0.0, "1", -1.0, 1.0, "radial distortion, as OpenCV defines it")
    focus_sigma_px: float = number(0.5, "px", 0.0, 10.0, "blur of the optics, one standard deviation")
    vignetting: float = number(
        0.5, "1", 0.0, 1.0, "share of the natural fall of light, cos^4, towards the edge"
    )
    exposure_s: float = number(0.008, "s", 1e-5, 0.133, "how long the shutter is open")
    white_flux: float = number(1e6, "1/s", 1e3, 1e9, "electrons that white leaves in a pixel per second")
    read_noise: float = number(
        12.0, "1", 0.0, 1e3, "noise of the read-out, one standard deviation [electrons]"
    )
    white_level: float = number(210.0, "1", 1.0, 255.0, "count of white in the middle of the image")

    @cached_property
    def camera(self) -> Camera:
        """Its calibration."""
        focal_px = 0.5 * self.width / math.tan(0.5 * self.field_of_view)
        middle = 0.5 * (self.width - 1), 0.5 * (self.height - 1)
        distortion = (self.k1, self.k2, self.p1, self.p2, self.k3)
        return Camera(self.width, self.height, focal_px, focal_px, *middle, distortion)

    @property
    def calibration(self) -> CameraCalibration:
        """The content of its sensor_msgs/CameraInfo; images are not rectified."""
        camera = self.camera
        k = camera.matrix
        return CameraCalibration(
            camera.width,
            camera.height,
            camera.model,
            camera.distortion,
            tuple(k.ravel().tolist()),
            tuple(np.eye(3).ravel().tolist()),
            tuple(np.column_stack([k, np.zeros(3)]).ravel().tolist()),
        )

    def lens(self, focal_scale: float = 1.0) -> FloatArray:
        """The constants of `raster.project` for a camera whose true focal length is off by a factor."""
        camera = self.camera
        border = np.array([[u, v] for u in (0, self.width) for v in (0, self.height)], dtype=float) - 0.5
        # not by `to_ideal`, which knows nothing of corners that the distortion's model never gets to
        tangents = cv2.undistortPoints(border[:, None], camera.matrix, np.array(camera.distortion))[:, 0]
        reach = _REACH_MARGIN * float(np.linalg.norm(tangents, axis=1).max()) / focal_scale
        true = replace(camera, fx=focal_scale * camera.fx, fy=focal_scale * camera.fy)
        return np.append(true.lens, reach)

    def electrons(self) -> NDArray[np.float32]:
        """What white leaves in each pixel (height, width) during the exposure."""
        v, u = np.mgrid[: self.height, : self.width]
        tan2 = ((u - self.camera.cx) ** 2 + (v - self.camera.cy) ** 2) / self.camera.fx**2
        light = 1.0 - self.vignetting * (1.0 - 1.0 / (1.0 + tan2) ** 2)
        electrons: NDArray[np.float32] = (self.white_flux * self.exposure_s * light).astype(np.float32)
        return electrons

    @property
    def gain(self) -> float:
        """Counts per electron."""
        return self.white_level / (self.white_flux * self.exposure_s)


@cached_njit
def expose(
    image: Image,
    frame: NDArray[np.uint8],
    electrons: Image,
    read_noise: float,
    gain: float,
    noise: Image,
    offset: IntArray,
) -> None:
    """Turn light into counts, with the noise of photons and of the read-out.

    Args:
        image: (height, width) brightness of what is seen [1].
        frame: (height, width), written.
        electrons: (height, width) that white leaves in each pixel.
        read_noise: [electrons].
        gain: Counts per electron.
        noise: (K,) numbers of unit variance.
        offset: (height,) where each row begins in them, at most K - width.
    """
    floor = np.float32(read_noise * read_noise)
    for line in range(image.shape[0]):
        row = noise[offset[line] :]
        for column in range(image.shape[1]):
            signal = max(image[line, column] * electrons[line, column], np.float32(0.0))
            count = (signal + math.sqrt(signal + floor) * row[column]) * np.float32(gain) + np.float32(0.5)
            frame[line, column] = np.uint8(min(max(count, np.float32(0.0)), np.float32(255.0)))
