"""Lens distortion: where a direction, or a pixel of an image without distortion, is seen; OpenCV's models.

A lens is an array with the constants below; `camera.Camera` makes it.
"""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit

LENS_KIND, FX, FY, CX, CY, K1, K2, P1, P2, K3, K4, K5, K6 = range(13)
LENS_SIZE = 13
STRAIGHT, RADIAL, FISHEYE = 0.0, 1.0, 2.0
"""Kinds: no distortion; plumb_bob and rational_polynomial; equidistant with K1, K2, K3, K4."""


@cached_njit
def distorted(lens: FloatArray, x: float, y: float) -> tuple[float, float]:
    """The direction (x, y, 1) as the lens bends it."""
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
    return bent_x, bent_y


@cached_njit
def raw_pixel(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Where the raw image shows an ideal pixel, one of an image without distortion."""
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
