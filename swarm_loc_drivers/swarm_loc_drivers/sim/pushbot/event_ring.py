"""The ring of events that an emulated PushBot has still to send, and their bytes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RING = 4092  # Events that wait; with four places left the oldest is dropped
_DELTA_LIMITS = (0x7F, 0x3FFF, 0x1FFFFF)


class EventRing:
    """Ring buffer of events to be sent.

    Attributes:
        dropped: Events that were overwritten, unnoticed by the board.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._words = np.zeros(0, np.uint16)
        self._times = np.zeros(0, np.int64)
        self._last = 0

    def __len__(self) -> int:
        return len(self._words)

    def put(self, words: NDArray[np.uint16], times_us: NDArray[np.int64], room: int) -> None:
        """Take events `0yyyyyyy pxxxxxxx`, in order, with their board's time.

        Args:
            words: (N,).
            times_us: (N,) [us].
            room: Events that are sent while these come, which leave their places.
        """
        self._words = np.concatenate([self._words, words])
        self._times = np.concatenate([self._times, times_us])
        self._forget(RING + room)

    def _forget(self, kept: int) -> None:
        extra = len(self._words) - kept
        if extra > 0:
            self.dropped += extra
            self._words, self._times = self._words[extra:], self._times[extra:]

    def clear(self) -> None:
        """Drop all events, as when nothing is streamed."""
        self._words, self._times = self._words[:0], self._times[:0]

    def take(self, until_us: int, max_bytes: int, stamp_bytes: int) -> bytes:
        """The bytes of events up to a time, as many as fit; stamp_bytes of -1: differences."""
        due = int(np.searchsorted(self._times, until_us, side="right"))
        if stamp_bytes >= 0:
            count = min(due, max_bytes // (2 + stamp_bytes))
            data = _fixed(self._words[:count], self._times[:count], stamp_bytes)
        else:
            deltas = np.diff(self._times[:due], prepend=self._last) & 0xFFFFFFFF
            sizes = 3 + np.searchsorted(_DELTA_LIMITS, deltas, side="right")
            count = int(np.searchsorted(np.cumsum(sizes), max_bytes, side="right"))
            data = _differences(self._words[:count], deltas[:count], sizes[:count])
            self._last = int(self._times[count - 1]) if count else self._last
        self._words, self._times = self._words[count:], self._times[count:]
        self._forget(RING)
        return data


def _fixed(words: NDArray[np.uint16], times: NDArray[np.int64], stamp_bytes: int) -> bytes:
    """Events with timestamps of one length, the most significant byte first."""
    table = np.empty((len(words), 2 + stamp_bytes), np.uint8)
    table[:, 0] = words >> 8 | 0x80
    table[:, 1] = words & 0xFF
    for k in range(stamp_bytes):
        table[:, 2 + k] = times >> 8 * (stamp_bytes - 1 - k) & 0xFF
    return table.tobytes()


def _differences(words: NDArray[np.uint16], deltas: NDArray[np.int64], sizes: NDArray[np.int64]) -> bytes:
    """Events with the time since the last one, seven bits a byte, the last byte marked."""
    ends = np.cumsum(sizes)
    data = np.zeros(int(ends[-1]) if len(ends) else 0, np.uint8)
    data[ends - sizes] = words >> 8 | 0x80
    data[ends - sizes + 1] = words & 0xFF
    for k in range(4):
        has = sizes >= 3 + k
        data[ends[has] - 1 - k] = (deltas[has] >> 7 * k & 0x7F) | (0x80 if k == 0 else 0)
    return data.tobytes()
