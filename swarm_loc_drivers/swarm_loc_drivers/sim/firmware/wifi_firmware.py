"""The e-puck2's WiFi firmware: takes commands of 21 bytes, streams pictures and sensor values."""

from __future__ import annotations

from swarm_loc_drivers.protocols import epuck_wifi as wifi
from swarm_loc_drivers.protocols.epuck import EPUCK2
from swarm_loc_drivers.protocols.rgb565 import encode_rgb565
from swarm_loc_drivers.sim.body import EpuckBody
from swarm_loc_drivers.sim.firmware.parts import Motors, picture, sensor_values

CYCLE_NS = 16_000_000
"""Period of the sensor values: 125 bytes between its two chips, and 5 ms of silence."""

_CAMERA_ON, _SENSORS_ON = 1, 2
_PRESET_COUNTERS = 4
_QUEUE_LIMIT = 5 * wifi.COMMAND_SIZE
_ZOOM = 4


class WifiFirmware:
    """Answers one client.

    Args:
        body: The robot.
    """

    def __init__(self, body: EpuckBody) -> None:
        self._body = body
        self._motors = Motors(body, EPUCK2)
        self._due_ns = body.now_ns
        self.disconnect()

    def disconnect(self) -> None:
        """The client is gone; the motors keep running."""
        self._queue = b""
        self._streams: int | None = None
        self._sent_exposure_ns: int | None = None

    def receive(self, data: bytes) -> None:
        """Take what one or more reads brought.

        Only the first command is checked for its first byte, and only as one whole read; later bytes are cut
        into commands as they come, and of too many the older are dropped.
        """
        while data and self._streams is None:
            read, data = data[: wifi.COMMAND_SIZE], data[wifi.COMMAND_SIZE :]
            if len(read) == wifi.COMMAND_SIZE and read[0] == wifi.COMMAND_ID:
                self._obey(read)
        self._queue += data
        if len(self._queue) >= _QUEUE_LIMIT:
            self._queue = self._queue[
                len(self._queue) // wifi.COMMAND_SIZE * wifi.COMMAND_SIZE - wifi.COMMAND_SIZE :
            ]
        while len(self._queue) >= wifi.COMMAND_SIZE:
            self._obey(self._queue[: wifi.COMMAND_SIZE])
            self._queue = self._queue[wifi.COMMAND_SIZE :]

    def _obey(self, command: bytes) -> None:
        self._streams = command[1] & (_CAMERA_ON | _SENSORS_ON)
        left = int.from_bytes(command[3:5], "little", signed=True)
        right = int.from_bytes(command[5:7], "little", signed=True)
        if command[2] & _PRESET_COUNTERS:
            self._motors.preset(left, right)
        else:
            self._motors.set_speeds(left, right)

    def stream(self) -> bytes:
        """What is to be sent now; nothing before the first command, or before the next cycle."""
        now_ns = self._body.now_ns
        if self._streams is None or self._due_ns - CYCLE_NS <= now_ns < self._due_ns:
            return b""
        self._due_ns = now_ns + CYCLE_NS - (now_ns - self._due_ns) % CYCLE_NS
        if not self._streams:
            return bytes([wifi.NOTHING_ID])
        image = self._new_image() if self._streams & _CAMERA_ON else b""
        return image + (self._sensors() if self._streams & _SENSORS_ON else b"")

    def _new_image(self) -> bytes:
        """The newest picture, if it has not been sent yet."""
        newest = self._body.image()
        if newest is None or newest[1] == self._sent_exposure_ns:
            return b""
        self._sent_exposure_ns = newest[1]
        pixels = encode_rgb565(picture(self._body, wifi.WIDTH, wifi.HEIGHT, _ZOOM))
        return bytes([wifi.IMAGE_ID]) + pixels

    def _sensors(self) -> bytes:
        return bytes([wifi.SENSORS_ID]) + sensor_values(self._body, self._motors).tobytes()
