"""A conversation with an e-puck2 by its WiFi stream: the robot talks all the time. No I/O."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.common.session import SessionError
from swarm_loc_drivers.epuck import wifi_protocol as protocol
from swarm_loc_drivers.epuck.hardware import decode_rgb565
from swarm_loc_drivers.epuck.session import CameraImage, EpuckSettings, Reading, Speeds

_REPEAT_S = 0.1
"""A command is said again after so long, in case the robot has dropped one."""
_JITTER_NS = 50_000_000
"""By so much the time between two messages may vary."""
_FIRMWARE_PAUSE_S = 1.5
"""The firmware pauses for 1 s when its two chips have misunderstood each other. It never closes a connection,
and there is room for few: so a pause may not cost one."""


class _Arrival(NamedTuple):
    """When a message came, how long after the one before it, and whether it was held up on the way."""

    stamp_ns: int
    gap_ns: float = math.inf
    is_late: bool = False

    def next(self, stamp_ns: int) -> _Arrival:
        """That of the next message."""
        gap_ns = stamp_ns - self.stamp_ns
        return _Arrival(stamp_ns, gap_ns, gap_ns > 2.0 * self.gap_ns + _JITTER_NS)


class WifiSession:
    """Commands and listens; see `EpuckSession`.

    What the robot sends it has read when it sent the message of the same kind before: it reads the next
    values at once into a second buffer, where they wait however long the way to the computer is blocked. So
    that message's arrival is the stamp. What has none is not used: the first message of a connection, which
    may be of any age, one that comes late, of which nobody knows where it was held up, and the one behind it.

    Args:
        settings: Of the robot.
        speeds: Tells what the wheels are to do.
        counts: Gets `messages`, `stray_bytes`, `resyncs`.
    """

    is_idle = False

    def __init__(self, settings: EpuckSettings, speeds: Speeds, counts: Counter[str]) -> None:
        self.ending = self.connected = self.ended = False
        self.found: list[Reading | CameraImage] = []
        self._camera = settings.camera is not None
        self._period_ns = round(settings.reading_period_s * 1e9)
        self._silence_s = _FIRMWARE_PAUSE_S + settings.reply_timeout_s
        self._speeds = speeds
        self._counts = counts
        self._parser = protocol.StreamParser()
        self._sent: protocol.Command | None = None
        self._sent_s = -math.inf
        self._heard: tuple[int, float] | None = None
        self._arrivals: dict[int, _Arrival] = {}
        self._due_ns = 0

    def step(self, data: bytes, now_ns: int, steady_s: float) -> bytes:
        """See `EpuckSession.step`."""
        self._check_silence(bool(data), now_ns, steady_s)
        newest: dict[int, protocol.Message] = {}
        for message in self._parsed(data, now_ns):
            self.connected = True
            self.ended |= self.ending and message.id == protocol.NOTHING_ID
            before = self._arrivals.get(message.id)
            arrival = before.next(message.stamp_ns) if before else _Arrival(message.stamp_ns)
            if before is not None and not before.is_late and not arrival.is_late:
                newest[message.id] = replace(message, stamp_ns=before.stamp_ns)
            self._arrivals[message.id] = arrival
        self._keep(newest)
        return self._command(steady_s)

    def _check_silence(self, is_heard: bool, now_ns: int, steady_s: float) -> None:
        """Make sure that the robot is there, by real time and by the clock: a simulated one may stand still.

        Raises:
            SessionError: It has been silent for too long.
        """
        if is_heard or self._heard is None:
            self._heard = now_ns, steady_s
        heard_ns, heard_s = min(self._heard[0], now_ns), self._heard[1]  # the clock may jump back
        self._heard = heard_ns, heard_s
        if min(steady_s - heard_s, (now_ns - heard_ns) * 1e-9) > self._silence_s:
            raise SessionError(f"the robot has been silent for {self._silence_s:g} s")

    def _parsed(self, data: bytes, now_ns: int) -> list[protocol.Message]:
        skipped, resyncs = self._parser.skipped, self._parser.resyncs
        messages = self._parser.feed(data, now_ns) if data else []
        self._counts["messages"] += len(messages)
        self._counts["stray_bytes"] += self._parser.skipped - skipped
        self._counts["resyncs"] += self._parser.resyncs - resyncs
        return messages

    def _keep(self, newest: dict[int, protocol.Message]) -> None:
        """Note what the newest messages of each kind say: of those that come at once the last is fresh."""
        if protocol.SENSORS_ID in newest:
            message = newest[protocol.SENSORS_ID]
            if self._is_due(message.stamp_ns):
                values = message.sensors
                left, right = int(values["left_counter"]), int(values["right_counter"])
                self.found.append(
                    Reading(message.stamp_ns, 0, left, right, values["proximity"].astype(np.int64))
                )
        if protocol.IMAGE_ID in newest:
            message = newest[protocol.IMAGE_ID]
            pixels = decode_rgb565(message.payload, protocol.WIDTH, protocol.HEIGHT)
            self.found.append(CameraImage(message.stamp_ns, pixels))

    def _is_due(self, stamp_ns: int) -> bool:
        """Whether a reading is the next to be used; the period is kept on average."""
        if self._due_ns - self._period_ns <= stamp_ns < self._due_ns:
            return False
        on_time = 0 <= stamp_ns - self._due_ns < self._period_ns
        self._due_ns = (self._due_ns if on_time else stamp_ns) + self._period_ns
        return True

    def _command(self, steady_s: float) -> bytes:
        """What the robot is to do, if it has to be told; one that streams nothing knows that it stands."""
        left, right = self._speeds() if self.connected and not self.ending else (0, 0)
        streams = not self.ending
        command = protocol.Command(left, right, camera=self._camera and streams, sensors=streams)
        if command == self._sent and steady_s <= self._sent_s + _REPEAT_S:
            return b""
        self._sent, self._sent_s = command, steady_s
        return command.encode()
