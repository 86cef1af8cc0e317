"""The serial command set of e-puck and e-puck2 ("advanced sercom"), as far as the driver speaks it.

A binary command is the negative of its letter; commands chain, a zero byte ends the chain, and then the
payloads come back in the order of the requests: no header, no length, no checksum. So every request here asks
for the commanded speed (E) before and after what it wants. The robot repeats the speeds that it was told:
that shows that it has understood them, and where its reply begins and ends.
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

    The zeros fill up and end a binary command that has lost bytes, the first CR ends a line. It may not come
    last: after a lone CR the firmware waits for the rest of a line and would swallow binary commands.
    """
    return bytes(_MAX_ARGUMENTS) + f"\rD,{left},{right}\rE\r".encode()


def speed_reply(left: int, right: int) -> re.Pattern[bytes]:
    """The end of the answer to `resync`."""
    return re.compile(rf"e,{left},{right}\r\n".encode())


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


def readings_request(left: int, right: int, *, is_new: bool) -> Request:
    """Ask for counters and proximity of a robot with these speeds [steps/s], and set them if they are new.

    Each command loses an e-puck part of a step: below 601 steps/s it would be slower for being told again.
    """
    request = _request(left, right, "QN", _READINGS.size)
    command = bytes([code("D")]) + request.mark if is_new else b""
    return Request(command + request.data, request.mark, request.size)


def image_request(left: int, right: int, width: int, height: int) -> Request:
    """Ask for an image of RGB565 pixels of a robot with these speeds [steps/s]."""
    return _request(left, right, "I", _IMAGE_HEADER + 2 * width * height)


def _request(left: int, right: int, letters: str, size: int) -> Request:
    queries = bytes([code("E"), *map(code, letters), code("E"), END])
    return Request(queries, _SPEEDS.pack(left, right), size)


def camera_setting(width: int, height: int, zoom: int) -> bytes:
    """The line that sets the camera to RGB565; the robot answers `ASCII_CAMERA_SET`, even when it refuses."""
    return f"J,{RGB565_MODE},{width},{height},{zoom}\r".encode()


def decode_readings(body: bytes) -> Readings:
    """What a reply to `readings_request` says."""
    left, right, *proximity = _READINGS.unpack(body)
    return Readings(left, right, tuple(proximity))


def decode_image(body: bytes, width: int, height: int) -> bytes | None:
    """The pixels of a reply to `image_request`; None when it is another kind of image."""
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
