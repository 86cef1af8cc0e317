"""Session with an e-puck over the serial command set: request and reply, without I/O.

The serial command set of e-puck and e-puck2 ("advanced sercom"), as far as the driver uses it.

A binary command is the negative of its letter; commands chain, a zero byte ends the chain, and then the
payloads come back in the order of the requests: no header, no length, no checksum. So every request here asks
for the commanded speed (E) before and after its payload. The robot returns the speeds that it has received,
which confirms them and marks the beginning and the end of the reply.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from swarm_loc_drivers.common.robot_driver import MAX_NONSENSE_S, NONSENSE, SessionError, Talk, TalkSession
from swarm_loc_drivers.epuck.hardware import (
    CameraImage,
    CameraSettings,
    Reading,
    Speeds,
    as_counter,
    decode_rgb565,
)
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_estimator.common.arrays import IntArray

END = 0
RGB565_MODE = 1

_SPEEDS = struct.Struct("<2h")
_READINGS = struct.Struct("<2h8H")
_IMAGE_HEADER = 3
_MAX_ARGUMENTS = 40

ASCII_CAMERA_SET = re.compile(rb"j\r\n")
ASCII_CAMERA_REPLY = re.compile(rb"i,(\d{1,5}),(\d{1,5}),(\d{1,5}),(\d{1,5}),(\d{1,10})\r\n")

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


def decode_readings(body: bytes) -> tuple[int, int, IntArray]:
    """Counters of the left and the right wheel, 16 bits, and raw values (8,) of ps0..ps7."""
    left, right, *proximity = _READINGS.unpack(body)
    return left, right, np.array(proximity, np.int64)


def decode_image(body: bytes, width: int, height: int) -> bytes | None:
    """The pixels of a reply to `image_request`; None for another kind of image."""
    header, pixels = body[:_IMAGE_HEADER], body[_IMAGE_HEADER:]
    return pixels if header == bytes([RGB565_MODE, width, height]) else None


class ReplyParser:
    """Finds the reply to one request in pieces of any size, after any stray bytes."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self._buffer = bytearray()
        self.skipped = 0  # Number of bytes outside the reply

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


_TRIES = 5  # Tries of a request
_JITTER_NS = 50_000_000  # Allowed jitter of half the time between request and reply [ns]
_SLACK_S, _ROUNDING_STEPS = 0.1, 2  # Uncertainty of the time between two readings, and of counters
_NS = 1_000_000_000


class SerialSession(TalkSession):
    """Requests readings at every step that finds it idle, and images in between; a `Session`.

    `doubt` is called when it is unknown which commands the robot has received. Counts `exchanges`,
    `missed_replies`, `stray_bytes`, `resyncs`, `bad_images`.
    """

    def __init__(
        self, params: EpuckParameters, speeds: Speeds, doubt: Callable[[], None], counts: Counter[str]
    ) -> None:
        super().__init__(counts)
        self.is_idle = False  # Whether no answer is pending: the next step sends a request
        self.found: list[Reading | CameraImage] = []  # Measurements; the reader empties the list
        self._params = params
        self._wanted_speeds = speeds
        self._doubt = doubt
        self._sent = (0, 0)
        self._sense: Reading | None = None  # The last reading that makes sense, and when it came
        self._sense_s = 0.0
        self._may_have_moved = False  # Since that reading
        image_bytes = 2 * camera.width * camera.height if (camera := params.images) else 0
        self._patience_s = max(MAX_NONSENSE_S, 2.0 * self._timeout_s(_READINGS.size + image_bytes))
        self._image_due_ns = 0
        self._way_ns = 0

    def step(self, data: bytes, now_ns: int, steady_s: float) -> bytes:
        """See `TalkSession.step`."""
        output = super().step(data, now_ns, steady_s)
        if self.connected and steady_s > self._sense_s + self._patience_s:
            raise SessionError(NONSENSE)
        return output

    def _run(self) -> Talk[None]:
        yield from self._resync()
        camera = self._params.images
        if camera is not None:
            yield from self._set_camera(camera)
        self.connected, self._sense_s = True, self._steady_s
        while True:
            self.is_idle = True
            yield
            self.is_idle = False
            if self.ending:
                break
            # send the wheel speeds and take the measurements
            speeds = self._speeds()
            is_answered = yield from self._read(speeds)
            if is_answered and camera is not None:
                is_answered = yield from self._take_image(speeds, camera)
            if not is_answered:
                self._doubt()
                self._may_have_moved = True
                self._counts["missed_replies"] += 1
                yield from self._resync()
        yield from self._resync()

    def _speeds(self) -> tuple[int, int]:
        """Commands of the wheels now; zero before the connection and at the end."""
        return self._wanted_speeds() if self.connected and not self.ending else (0, 0)

    def _read(self, speeds: tuple[int, int]) -> Talk[bool]:
        """Read counters and proximity; the stamp is the middle between request and reply."""
        asked_ns = self._now_ns
        body = yield from self._request(readings_request(*speeds, is_new=speeds != self._sent))
        if body is None:
            return False
        way_ns = max(0, self._now_ns - asked_ns) // 2
        # a reply that is far later than the one before is not used: this process was stopped meanwhile
        is_late = way_ns > (most_ns := 2 * self._way_ns + _JITTER_NS)
        self._way_ns = min(way_ns, most_ns)
        left, right, proximity = decode_readings(body)
        reading = Reading(asked_ns + self._way_ns, self._way_ns, left, right, proximity)
        if not is_late:
            self.found.append(reading)
        self._may_have_moved |= any(self._sent) or any(speeds)
        if self._sense is None or self._can_follow(self._sense, reading):
            self._sense, self._sense_s, self._may_have_moved = reading, self._steady_s, False
        self._sent = speeds
        return True

    def _can_follow(self, before: Reading, after: Reading) -> bool:
        """Whether the wheels can have moved from one reading to another one."""
        elapsed_s = 1e-9 * abs(after.stamp_ns - before.stamp_ns)
        most = self._params.epuck_model.max_rate * (elapsed_s + _SLACK_S) * self._may_have_moved
        left, right = after.left_counter - before.left_counter, after.right_counter - before.right_counter
        return max(abs(as_counter(left)), abs(as_counter(right))) <= most + _ROUNDING_STEPS

    def _take_image(self, speeds: tuple[int, int], camera: CameraSettings) -> Talk[bool]:
        """Read an image if one is due, which the robot takes when the request arrives; whether it answers."""
        period_ns, asked_ns = round(camera.period_s * _NS), self._now_ns
        if self._image_due_ns - period_ns <= asked_ns < self._image_due_ns:
            return True
        self._image_due_ns = asked_ns + period_ns
        body = yield from self._request(image_request(*speeds, camera.width, camera.height))
        if body is None:
            return False
        pixels = decode_image(body, camera.width, camera.height)
        if pixels is None:
            self._counts["bad_images"] += 1
        else:
            image = decode_rgb565(pixels, camera.width, camera.height)
            self.found.append(CameraImage(asked_ns + self._way_ns, image))
        return True

    def _request(self, request: Request) -> Talk[bytes | None]:
        """The body of the reply; None if it is late or incomplete."""
        self._counts["stray_bytes"] += len(self._received)
        self._received = b""
        self._output += request.data
        parser = ReplyParser(request)
        deadline_s = self._steady_s + self._timeout_s(
            len(request.data) + request.size + 2 * len(request.mark)
        )
        while self._steady_s < deadline_s:
            yield
            received, self._received = self._received, b""
            body = parser.feed(received)
            if body is not None:
                self._counts["exchanges"] += 1
                self._counts["stray_bytes"] += parser.skipped
                return body
        return None

    def _timeout_s(self, bytes_in_all: int) -> float:
        """How long an exchange of bytes may take [s]."""
        return self._params.reply_timeout_s + 20.0 * bytes_in_all / self._params.baud_rate

    def _set_camera(self, camera: CameraSettings) -> Talk[None]:
        """Set the size of images, and check that the robot has accepted it."""
        setting = f"J,{RGB565_MODE},{camera.width},{camera.height},{camera.zoom}\r".encode()
        timeouts_s = (self._timeout_s(len(line)) for line in (setting, ASCII_CAMERA_QUERY))
        yield from self._ask(setting, ASCII_CAMERA_SET, next(timeouts_s), _TRIES)  # even when it refuses
        answer = yield from self._ask(ASCII_CAMERA_QUERY, ASCII_CAMERA_REPLY, next(timeouts_s), _TRIES)
        self._received = b""
        wanted = (RGB565_MODE, camera.width, camera.height, camera.zoom)
        taken = tuple(int(number) for number in answer.groups()[:4])
        if taken != wanted:
            raise SessionError(f"the robot's camera is set to {taken} though {wanted} was asked for")

    def _resync(self) -> Talk[None]:
        """Bring the robot back to idle; each attempt sends the speeds of its moment: it may be heard."""
        for _ in range(_TRIES):
            self._counts["resyncs"] += 1
            self._sent = self._speeds()
            line = resync(*self._sent)
            answer = speed_reply(*self._sent)
            if (yield from self._ask_once(line, answer, self._timeout_s(len(line)))) is not None:
                self._received = b""
                return
        raise SessionError("the robot does not answer")
