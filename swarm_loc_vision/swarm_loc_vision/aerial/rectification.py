"""Rectified images: a level plane as if seen straight from above, with the same size for every robot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.ground_control import AerialSettings, GroundCamera
from swarm_loc_vision.common.images import Gray

Plain = NDArray[np.float32]

_CELL_PX = 16  # Distance of the raw pixels at which the extent of a plane is sampled
_EVERY = 4  # Rows and columns of a rectified image of which one is projected
_MAX_AREA = 12_000_000  # Bound on the pixels of a rectified image


class RectificationError(ValueError):
    """A plane that cannot be rectified; the message is one sentence."""


@dataclass(frozen=True)
class Rectification:
    """A grid over a level plane, and the raw pixels that show it."""

    origin: FloatArray  # (2,) x, y of the middle of the first pixel, which has the least x and y [m]
    metres_per_px: float  # Size of a pixel
    height: float  # Height of the plane [m]
    maps: Plain  # (2, rows, columns) raw pixels u and v, columns along x, rows along y; -1 outside the image
    seen: NDArray[np.bool_]  # (rows, columns) whether the raw image shows the pixel
    blur_px: float  # Blur of the raw image before sampling, where the grid is coarser than the image

    def apply(self, image: Gray) -> Plain:
        """The rectified image (rows, columns)."""
        raw = cv2.GaussianBlur(image, (0, 0), self.blur_px) if self.blur_px else image
        raw = raw.astype(np.float32)
        flat = cv2.remap(raw, self.maps[0], self.maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(flat, np.float32)

    def places(self, cells: FloatArray) -> FloatArray:
        """(..., 3) places in map of columns and rows (..., 2) of the grid."""
        flat = self.origin + cells * self.metres_per_px
        return np.concatenate([flat, np.full((*flat.shape[:-1], 1), self.height)], axis=-1)


def rectification(
    ground: GroundCamera, settings: AerialSettings, diameter: float, size_px: tuple[float, float]
) -> Rectification:
    """The part of a plane in which robots of a diameter [m] are large enough to be found.

    `size_px` is the least and largest diameter of robots in the rectified image; in between that in the raw
    image.

    Raises:
        RectificationError: The camera does not see the plane, or robots on it look too small.
    """
    height, least_px = settings.robot_height, settings.min_diameter_px
    flat, scale = _visible(ground, height)
    lower, upper = (settings.x_min, settings.y_min), (settings.x_max, settings.y_max)
    usable = scale * diameter >= least_px
    if not len(flat):
        raise RectificationError(f"the camera does not see the plane {height:g} m above the floor.")
    if not usable.any():
        raise RectificationError(
            f"robots of {diameter:g} m look smaller than {least_px:g} px everywhere: the largest is"
            f" {diameter * scale.max():.2g} px."
        )
    low, high = flat[usable].min(axis=0), flat[usable].max(axis=0)
    low, high = np.maximum(low - 0.5 * diameter, lower), np.minimum(high + 0.5 * diameter, upper)
    if not (high - low > diameter).all():
        raise RectificationError("the camera does not see the region from x_min, y_min to x_max, y_max.")
    native = diameter * float(np.median(scale[usable]))
    wanted = min(max(native, size_px[0]), size_px[1])
    step = max(diameter / wanted, math.sqrt(float(np.prod(high - low)) / _MAX_AREA))
    columns, rows = (int(n) for n in np.ceil((high - low) / step) + 1)
    # the raw pixels of the grid, linear between every fourth row and column: off by 0.01 px
    coarse = [np.arange(n // _EVERY + 2) * _EVERY for n in (columns, rows)]
    places = np.stack(np.meshgrid(*coarse), axis=-1) * step + low
    pixels = ground.pixels(np.concatenate([places, np.full((*places.shape[:2], 1), height)], axis=-1))
    spread = np.array([[1.0 / _EVERY, 0.0, 0.0], [0.0, 1.0 / _EVERY, 0.0]])
    flags, axes = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, np.moveaxis(pixels.astype(np.float32), -1, 0)
    maps = np.asarray([cv2.warpAffine(one, spread, (columns, rows), flags=flags) for one in axes], np.float32)
    most_u, most_v = ground.camera.width - 1, ground.camera.height - 1
    seen = (maps[0] >= 0.0) & (maps[0] <= most_u) & (maps[1] >= 0.0) & (maps[1] <= most_v)
    shrink = native / (diameter / step)
    blur = 0.5 * math.sqrt(max(shrink**2 - 1.0, 0.0)) if shrink > 1.2 else 0.0
    return Rectification(low, step, height, np.where(seen, maps, np.float32(-1.0)), seen, blur)


def _visible(ground: GroundCamera, height: float) -> tuple[FloatArray, FloatArray]:
    """Places (K, 2) of a plane, evenly spread in the image, and the pixels per metre there."""
    camera = ground.camera
    across, down = (
        np.linspace(0.0, n - 1.0, max(math.ceil(n / _CELL_PX), 2)) for n in (camera.width, camera.height)
    )
    flat = ground.places(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2), height)
    places = np.concatenate([flat, np.full((len(flat), 1), height)], axis=-1)
    scale = np.full(len(flat), np.nan)
    shown = np.isfinite(flat).all(axis=1)
    scale[shown] = ground.scale(places[shown])
    good = np.isfinite(scale) & (scale > 0.0)
    return flat[good], scale[good]


# Chosen on the pictures of `make bench-aerial`, see `detector`; strong noise: its look noise_16.
_DARK = 10.0  # Counts added to brightness: without them the logarithm of dark pixels is mostly noise
_SMOOTHING_SHARE, _MIN_SMOOTHING_PX = 0.035, 0.6
_KERNEL = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
_KERNEL_NORM = 6.0
_MEDIAN_OF_NORMAL = 0.6745
_LEAST_NOISE = 0.3  # Noise of quantization alone [counts]


@dataclass(frozen=True)
class Brightness:
    """A rectified image."""

    plain: Plain  # (rows, columns) counts, slightly smoothed
    # (rows, columns, 3) their logarithm, in which uneven light and shadows change edges little, and its
    # change to the next column and row
    log: Plain
    noise: float  # Standard deviation of the noise of the raw image [counts]


def logarithm(plain: Plain | FloatArray) -> FloatArray:
    """The logarithm of counts, with an offset."""
    return np.asarray(np.log(np.maximum(plain, 0.0) + _DARK))


def brightness(flat: Plain, diameter_px: float, noise: float) -> Brightness:
    """Smooth a rectified image; `noise` is that of the raw image."""
    sigma = max(_SMOOTHING_SHARE * diameter_px, _MIN_SMOOTHING_PX)
    plain = np.asarray(cv2.GaussianBlur(flat, (0, 0), sigma), np.float32)
    log = np.asarray(logarithm(plain), np.float32)
    # divided by 32 Scharr's kernel gives the change per pixel
    slopes = [cv2.Scharr(log, cv2.CV_32F, *axis, scale=1.0 / 32.0) for axis in ((1, 0), (0, 1))]
    return Brightness(plain, np.asarray(cv2.merge([log, *slopes]), np.float32), noise)


def noise_of(image: Gray) -> float:
    """Noise of an image [counts] from the median of its second differences, after Immerkaer (1996)."""
    rough = cv2.filter2D(image[::2], cv2.CV_32F, _KERNEL)
    median = float(np.median(np.abs(rough)))
    return max(median / (_MEDIAN_OF_NORMAL * _KERNEL_NORM), _LEAST_NOISE)
