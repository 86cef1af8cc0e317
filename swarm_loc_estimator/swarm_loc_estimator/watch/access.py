"""Who may open the page: this machine's browsers, and from elsewhere only those who know the token."""

from __future__ import annotations

import hmac
import ipaddress
import re
import socket
import time
from dataclasses import dataclass, field
from typing import NamedTuple

from swarm_loc_estimator.common.parameters import UserError

MIN_TOKEN_LENGTH = 8
GUESS_PERIOD_S = 1.0
"""A client that has used up its free guesses may give one wrong token in such a period."""
_FREE_GUESSES = 5
_SLOTS = 256
_LOCAL_NAMES = {"localhost", "127.0.0.1", "::1"}
_HOST = re.compile(r"(?:\[(?P<v6>[0-9a-f:.]+)\]|(?P<name>[0-9a-z._-]+))(?::[0-9]{1,5})?", re.ASCII)
_WRONG = "The token is missing or wrong: open the address that the log shows, with ?token=."


class AccessError(UserError):
    """An address or a token that cannot be used; the message is one sentence."""


class WrongTokens:
    """Slows down clients that guess the token.

    Its memory is fixed: clients whose names have the same hash share a slot. A token that is repeated tells a
    client nothing new, so that a page which reconnects with an old token does not lock out its neighbours.
    """

    def __init__(self) -> None:
        self._slots = [_Slot(0.0, 0)] * _SLOTS

    def refusal(self, client: str, given: str, token: str) -> str:
        """Why a token is refused, one sentence; "" when it is right.

        Args:
            client: Address of the client.
            given: The token that it gave; "" for none.
            token: The right one.
        """
        place, guess = hash(client) % _SLOTS, hash((client, given))
        slot, now_s = self._slots[place], time.monotonic()
        if not given or guess == slot.guess:
            return _WRONG
        if slot.clear_s > now_s + (_FREE_GUESSES - 1) * GUESS_PERIOD_S:
            return f"Too many wrong tokens came from this address: wait {GUESS_PERIOD_S:g} s and try again."
        if hmac.compare_digest(given.encode(errors="replace"), token.encode()):
            return ""
        self._slots[place] = _Slot(max(slot.clear_s, now_s) + GUESS_PERIOD_S, guess)
        return _WRONG


class _Slot(NamedTuple):
    """What is known of the clients of one slot.

    Attributes:
        clear_s: When their wrong tokens are forgiven [s, monotonic].
        guess: Hash of the last wrong token.
    """

    clear_s: float
    guess: int


@dataclass(frozen=True)
class Access:
    """The rule.

    Args:
        address: What the server listens on.
        token: What a page must know; "" for none, on a loopback address only.

    Raises:
        AccessError: Others could reach the address, and there is no token; or the token is too short.
    """

    address: str
    token: str = ""
    _wrong_tokens: WrongTokens = field(default_factory=WrongTokens, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.token and not is_loopback(self.address):
            raise AccessError(
                f"parameter address = '{self.address}' can be reached by others: set the parameter token,"
                " which their browsers must then give as ?token=."
            )
        if self.token and len(self.token) < MIN_TOKEN_LENGTH:
            raise AccessError(
                f"parameter token is too short: it needs {MIN_TOKEN_LENGTH} characters or more."
            )

    def refusal(self, host: str, origin: str | None, token: str, client: str = "") -> str:
        """Why a request is refused, one sentence; "" when it is not.

        A page of another site may not use this browser to look or to command (Origin), nor may a foreign name
        that was made to lead here (Host).

        Args:
            host: Its Host header.
            origin: Its Origin header, which browsers give with a WebSocket.
            token: Its ?token=.
            client: Address of who sent it.
        """
        parsed = _HOST.fullmatch(host.lower())
        if not parsed:
            return "The Host header is not a host name with an optional port."
        name = parsed["v6"] or parsed["name"]
        if not self.token and name not in {*_LOCAL_NAMES, self.address}:
            return f"The name '{name}' is not one of this machine's own."
        if origin is not None and origin.lower() not in {f"http://{host}".lower(), f"https://{host}".lower()}:
            return f"Pages of {origin!a} may not use this server."
        return self._wrong_tokens.refusal(client, token, self.token) if self.token else ""


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
