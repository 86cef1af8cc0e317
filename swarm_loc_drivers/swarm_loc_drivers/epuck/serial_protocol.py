"""The serial command set of e-puck and e-puck2 ("advanced sercom"), as far as the driver uses it.

A binary command is the negative of its letter; commands chain, a zero byte ends the chain, and then the
payloads come back in the order of the requests: no header, no length, no checksum. So every request here asks
for the commanded speed (E) before and after its payload. The robot returns the speeds that it has received,
which confirms them and marks the beginning and the end of the reply.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import NamedTuple

END = 0
RGB565_MODE = 1

_SPEEDS = struct.Struct("<2h")
_READINGS = struct.Struct("<2h8H")
_IMAGE_HEADER = 3
_MAX_ARGUMENTS = 40

ASCII_CAMERA_SET = re.compile(rb"j\r\n")
ASCII_CAMERA_REPLY = re.compile(rb"i,(\d+),(\d+),(\d+),(\d+),(\d+)\r\n")

ASCII_CAMERA_QUERY = b"I\r"


def resync(left: int, right: int) -> bytes:
    """Bring the robot from any state back to idle and set the speeds [steps/s]; it answers `speed_reply`.

    The zeros complete a binary command that has lost bytes, the first CR ends a line. A lone CR must not come
    last: the firmware would wait for the rest of a line and drop binary commands.
    """
    return bytes(_MAX_ARGUMENTS) + f"\rD,{left},{right}\rE\r".encode()


def speed_reply(left: int, right: int) -> re.Pattern[bytes]:
    """Pattern of the end of the answer to `resync`."""
    return re.compile(rf"e,{left},{right}\r\n".encode())


def code(letter: str) -> int:
    """Binary command of a letter."""
    return 256 - ord(letter)


class Readings(NamedTuple):
    """Periodic readings."""

    left_counter: int  # Steps of the left wheel, 16 bits, wrapping
    right_counter: int  # Steps of the right wheel, 16 bits, wrapping
    proximity: tuple[int, ...]  # Raw values of ps0..ps7


@dataclass(frozen=True)
class Request:
    """A chain of binary commands and the frame of its reply."""

    data: bytes  # The bytes to send
    mark: bytes  # Bytes at the beginning and the end of the reply
    size: int  # Number of bytes between the marks


def readings_request(left: int, right: int, *, is_new: bool) -> Request:
    """Request counters and proximity of a robot with these speeds [steps/s], and set new speeds.

    Setting a speed costs an e-puck part of a step, so repeating it would slow the robot below 601 steps/s.
    """
    request = _request(left, right, "QN", _READINGS.size)
    command = bytes([code("D")]) + request.mark if is_new else b""
    return Request(command + request.data, request.mark, request.size)


def image_request(left: int, right: int, width: int, height: int) -> Request:
    """Request an image of RGB565 pixels of a robot with these speeds [steps/s]."""
    return _request(left, right, "I", _IMAGE_HEADER + 2 * width * height)


def _request(left: int, right: int, letters: str, size: int) -> Request:
    queries = bytes([code("E"), *map(code, letters), code("E"), END])
    return Request(queries, _SPEEDS.pack(left, right), size)


def camera_setting(width: int, height: int, zoom: int) -> bytes:
    """The line that sets the camera to RGB565; the robot answers `ASCII_CAMERA_SET`, even when it refuses."""
    return f"J,{RGB565_MODE},{width},{height},{zoom}\r".encode()


def decode_readings(body: bytes) -> Readings:
    """Decode a reply to `readings_request`."""
    left, right, *proximity = _READINGS.unpack(body)
    return Readings(left, right, tuple(proximity))


def decode_image(body: bytes, width: int, height: int) -> bytes | None:
    """The pixels of a reply to `image_request`; None for another kind of image."""
    header, pixels = body[:_IMAGE_HEADER], body[_IMAGE_HEADER:]
    return pixels if header == bytes([RGB565_MODE, width, height]) else None


class ReplyParser:
    """Finds the reply to one request in pieces of any size, after any stray bytes.

    Args:
        request: The request that was sent.

    Attributes:
        skipped: Number of bytes outside the reply.
    """

    def __init__(self, request: Request) -> None:
        self._request = request
        self._buffer = bytearray()
        self.skipped = 0

    def feed(self, data: bytes) -> bytes | None:
        """Take bytes; the body of the reply once it is complete. Bytes after it are skipped."""
        self._buffer += data
        mark, length = self._request.mark, self._request.size + 2 * len(self._request.mark)
        begin = self._buffer.find(mark)
        while 0 <= begin <= len(self._buffer) - length:
            end = begin + length
            if self._buffer[end - len(mark) : end] == mark:
                self.skipped += len(self._buffer) - length
                body = bytes(self._buffer[begin + len(mark) : end - len(mark)])
                self._buffer.clear()
                return body
            begin = self._buffer.find(mark, begin + 1)
        kept = len(self._buffer) - begin if begin >= 0 else len(mark) - 1
        surplus = max(0, len(self._buffer) - kept)
        self.skipped += surplus
        del self._buffer[:surplus]
        return None
