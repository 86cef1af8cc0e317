"""The serial command set of e-puck and e-puck2 ("advanced sercom"), as far as the driver speaks it.

A binary command is the negative of its letter; commands chain, a zero byte ends the chain, and then the
payloads come back in the order of the requests: no header, no length, no checksum. So every request here asks
for the commanded speed (E) before and after what it wants. The robot repeats the speeds that the same request
has set: that shows that the request arrived whole, and where its reply begins and ends.
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
_ARGUMENTS_AT_MOST = 40

ASCII_SPEED_REPLY = re.compile(rb"e,-?\d+,-?\d+\r\n")
ASCII_CAMERA_SET = re.compile(rb"j\r\n")
ASCII_CAMERA_REPLY = re.compile(rb"i,(\d+),(\d+),(\d+),(\d+),(\d+)\r\n")

RESYNC = bytes(_ARGUMENTS_AT_MOST) + b"\rE\r"
"""Brings the robot from any state back to idle; then it answers `ASCII_SPEED_REPLY`.

The zeros fill up and end a binary command that has lost bytes, the first CR ends a line. It may not come
last: after a lone CR the firmware waits for the rest of a line and would swallow binary commands.
"""

ASCII_CAMERA_QUERY = b"I\r"


def code(letter: str) -> int:
    """The binary command of a letter."""
    return 256 - ord(letter)


class Readings(NamedTuple):
    """What the driver asks for regularly.

    Attributes:
        left_counter: Steps of the left wheel, 16 bits, wrapping.
        right_counter: Likewise of the right wheel.
        proximity: Raw values of ps0..ps7.
    """

    left_counter: int
    right_counter: int
    proximity: tuple[int, ...]


@dataclass(frozen=True)
class Request:
    """A chain of binary commands and the frame of its reply.

    Attributes:
        data: The bytes to send.
        mark: What the reply begins and ends with.
        size: Bytes between the marks.
    """

    data: bytes
    mark: bytes
    size: int


def readings_request(left: int, right: int) -> Request:
    """Set the speeds [steps/s] and ask for counters and proximity."""
    return _request(left, right, "QN", _READINGS.size)


def image_request(left: int, right: int, width: int, height: int) -> Request:
    """Set the speeds [steps/s] and ask for a picture of RGB565 pixels."""
    return _request(left, right, "I", _IMAGE_HEADER + 2 * width * height)


def _request(left: int, right: int, letters: str, size: int) -> Request:
    speeds = _SPEEDS.pack(left, right)
    queries = bytes([code("E"), *map(code, letters), code("E"), END])
    return Request(bytes([code("D")]) + speeds + queries, speeds, size)


def camera_setting(width: int, height: int, zoom: int) -> bytes:
    """The line that sets the camera to RGB565; the robot answers `ASCII_CAMERA_SET`, even when it refuses."""
    return f"J,{RGB565_MODE},{width},{height},{zoom}\r".encode()


def decode_readings(body: bytes) -> Readings:
    """What a reply to `readings_request` says."""
    left, right, *proximity = _READINGS.unpack(body)
    return Readings(left, right, tuple(proximity))


def decode_image(body: bytes, width: int, height: int) -> bytes | None:
    """The pixels of a reply to `image_request`; None when it is another kind of picture."""
    header, pixels = body[:_IMAGE_HEADER], body[_IMAGE_HEADER:]
    return pixels if header == bytes([RGB565_MODE, width, height]) else None


class ReplyParser:
    """Finds the reply to one request in what comes, in pieces of any size and after any garbage.

    Args:
        request: What was asked.

    Attributes:
        skipped: Bytes that did not belong to the reply.
    """

    def __init__(self, request: Request) -> None:
        self._request = request
        self._buffer = bytearray()
        self.skipped = 0

    def feed(self, data: bytes) -> bytes | None:
        """Take what came; the reply between its marks once it is complete. What follows it is skipped."""
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
