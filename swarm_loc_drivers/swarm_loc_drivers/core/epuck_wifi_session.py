"""A conversation by the e-puck2's WiFi stream: the robot talks all the time."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from swarm_loc_drivers.core.epuck_session import Photo, Reading, Speeds
from swarm_loc_drivers.core.link_keeper import SessionError
from swarm_loc_drivers.protocols import epuck_wifi as protocol
from swarm_loc_drivers.protocols.rgb565 import decode_rgb565
from swarm_loc_drivers.transports.link import Link

_REPEAT_S = 0.1
"""A command is said again after so long, in case the robot has dropped one."""
_READ_S = 0.02
_STOP_ATTEMPTS = 5


class WifiSession:
    """Commands and listens.

    Args:
        link: To the robot.
        camera: Whether pictures are wanted.
        reading_period_s: Of the readings, which come every 16 ms, one in so long is used [s].
        silence_s: A robot silent for so long is taken for gone, by real time and by the clock: a simulated
            one may stand still for a while.
        clock: Tells the time [ns]; may be simulated.
        counts: Gets `messages`, `stray_bytes`, `resyncs`.
    """

    def __init__(
        self,
        link: Link,
        camera: bool,
        reading_period_s: float,
        silence_s: float,
        clock: Callable[[], int],
        counts: Counter[str],
    ) -> None:
        self._link = link
        self._camera = camera
        self._period_ns = round(reading_period_s * 1e9)
        self._due_ns = 0
        self._silence_s = silence_s
        self._clock = clock
        self._counts = counts
        self._parser = protocol.StreamParser()
        self._said: protocol.Command | None = None
        self._said_s = self._heard_s = time.monotonic()
        self._heard_ns = clock()

    def begin(self) -> None:
        """See `Session.begin`."""
        self._say(protocol.Command(0, 0, camera=self._camera, sensors=True))

    def exchange(self, speeds: Speeds) -> list[Reading | Photo]:
        """See `Session.exchange`."""
        left, right = speeds()
        command = protocol.Command(left, right, camera=self._camera, sensors=True)
        if command != self._said or time.monotonic() > self._said_s + _REPEAT_S:
            self._say(command)
        messages = self._listen(_READ_S)
        readings = [message for message in messages if message.id == protocol.SENSORS_ID]
        photos = [message for message in messages if message.id == protocol.IMAGE_ID]
        # of readings that come at once only the last has just been taken
        return [*map(_reading, filter(self._is_due, readings[-1:])), *map(_photo, photos[-1:])]

    def _is_due(self, message: protocol.Message) -> bool:
        """Whether a reading is the next to be used; the period is kept on average."""
        if self._due_ns - self._period_ns <= message.stamp_ns < self._due_ns:
            return False
        behind_ns = message.stamp_ns - self._due_ns
        on_time = 0 <= behind_ns < self._period_ns
        self._due_ns = (self._due_ns if on_time else message.stamp_ns) + self._period_ns
        return True

    def end(self) -> None:
        """See `Session.end`: a robot that streams nothing any more has heard the command that said so."""
        for _ in range(_STOP_ATTEMPTS):
            self._say(protocol.Command(0, 0, camera=False, sensors=False))
            end_s = time.monotonic() + self._silence_s / _STOP_ATTEMPTS
            while time.monotonic() < end_s:
                if any(message.id == protocol.NOTHING_ID for message in self._listen(_READ_S)):
                    return
        raise SessionError("the robot does not confirm that it has stopped")

    def _say(self, command: protocol.Command) -> None:
        self._link.write(command.encode())
        self._said, self._said_s = command, time.monotonic()

    def _listen(self, timeout_s: float) -> list[protocol.Message]:
        """What has come, after a moment at most."""
        data = self._link.read(timeout_s)
        now_s, now_ns = time.monotonic(), self._clock()
        self._heard_ns = min(self._heard_ns, now_ns)  # the clock may jump back
        if data:
            self._heard_s, self._heard_ns = now_s, now_ns
        elif min(now_s - self._heard_s, (now_ns - self._heard_ns) * 1e-9) > self._silence_s:
            raise SessionError(f"the robot has been silent for {self._silence_s:g} s")
        skipped, resyncs = self._parser.skipped, self._parser.resyncs
        messages = self._parser.feed(data, now_ns) if data else []
        self._counts["messages"] += len(messages)
        self._counts["stray_bytes"] += self._parser.skipped - skipped
        self._counts["resyncs"] += self._parser.resyncs - resyncs
        return messages


def _reading(message: protocol.Message) -> Reading:
    values = message.sensors
    left, right = int(values["left_counter"]), int(values["right_counter"])
    return Reading(message.stamp_ns, left, right, values["proximity"].astype(np.int64))


def _photo(message: protocol.Message) -> Photo:
    pixels = decode_rgb565(message.payload, protocol.WIDTH, protocol.HEIGHT)
    return Photo(message.stamp_ns, pixels)
