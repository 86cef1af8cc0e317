"""A TCP connection."""

from __future__ import annotations

import socket
import time

from swarm_loc_drivers.transports.link import LinkError

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
        """See `Link.close`.

        What has come and was not read would make the system reset the connection, and the last bytes sent
        might never arrive; so it is read first.
        """
        try:
            self._socket.shutdown(socket.SHUT_WR)
            self._read_to_end(time.monotonic() + self._timeout_s)
        except OSError:
            pass  # it was broken already
        finally:
            self._socket.close()

    def _read_to_end(self, deadline_s: float) -> None:
        """Read until the robot closes, too, or time is up."""
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            self._socket.settimeout(left_s)
            if not self._socket.recv(_CHUNK):
                return
