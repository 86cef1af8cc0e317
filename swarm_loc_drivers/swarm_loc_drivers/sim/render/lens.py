"""A camera's optics and sensor, as calibrated: what turns directions into pixels and light into counts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.core.number_spec import number

FloatArray = NDArray[np.float64]

_REACH_MARGIN = 1.1


@dataclass(frozen=True)
class CameraModel:
    """A global-shutter camera; the principal point is the middle of the picture.

    The auto-exposure keeps white at `white_level`: a shorter exposure means less blur and more noise.
    """

    width: int = number(1280, "px", 16, 8192, "columns")
    height: int = number(960, "px", 16, 8192, "rows")
    field_of_view: float = number(math.radians(60.0), "rad", 0.05, 2.6, "across, without distortion")
    k1: float = number(0.0, "1", -1.0, 1.0, "radial distortion, as OpenCV defines it")
    k2: float = number(0.0, "1", -1.0, 1.0, "likewise")
    p1: float = number(0.0, "1", -0.1, 0.1, "tangential distortion, likewise")
    p2: float = number(0.0, "1", -0.1, 0.1, "likewise")
    k3: float = number(0.0, "1", -1.0, 1.0, "radial distortion, likewise")
    focus_sigma_px: float = number(0.5, "px", 0.0, 10.0, "blur of the optics, one standard deviation")
    vignetting: float = number(
        0.5, "1", 0.0, 1.0, "share of the natural fall of light, cos^4, towards the edge"
    )
    exposure_s: float = number(0.008, "s", 1e-5, 0.133, "how long the shutter is open")
    white_flux: float = number(1e6, "1/s", 1e3, 1e9, "electrons that white leaves in a pixel per second")
    read_noise: float = number(
        12.0, "1", 0.0, 1e3, "noise of the read-out, one standard deviation [electrons]"
    )
    white_level: float = number(210.0, "1", 1.0, 255.0, "count of white in the middle of the picture")

    @property
    def focal_px(self) -> float:
        """Focal length [px]."""
        return 0.5 * self.width / math.tan(0.5 * self.field_of_view)

    @property
    def matrix(self) -> FloatArray:
        """K (3, 3) of camera_info [px]."""
        f = self.focal_px
        centre = 0.5 * (self.width - 1), 0.5 * (self.height - 1)
        return np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> FloatArray:
        """k1, k2, p1, p2, k3 (5,) of camera_info, model plumb_bob."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def camera_info(self) -> dict[str, Any]:
        """The fields of sensor_msgs/CameraInfo that calibrate it."""
        k = self.matrix
        return {
            "height": self.height,
            "width": self.width,
            "distortion_model": "plumb_bob",
            "d": self.distortion,
            "k": k.reshape(9),
            "r": np.eye(3).reshape(9),
            "p": np.column_stack([k, np.zeros(3)]).reshape(12),
        }

    def constants(self, focal_scale: float = 1.0) -> FloatArray:
        """The constants of `raster.project` for a camera whose true focal length is off by a factor."""
        k = self.matrix
        border = np.array([[u, v] for u in (0, self.width) for v in (0, self.height)], dtype=float)
        directions = cv2.undistortPoints(border[:, None] - 0.5, k, self.distortion)[:, 0]
        reach = _REACH_MARGIN * float(np.linalg.norm(directions, axis=1).max()) / focal_scale
        f = focal_scale * self.focal_px
        return np.array([f, f, k[0, 2], k[1, 2], *self.distortion, reach])

    def electrons(self) -> NDArray[np.float32]:
        """What white leaves in each pixel (height, width) during the exposure."""
        v, u = np.mgrid[: self.height, : self.width]
        k = self.matrix
        tan2 = ((u - k[0, 2]) ** 2 + (v - k[1, 2]) ** 2) / self.focal_px**2
        light = 1.0 - self.vignetting * (1.0 - 1.0 / (1.0 + tan2) ** 2)
        electrons: NDArray[np.float32] = (self.white_flux * self.exposure_s * light).astype(np.float32)
        return electrons

    @property
    def gain(self) -> float:
        """Counts per electron."""
        return self.white_level / (self.white_flux * self.exposure_s)
