"""Stamps of events and of wheel ticks, from the clock of the board and that of the computer."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray

_WINDOW_NS = 2_000_000_000  # Window of the smallest delay; the clocks drift by less than 0.1 ms within it
_MAX_AHEAD_US = 250_000  # Longest time that one of the board's 4092 buffered events waits [us]
_LEAK = 1e-4  # Share by which periods are shortened, so that a late estimate recovers
_US = 1000


class EventClock:
    """Converts times of the board to stamps, by the smallest recent delay of its bytes.

    The bytes of an event arrive with a varying delay (buffers, wireless link), so the smallest difference
    between the two clocks is the best estimate of their offset. A constant delay remains in the stamps.

    Args:
        span_us: The board's timestamps wrap after so long [us]; 0: never.
    """

    def __init__(self, span_us: int) -> None:
        self._span_us = span_us
        self._added_us = 0
        self._last: tuple[int, int] | None = None  # computer [ns], board [us] of the newest event
        self._window_ns = 0
        self._offsets_ns: list[int] = []  # the smallest of this window and of the previous one

    def stamps(self, time_us: IntArray, now_ns: int) -> IntArray:
        """Stamps (N,) [ns] of events.

        Args:
            time_us: (N,) the board's clock, unwrapped [us], N > 0.
            now_ns: Arrival of their bytes [ns].
        """
        if self._last is not None and now_ns < self._last[0]:
            self._last, self._offsets_ns = None, []  # the computer's clock was set back
        self._add_missed_wraps(int(time_us[0]), now_ns)
        time_ns = (time_us + self._added_us) * _US
        self._learn(now_ns - int(time_ns[-1]), now_ns)
        self._last = now_ns, int(time_us[-1])
        stamps: IntArray = time_ns + min(self._offsets_ns)
        return np.minimum(stamps, now_ns)

    def _add_missed_wraps(self, first_us: int, now_ns: int) -> None:
        """Add the wraps of a silence that is longer than the timestamps' span, by the computer's clock."""
        if self._last is None or not self._span_us:
            return
        silence_us = (now_ns - self._last[0]) // _US - (first_us - self._last[1])
        self._added_us += max(0, round(silence_us / self._span_us)) * self._span_us

    def _learn(self, offset_ns: int, now_ns: int) -> None:
        if not self._offsets_ns:
            self._window_ns, self._offsets_ns = now_ns, [offset_ns]
        elif now_ns > self._window_ns + _WINDOW_NS:
            self._window_ns, self._offsets_ns = now_ns, [offset_ns, self._offsets_ns[0]]
        self._offsets_ns[0] = min(self._offsets_ns[0], offset_ns)


class TickClock:
    """Stamps wheel readings, which have a constant period.

    Text overtakes events in the transmit buffer: if the camera sees more than the link carries, the event
    before a reading is up to 50 ms older than the reading. But no reading is older than that event, or less
    than a period after the previous reading.

    Args:
        period_ms: Period of readings [ms].
    """

    def __init__(self, period_ms: int) -> None:
        self._step_us = _US * period_ms * (1.0 - _LEAK)
        self._last_us: float | None = None
        self._event: tuple[int, int] | None = None

    def pass_event(self, time_us: int, stamp_ns: int) -> None:
        """Note an event: its time by the board's clock, not wrapped [us], and its stamp [ns]."""
        self._event = time_us, stamp_ns

    def stamp_ns(self, now_ns: int) -> int:
        """Stamp of a reading that has just arrived [ns]; `now_ns` before the first event."""
        if self._event is None:
            return now_ns
        event_us, event_ns = self._event
        time_us = float(event_us)
        if self._last_us is not None:
            due_us = self._last_us + self._step_us
            if 0.0 < due_us - event_us < _MAX_AHEAD_US:
                time_us = due_us
        self._last_us = time_us
        return min(now_ns, event_ns + round(_US * (time_us - event_us)))
