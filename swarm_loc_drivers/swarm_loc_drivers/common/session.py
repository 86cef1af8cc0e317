"""Conversations with a robot over one link, without I/O."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Generator
from typing import Protocol, TypeVar

MAX_NONSENSE_S = 2.5  # A robot whose answers make no sense for so long is no longer connected [s]
NONSENSE = "what the robot sends makes no sense"
_MAX_RECEIVED = 1 << 16  # Bytes kept while an answer is awaited: a camera may still be streaming

Result = TypeVar("Result")
Talk = Generator[None, None, Result]  # Part of a conversation; it continues at every step


class SessionError(Exception):
    """The robot does not answer as it must; the link is closed and opened again."""


class Session(Protocol):
    """A conversation with one robot."""

    ending: bool  # Set it to stop the robot and end the conversation
    connected: bool  # Whether the robot has answered; `step` fails soon after answers make no sense
    ended: bool  # Whether the conversation has ended; the robot stands


class TalkSession(ABC):
    """A `Session` that is written as one generator, and counts what happens."""

    def __init__(self, counts: Counter[str]) -> None:
        self.ending = self.connected = self.ended = False
        self._counts = counts
        self._received = self._output = b""
        self._now_ns, self._steady_s = 0, 0.0
        self._talk = self._run()

    @abstractmethod
    def _run(self) -> Talk[None]:
        """Talk to the robot: append to `_output`, yield, and read `_received`."""

    def step(self, data: bytes, now_ns: int, steady_s: float) -> bytes:
        """Continue the conversation with the bytes received since the last step; returns bytes to send.

        The time [ns] may be simulated, stand still or jump back; 0 means no time. `steady_s` is real time.

        Raises:
            SessionError: The robot does not answer as it must.
        """
        self._received += data
        self._now_ns, self._steady_s = now_ns, steady_s
        try:
            next(self._talk)
        except StopIteration:
            self.ended = True
        output, self._output = self._output, b""
        return output

    def _ask_once(
        self, request: bytes, answer: re.Pattern[bytes], timeout_s: float
    ) -> Talk[re.Match[bytes] | None]:
        """Send a request and wait for its answer; None after the timeout."""
        self._received = b""
        self._output += request
        deadline_s = self._steady_s + timeout_s
        while self._steady_s < deadline_s:
            yield
            if match := answer.search(self._received):
                self._received = self._received[match.end() :]
                return match
            self._received = self._received[-_MAX_RECEIVED:]
        return None
