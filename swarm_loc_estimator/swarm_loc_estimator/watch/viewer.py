"""One open page: it gets the newest frame of each kind, as fast as it takes them, within an agreed rate."""

from __future__ import annotations

import asyncio
import json
import time
from collections import deque
from collections.abc import Iterable
from typing import Any, NamedTuple

from aiohttp import web

from swarm_loc_estimator.watch.frames import Frame

MAX_NOTES = 64
"""So many texts wait for a slow page; older ones go first."""
RECEIVED = "+"
"""What a page says of each frame that it has taken in."""
_MAX_ON_THE_WAY = 4
"""More frames would only lie in the buffers of a page that is busy, and be old when it comes to them."""


class LeftOut(NamedTuple):
    """What a page did not get.

    Attributes:
        frames: That newer ones replaced while it was still busy with older ones.
        texts: That were dropped since too many waited.
    """

    frames: int
    texts: int


class Viewer:
    """Sends to one page; a slow one gets fewer frames, and nothing piles up for it.

    Args:
        socket: The connection.
        rate: Frames of a kind per second, at most.

    Attributes:
        selected: Index of the robot whose numbers the page shows; -1: none.
        left_out: What it did not get.
    """

    def __init__(self, socket: web.WebSocketResponse, rate: float) -> None:
        self._socket = socket
        self._period_s = 1.0 / rate
        self._newest: dict[str, Frame] = {}
        self._notes: deque[str] = deque(maxlen=MAX_NOTES)
        self._wake = asyncio.Event()
        self._on_the_way = 0
        self.selected = -1
        self.left_out = LeftOut(0, 0)

    def offer(self, frame: Frame) -> None:
        """Have a frame sent, unless a newer one of its kind comes before."""
        if frame.kind in self._newest and self._on_the_way >= _MAX_ON_THE_WAY:
            self.left_out = self.left_out._replace(frames=self.left_out.frames + 1)
        self._newest[frame.kind] = frame
        self._wake.set()

    def note(self, message: dict[str, Any]) -> None:
        """Have a text sent."""
        if len(self._notes) == MAX_NOTES:
            self.left_out = self.left_out._replace(texts=self.left_out.texts + 1)
        self._notes.append(json.dumps(message))
        self._wake.set()

    def on_received(self) -> None:
        """The page has taken a frame in."""
        self._on_the_way -= 1
        self._wake.set()

    async def send_past(self, frames: Iterable[Frame]) -> None:
        """Send what happened before the page was opened."""
        for frame in frames:
            while self._on_the_way >= _MAX_ON_THE_WAY:
                self._wake.clear()
                await self._wake.wait()
            await self._send(frame)
        self._wake.set()

    async def send_for_ever(self) -> None:
        """Send until the connection breaks."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            began_s = time.monotonic()
            while self._notes:
                await self._socket.send_str(self._notes.popleft())
            if self._on_the_way >= _MAX_ON_THE_WAY:
                continue  # its word wakes this up
            frames, self._newest = self._newest, {}
            for frame in frames.values():
                await self._send(frame)
            if frames:
                await asyncio.sleep(max(0.0, began_s + self._period_s - time.monotonic()))

    async def _send(self, frame: Frame) -> None:
        self._on_the_way += 1
        await self._socket.send_bytes(frame.data)

    async def close(self) -> None:
        """End the connection."""
        await self._socket.close()
