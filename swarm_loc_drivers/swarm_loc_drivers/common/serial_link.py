"""A serial port: a Bluetooth or USB one, or a pseudo-terminal."""

from __future__ import annotations

import termios

import serial

from swarm_loc_drivers.common.link import LinkError

_BROKEN = (OSError, TypeError, termios.error)
"""What pyserial raises when a port hangs up; one that vanishes makes it compare None."""


class SerialLink:
    """An open serial port, 8N1, for this process alone.

    Args:
        device: Its path.
        baud_rate: [bit/s].
        write_timeout_s: After so long a write that is not taken breaks the link.

    Raises:
        LinkError: It cannot be opened.
    """

    def __init__(self, device: str, baud_rate: int, write_timeout_s: float) -> None:
        self._device = device
        try:
            self._port = serial.Serial(device, baud_rate, write_timeout=write_timeout_s, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise LinkError(f"{device} cannot be opened: {_reason(error)}") from error

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        try:
            self._port.timeout = timeout_s
            first = self._port.read(1)
            return bytes(first + self._port.read(self._port.in_waiting)) if first else b""
        except _BROKEN as error:
            raise LinkError(f"{self._device} is broken: {_reason(error)}") from error

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        try:
            self._port.write(data)
        except _BROKEN as error:
            raise LinkError(f"{self._device} is broken: {_reason(error)}") from error

    def close(self) -> None:
        """See `Link.close`."""
        self._port.close()


def _reason(error: Exception) -> str:
    return str(error.args[-1])
