"""Images with 16 bits a pixel, high byte first: RRRRRGGG GGGBBBBB."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def decode_rgb565(data: bytes, width: int, height: int) -> Image:
    """The image (height, width, 3) RGB of 2 * width * height bytes; full scale stays full scale."""
    pixels = np.frombuffer(data, ">u2").reshape(height, width)
    red, green, blue = pixels >> 11, (pixels >> 5) & 0x3F, pixels & 0x1F
    channels = [(red << 3) | (red >> 2), (green << 2) | (green >> 4), (blue << 3) | (blue >> 2)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def encode_rgb565(image: Image) -> bytes:
    """The bytes of an image (height, width, 3) RGB."""
    red, green, blue = np.moveaxis(image.astype(np.uint16), -1, 0)
    pixels: NDArray[np.uint16] = ((red >> 3) << 11) | ((green >> 2) << 5) | (blue >> 3)
    return pixels.astype(">u2").tobytes()
