"""A link to a robot: bytes with deadlines, over a serial port or TCP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol
from urllib.parse import urlsplit

from swarm_loc_estimator.common.errors import UserError


class LinkError(OSError):
    """A link cannot be opened or has broken; the message says which and why."""


class AddressError(UserError):
    """An address that cannot be understood; the message is one sentence."""


class Link(Protocol):
    """An open link."""

    def read(self, timeout_s: float) -> bytes:
        """Whatever has come, as soon as there is any; empty after a while without any.

        Raises:
            LinkError: The link is broken.
        """

    def write(self, data: bytes) -> None:
        """Send all of it.

        Raises:
            LinkError: The link is broken, or takes nothing.
        """

    def close(self) -> None:
        """End the link."""


@dataclass(frozen=True)
class Address:
    """Where a robot answers.

    Attributes:
        device: Serial port; "" for TCP.
        host: Name or number of a computer; "" for a serial port.
        port: TCP port.
    """

    device: str = ""
    host: str = ""
    port: int = 0

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return self.device or f"tcp://{host}:{self.port}"


def parse_address(text: str, default_port: int) -> Address:
    """Understand `/dev/rfcomm0` or `tcp://192.168.1.1[:1000]`.

    Raises:
        AddressError: It is neither.
    """
    if text.startswith("/"):
        return Address(device=text)
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError:
        parts, host, port = urlsplit(""), None, None
    if parts.scheme != "tcp" or not host or parts.path or port == 0:
        raise AddressError(
            f"'{text}' must be the path of a serial port, such as /dev/rfcomm0, or tcp://HOST or tcp://HOST:PORT."
        )
    return Address(host=host, port=port or default_port)
