"""The serial firmware of e-puck and e-puck2 ("advanced sercom"), as far as drivers use it."""

from __future__ import annotations

import re
import struct
from collections.abc import Generator
from typing import NamedTuple

from swarm_loc_drivers.epuck.hardware import EpuckModel, encode_rgb565
from swarm_loc_drivers.epuck.serial_session import RGB565_MODE, code
from swarm_loc_drivers.sim.epuck.parts import EpuckBody, Motors, camera_image

_SPEEDS = struct.Struct("<2h")
_NUMBER = re.compile(r",\s*([-+]?\d{1,1000})")
_LINE_ENDS = b"\r\n"
_BINARY = 0x80
_ARGUMENTS = {code("D"): 4, code("P"): 4, code("L"): 2}
_ARGUMENTS_EPUCK2 = {0xF7: 19, 0xF6: 12, 0xF1: 1, 0xF0: 1, 0xEF: 1}
"""Bytes of arguments that commands wait for, also those that drivers do not send: noise may begin one."""


class CameraSetting(NamedTuple):
    """How images are taken."""

    mode: int = RGB565_MODE
    width: int = 40  # [px]
    height: int = 40  # [px]
    zoom: int = 8

    @property
    def size(self) -> int:
        """Bytes of an image."""
        return 2 * self.width * self.height


class SerialFirmware:
    """Answers bytes one after the other as the robot does, without any timeout.

    It knows the commands that drivers send, and ignores others.
    """

    def __init__(self, body: EpuckBody, model: EpuckModel) -> None:
        self._body = body
        self._model = model
        self._motors = Motors(body, model)
        self._camera = CameraSetting()
        self._arguments = _ARGUMENTS | (_ARGUMENTS_EPUCK2 if model.name == "epuck2" else {})
        self._program = self._run()
        next(self._program)

    def receive(self, data: bytes) -> bytes:
        """Take bytes; returns the answer."""
        return b"".join(self._program.send(byte) for byte in data)

    def stream(self) -> bytes:
        """It only answers."""
        return b""

    def _run(self) -> Generator[bytes, int, None]:
        """The firmware's main loop: yields what to send, gets the next byte."""
        byte = yield b""
        while True:
            if byte & _BINARY:
                reply = yield from self._binary_chain(byte)
            elif byte:
                reply = yield from self._ascii_line(byte)
            else:
                reply = b""
            byte = yield reply

    def _binary_chain(self, byte: int) -> Generator[bytes, int, bytes]:
        """Commands up to a zero byte; only then their answers are sent."""
        answer = b""
        while byte:
            arguments = bytearray()
            for _ in range(self._arguments.get(byte, 0)):
                arguments.append((yield b""))
            answer += self._execute(byte, bytes(arguments))
            byte = yield b""
        while len(answer) > self._model.answer_buffer:
            yield b""  # its memory is overrun: it does nothing any more
        return answer

    def _execute(self, byte: int, arguments: bytes) -> bytes:
        """Execute a binary command; returns the payload."""
        if byte == code("D"):
            self._motors.set_speeds(*_SPEEDS.unpack(arguments))
        elif byte == code("E"):
            return _SPEEDS.pack(*self._motors.commanded)
        elif byte == code("Q"):
            return _SPEEDS.pack(*self._motors.counters())
        elif byte == code("N"):
            return self._body.proximity().astype("<u2").tobytes()
        elif byte == code("I"):
            return self._image()
        return b""

    def _image(self) -> bytes:
        """An image by the camera's setting; of a zoom that it does not have the camera makes its last one."""
        mode, width, height, zoom = self._camera
        zooms = self._model.zooms
        shown = camera_image(self._body, width, height, zoom if zoom in zooms else zooms[-1])
        return bytes([mode & 0xFF, width & 0xFF, height & 0xFF]) + encode_rgb565(shown)

    def _ascii_line(self, byte: int) -> Generator[bytes, int, bytes]:
        """A line; ends of lines before it do not count."""
        while byte in _LINE_ENDS:
            byte = yield b""
        line = bytearray()
        while byte not in _LINE_ENDS:
            line.append(byte)
            byte = yield b""
        return f"{self._answer(line.decode('latin-1'))}\r\n".encode()

    def _answer(self, text: str) -> str:
        letter, motors = text[0].upper(), self._motors
        if letter == "D":
            motors.set_speeds(*_filled(text, motors.commanded))
            return "d"
        if letter == "E":
            return "e,{},{}".format(*motors.commanded)
        if letter == "I":
            return "i,{},{},{},{},{}".format(*self._camera, self._camera.size)
        if letter == "J":
            # one that the buffer cannot hold becomes the default, silently
            wanted = CameraSetting(*_filled(text, self._camera))
            is_sensible = wanted.width > 0 and wanted.height > 0 and wanted.zoom > 0
            fits = is_sensible and wanted.size <= self._model.largest_setting
            self._camera = wanted if fits else CameraSetting()
            return "j"
        return "z,Command not found"


def _filled(text: str, present: tuple[int, ...]) -> list[int]:
    """The arguments that scanf would find, integers of 32 bits; what is missing stays as it is."""
    numbers: list[int] = []
    end = 1
    while match := _NUMBER.match(text, end):
        numbers.append((int(match[1]) + 2**31) % 2**32 - 2**31)
        end = match.end()
    return [*numbers[: len(present)], *present[len(numbers) :]]
