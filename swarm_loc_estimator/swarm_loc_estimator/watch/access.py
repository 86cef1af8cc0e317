"""Who may open the page: this machine's browsers, and from elsewhere only those who know the token."""

from __future__ import annotations

import hmac
import ipaddress
import socket
from dataclasses import dataclass
from urllib.parse import urlsplit

from swarm_loc_estimator.common.parameters import UserError

_LOCAL_NAMES = {"localhost", "127.0.0.1", "::1"}


class AccessError(UserError):
    """An address that cannot be listened on; the message is one sentence."""


@dataclass(frozen=True)
class Access:
    """The rule.

    Args:
        address: What the server listens on.
        token: What a page must know; "" for none, on a loopback address only.

    Raises:
        AccessError: Others could reach the address, and there is no token.
    """

    address: str
    token: str = ""

    def __post_init__(self) -> None:
        if not self.token and not is_loopback(self.address):
            raise AccessError(
                f"parameter address = '{self.address}' can be reached by others: set the parameter token,"
                " which their browsers must then give as ?token=."
            )

    def refusal(self, host: str, origin: str | None, token: str) -> str:
        """Why a request is refused, one sentence; "" when it is not.

        A page of another site may not use this browser to look or to command (Origin), nor may a foreign name
        that was made to lead here (Host).

        Args:
            host: Its Host header.
            origin: Its Origin header, which browsers give with a WebSocket.
            token: Its ?token=.
        """
        name = urlsplit(f"//{host}").hostname or ""
        if not self.token and name not in {*_LOCAL_NAMES, self.address}:
            return f"The name '{name}' is not one of this machine's own."
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return f"Pages of '{origin}' may not use this server."
        if self.token and not hmac.compare_digest(token.encode(), self.token.encode()):
            return "The token is missing or wrong: open the address that the log shows, with ?token=."
        return ""


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def free_port() -> int:
    """A port of this machine that nobody listens on just now."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port
