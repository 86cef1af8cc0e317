"""A TCP connection."""

from __future__ import annotations

import socket

from swarm_loc_drivers.common.link import LinkError

_CHUNK = 1 << 16


class TcpLink:
    """A connection to a robot that is the server.

    Args:
        host: Name or number.
        port: TCP port.
        timeout_s: How long connecting, or a write that is not taken, may last.

    Raises:
        LinkError: It cannot be opened.
    """

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
            data = self._socket.recv(_CHUNK)
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
        """See `Link.close`: at once, since some robots never close their end."""
        self._socket.close()
