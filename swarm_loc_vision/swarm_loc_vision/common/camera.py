"""Camera model: intrinsics, and distortion between raw pixels and ideal ones, those of a pinhole."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit

LENS_KIND, FX, FY, CX, CY, K1, K2, P1, P2, K3, K4, K5, K6, S1, S2, S3, S4, TAU_X, TAU_Y = range(19)
"""From K1 on in the order of OpenCV; S1 to S4 model a thin prism, TAU_X and TAU_Y a tilted sensor [rad]."""
LENS_SIZE = 19
STRAIGHT, RADIAL, FISHEYE, TILTED = 0.0, 1.0, 2.0, 3.0
"""Kinds: no distortion; coefficients up to K6; equidistant with K1, K2, K3, K4; coefficients up to TAU_Y."""


@cached_njit
def distorted(lens: FloatArray, x: float, y: float) -> tuple[float, float]:
    """The direction (x, y, 1) after distortion."""
    if lens[LENS_KIND] == STRAIGHT:
        return x, y
    r2 = x * x + y * y
    if lens[LENS_KIND] == FISHEYE:
        r = math.sqrt(r2)
        if r < 1e-9:
            return x, y
        theta = math.atan(r)
        t2 = theta * theta
        scale = theta * (1.0 + t2 * (lens[K1] + t2 * (lens[K2] + t2 * (lens[K3] + t2 * lens[K4])))) / r
        return scale * x, scale * y
    radial = (1.0 + r2 * (lens[K1] + r2 * (lens[K2] + r2 * lens[K3]))) / (
        1.0 + r2 * (lens[K4] + r2 * (lens[K5] + r2 * lens[K6]))
    )
    bent_x = x * radial + 2.0 * lens[P1] * x * y + lens[P2] * (r2 + 2.0 * x * x)
    bent_y = y * radial + lens[P1] * (r2 + 2.0 * y * y) + 2.0 * lens[P2] * x * y
    if lens[LENS_KIND] != TILTED:
        return bent_x, bent_y
    bent_x += r2 * (lens[S1] + r2 * lens[S2])
    bent_y += r2 * (lens[S3] + r2 * lens[S4])
    sin_x, cos_x = math.sin(lens[TAU_X]), math.cos(lens[TAU_X])
    sin_y, cos_y = math.sin(lens[TAU_Y]), math.cos(lens[TAU_Y])
    along = cos_x * bent_y + sin_x
    depth = cos_x - sin_x * bent_y
    across, depth = cos_y * bent_x - sin_y * depth, sin_y * bent_x + cos_y * depth
    shrink = cos_x * cos_y / depth
    return shrink * across + sin_y * cos_x, shrink * along - sin_x


@cached_njit
def raw_pixel(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """The raw pixel of an ideal pixel, one of an image without distortion."""
    if lens[LENS_KIND] == STRAIGHT:
        return u, v
    x, y = distorted(lens, (u - lens[CX]) / lens[FX], (v - lens[CY]) / lens[FY])
    return lens[CX] + lens[FX] * x, lens[CY] + lens[FY] * y


@cached_njit
def raw_pixels(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """(N, 2) raw pixels of ideal ones."""
    raw = np.empty_like(pixels)
    for i in range(len(pixels)):
        raw[i, 0], raw[i, 1] = raw_pixel(lens, pixels[i, 0], pixels[i, 1])
    return raw


_OPENCV = (0, 4, 5, 8, 12, 14)
_MODELS = {"": (0,), "plumb_bob": _OPENCV, "rational_polynomial": _OPENCV, "equidistant": (0, 4)}
"""Distortion models of sensor_msgs/CameraInfo, and their numbers of coefficients; only zeros may follow."""

_MOST_PX, _STRONGEST = 1e6, 1e4  # Bounds on intrinsics and on coefficients of the distortion
_MAX_OFF_AXIS = math.tan(math.radians(80.0))
"""Further off the axis a flat image is stretched too much to detect straight sides."""
_ROUNDS, _EXACT_PX = 50, 1e-4
_MAX_ERROR_PX = 0.01  # Largest error of an ideal pixel, projected back; beyond, a pixel has no ideal one


class CameraError(ValueError):
    """A camera that cannot be used; the message is one sentence."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera.

    Raises:
        CameraError: The camera is not calibrated, or a number is out of its range.
    """

    width: int  # Columns of the image
    height: int  # Rows of the image
    fx: float  # Horizontal focal length [px]
    fy: float  # Vertical focal length [px]
    cx: float  # Column of the principal point [px]
    cy: float  # Row of the principal point [px]
    distortion: tuple[float, ...] = ()  # Coefficients in the order of OpenCV; all that are given count
    model: str = "plumb_bob"  # Distortion model by its name in sensor_msgs/CameraInfo

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise CameraError(
                f"the camera's image has {self.width} x {self.height} pixels, but must have at least 1 x 1."
            )
        if not (0.0 < self.fx <= _MOST_PX and 0.0 < self.fy <= _MOST_PX):  # nor NaN
            raise CameraError(
                f"the camera is not calibrated: its focal lengths are {self.fx:g} and {self.fy:g} px,"
                f" but must lie in (0, {_MOST_PX:g}] px."
            )
        numbers = {"cx": (self.cx, _MOST_PX), "cy": (self.cy, _MOST_PX)}
        numbers |= {f"distortion coefficient {i}": (d, _STRONGEST) for i, d in enumerate(self.distortion)}
        for name, (number, most) in numbers.items():
            if not abs(number) <= most:  # nor NaN
                raise CameraError(
                    f"the camera's {name} is {number:g}, but must lie in [-{most:g}, {most:g}]."
                )
        if self.model not in _MODELS:
            known = ", ".join(filter(None, _MODELS))
            raise CameraError(f"the camera's distortion model is '{self.model}', but must be one of {known}.")
        counts = _MODELS[self.model]
        if any(self.distortion[max(count for count in counts if count <= len(self.distortion)) :]):
            raise CameraError(
                f"the camera's distortion model '{self.model}' has {len(self.distortion)} coefficients,"
                f" but must have {' or '.join(map(str, counts))}; only zeros may follow."
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
        """The lens (LENS_SIZE,) for compiled code such as `raw_pixels`."""
        lens = np.zeros(LENS_SIZE)
        lens[[FX, FY, CX, CY]] = self.fx, self.fy, self.cx, self.cy
        if self.model == "equidistant" or any(self.distortion):
            places = [K1, K2, K3, K4] if self.model == "equidistant" else list(range(K1, LENS_SIZE))
            given = self.distortion[: len(places)]
            lens[places[: len(given)]] = given
            lens[LENS_KIND] = (
                FISHEYE if self.model == "equidistant" else TILTED if lens[S1:].any() else RADIAL
            )
        return lens

    def to_ideal(self, pixels: FloatArray) -> FloatArray:
        """(..., 2) pixels of an image without distortion from raw pixels; NaN where there is none.

        There is none far off the axis of a fisheye, and where the model of the lens has no inverse.
        """
        if self.lens[LENS_KIND] == STRAIGHT or not pixels.size:
            return np.array(pixels)
        flat = np.ascontiguousarray(pixels, float).reshape(-1, 1, 2)
        if self.model == "equidistant":
            ideal = cv2.fisheye.undistortPoints(flat, self.matrix, self.lens[[K1, K2, K3, K4]], P=self.matrix)
        else:
            ideal = cv2.undistortPoints(flat, self.matrix, self.lens[K1:], P=self.matrix)
        found = np.asarray(ideal, np.float64).reshape(pixels.shape)
        missed = pixels - self.to_raw(found)
        for _ in range(_ROUNDS):  # OpenCV stops early, up to a pixel off at the rim of a strong lens
            if not np.nanmax(np.abs(missed), initial=0.0) > _EXACT_PX:
                break
            found += missed
            missed = pixels - self.to_raw(found)
        is_wrong = ~(np.abs(missed).max(axis=-1) < _MAX_ERROR_PX)
        with np.errstate(over="ignore"):  # the search diverges where there is no inverse
            off_axis = np.linalg.norm((found - self.intrinsics[2:]) / self.intrinsics[:2], axis=-1)
        found[is_wrong | (off_axis > _MAX_OFF_AXIS)] = np.nan
        return found

    def to_raw(self, pixels: FloatArray) -> FloatArray:
        """(..., 2) raw pixels from pixels of an image without distortion."""
        raw = raw_pixels(self.lens, np.ascontiguousarray(pixels, float).reshape(-1, 2))
        return np.asarray(raw.reshape(pixels.shape))
