"""A TCP connection to a robot that can be cut and mended, as a wireless one is."""

import socket
import threading
from contextlib import suppress
from types import TracebackType

from typing_extensions import Self


class TcpLink:
    """Passes bytes to and fro between one client at a time and a port of this machine.

    Args:
        port: The robot's.

    Attributes:
        port: Where the client finds it.
    """

    def __init__(self, port: int) -> None:
        self._robot_port = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._is_cut = threading.Event()
        self._ends: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Nothing goes through from now on."""
        self._is_cut.set()
        for end in self._ends:
            _close(end)

    def mend(self) -> None:
        """The next connection goes through."""
        self._is_cut.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _close(self._server)
        self.cut()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            if self._is_cut.is_set():
                client.close()
                continue
            robot = socket.create_connection(("127.0.0.1", self._robot_port))
            self._ends = [client, robot]
            for source, sink in ((client, robot), (robot, client)):
                threading.Thread(target=_pass_on, args=(source, sink), daemon=True).start()


def _pass_on(source: socket.socket, sink: socket.socket) -> None:
    try:
        while data := source.recv(4096):
            sink.sendall(data)
    except OSError:
        pass
    _close(source)
    _close(sink)


def _close(end: socket.socket) -> None:
    with suppress(OSError):  # the other side was faster
        end.shutdown(socket.SHUT_RDWR)
    end.close()
