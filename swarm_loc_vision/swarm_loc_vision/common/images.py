"""Images as ROS messages: any encoding or compression is read as 8-bit gray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Pixels = NDArray[np.uint8] | NDArray[np.uint16]


class ImageError(ValueError):
    """An image that cannot be used; the message is one sentence.

    Attributes:
        reason: In one word, for counting.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class _Encoding:
    """Layout of pixels in memory, and their conversion to gray."""

    channels: int
    to_gray: Callable[[Pixels], Pixels]
    bytes_per_channel: int = 1


def _converted(code: int) -> Callable[[Pixels], Pixels]:
    """A conversion of OpenCV."""

    def convert(pixels: Pixels) -> Pixels:
        return np.asarray(cv2.cvtColor(pixels, code), np.uint8)

    return convert


def _highest_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """The highest 8 bits that any pixel uses: cameras of 10 or 12 bits may leave the upper bits empty."""
    surplus = max(int(pixels.max()).bit_length() - 8, 0)
    return (pixels >> surplus).astype(np.uint8)


_PLAIN = _Encoding(1, lambda pixels: pixels[..., 0])
_WIDE = _Encoding(1, lambda pixels: _highest_bits(pixels[..., 0]), 2)
_ENCODINGS = {
    "mono8": _PLAIN,
    "8UC1": _PLAIN,
    "mono16": _WIDE,
    "16UC1": _WIDE,
    "rgb8": _Encoding(3, _converted(cv2.COLOR_RGB2GRAY)),
    "bgr8": _Encoding(3, _converted(cv2.COLOR_BGR2GRAY)),
    "8UC3": _Encoding(3, _converted(cv2.COLOR_BGR2GRAY)),
    "rgba8": _Encoding(4, _converted(cv2.COLOR_RGBA2GRAY)),
    "bgra8": _Encoding(4, _converted(cv2.COLOR_BGRA2GRAY)),
    "bayer_rggb8": _Encoding(1, _converted(cv2.COLOR_BayerBG2GRAY)),
    "bayer_bggr8": _Encoding(1, _converted(cv2.COLOR_BayerRG2GRAY)),
    "bayer_gbrg8": _Encoding(1, _converted(cv2.COLOR_BayerGR2GRAY)),
    "bayer_grbg8": _Encoding(1, _converted(cv2.COLOR_BayerGB2GRAY)),
    "yuv422": _Encoding(2, lambda pixels: pixels[..., 1]),
    "uyvy": _Encoding(2, lambda pixels: pixels[..., 1]),
    "yuv422_yuy2": _Encoding(2, lambda pixels: pixels[..., 0]),
    "yuyv": _Encoding(2, lambda pixels: pixels[..., 0]),
}
"""By the names of sensor_msgs/image_encodings."""


@dataclass(frozen=True)
class _Compression:
    """Markers in the bytes of a compressed image.

    Attributes:
        name: Its name in error messages.
        begin: First bytes.
        data: Mark before pixel data; `end` must follow its last occurrence.
        end: Mark behind all pixel data.
    """

    name: str
    begin: bytes
    data: bytes
    end: bytes

    def is_whole(self, data: bytes) -> bool:
        """Whether bytes are a whole image; cameras may append bytes."""
        return data.startswith(self.begin) and data.rfind(self.end) > data.rfind(self.data) > 0


_JPEG = _Compression("jpeg", b"\xff\xd8\xff", b"\xff\xda", b"\xff\xd9")
_PNG = _Compression("png", b"\x89PNG\r\n\x1a\n", b"IDAT", b"IEND")
_COMPRESSIONS = {"jpeg": _JPEG, "jpg": _JPEG, "png": _PNG}
_COMPRESSED_DEPTH = "compressedDepth"
"""The format of image_transport whose bytes are no plain image."""


def gray_image(message: Any) -> Gray:
    """The brightness (height, width) of a sensor_msgs/Image.

    Raises:
        ImageError: Unknown encoding (`encoding`), or the bytes are not those of such an image (`size`).
    """
    encoding, width, height, step = message.encoding, message.width, message.height, message.step
    known = _ENCODINGS.get(encoding)
    if known is None:
        raise ImageError("encoding", f"the encoding '{encoding}' is not one of {', '.join(_ENCODINGS)}.")
    raw = np.frombuffer(message.data, np.uint8)
    row = width * known.channels * known.bytes_per_channel
    if width < 1 or height < 1 or step < row or raw.size < step * (height - 1) + row:
        raise ImageError(
            "size",
            f"{raw.size} bytes, {step} a row, are no image of {width} x {height} pixels in '{encoding}'.",
        )
    rows = np.lib.stride_tricks.as_strided(raw, (height, row), (step, 1))
    pixels: Pixels = np.ascontiguousarray(rows)
    if known.bytes_per_channel == 2:
        pixels = pixels.view(">u2" if message.is_bigendian else "<u2")
    gray = np.ascontiguousarray(known.to_gray(pixels.reshape(height, width, known.channels)), np.uint8)
    return gray if gray.flags.writeable else gray.copy()  # a read-only array would be compiled for separately


def decoded_image(message: Any) -> Gray:
    """The brightness (height, width) of a sensor_msgs/CompressedImage; an EXIF orientation is ignored.

    Raises:
        ImageError: The format is unknown (`encoding`), or the bytes are no whole image of it (`corrupt`).
    """
    how = message.format
    known = next((_COMPRESSIONS[name] for name in _COMPRESSIONS if name in how.lower()), None)
    if known is None or _COMPRESSED_DEPTH in how:
        raise ImageError("encoding", f"the format '{how}' is not one of {', '.join(_COMPRESSIONS)}.")
    raw = np.frombuffer(message.data, np.uint8)
    gray = _decoded(raw) if known.is_whole(raw.tobytes()) else None
    if gray is None:
        raise ImageError("corrupt", f"{raw.size} bytes are no whole image in '{known.name}'.")
    return _highest_bits(gray)


def _decoded(raw: NDArray[np.uint8]) -> MatLike | None:
    """The image that OpenCV decodes; None: none, or it would be too large."""
    try:
        return cv2.imdecode(raw, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None


@dataclass(frozen=True)
class Transport:
    """A transport of images, as in image_transport.

    Attributes:
        suffix: Suffix of the topic `image_raw`.
        message_type: Type of its messages.
        gray_of: Reads a message.
    """

    suffix: str
    message_type: str
    gray_of: Callable[[Any], Gray]


TRANSPORTS = {
    "raw": Transport("", "sensor_msgs/msg/Image", gray_image),
    "compressed": Transport("/compressed", "sensor_msgs/msg/CompressedImage", decoded_image),
}
"""By the names of image_transport."""
