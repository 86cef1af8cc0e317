"""The binary commands of the serial firmware: the negative of a letter, arguments, a payload."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.epuck.serial_protocol import code
from swarm_loc_drivers.sim.epuck.firmware.serial_robot import SerialRobot

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
        """Do it; the payload."""
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
        """What the WiFi commands' bytes 2 to 20 do."""
        words = arguments[1 : 1 + _SPEEDS.size]
        return self._preset(words) if arguments[0] & _PRESET_COUNTERS else self._set_speeds(words)
