"""Image sensor: light into counts, with photon noise, read-out noise and quantization."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.sim.render.coverage import Image
from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.jit import cached_njit


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
