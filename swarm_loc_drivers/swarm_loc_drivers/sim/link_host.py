"""Pseudo-terminals and TCP ports at which emulated firmware answers.

Everything happens in the thread that calls `poll`, so a world that steps its bodies there needs no locks.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import selectors
import socket
import tty
from pathlib import Path
from typing import Protocol

from typing_extensions import Self

_CHUNK = 4096
_MAX_CLIENTS = 9  # Client sockets: the firmware closes none; it has ten, one of them for the server


class ConsoleFirmware(Protocol):
    """A firmware at a serial port."""

    def receive(self, data: bytes) -> bytes:
        """Process received bytes; returns the immediate answer."""

    def stream(self) -> bytes:
        """The bytes that the robot sends unprompted; with flow control, called when all others are sent."""


class StreamFirmware(ConsoleFirmware, Protocol):
    """A firmware at a TCP port, which answers as it streams."""

    def disconnect(self) -> None:
        """Handle a disconnected client."""


class _PtyPort:
    """A pseudo-terminal; it stays open while clients come and go, as a robot's Bluetooth module does.

    Arguments as of `FirmwareHost.serve_pty`.
    """

    def __init__(self, firmware: ConsoleFirmware, link: Path | None, *, waits: bool) -> None:
        self._firmware, self._link, self._waits = firmware, link, waits
        self._unsent = b""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = Path(os.ttyname(self._slave))
        if link is not None:
            link.unlink(missing_ok=True)
            link.symlink_to(self.path)

    def fileno(self) -> int:
        return self._master

    def on_readable(self) -> None:
        """Read and answer pending input."""
        with contextlib.suppress(BlockingIOError):
            if answer := self._firmware.receive(os.read(self._master, _CHUNK)):
                self._send(answer)

    def on_cycle(self) -> None:
        """Send pending output."""
        self._send(self._unsent or self._firmware.stream())

    def is_used(self) -> bool:
        """Whether a client has locked the terminal, as drivers do."""
        try:
            fcntl.flock(self._slave, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(self._slave, fcntl.LOCK_UN)
        return False

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            while data:
                data = data[os.write(self._master, data) :]
        self._unsent = data if self._waits else b""

    def close(self) -> None:
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        os.close(self._master)
        os.close(self._slave)


class _TcpPort:
    """A TCP server for one client at a time; others wait, and sending blocks until it reads."""

    def __init__(self, firmware: StreamFirmware, port: int, selector: selectors.BaseSelector) -> None:
        self._firmware = firmware
        self._selector = selector
        self._server = socket.create_server(("127.0.0.1", port), backlog=1)
        self._server.setblocking(False)
        self._client: socket.socket | None = None
        self._gone: list[socket.socket] = []
        self._unsent = b""
        self.port: int = self._server.getsockname()[1]

    def fileno(self) -> int:
        return self._server.fileno()

    def on_readable(self) -> None:
        """Accept a client; others wait until it disconnects."""
        with contextlib.suppress(BlockingIOError):
            self._client, _ = self._server.accept()
            self._client.setblocking(False)
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._selector.unregister(self._server)
            self._selector.register(self._client, selectors.EVENT_READ, self._on_client)

    def _on_client(self) -> None:
        """Process commands; detects a disconnected client."""
        assert self._client is not None  # noqa: S101
        try:
            data = self._client.recv(_CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._firmware.receive(data)
        else:
            self._drop_client()

    def on_cycle(self) -> None:
        if self._client is None:
            return
        self._unsent = self._unsent or self._firmware.stream()
        try:
            self._unsent = self._unsent[self._client.send(self._unsent) :] if self._unsent else b""
        except BlockingIOError:
            return
        except OSError:
            self._drop_client()

    def is_used(self) -> bool:
        return self._client is not None

    def _drop_client(self) -> None:
        assert self._client is not None  # noqa: S101
        self._selector.unregister(self._client)
        self._gone.append(self._client)
        self._client, self._unsent = None, b""
        self._firmware.disconnect()
        if len(self._gone) < _MAX_CLIENTS:
            self._selector.register(self._server, selectors.EVENT_READ, self.on_readable)

    def close(self) -> None:
        for one in (self._client, self._server, *self._gone):
            if one is not None:
                one.close()


class FirmwareHost:
    """Serves the bytes of any number of emulated robots."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._ports: list[_PtyPort | _TcpPort] = []

    def serve_pty(self, firmware: ConsoleFirmware, link: Path | None = None, *, waits: bool = False) -> Path:
        """Put a firmware at a pseudo-terminal; returns the path for a driver.

        `link` is a name for the terminal that stays the same. A firmware may wait for the client (RTS/CTS);
        else what it does not take is lost.
        """
        port = _PtyPort(firmware, link, waits=waits)
        self._add(port)
        return link or port.path

    def serve_tcp(self, firmware: StreamFirmware, port: int = 0) -> int:
        """Put a firmware at a TCP port, 0 for any that is free; returns the port."""
        server = _TcpPort(firmware, port, self._selector)
        self._add(server)
        return server.port

    def _add(self, port: _PtyPort | _TcpPort) -> None:
        self._ports.append(port)
        self._selector.register(port, selectors.EVENT_READ, port.on_readable)

    def poll(self, timeout_s: float) -> None:
        """Wait for bytes up to a timeout, answer them, and send pending output of the streams."""
        for key, _ in self._selector.select(timeout_s):
            key.data()
        for port in self._ports:
            port.on_cycle()

    def is_used(self) -> bool:
        """Whether a driver is connected to any robot."""
        return any(port.is_used() for port in self._ports)

    def close(self) -> None:
        """Close all links."""
        self._selector.close()
        for port in self._ports:
            port.close()
        self._ports.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
