"""Links to robots: bytes with deadlines, over a serial port or TCP."""

from __future__ import annotations

import socket
import termios
from dataclasses import dataclass
from typing import Protocol
from urllib.parse import urlsplit

import serial

from swarm_loc_estimator.common.parameters import ParameterError


class LinkError(OSError):
    """A link cannot be opened or has broken; the message says which and why."""


class Link(Protocol):
    """An open link."""

    def read(self, timeout_s: float) -> bytes:
        """Bytes received, as soon as there are any; empty after the timeout; a LinkError if it is broken."""

    def write(self, data: bytes) -> None:
        """Send all bytes; a LinkError if the link is broken, or a write timed out."""

    def close(self) -> None:
        """Close the link."""


@dataclass(frozen=True)
class Address:
    """Where a robot answers."""

    device: str = ""  # Serial port; "" for TCP
    host: str = ""  # Name or number of a computer; "" for a serial port
    port: int = 0  # TCP port

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return self.device or f"tcp://{host}:{self.port}"


def parse_address(text: str, default_port: int) -> Address:
    """The address in a parameter `address`: `/dev/rfcomm0` or `tcp://192.168.1.1[:1000]`.

    Raises ParameterError if it is neither.
    """
    if text.startswith("/"):
        return Address(device=text)
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError:
        parts, host, port = urlsplit(""), None, None
    if parts.scheme != "tcp" or not host or parts.path or port == 0:
        raise ParameterError(
            f"parameter address = '{text}' must be the path of a serial port, such as /dev/rfcomm0,"
            " or tcp://HOST or tcp://HOST:PORT."
        )
    return Address(host=host, port=port or default_port)


def open_link(address: Address, baud_rate: int, timeout_s: float) -> Link:
    """Open a serial port with a baud rate [bit/s], or a TCP connection; a LinkError if that fails.

    A write has a timeout [s]; connecting by TCP may take twice as long.
    """
    if address.device:
        return SerialLink(address.device, baud_rate, timeout_s)
    return TcpLink(address.host, address.port, 2.0 * timeout_s)


_BROKEN = (OSError, TypeError, termios.error)
"""Errors of pyserial when a port hangs up; it compares None when the port vanishes."""


class SerialLink:
    """An open serial port, 8N1, locked by this process; a write longer than its timeout breaks the link."""

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


class TcpLink:
    """A TCP connection; the robot is the server. Connecting, and a write, have a timeout [s]."""

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        self._name = f"tcp://{host}:{port}"
        self._timeout_s = timeout_s
        try:
            self._socket = socket.create_connection((host, port), timeout_s)
        except OSError as error:
            raise LinkError(f"{self._name} cannot be opened: {error.strerror or error}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        try:
            self._socket.settimeout(timeout_s)
            data = self._socket.recv(1 << 16)
        except (TimeoutError, BlockingIOError):
            return b""
        except OSError as error:
            raise LinkError(f"{self._name} is broken: {error.strerror or error}") from error
        if not data:
            raise LinkError(f"{self._name} was closed by the robot")
        return data

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        try:
            self._socket.settimeout(self._timeout_s)
            self._socket.sendall(data)
        except OSError as error:
            raise LinkError(f"{self._name} is broken: {error.strerror or error}") from error

    def close(self) -> None:
        """See `Link.close`; does not wait, since some robots never close their end."""
        self._socket.close()
