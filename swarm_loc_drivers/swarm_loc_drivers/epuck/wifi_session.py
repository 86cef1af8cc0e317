"""Session with an e-puck2 over its WiFi stream: commands one way, sensor values and images the other.

A message of the robot is an id byte and a payload of fixed length, without checksum. A position in the stream
is accepted as the beginning of a message if the id is known, the sensor values are plausible, and the bytes
after it can begin a message, too. An image, whose bytes are arbitrary, is accepted if a message follows it
and none lies within it.
"""

from __future__ import annotations

import math
import struct
from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.common.robot_driver import SessionError
from swarm_loc_drivers.epuck.hardware import (
    WIFI_HEIGHT,
    WIFI_WIDTH,
    CameraImage,
    Reading,
    Speeds,
    decode_rgb565,
)
from swarm_loc_drivers.epuck.parameters import EpuckParameters

COMMAND_SIZE = 21
COMMAND_ID = 0x80
IMAGE_SIZE = 2 * WIFI_WIDTH * WIFI_HEIGHT

IMAGE_ID, SENSORS_ID, NOTHING_ID = 1, 2, 3

_CAMERA_ON, _SENSORS_ON = 1, 2
_COMMAND = struct.Struct("<BBB2h14x")

SENSORS_DTYPE = np.dtype(
    [
        ("acceleration", "<i2", 3),
        ("acceleration_polar", "<f4", 3),  # magnitude, orientation [deg], inclination [deg]
        ("gyro", "<i2", 3),
        ("magnetic_field", "<f4", 3),  # [uT]
        ("temperature", "i1"),  # [deg C]
        ("proximity", "<u2", 8),
        ("ambient", "<u2", 8),
        ("tof", "<u2"),  # [mm]
        ("microphones", "<u2", 4),
        ("left_counter", "<i2"),
        ("right_counter", "<i2"),
        ("battery", "<u2"),  # 819.2 per volt
        ("sd_card", "u1"),
        ("remote_control", "u1", 3),
        ("selector", "u1"),
        ("ground", "<u2", 3),
        ("ground_ambient", "<u2", 3),
        ("button", "u1"),
        ("spare", "u1"),
    ]
)
"""Layout of the 104 bytes of sensor values."""

_ADC_MAX = 4095
_SELECTOR_MAX = 15
_SIZES = {IMAGE_ID: IMAGE_SIZE, SENSORS_ID: SENSORS_DTYPE.itemsize, NOTHING_ID: 0}
_BAD, _UNDECIDED = 0, -1


@dataclass(frozen=True)
class Command:
    """A command; LEDs and sound stay off."""

    left: int  # Speed of the left wheel [steps/s]
    right: int  # Speed of the right wheel [steps/s]
    camera: bool  # Whether images are to be streamed
    sensors: bool  # Whether sensor values are to be streamed

    def encode(self) -> bytes:
        """Encode as 21 bytes."""
        streams = _CAMERA_ON * self.camera | _SENSORS_ON * self.sensors
        return _COMMAND.pack(COMMAND_ID, streams, 0, self.left, self.right)


@dataclass(frozen=True)
class Message:
    """One message of the robot."""

    id: int  # IMAGE_ID, SENSORS_ID or NOTHING_ID
    payload: bytes  # Pixels (RGB565), sensor values (SENSORS_DTYPE), or nothing
    stamp_ns: int  # Arrival of its first byte [ns]

    @property
    def sensors(self) -> np.void:
        """The payload as a record of SENSORS_DTYPE."""
        record: np.void = np.frombuffer(self.payload, SENSORS_DTYPE)[0]
        return record


def plausible(payload: bytes) -> bool:
    """Whether 104 bytes can be sensor values: 12-bit converters, finite numbers."""
    record = np.frombuffer(payload, SENSORS_DTYPE)[0]
    converted = (record["proximity"], record["ambient"], record["microphones"])
    return bool(
        record["selector"] <= _SELECTOR_MAX
        and record["button"] <= 1
        and all(np.all(value <= _ADC_MAX) for value in converted)
        and np.isfinite(record["acceleration_polar"]).all()
        and np.isfinite(record["magnetic_field"]).all()
    )


class StreamParser:
    """Splits the stream into messages; after lost or stray bytes it finds the next sensor values."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._offset = 0
        self._arrivals: deque[tuple[int, int]] = deque()
        self._synced = True
        self._searched = 0
        self.skipped = 0  # Number of bytes outside messages
        self.resyncs = 0  # How often the stream had to be searched for a message

    def feed(self, data: bytes, stamp_ns: int) -> list[Message]:
        """Take bytes that arrived at `stamp_ns`; the messages that they complete."""
        self._arrivals.append((self._offset + len(self._buffer), stamp_ns))
        self._buffer += data
        self._drop(0)
        messages = []
        while (length := self._verdict()) != _UNDECIDED:
            if length == _BAD:
                # drop bytes up to the next possible beginning of sensor values
                self.resyncs += self._synced
                self._synced = False
                candidate = self._buffer.find(SENSORS_ID, 1)
                dropped = candidate if candidate > 0 else len(self._buffer)
                self.skipped += dropped
                self._drop(dropped)
            else:
                self._synced = True
                payload, stamp_ns = bytes(self._buffer[1:length]), self._arrivals[0][1]
                messages.append(Message(self._buffer[0], payload, stamp_ns))
                self._drop(length)
        return messages

    def _verdict(self) -> int:
        """Length of the first message of the buffer; _BAD if none, _UNDECIDED if more bytes are needed."""
        if not self._synced and self._buffer and self._buffer[0] != SENSORS_ID:
            return _BAD
        length = self._length_at(0)
        # the end of an image would give no further evidence
        is_image, is_before_image = (self._buffer[at : at + 1] == bytes([IMAGE_ID]) for at in (0, length))
        if length > 0 and not is_before_image:
            following = self._length_at(length)
            if following == _BAD or (following == _UNDECIDED and (is_image or not self._synced)):
                length = following
        if is_image and self._holds_sensor_values():
            return _BAD
        return length

    def _length_at(self, begin: int) -> int:
        """Length of the message at a position of the buffer, or _BAD or _UNDECIDED."""
        if begin >= len(self._buffer):
            return _UNDECIDED
        kind = self._buffer[begin]
        if kind not in _SIZES:
            return _BAD
        end = begin + 1 + _SIZES[kind]
        if end > len(self._buffer):
            return _UNDECIDED
        if kind == SENSORS_ID and not plausible(bytes(self._buffer[begin + 1 : end])):
            return _BAD
        return end - begin

    def _holds_sensor_values(self) -> bool:
        """Whether an image contains two consecutive messages of sensor values: then part of it was lost."""
        size = 1 + _SIZES[SENSORS_ID]
        last = min(len(self._buffer), 1 + IMAGE_SIZE) - 2 * size
        candidate = self._buffer.find(SENSORS_ID, max(1, self._searched))
        while 0 <= candidate <= last:
            after = candidate + size
            follows = self._buffer[after] == SENSORS_ID
            if follows and min(self._length_at(candidate), self._length_at(after)) > 0:
                return True
            candidate = self._buffer.find(SENSORS_ID, candidate + 1)
        self._searched = max(0, last)
        return False

    def _drop(self, count: int) -> None:
        """Remove the first bytes, and the arrivals before those of the remaining bytes."""
        del self._buffer[:count]
        self._offset += count
        self._searched = max(0, self._searched - count)
        while len(self._arrivals) > 1 and self._arrivals[1][0] <= self._offset:
            self._arrivals.popleft()


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


class WifiSession:
    """Sends commands and receives the stream; a `Session`.

    The robot reads new values into a second buffer as soon as it has sent a message, and sends them with the
    next message of that kind. So the stamp of a message is the arrival of the previous one. Messages without
    a reliable stamp are not used: the first one of a connection, one that arrives late, and its successor.
    Nor are they signs of life: among corrupted bytes, one message may look right by chance.
    Counts `messages`, `stray_bytes`, `resyncs`.
    """

    is_idle = False  # No answer is pending that the next step would ask for

    def __init__(self, params: EpuckParameters, speeds: Speeds, counts: Counter[str]) -> None:
        self.ending = self.connected = self.ended = False
        self.found: list[Reading | CameraImage] = []  # Measurements; the reader empties the list
        self._camera = params.camera
        self._period_ns = round(1e9 / params.reading_rate)
        self._silence_s = _FIRMWARE_PAUSE_S + params.reply_timeout_s
        self._speeds = speeds
        self._counts = counts
        self._parser = StreamParser()
        self._sent: Command | None = None
        self._sent_s = -math.inf
        self._heard: tuple[int, float] | None = None
        self._arrivals: dict[int, _Arrival] = {}
        self._due_ns = 0

    def step(self, data: bytes, now_ns: int, steady_s: float) -> bytes:
        """See `TalkSession.step`."""
        newest: dict[int, Message] = {}
        skipped, resyncs = self._parser.skipped, self._parser.resyncs
        messages = self._parser.feed(data, now_ns) if data else []
        self._counts["messages"] += len(messages)
        self._counts["stray_bytes"] += self._parser.skipped - skipped
        self._counts["resyncs"] += self._parser.resyncs - resyncs
        # of each kind the newest message that has a reliable stamp: the arrival of the one before
        for message in messages:
            before = self._arrivals.get(message.id)
            arrival = _Arrival(message.stamp_ns)
            if before is not None:
                gap_ns = message.stamp_ns - before.stamp_ns
                is_late = gap_ns > 2.0 * before.gap_ns + _JITTER_NS
                arrival = _Arrival(message.stamp_ns, gap_ns, is_late)
                if not before.is_late and not is_late:
                    newest[message.id] = replace(message, stamp_ns=before.stamp_ns)
            self._arrivals[message.id] = arrival
        is_heard = (NOTHING_ID if self.ending else SENSORS_ID) in newest
        # by real time and by the clock, which may stand still or jump back
        if is_heard or self._heard is None:
            self._heard = now_ns, steady_s
        heard_ns, heard_s = self._heard = min(self._heard[0], now_ns), self._heard[1]
        if min(steady_s - heard_s, (now_ns - heard_ns) * 1e-9) > self._silence_s:
            raise SessionError(f"the robot has been silent for {self._silence_s:g} s, or made no sense")
        self.connected |= is_heard and not self.ending
        self.ended |= is_heard and self.ending
        self._keep(newest)
        return self._command(steady_s)

    def _keep(self, newest: dict[int, Message]) -> None:
        """Use the newest message of each kind; the mean period of readings is that of the settings."""
        message = newest.get(SENSORS_ID)
        if message and not self._due_ns - self._period_ns <= (stamp_ns := message.stamp_ns) < self._due_ns:
            on_time = 0 <= stamp_ns - self._due_ns < self._period_ns
            self._due_ns = (self._due_ns if on_time else stamp_ns) + self._period_ns
            values = message.sensors
            left, right = int(values["left_counter"]), int(values["right_counter"])
            self.found.append(Reading(stamp_ns, 0, left, right, values["proximity"].astype(np.int64)))
        if message := newest.get(IMAGE_ID):
            pixels = decode_rgb565(message.payload, WIFI_WIDTH, WIFI_HEIGHT)
            self.found.append(CameraImage(message.stamp_ns, pixels))

    def _command(self, steady_s: float) -> bytes:
        """The command to send, if any. A robot that is asked to stream nothing has stopped."""
        left, right = self._speeds() if self.connected and not self.ending else (0, 0)
        streams = not self.ending
        command = Command(left, right, camera=self._camera and streams, sensors=streams)
        if command == self._sent and steady_s <= self._sent_s + _REPEAT_S:
            return b""
        self._sent, self._sent_s = command, steady_s
        return command.encode()
