"""Encodings of pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from swarm_loc_vision.core.gray import ImageError, gray_image

WIDTH, HEIGHT = 14, 10
SHADES = np.linspace(10, 240, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).astype(np.uint8)
COLOURS = np.stack([SHADES, SHADES[::-1], 255 - SHADES], axis=2)  # red, green, blue
RGB_GRAY = cv2.cvtColor(COLOURS, cv2.COLOR_RGB2GRAY)


def wide(order: str) -> NDArray[np.uint8]:
    return (SHADES.astype(order + "u2") * 257).view(np.uint8).reshape(HEIGHT, -1)


@pytest.mark.parametrize(
    ("encoding", "data", "expected"),
    [
        ("mono8", SHADES, SHADES),
        ("mono16", wide("<"), SHADES),
        ("rgb8", COLOURS, RGB_GRAY),
        ("bgr8", COLOURS[..., ::-1], RGB_GRAY),
        ("rgba8", np.dstack([COLOURS, SHADES]), RGB_GRAY),
        ("bgra8", np.dstack([COLOURS[..., ::-1], SHADES]), RGB_GRAY),
        ("yuyv", np.dstack([SHADES, SHADES[::-1]]), SHADES),
        ("uyvy", np.dstack([SHADES[::-1], SHADES]), SHADES),
    ],
)
def test_encodings(encoding: str, data: NDArray[np.uint8], expected: NDArray[np.uint8]) -> None:
    rows = np.ascontiguousarray(data).reshape(HEIGHT, -1)
    padded = np.pad(rows, ((0, 0), (0, 5)))  # cameras may leave bytes at the end of rows
    for picture in (rows, padded):
        gray = gray_image(encoding, WIDTH, HEIGHT, picture.shape[1], picture.tobytes())
        assert (gray == expected).all()
        assert gray.flags.writeable
        assert gray.flags.c_contiguous


def test_big_endian() -> None:
    gray = gray_image("mono16", WIDTH, HEIGHT, 2 * WIDTH, wide(">").tobytes(), is_bigendian=True)
    assert (gray == SHADES).all()


def test_bayer_of_a_gray_scene_is_gray() -> None:
    flat = np.full((HEIGHT, WIDTH), 99, np.uint8)
    for encoding in ("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"):
        assert (gray_image(encoding, WIDTH, HEIGHT, WIDTH, flat.tobytes()) == 99).all()


@pytest.mark.parametrize(
    ("encoding", "width", "step", "size", "reason"),
    [
        ("jpeg", WIDTH, WIDTH, WIDTH * HEIGHT, "encoding"),
        ("", WIDTH, WIDTH, WIDTH * HEIGHT, "encoding"),
        ("mono8", WIDTH, WIDTH, WIDTH * HEIGHT - 1, "size"),
        ("mono8", WIDTH, WIDTH - 1, WIDTH * HEIGHT, "size"),
        ("rgb8", WIDTH, WIDTH, WIDTH * HEIGHT, "size"),
        ("mono8", 0, 0, 0, "size"),
    ],
)
def test_what_is_no_picture_is_refused(encoding: str, width: int, step: int, size: int, reason: str) -> None:
    with pytest.raises(ImageError) as caught:
        gray_image(encoding, width, HEIGHT, step, bytes(size))
    assert caught.value.reason == reason
