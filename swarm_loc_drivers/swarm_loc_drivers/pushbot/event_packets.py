"""Packets of events: the events of a few milliseconds, encoded once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.common.messages.event_encoding import Events, encode_events

MAX_EVENTS = 1 << 16  # Most events of a packet


@dataclass(frozen=True)
class EventPacket:
    """A packet of events."""

    stamp_ns: int  # Time of the first event [ns]
    board_ns: int  # The same by the board's own clock [ns]
    number: int  # Number of the packet on this link
    data: bytes  # The events, encoded
    count: int  # Number of events


class EventPackets:
    """Collects events in packets of a period [s]; `on_bit` is the polarity of pixels that became brighter."""

    def __init__(self, period_s: float, on_bit: int) -> None:
        self._period_ns = round(period_s * 1e9)
        self._on_bit = on_bit
        self._waiting: list[tuple[NDArray[np.uint8], NDArray[np.uint8], BoolArray, IntArray]] = []
        self._board_ns = 0
        self._count = 0
        self._number = 0
        self.ready: list[EventPacket] = []
        """Complete packets; the reader empties the list."""

    def add(
        self,
        x: NDArray[np.uint8],
        y: NDArray[np.uint8],
        polarity: NDArray[np.uint8],
        stamps_ns: IntArray,
        board_us: IntArray,
    ) -> None:
        """Take events (N,); a packet ends where the time steps back or a period is over."""
        periods = (stamps_ns - stamps_ns[0]) // self._period_ns
        cuts = np.flatnonzero((stamps_ns[1:] < stamps_ns[:-1]) | (periods[1:] != periods[:-1])) + 1
        for begin, end in zip([0, *cuts], [*cuts, len(x)], strict=True):
            for first in range(begin, end, MAX_EVENTS):
                part = slice(first, min(end, first + MAX_EVENTS))
                self._add(
                    x[part], y[part], polarity[part] == self._on_bit, stamps_ns[part], int(board_us[first])
                )

    def _add(
        self, x: NDArray[np.uint8], y: NDArray[np.uint8], is_on: BoolArray, stamps_ns: IntArray, board_us: int
    ) -> None:
        if self._waiting:
            since_ns = stamps_ns[-1] - self._waiting[0][3][0]
            steps_back = stamps_ns[0] < self._waiting[-1][3][-1]
            if steps_back or since_ns > 2 * self._period_ns or self._count + len(x) > MAX_EVENTS:
                self.flush()
        if not self._waiting:
            self._board_ns = 1000 * board_us
        self._waiting.append((x, y, is_on, stamps_ns))
        self._count += len(x)
        if stamps_ns[-1] - self._waiting[0][3][0] >= self._period_ns:
            self.flush()

    def flush_late(self, now_ns: int) -> None:
        """Complete the current packet if no later event has done so in time."""
        if self._waiting and not 0 <= now_ns - int(self._waiting[0][3][0]) <= 2 * self._period_ns:
            self.flush()

    def flush(self) -> None:
        """Complete the current packet."""
        if not self._waiting:
            return
        x, y, is_on, stamps_ns = (np.concatenate(column) for column in zip(*self._waiting, strict=True))
        stamp_ns = int(stamps_ns[0])
        data = encode_events(Events(x, y, is_on, stamps_ns - stamp_ns))
        self.ready.append(EventPacket(stamp_ns, self._board_ns, self._number, data, len(x)))
        self._number += 1
        self._count = 0
        self._waiting.clear()
