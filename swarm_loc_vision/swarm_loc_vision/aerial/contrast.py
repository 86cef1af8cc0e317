"""Logarithm of brightness, in which uneven light and shadows change edges little, and its noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_vision.aerial.rectification import Plain
from swarm_loc_vision.common.gray import Gray

_DARK = 10.0
"""Counts that black still has: below it the logarithm would show noise alone."""
_SMOOTHING_SHARE, _MIN_SMOOTHING_PX = 0.035, 0.6
_KERNEL = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
_KERNEL_NORM = 6.0
_MEDIAN_OF_NORMAL = 0.6745
_LEAST_NOISE = 0.3
"""Counts: the noise of quantization alone."""


@dataclass(frozen=True)
class Brightness:
    """A rectified image.

    Attributes:
        plain: (rows, columns) counts, smoothed a little.
        log: (rows, columns) their logarithm.
        noise: Of the counts of the raw image, one standard deviation.
    """

    plain: Plain
    log: Plain
    noise: float

    def log_noise(self, log: FloatArray) -> FloatArray:
        """By how much noise moves values of the logarithm."""
        return np.asarray(self.noise * np.exp(-log))


def logarithm(plain: Plain | FloatArray) -> FloatArray:
    """Of counts, and of what black still has."""
    return np.asarray(np.log(np.maximum(plain, 0.0) + _DARK))


def brightness(flat: Plain, diameter_px: float, noise: float) -> Brightness:
    """A rectified image in which robots have a diameter, by a raw image with so much noise."""
    sigma = max(_SMOOTHING_SHARE * diameter_px, _MIN_SMOOTHING_PX)
    plain = np.asarray(cv2.GaussianBlur(flat, (0, 0), sigma), np.float32)
    return Brightness(plain, np.asarray(logarithm(plain), np.float32), noise)


def noise_of(image: Gray) -> float:
    """Noise of an image's counts by its second differences (Immerkaer 1996), here by their median."""
    rough = cv2.filter2D(image[::2], cv2.CV_32F, _KERNEL)
    median = float(np.median(np.abs(rough)))
    return max(median / (_MEDIAN_OF_NORMAL * _KERNEL_NORM), _LEAST_NOISE)
