"""The serial firmware of e-puck and e-puck2 ("advanced sercom"): binary chains and ASCII lines."""

from __future__ import annotations

from collections.abc import Generator

from swarm_loc_drivers.epuck.hardware import EpuckModel
from swarm_loc_drivers.sim.common.body import EpuckBody
from swarm_loc_drivers.sim.epuck.firmware.ascii_commands import AsciiCommands
from swarm_loc_drivers.sim.epuck.firmware.binary_commands import BinaryCommands
from swarm_loc_drivers.sim.epuck.firmware.serial_robot import SerialRobot

_LINE_ENDS = b"\r\n"
_BINARY = 0x80
_BANNER = b'\f\aWELCOME to the SerCom protocol on e-Puck\r\nthe EPFL education robot type "H" for help\r\n'


class SerialFirmware:
    """Answers bytes as the robot does, one after the other and without any timeout.

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
        """Take bytes; what the robot sends."""
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
