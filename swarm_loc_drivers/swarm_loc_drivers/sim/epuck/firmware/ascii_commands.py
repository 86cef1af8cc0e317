"""The ASCII commands of the serial firmware: a letter, numbers behind commas, a line in answer."""

from __future__ import annotations

import re
from collections.abc import Callable

from swarm_loc_drivers.sim.epuck.firmware.serial_robot import CameraSetting, SerialRobot

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
        """Do what a line says; the answer with its end of line."""
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
        """Only the first generation knows it."""
        self._robot.reset_wanted = self._robot.is_first
        return b"r\r\n" if self._robot.is_first else b""


def _filled(numbers: list[int], present: tuple[int, ...]) -> list[int]:
    """The numbers given; what is missing stays as it is."""
    return [*numbers[: len(present)], *present[len(numbers) :]]
