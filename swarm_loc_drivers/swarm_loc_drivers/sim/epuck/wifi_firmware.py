"""The e-puck2's WiFi firmware: takes commands of 21 bytes, streams images and sensor values.

Two chips: one, with motors and sensors, is asked by the other, which talks to the client. What is sent was
read at once after the message before was fetched, and waits in a second buffer: it is a cycle old, or as old
as the client has not been listening.
"""

from __future__ import annotations

import struct
from collections.abc import Generator

from swarm_loc_drivers.epuck import wifi_session as wifi
from swarm_loc_drivers.epuck.hardware import EPUCK2, WIFI_HEIGHT, WIFI_WIDTH, as_counter, encode_rgb565
from swarm_loc_drivers.sim.epuck.parts import EpuckBody, Motors, camera_image, sensor_values

DELAY_NS = 10_000_000  # After reading a command, and after sending a message
IMAGE_NS = 70_000_000  # Fetching an image from the other chip, and sending it
FAILED_EXCHANGE_NS = 1_071_000_000
"""How long an exchange between the two chips that fails takes, with the pause after it."""

_CAMERA_ON, _SENSORS_ON = 1, 2
_QUEUE_LIMIT = 5 * wifi.COMMAND_SIZE
_ZOOM = 4


class WifiFirmware:
    """Answers one client.

    With `counts_right_backwards` the right counter falls when its wheel rolls ahead, as before December 2018.
    """

    def __init__(self, body: EpuckBody, *, counts_right_backwards: bool = False) -> None:
        self._body = body
        self._motors = Motors(body, EPUCK2)
        self._counts_right_backwards = counts_right_backwards
        self.exchange_fails = False  # Set it to have the next exchange between the chips fail
        self._command = b""
        self._exchange_due_ns = body.now_ns
        self._sensors: bytes | None = None
        self._image: bytes | None = None
        self._exposure_ns: int | None = None
        self._exchange()
        self.disconnect()

    def disconnect(self) -> None:
        """The client has disconnected; the motors keep running."""
        self._queue = b""
        self._due_ns = self._body.now_ns
        self._program = self._run()

    def receive(self, data: bytes) -> bytes:
        """Take what the client sends; the program reads it later, so nothing is answered at once."""
        self._queue += data
        return b""

    def stream(self) -> bytes:
        """What is to be sent now; called when all before has been sent."""
        self._exchange()
        self._fetch_image()
        return next(self._program)

    def _run(self) -> Generator[bytes, None, None]:
        """The program's main loop: yields what to send."""
        is_commanded = False
        while True:
            is_commanded |= yield from self._read_command()
            yield from self._pause(DELAY_NS)
            if not is_commanded:
                continue
            streams = self._command[1] & (_CAMERA_ON | _SENSORS_ON)
            if streams & _CAMERA_ON:
                yield (yield from self._next_image())
                yield from self._pause(IMAGE_NS)
            values = yield from self._values()
            if streams & _SENSORS_ON:
                yield bytes([wifi.SENSORS_ID]) + values
            elif not streams:
                yield bytes([wifi.NOTHING_ID])
            yield from self._pause(DELAY_NS)

    def _pause(self, duration_ns: int) -> Generator[bytes, None, None]:
        """Wait, counted from when the last pause was over unless sending has taken longer."""
        now_ns = self._body.now_ns
        on_time = 0 <= now_ns - self._due_ns <= duration_ns
        self._due_ns = (self._due_ns if on_time else now_ns) + duration_ns
        while self._due_ns - duration_ns <= self._body.now_ns < self._due_ns:
            yield b""

    def _read_command(self) -> Generator[bytes, None, bool]:
        """Take the oldest command, of many the newest; whether it came as a whole and as a command.

        Later ones need not: the first byte is not looked at, and what has come in pieces is waited for.
        """
        if len(self._queue) >= _QUEUE_LIMIT:
            whole, rest = divmod(len(self._queue), wifi.COMMAND_SIZE)
            self._queue = self._queue[(whole - (not rest)) * wifi.COMMAND_SIZE :]
        if not self._queue:
            return False
        is_whole = len(self._queue) >= wifi.COMMAND_SIZE
        while len(self._queue) < wifi.COMMAND_SIZE:
            yield b""
        self._command, self._queue = self._queue[: wifi.COMMAND_SIZE], self._queue[wifi.COMMAND_SIZE :]
        return is_whole and self._command[0] == wifi.COMMAND_ID

    def _values(self) -> Generator[bytes, None, bytes]:
        """The sensor values that wait, as soon as there are any; the next ones are asked for at once."""
        while self._sensors is None:
            yield b""
        values, self._sensors = self._sensors, None
        self._exchange_due_ns = self._body.now_ns
        self._exchange()
        return values

    def _exchange(self) -> None:
        """Ask the other chip for sensor values, then tell it what the client wants."""
        if self._sensors is not None or self._body.now_ns < self._exchange_due_ns:
            return
        if self.exchange_fails:
            self.exchange_fails = False
            self._exchange_due_ns = self._body.now_ns + FAILED_EXCHANGE_NS
            return
        values = sensor_values(self._body, self._motors)
        if self._counts_right_backwards:
            values["right_counter"] = as_counter(-int(values["right_counter"]))
        self._sensors = values.tobytes()
        if self._command:
            self._motors.set_speeds(*struct.unpack_from("<2h", self._command, 3))

    def _next_image(self) -> Generator[bytes, None, bytes]:
        """The image that waits, as soon as there is one; the next one is fetched at once."""
        while self._image is None:
            yield b""
        image, self._image = self._image, None
        self._fetch_image()
        return bytes([wifi.IMAGE_ID]) + image

    def _fetch_image(self) -> None:
        """Ask the other chip for an image that it has not sent yet, if the client wants any."""
        if self._image is not None or not self._command or not self._command[1] & _CAMERA_ON:
            return
        newest = self._body.image()
        if newest is not None and newest[1] != self._exposure_ns:
            self._exposure_ns = newest[1]
            self._image = encode_rgb565(camera_image(self._body, WIFI_WIDTH, WIFI_HEIGHT, _ZOOM))
