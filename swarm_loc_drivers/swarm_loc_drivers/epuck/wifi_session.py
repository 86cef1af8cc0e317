"""Session with an e-puck2 over its WiFi stream: the robot sends continuously, without I/O."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.common.session import SessionError
from swarm_loc_drivers.epuck import wifi_protocol as protocol
from swarm_loc_drivers.epuck.hardware import decode_rgb565
from swarm_loc_drivers.epuck.parameters import EpuckParameters
from swarm_loc_drivers.epuck.session import CameraImage, Reading, Speeds

_REPEAT_S = 0.1  # A command is repeated after so long, since the robot may have dropped it [s]
_JITTER_NS = 50_000_000  # Allowed jitter of the time between two messages [ns]
_FIRMWARE_PAUSE_S = 1.5
"""The firmware pauses for 1 s after an error between its two chips. It never closes a connection and supports
few of them, so a pause must not lead to a reconnection."""


class _Arrival(NamedTuple):
    """Arrival of a message: time, gap to the previous one, and whether it was delayed in transit."""

    stamp_ns: int
    gap_ns: float = math.inf
    is_late: bool = False

    def next(self, stamp_ns: int) -> _Arrival:
        """The arrival of the next message."""
        gap_ns = stamp_ns - self.stamp_ns
        return _Arrival(stamp_ns, gap_ns, gap_ns > 2.0 * self.gap_ns + _JITTER_NS)


class WifiSession:
    """Sends commands and receives the stream; see `EpuckSession`.

    The robot reads new values into a second buffer as soon as it has sent a message, and sends them with the
    next message of that kind. So the stamp of a message is the arrival of the previous one. Messages without
    a reliable stamp are not used: the first one of a connection, one that arrives late, and its successor.
    Nor are they signs of life: among corrupted bytes, one message may look right by chance.
    Counts `messages`, `stray_bytes`, `resyncs`.
    """

    is_idle = False

    def __init__(self, params: EpuckParameters, speeds: Speeds, counts: Counter[str]) -> None:
        self.ending = self.connected = self.ended = False
        self.found: list[Reading | CameraImage] = []
        self._camera = params.camera
        self._period_ns = round(1e9 / params.reading_rate)
        self._silence_s = _FIRMWARE_PAUSE_S + params.reply_timeout_s
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
        newest: dict[int, protocol.Message] = {}
        for message in self._parsed(data, now_ns):
            before = self._arrivals.get(message.id)
            arrival = before.next(message.stamp_ns) if before else _Arrival(message.stamp_ns)
            if before is not None and not before.is_late and not arrival.is_late:
                newest[message.id] = replace(message, stamp_ns=before.stamp_ns)
            self._arrivals[message.id] = arrival
        is_heard = (protocol.NOTHING_ID if self.ending else protocol.SENSORS_ID) in newest
        self._check_silence(is_heard, now_ns, steady_s)
        self.connected |= is_heard and not self.ending
        self.ended |= is_heard and self.ending
        self._keep(newest)
        return self._command(steady_s)

    def _check_silence(self, is_heard: bool, now_ns: int, steady_s: float) -> None:
        """Check that the robot sends what it shall, by real time and by the clock, which may stand still.

        Raises:
            SessionError: It has been silent for too long.
        """
        if is_heard or self._heard is None:
            self._heard = now_ns, steady_s
        heard_ns, heard_s = min(self._heard[0], now_ns), self._heard[1]  # the clock may jump back
        self._heard = heard_ns, heard_s
        if min(steady_s - heard_s, (now_ns - heard_ns) * 1e-9) > self._silence_s:
            raise SessionError(f"the robot has been silent for {self._silence_s:g} s, or made no sense")

    def _parsed(self, data: bytes, now_ns: int) -> list[protocol.Message]:
        skipped, resyncs = self._parser.skipped, self._parser.resyncs
        messages = self._parser.feed(data, now_ns) if data else []
        self._counts["messages"] += len(messages)
        self._counts["stray_bytes"] += self._parser.skipped - skipped
        self._counts["resyncs"] += self._parser.resyncs - resyncs
        return messages

    def _keep(self, newest: dict[int, protocol.Message]) -> None:
        """Use the newest message of each kind."""
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
        """Whether to use a reading: the mean period of used readings is that of the settings."""
        if self._due_ns - self._period_ns <= stamp_ns < self._due_ns:
            return False
        on_time = 0 <= stamp_ns - self._due_ns < self._period_ns
        self._due_ns = (self._due_ns if on_time else stamp_ns) + self._period_ns
        return True

    def _command(self, steady_s: float) -> bytes:
        """The command to send, if any. A robot that is asked to stream nothing has stopped."""
        left, right = self._speeds() if self.connected and not self.ending else (0, 0)
        streams = not self.ending
        command = protocol.Command(left, right, camera=self._camera and streams, sensors=streams)
        if command == self._sent and steady_s <= self._sent_s + _REPEAT_S:
            return b""
        self._sent, self._sent_s = command, steady_s
        return command.encode()
