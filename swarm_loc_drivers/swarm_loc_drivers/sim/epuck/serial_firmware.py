"""The serial firmware of e-puck and e-puck2 ("advanced sercom"): binary chains and ASCII lines."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.epuck.hardware import EPUCK1, EpuckModel, encode_rgb565
from swarm_loc_drivers.epuck.serial_session import RGB565_MODE, code
from swarm_loc_drivers.sim.epuck.parts import GRAVITY_EPUCK2, EpuckBody, Motors, camera_image, sensor_values

GREY_MODE = 0
_ZERO_G = 2048
_GRAVITY_EPUCK1 = 800


@dataclass(frozen=True)
class CameraSetting:
    """How images are taken: mode (0 grey, 1 RGB565), size [px], zoom."""

    mode: int = RGB565_MODE
    width: int = 40
    height: int = 40
    zoom: int = 8

    @property
    def size(self) -> int:
        """Bytes of an image."""
        return self.width * self.height * (1 if self.mode == GREY_MODE else 2)


class SerialRobot:
    """An e-puck as its serial firmware sees it.

    Args:
        body: The robot.
        model: Its generation.
    """

    def __init__(self, body: EpuckBody, model: EpuckModel) -> None:
        self.body = body
        self.model = model
        self.motors = Motors(body, model)
        self.camera = CameraSetting()
        self.reset_wanted = False

    @property
    def is_first(self) -> bool:
        """Whether it is an e-puck of the first generation."""
        return self.model is EPUCK1

    def reset(self) -> None:
        """Reset as after power-on."""
        self.motors.set_speeds(0, 0)
        self.motors.preset(0, 0)
        self.camera = CameraSetting()
        self.reset_wanted = False

    def set_camera(self, setting: CameraSetting) -> None:
        """Use a setting; one that the buffer cannot hold becomes the default, silently."""
        sensible = setting.width > 0 and setting.height > 0 and setting.zoom > 0
        fits = sensible and setting.size <= self.model.largest_setting
        self.camera = setting if fits else CameraSetting()

    def pixels(self) -> bytes:
        """An image by the camera's setting; of a zoom that it does not have the camera makes its last one."""
        zooms, zoom = self.model.zooms, self.camera.zoom
        zoom = zoom if zoom in zooms else zooms[-1]
        shown = camera_image(self.body, self.camera.width, self.camera.height, zoom)
        if self.camera.mode == GREY_MODE:
            grey: NDArray[np.uint8] = shown.mean(axis=2).astype(np.uint8)
            return grey.tobytes()
        return encode_rgb565(shown)

    def acceleration(self) -> tuple[int, int, int]:
        """Raw values, level."""
        return _ZERO_G, _ZERO_G, _ZERO_G + (_GRAVITY_EPUCK1 if self.is_first else GRAVITY_EPUCK2)

    def values(self) -> NDArray[np.void]:
        """All sensors, () of SENSORS_DTYPE."""
        return sensor_values(self.body, self.motors)


_NUMBER = re.compile(r",\s*([-+]?\d{1,1000})")
_UNKNOWN = "z,Command not found"
_VERSIONS = ("v,Version 1.1.3 September 2006", "v,Version 1.2.2 e-puck2")


def _line(letter: str, *values: int) -> str:
    return ",".join([letter, *map(str, values)])


def _numbers(text: str) -> list[int]:
    """The arguments that scanf would find, integers of 32 bits."""
    numbers, end = [], 1
    while match := _NUMBER.match(text, end):
        numbers.append((int(match[1]) + 2**31) % 2**32 - 2**31)
        end = match.end()
    return numbers


class AsciiCommands:
    """Executes lines.

    Args:
        robot: What they act on.
    """

    def __init__(self, robot: SerialRobot) -> None:
        self._robot = robot
        motors = robot.motors
        self._commands: dict[str, Callable[[list[int]], str]] = {
            "A": lambda _: _line("a", *robot.acceleration()),
            "B": lambda _: "b",
            "C": lambda _: self._field("c", "selector"),
            "D": self._set_speeds,
            "E": lambda _: _line("e", *motors.commanded),
            "F": lambda _: "f",
            "I": lambda _: self._camera(),
            "J": self._set_camera,
            "K": lambda _: (
                "k, Starting calibration - Remove any object in sensors range\r\nk, Calibration finished"
            ),
            "L": lambda _: "l",
            "M": lambda _: _line("m", *[0] * 5),
            "N": lambda _: self._field("n", "proximity"),
            "O": lambda _: self._field("o", "ambient"),
            "P": self._preset,
            "Q": lambda _: _line("q", *(motors.counters() if robot.is_first else motors.steps())),
            "S": self._stop,
            "T": lambda _: "t",
            "U": lambda _: _line("u", *robot.values()["microphones"][:3]),
            "V": lambda _: "\r\n".join([_VERSIONS[not robot.is_first], "HW Revision: 1"]),
            "b": lambda _: self._field("b", "battery"),
            "g": lambda _: self._field("g", "gyro"),
        }

    def execute(self, text: str) -> bytes:
        """Execute a line; returns the answer with its end of line."""
        letter = text[0] if text[0] in "bg" else text[0].upper()
        if letter == "R":
            return self._reset()
        command = self._commands.get(letter)
        return f"{command(_numbers(text)) if command else _UNKNOWN}\r\n".encode()

    def _field(self, letter: str, name: str) -> str:
        return _line(letter, *self._robot.values()[name].reshape(-1).tolist())

    def _set_speeds(self, numbers: list[int]) -> str:
        left, right = _filled(numbers, self._robot.motors.commanded)
        self._robot.motors.set_speeds(left, right)
        return "d"

    def _preset(self, numbers: list[int]) -> str:
        left, right = _filled(numbers, self._robot.motors.steps())
        self._robot.motors.preset(left, right)
        return "p"

    def _stop(self, _: list[int]) -> str:
        self._robot.motors.set_speeds(0, 0)
        return "s"

    def _camera(self) -> str:
        camera = self._robot.camera
        return _line("i", camera.mode, camera.width, camera.height, camera.zoom, camera.size)

    def _set_camera(self, numbers: list[int]) -> str:
        camera = self._robot.camera
        self._robot.set_camera(
            CameraSetting(*_filled(numbers, (camera.mode, camera.width, camera.height, camera.zoom)))
        )
        return "j"

    def _reset(self) -> bytes:
        """Reset; only the first generation has this command."""
        self._robot.reset_wanted = self._robot.is_first
        return b"r\r\n" if self._robot.is_first else b""


def _filled(numbers: list[int], present: tuple[int, ...]) -> list[int]:
    """The numbers given; what is missing stays as it is."""
    return [*numbers[: len(present)], *present[len(numbers) :]]


_SPEEDS = struct.Struct("<2h")
_PRESET_COUNTERS = 4
_ALL_SENSORS = 0xF8
_ALL_SENSORS_SIZE = 103
_MICROPHONE_SAMPLES = 600


class _Command(NamedTuple):
    arguments: int
    execute: Callable[[bytes], bytes]


def _words(*values: int) -> bytes:
    return np.array(values).astype("<u2").tobytes()


class BinaryCommands:
    """Executes binary commands; unknown ones are ignored.

    Args:
        robot: What they act on.
    """

    def __init__(self, robot: SerialRobot) -> None:
        self._robot = robot
        self._commands = self._common() | (self._of_first() if robot.is_first else self._of_second())

    def argument_count(self, byte: int) -> int:
        """Bytes of arguments that the firmware waits for."""
        command = self._commands.get(byte)
        return command.arguments if command else 0

    def execute(self, byte: int, arguments: bytes) -> bytes:
        """Execute a command; returns the payload."""
        command = self._commands.get(byte)
        return command.execute(arguments) if command else b""

    def _common(self) -> dict[int, _Command]:
        motors = self._robot.motors
        by_letter = {
            "D": _Command(4, self._set_speeds),
            "P": _Command(4, self._preset),
            "L": _Command(2, lambda _: b""),
            "E": _Command(0, lambda _: _words(*motors.commanded)),
            "Q": _Command(0, lambda _: _words(*motors.counters())),
            "a": _Command(0, lambda _: _words(*self._robot.acceleration())),
            "A": _Command(0, lambda _: self._field("acceleration_polar")),
            "g": _Command(0, lambda _: self._field("gyro")),
            "N": _Command(0, lambda _: self._field("proximity")),
            "O": _Command(0, lambda _: self._field("ambient")),
            "t": _Command(0, lambda _: self._field("temperature")),
            "u": _Command(0, lambda _: self._field("microphones")[:6]),
            "b": _Command(0, lambda _: self._field("battery")),
            "I": _Command(0, lambda _: self._image()),
        }
        return {code(letter): command for letter, command in by_letter.items()}

    @staticmethod
    def _of_first() -> dict[int, _Command]:
        return {
            code("M"): _Command(0, lambda _: bytes(10)),
            code("U"): _Command(0, lambda _: bytes(_MICROPHONE_SAMPLES + 1)),
        }

    def _of_second(self) -> dict[int, _Command]:
        switches = {byte: _Command(1, lambda _: b"\x00") for byte in (0xF1, 0xF0, 0xEF)}
        return switches | {
            code("M"): _Command(0, lambda _: bytes(8)),
            _ALL_SENSORS: _Command(0, lambda _: self._all_sensors()),
            0xF7: _Command(19, self._actuate),
            0xF6: _Command(12, lambda _: b""),
            0xF5: _Command(0, lambda _: self._field("button")),
            0xF4: _Command(0, lambda _: self._field("microphones")),
            0xF3: _Command(0, lambda _: self._field("tof")),
            0xF2: _Command(0, lambda _: self._field("sd_card")),
        }

    def _set_speeds(self, arguments: bytes) -> bytes:
        self._robot.motors.set_speeds(*_SPEEDS.unpack(arguments))
        return b""

    def _preset(self, arguments: bytes) -> bytes:
        self._robot.motors.preset(*_SPEEDS.unpack(arguments))
        return b""

    def _field(self, name: str) -> bytes:
        data: bytes = self._robot.values()[name].tobytes()
        return data

    def _image(self) -> bytes:
        camera = self._robot.camera
        header = (camera.mode & 0xFF, camera.width & 0xFF, camera.height & 0xFF)
        return bytes(header) + self._robot.pixels()

    def _all_sensors(self) -> bytes:
        return self._robot.values().tobytes()[: _ALL_SENSORS_SIZE - 1] + b"\x00"

    def _actuate(self, arguments: bytes) -> bytes:
        """Act like bytes 2 to 20 of a WiFi command."""
        words = arguments[1 : 1 + _SPEEDS.size]
        return self._preset(words) if arguments[0] & _PRESET_COUNTERS else self._set_speeds(words)


_LINE_ENDS = b"\r\n"
_BINARY = 0x80
_BANNER = b'\f\aWELCOME to the SerCom protocol on e-Puck\r\nthe EPFL education robot type "H" for help\r\n'


class SerialFirmware:
    """Answers bytes one after the other as the robot does, without any timeout.

    Args:
        body: The robot.
        model: Its generation.
    """

    def __init__(self, body: EpuckBody, model: EpuckModel) -> None:
        self._robot = SerialRobot(body, model)
        self._binary = BinaryCommands(self._robot)
        self._ascii = AsciiCommands(self._robot)
        self._boot()

    def _boot(self) -> None:
        """Start the program; the speeds and counters of a freshly made robot are zero."""
        self._program = self._run()
        next(self._program)

    def receive(self, data: bytes) -> bytes:
        """Take bytes; returns the answer."""
        replies = []
        for byte in data:
            reply = self._program.send(byte)
            if self._robot.reset_wanted:
                self._robot.reset()
                self._boot()
                reply += _BANNER
            replies.append(reply)
        return b"".join(replies)

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
            for _ in range(self._binary.argument_count(byte)):
                arguments.append((yield b""))
            answer += self._binary.execute(byte, bytes(arguments))
            byte = yield b""
        while len(answer) > self._robot.model.answer_buffer:
            yield b""  # its memory is overrun: it does nothing any more
        return answer

    def _ascii_line(self, byte: int) -> Generator[bytes, int, bytes]:
        """A line; ends of lines before it do not count."""
        while byte in _LINE_ENDS:
            byte = yield b""
        line = bytearray()
        while byte not in _LINE_ENDS:
            line.append(byte)
            byte = yield b""
        return self._ascii.execute(line.decode("latin-1"))
