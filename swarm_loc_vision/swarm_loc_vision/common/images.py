"""One camera by its messages: the calibration, and images of any encoding or compression as 8-bit gray."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from swarm_loc_vision.common.camera import Camera, CameraError

Gray = NDArray[np.uint8]
Pixels = NDArray[np.uint8] | NDArray[np.uint16]
Size = tuple[int, int]  # Width and height [px]

_MAX_SEGMENTS = 256
_NO_FRAMES = (0xC4, 0xC8, 0xCC)  # Markers of tables among those of frame headers


class ImageError(ValueError):
    """An image that cannot be used; the message is one sentence."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason  # In one word, for counting


@dataclass(frozen=True)
class _Encoding:
    """Layout of pixels in memory, and their conversion to gray."""

    channels: int  # Of a pixel
    to_gray: Callable[[Pixels], NDArray[Any]]  # Converts (height, width, channels)
    bytes_per_channel: int = 1  # 1 or 2
    planes: float = 1.0  # Rows in memory per row of the image; those below the image hold colours


def _highest_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """The highest 8 bits that any pixel uses: cameras of 10 or 12 bits may leave the upper bits empty."""
    surplus = max(int(pixels.max()).bit_length() - 8, 0)
    return (pixels >> surplus).astype(np.uint8)


def _of_8_and_16_bits(name: str, channels: int, conversion: int | None = None) -> dict[str, _Encoding]:
    """An encoding of 8 bits per channel and that of 16; the conversion is one of OpenCV, None: it is gray."""

    def to_gray(pixels: Pixels) -> NDArray[Any]:
        return pixels[..., 0] if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))

    return {
        name: _Encoding(channels, to_gray),
        name.replace("8", "16"): _Encoding(channels, lambda pixels: _highest_bits(to_gray(pixels)), 2),
    }


_ENCODINGS = {
    **_of_8_and_16_bits("mono8", 1),
    **_of_8_and_16_bits("8UC1", 1),
    **_of_8_and_16_bits("rgb8", 3, cv2.COLOR_RGB2GRAY),
    **_of_8_and_16_bits("bgr8", 3, cv2.COLOR_BGR2GRAY),
    **_of_8_and_16_bits("8UC3", 3, cv2.COLOR_BGR2GRAY),
    **_of_8_and_16_bits("rgba8", 4, cv2.COLOR_RGBA2GRAY),
    **_of_8_and_16_bits("bgra8", 4, cv2.COLOR_BGRA2GRAY),
    **_of_8_and_16_bits("8UC4", 4, cv2.COLOR_BGRA2GRAY),
    **_of_8_and_16_bits("bayer_rggb8", 1, cv2.COLOR_BayerBG2GRAY),
    **_of_8_and_16_bits("bayer_bggr8", 1, cv2.COLOR_BayerRG2GRAY),
    **_of_8_and_16_bits("bayer_gbrg8", 1, cv2.COLOR_BayerGR2GRAY),
    **_of_8_and_16_bits("bayer_grbg8", 1, cv2.COLOR_BayerGB2GRAY),
    **dict.fromkeys(("yuv422", "uyvy"), _Encoding(2, lambda pixels: pixels[..., 1])),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), _Encoding(2, lambda pixels: pixels[..., 0])),
    **dict.fromkeys(("nv12", "nv21"), _Encoding(1, lambda pixels: pixels[..., 0], planes=1.5)),
    "nv24": _Encoding(1, lambda pixels: pixels[..., 0], planes=3.0),
}
"""By the names of sensor_msgs/image_encodings."""


def _check_size(found: Size, size: Size) -> None:
    if found != size:
        shown, wanted = (f"{width} x {height}" for width, height in (found, size))
        said = f"the image has {shown} pixels, but must have {wanted}, as the calibration says."
        raise ImageError("size", said)


def _png_size(data: bytes) -> Size | None:
    """Width and height in the header of a PNG; None: there is none."""
    numbers = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    return numbers if data[12:16] == b"IHDR" else None


def _jpeg_size(data: bytes) -> Size | None:
    """Width and height in the frame header of a JPEG; None: there is none soon."""
    place = 2
    for _ in range(_MAX_SEGMENTS):
        head = data[place : place + 9]
        if len(head) < 9 or head[0] != 0xFF:
            break
        if head[1] & 0xF0 == 0xC0 and head[1] not in _NO_FRAMES:
            return int.from_bytes(head[7:9], "big"), int.from_bytes(head[5:7], "big")
        place += 1 if head[1] == 0xFF else 2 + int.from_bytes(head[2:4], "big")
    return None


@dataclass(frozen=True)
class _Compression:
    """Markers in the bytes of a compressed image."""

    name: str  # Its name in error messages
    begin: bytes  # First bytes
    data: bytes  # Mark before pixel data; `end` must follow its last occurrence
    end: bytes  # Mark after all pixel data
    size: Callable[[bytes], Size | None]  # Width and height in its header


_JPEG = _Compression("jpeg", b"\xff\xd8\xff", b"\xff\xda", b"\xff\xd9", _jpeg_size)
_PNG = _Compression("png", b"\x89PNG\r\n\x1a\n", b"IDAT", b"IEND", _png_size)
_COMPRESSIONS = {"jpeg": _JPEG, "jpg": _JPEG, "png": _PNG}
_COMPRESSED_DEPTH = "compressedDepth"  # The format of image_transport whose bytes are no plain image


def gray_image(message: Any, size: Size) -> Gray:
    """The brightness (height, width) of a sensor_msgs/Image of the camera's size.

    Raises:
        ImageError: Unknown encoding (`encoding`), or of another size, also by its bytes (`size`).
    """
    encoding, width, height, step = message.encoding, message.width, message.height, message.step
    _check_size((width, height), size)
    known = _ENCODINGS.get(encoding) or _ENCODINGS.get(encoding.lower())  # some drivers write NV12
    if known is None:
        raise ImageError(
            "encoding", f"the image's encoding is '{encoding}', but must be one of {', '.join(_ENCODINGS)}."
        )
    raw = np.frombuffer(message.data, np.uint8)
    row = width * known.channels * known.bytes_per_channel
    least = step * (math.ceil(known.planes * height) - 1) + row
    if width < 1 or height < 1 or step < row or raw.size < least:
        raise ImageError(
            "size",
            f"the image has {raw.size} bytes, {step} a row, but {width} x {height} pixels in '{encoding}'"
            f" must have at least {least}, {row} a row.",
        )
    rows = np.lib.stride_tricks.as_strided(raw, (height, row), (step, 1))
    pixels: Pixels = np.ascontiguousarray(rows)
    if known.bytes_per_channel == 2:
        pixels = pixels.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16, copy=False)
    gray = np.ascontiguousarray(known.to_gray(pixels.reshape(height, width, known.channels)), np.uint8)
    return gray if gray.flags.writeable else gray.copy()  # a read-only array would be compiled for separately


def decoded_image(message: Any, size: Size) -> Gray:
    """The brightness (height, width) of a sensor_msgs/CompressedImage; an EXIF orientation is ignored.

    Where the format is empty, the first bytes say what it is. An image of another size than the camera's is
    not decoded: a small one may say that it has a billion pixels.

    Raises:
        ImageError: Unknown format (`encoding`), no whole image (`corrupt`), or another size (`size`).
    """
    how = message.format
    raw = np.frombuffer(message.data, np.uint8)
    data = raw.tobytes()
    if how.strip():
        known = next((_COMPRESSIONS[name] for name in _COMPRESSIONS if name in how.lower()), None)
    else:
        known = next((one for one in (_JPEG, _PNG) if data.startswith(one.begin)), None)
    if known is None or _COMPRESSED_DEPTH in how:
        names = ", ".join(_COMPRESSIONS)
        raise ImageError(
            "encoding", f"the image's format is '{how}', but must be one of {names}, or empty for these."
        )
    gray: NDArray[Any] | None = None
    is_whole = data.startswith(known.begin) and data.rfind(known.end) > data.rfind(known.data) > 0
    if is_whole and (found := known.size(data)):  # cameras may append bytes
        _check_size(found, size)
        how_read = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        with suppress(cv2.error):  # it would be too large
            gray = cv2.imdecode(raw, how_read)
    if gray is None or gray.shape[::-1] != size:
        raise ImageError(
            "corrupt", f"the image's data has {raw.size} bytes, but must be a whole image in '{known.name}'."
        )
    return _highest_bits(gray)


@dataclass(frozen=True)
class Transport:
    """A transport of images, as in image_transport."""

    suffix: str  # Suffix of the topic `image_raw`
    message_type: str  # Type of its messages
    gray_of: Callable[[Any, Size], Gray]  # Reads a message of the camera's size


TRANSPORTS = {
    "raw": Transport("", "sensor_msgs/msg/Image", gray_image),
    "compressed": Transport("/compressed", "sensor_msgs/msg/CompressedImage", decoded_image),
}
"""By the names of image_transport."""


GrayOf = Callable[[Any, Size], Gray]


class Calibration:
    """The calibration of one camera; subclasses use its images, or what was found in them."""

    def __init__(self) -> None:
        self.images = 0  # Number of images received
        self.drops: Counter[str] = Counter()  # Number of drops by reason
        self.camera: Camera | None = None  # The calibration; None: none was received, or it cannot be used
        self.trouble = ""  # What is wrong with the calibration, a sentence; empty: nothing

    def calibrate(self, message: Any) -> None:
        """Use a sensor_msgs/CameraInfo from now on.

        Raises:
            CameraError: The camera is not calibrated; its images are dropped from now on.
        """
        try:
            camera = self.read(message)
        except CameraError as error:
            self.camera, self.trouble = None, str(error)
            raise
        self.take_over(camera)

    def read(self, message: Any) -> Camera:
        """The camera of a sensor_msgs/CameraInfo, see `camera_of`."""
        return camera_of(message)

    def take_over(self, camera: Camera) -> None:
        """Use a calibration from now on."""
        self.trouble = ""
        if camera != self.camera:
            self.camera = camera
            self.use(camera)

    def use(self, camera: Camera) -> None:
        """Adapt to a calibration that differs from the previous one."""
        raise NotImplementedError

    def detect(self, message: Any) -> bytes:
        """The serialized detections of an image, or of what was found in it; both are counted.

        Raises:
            ImageError: The message was dropped and counted.
        """
        self.images += 1
        try:
            return self.found(message)
        except ImageError as error:
            self.drops[error.reason] += 1
            raise

    def found(self, message: Any) -> bytes:
        """The serialized detections of a message; an ImageError if it cannot be used."""
        raise NotImplementedError

    def known_camera(self) -> Camera:
        """The calibration; without one an ImageError."""
        if self.camera is None:
            raise ImageError("no_calibration", self.trouble or "no camera_info was received yet.")
        return self.camera


class CalibratedCamera(Calibration):
    """The calibration of one camera, and its images; `gray_of` reads an image message, see `TRANSPORTS`."""

    def __init__(self, gray_of: GrayOf) -> None:
        super().__init__()
        self._gray_of = gray_of

    def gray(self, message: Any) -> Gray:
        """The brightness (height, width) of an image of this camera.

        Raises:
            ImageError: There is no calibration, or the image cannot be read or does not fit it.
        """
        camera = self.known_camera()
        return self._gray_of(message, (camera.width, camera.height))


def camera_of(message: Any, *, rectified: bool = False) -> Camera:
    """The camera of the images that a sensor_msgs/CameraInfo comes with, or of their rectified images.

    The calibration is that of the whole sensor. The images show its region of interest, and each of their
    pixels is the mean of `binning_x` x `binning_y` pixels of the sensor; what is left over at the right and
    lower rim is not shown.

    Raises:
        CameraError: It is not calibrated, or its region or binning do not fit its size.
    """
    matrix = np.reshape(message.p, (3, 4))[:, :3] if rectified else np.reshape(message.k, (3, 3))
    lens = ((), "") if rectified else (message.d, message.distortion_model)
    whole = Camera.from_matrix((message.width, message.height), matrix, *lens)
    roi = message.roi
    left, top, width, height = roi.x_offset, roi.y_offset, roi.width, roi.height
    if not any((left, top, width, height)):
        width, height = whole.width, whole.height
    if not (0 < width <= whole.width - left and 0 < height <= whole.height - top):
        raise CameraError(
            f"the camera's roi has {width} x {height} pixels at ({left}, {top}),"
            f" but must lie within its {whole.width} x {whole.height} pixels."
        )
    across, down = max(message.binning_x, 1), max(message.binning_y, 1)
    if across > width or down > height:
        raise CameraError(
            f"the camera's binning_x and binning_y are {across} and {down},"
            f" but must be at most the {width} x {height} pixels of its images."
        )
    return replace(
        whole,
        width=width // across,
        height=height // down,
        fx=whole.fx / across,
        fy=whole.fy / down,
        cx=(whole.cx - left - 0.5 * (across - 1)) / across,
        cy=(whole.cy - top - 0.5 * (down - 1)) / down,
    )
