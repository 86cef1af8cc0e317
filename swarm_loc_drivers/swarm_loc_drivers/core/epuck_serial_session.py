"""A conversation by the serial command set: question and answer."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from swarm_loc_drivers.core.epuck_session import Photo, Reading, Speeds
from swarm_loc_drivers.core.link_keeper import SessionError
from swarm_loc_drivers.protocols import epuck_serial as protocol
from swarm_loc_drivers.protocols.rgb565 import decode_rgb565
from swarm_loc_drivers.transports.link import Link

_MISSED_AT_MOST = 5
"""So many exchanges in a row without an answer, and the link is opened anew."""
_TURN_S = 0.5
"""Without a tick for so long, as when simulated time stands still, the robot is asked all the same."""
_NS = 1_000_000_000


@dataclass(frozen=True)
class SerialCamera:
    """The pictures to ask for.

    Attributes:
        width: [px].
        height: [px].
        zoom: Camera pixels per pixel.
        period_s: Between two pictures [s].
    """

    width: int
    height: int
    zoom: int
    period_s: float


class SerialSession:
    """Asks for readings at every tick, and for pictures in between.

    Args:
        link: To the robot.
        baud_rate: Of the link [bit/s]: how long a picture takes.
        camera: None for no pictures.
        reply_timeout_s: How long an answer may take to begin.
        tick: Set when the robot is to be asked.
        clock: Tells the time [ns]; may be simulated.
        doubt: Called when it is not known what the robot has understood.
        counts: Gets `exchanges`, `missed_replies`, `stray_bytes`, `resyncs`, `bad_pictures`.
    """

    def __init__(
        self,
        link: Link,
        baud_rate: int,
        camera: SerialCamera | None,
        reply_timeout_s: float,
        tick: threading.Event,
        clock: Callable[[], int],
        doubt: Callable[[], None],
        counts: Counter[str],
    ) -> None:
        self._link = link
        self._byte_s = 10.0 / baud_rate
        self._camera = camera
        self._reply_timeout_s = reply_timeout_s
        self._tick = tick
        self._clock = clock
        self._doubt = doubt
        self._counts = counts
        self._missed = 0
        self._picture_due_ns = 0
        self._way_ns = 0

    def begin(self) -> None:
        """See `Session.begin`."""
        self._resync()
        self._ask(protocol.readings_request(0, 0))
        if self._camera is not None:
            self._set_camera(self._camera)

    def exchange(self, speeds: Speeds) -> list[Reading | Photo]:
        """See `Session.exchange`; waits for a tick first."""
        self._tick.wait(_TURN_S)
        self._tick.clear()
        found: list[Reading | Photo] = []
        left, right = speeds()
        try:
            found.append(self._reading(left, right))
            if self._camera is not None and self._picture_is_due(self._camera):
                found += self._photo(left, right, self._camera)
            self._missed = 0
        except _NoReplyError:
            self._note_missed()
            self._resync()
        return found

    def end(self) -> None:
        """See `Session.end`."""
        while True:
            try:
                self._ask(protocol.readings_request(0, 0))
            except _NoReplyError:
                self._note_missed()
                self._resync()
            else:
                return

    def _note_missed(self) -> None:
        self._doubt()
        self._counts["missed_replies"] += 1
        self._missed += 1
        if self._missed >= _MISSED_AT_MOST:
            raise SessionError(f"the robot missed {self._missed} requests in a row")

    def _reading(self, left: int, right: int) -> Reading:
        """Counters and proximity; taken in the middle between question and answer."""
        asked_ns = self._clock()
        body = self._ask(protocol.readings_request(left, right))
        self._way_ns = max(0, self._clock() - asked_ns) // 2
        readings = protocol.decode_readings(body)
        proximity = np.array(readings.proximity, dtype=np.int64)
        return Reading(asked_ns + self._way_ns, readings.left_counter, readings.right_counter, proximity)

    def _picture_is_due(self, camera: SerialCamera) -> bool:
        now_ns, period_ns = self._clock(), round(camera.period_s * _NS)
        if self._picture_due_ns - period_ns <= now_ns < self._picture_due_ns:
            return False
        self._picture_due_ns = now_ns + period_ns
        return True

    def _photo(self, left: int, right: int, camera: SerialCamera) -> list[Photo]:
        """A picture; the robot takes it when the question arrives."""
        asked_ns = self._clock()
        body = self._ask(protocol.image_request(left, right, camera.width, camera.height))
        pixels = protocol.decode_image(body, camera.width, camera.height)
        if pixels is None:
            self._counts["bad_pictures"] += 1
            return []
        return [Photo(asked_ns + self._way_ns, decode_rgb565(pixels, camera.width, camera.height))]

    def _ask(self, request: protocol.Request) -> bytes:
        """The body of the reply.

        Raises:
            _NoReplyError: It did not come in time, or not whole.
        """
        self._counts["stray_bytes"] += len(self._link.read(0.0))
        self._link.write(request.data)
        parser = protocol.ReplyParser(request)
        bytes_in_all = len(request.data) + request.size + 2 * len(request.mark)
        deadline_s = time.monotonic() + self._reply_timeout_s + 2.0 * bytes_in_all * self._byte_s
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            body = parser.feed(self._link.read(left_s))
            if body is not None:
                self._counts["exchanges"] += 1
                self._counts["stray_bytes"] += parser.skipped
                return body
        raise _NoReplyError("the robot does not answer")

    def _set_camera(self, camera: SerialCamera) -> None:
        """Choose the size of pictures, and check that the robot has really taken it."""
        setting = protocol.camera_setting(camera.width, camera.height, camera.zoom)
        self._ask_line(setting, protocol.ASCII_CAMERA_SET)
        answer = self._ask_line(protocol.ASCII_CAMERA_QUERY, protocol.ASCII_CAMERA_REPLY)
        wanted = (protocol.RGB565_MODE, camera.width, camera.height, camera.zoom)
        taken = tuple(int(number) for number in answer.groups()[:4])
        if taken != wanted:
            raise SessionError(f"the robot's camera is set to {taken} though {wanted} was asked for")

    def _resync(self) -> None:
        """Bring the robot back to idle, whatever bytes were lost; returns when it says so."""
        self._counts["resyncs"] += 1
        self._ask_line(protocol.RESYNC, protocol.ASCII_SPEED_REPLY)

    def _ask_line(self, line: bytes, answer: re.Pattern[bytes]) -> re.Match[bytes]:
        """The answer to an ASCII command, behind whatever was still under way."""
        for _ in range(_MISSED_AT_MOST):
            self._link.write(line)
            received = b""
            deadline_s = time.monotonic() + self._reply_timeout_s + 2.0 * len(line) * self._byte_s
            while (left_s := deadline_s - time.monotonic()) > 0.0:
                received += self._link.read(left_s)
                if match := answer.search(received):
                    return match
        raise SessionError(f"the robot does not answer {line.lstrip(bytes(1))!r}")


class _NoReplyError(SessionError):
    """A request was not answered in time, or not whole."""
