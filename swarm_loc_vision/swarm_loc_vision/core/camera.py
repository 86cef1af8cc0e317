"""A calibrated camera: its matrix, its distortion, and the way from raw pixels to ideal ones and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_vision.core.sampling import (
    CX,
    CY,
    FISHEYE,
    FX,
    FY,
    K1,
    K2,
    K3,
    K4,
    K5,
    K6,
    LENS_KIND,
    LENS_SIZE,
    P1,
    P2,
    RADIAL,
    STRAIGHT,
    raw_pixels,
)

FloatArray = NDArray[np.float64]

_MODELS = {"": (0,), "plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8), "equidistant": (0, 4)}
"""Distortion models of sensor_msgs/CameraInfo, and how many coefficients they may have."""

_LONGEST_FOCAL = 100.0
"""Of all lenses that could see a marker, in widths of the picture."""
_STRONGEST = 1e4


class CameraError(ValueError):
    """A camera that cannot be used; the message is one sentence."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera.

    Attributes:
        width: Of the picture [px].
        height: Likewise.
        fx: Focal length [px].
        fy: Likewise.
        cx: Principal point [px].
        cy: Likewise.
        distortion: Coefficients, as OpenCV orders them.
        model: Distortion model, as sensor_msgs/CameraInfo names it.

    Raises:
        CameraError: It is not calibrated, or its numbers cannot be.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    model: str = "plumb_bob"

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.isfinite(numbers).all():
            raise CameraError("the camera's calibration has numbers that are not finite.")
        if self.fx <= 0.0 or self.fy <= 0.0:
            raise CameraError(
                f"the camera is not calibrated: its focal lengths are {self.fx:g} and {self.fy:g} px,"
                " but must be above 0 px."
            )
        if self.width <= 0 or self.height <= 0:
            raise CameraError(f"the camera's picture has {self.width} x {self.height} pixels.")
        longest = _LONGEST_FOCAL * max(self.width, self.height)
        if max(self.fx, self.fy) > longest or max(map(abs, self.distortion), default=0.0) > _STRONGEST:
            raise CameraError(
                f"the camera's calibration cannot be: focal lengths must be at most {longest:g} px"
                f" and distortion coefficients within {_STRONGEST:g}."
            )
        if self.model not in _MODELS:
            known = ", ".join(filter(None, _MODELS))
            raise CameraError(f"the camera's distortion model '{self.model}' is not one of {known}.")
        if len(self.distortion) not in _MODELS[self.model]:
            raise CameraError(
                f"the camera's distortion model '{self.model}' has {len(self.distortion)} coefficients,"
                f" but must have {' or '.join(map(str, _MODELS[self.model]))}."
            )

    @classmethod
    def from_matrix(
        cls, size: tuple[int, int], matrix: FloatArray, distortion: Sequence[float], model: str = "plumb_bob"
    ) -> Camera:
        """From width and height, K (3, 3) and the distortion's coefficients."""
        (fx, _, cx), (_, fy, cy), _ = np.asarray(matrix, float).tolist()
        return cls(*size, fx, fy, cx, cy, tuple(map(float, distortion)), model)

    @cached_property
    def matrix(self) -> FloatArray:
        """K (3, 3) [px]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> FloatArray:
        """(4,) fx, fy, cx, cy [px]."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @cached_property
    def lens(self) -> FloatArray:
        """The constants of `sampling.raw_pixel`."""
        lens = np.zeros(LENS_SIZE)
        lens[[FX, FY, CX, CY]] = self.fx, self.fy, self.cx, self.cy
        if self.model == "equidistant" or any(self.distortion):
            lens[LENS_KIND] = FISHEYE if self.model == "equidistant" else RADIAL
            places = [K1, K2, K3, K4] if self.model == "equidistant" else [K1, K2, P1, P2, K3, K4, K5, K6]
            lens[places[: len(self.distortion)]] = self.distortion
        return lens

    def to_ideal(self, pixels: FloatArray) -> FloatArray:
        """(..., 2) pixels of a picture without distortion, from raw ones."""
        if self.lens[LENS_KIND] == STRAIGHT or not pixels.size:
            return np.array(pixels)
        flat = np.ascontiguousarray(pixels, float).reshape(-1, 1, 2)
        coefficients = np.array(self.distortion or (0.0,) * 4)
        if self.model == "equidistant":
            ideal = cv2.fisheye.undistortPoints(flat, self.matrix, coefficients, P=self.matrix)
        else:
            ideal = cv2.undistortPoints(flat, self.matrix, coefficients, P=self.matrix)
        return np.asarray(ideal, np.float64).reshape(pixels.shape)

    def to_raw(self, pixels: FloatArray) -> FloatArray:
        """(..., 2) raw pixels, from those of a picture without distortion."""
        raw = raw_pixels(self.lens, np.ascontiguousarray(pixels, float).reshape(-1, 2))
        return np.asarray(raw.reshape(pixels.shape))
