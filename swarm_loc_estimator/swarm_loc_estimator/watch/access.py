"""Access control of the page: browsers of this machine, and other clients only with the token."""

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
"""A client that has used its free guesses may send one wrong token per period of this length [s]."""
_FREE_GUESSES = 5
_SLOTS = 256
_LOCAL_NAMES = {"localhost", "127.0.0.1", "::1"}
_HOST = re.compile(r"(?:\[(?P<v6>[0-9a-f:.]+)\]|(?P<name>[0-9a-z._-]+))(?::[0-9]{1,5})?", re.ASCII)
_WRONG = "The token is missing or wrong: open the address that the log shows, with ?token=."


class AccessError(UserError):
    """An address or a token that cannot be used; the message is one sentence."""


class WrongTokens:
    """Limits the rate at which clients guess the token.

    Its memory is fixed: clients whose names have the same hash share a slot. A repeated token does not count
    as a guess, so that a page which reconnects with an old token does not lock out clients of the same slot.
    """

    def __init__(self) -> None:
        self._slots = [_Slot(0.0, 0)] * _SLOTS

    def refusal(self, client: str, given: str, token: str) -> str:
        """Reason to refuse a token, one sentence; "" if it is right.

        Args:
            client: Address of the client.
            given: The token that it sent; "" for none.
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
    """State of the clients of one slot."""

    clear_s: float  # Time at which their wrong tokens expire [s, monotonic]
    guess: int  # Hash of the last wrong token


@dataclass(frozen=True)
class Access:
    """Decides which requests the server accepts.

    Args:
        address: Address on which the server listens.
        token: Required token; "" for none, on a loopback address only.

    Raises:
        AccessError: The address is reachable from outside without a token, or the token is too short.
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
        """Reason to refuse a request, one sentence; "" if it is accepted.

        Checks of Origin and Host prevent cross-site requests of the browser, and DNS rebinding.

        Args:
            host: Its Host header.
            origin: Its Origin header, which browsers send with a WebSocket.
            token: Its ?token=.
            client: Address of the sender.
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
    """A port of this machine that is free at present."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port
