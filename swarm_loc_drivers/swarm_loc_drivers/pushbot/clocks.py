"""Stamps of events and of wheel ticks, from the clock of the board and that of the computer."""

from __future__ import annotations

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray

_WINDOW_NS = 2_000_000_000
"""The least delay of so long counts; crystals drift by less than 0.1 ms meanwhile."""
_MAX_AHEAD_US = 250_000
"""The board keeps 4092 events; none waits for longer than that."""
_LEAK = 1e-4
"""Of a period, so that a time that has come too late gets right again."""
_US = 1000


class EventClock:
    """Stamps what the board has timed, by the shortest way that its bytes have lately taken.

    An event's bytes come late by a part that varies (buffers, wireless link) and never early, so the smallest
    difference between the two clocks is the truest. The part that is always there stays in the stamps.

    Args:
        span_us: After so long the board's timestamps begin anew [us]; 0: never.
    """

    def __init__(self, span_us: int) -> None:
        self._span_us = span_us
        self._added_us = 0
        self._last: tuple[int, int] | None = None  # computer [ns], board [us] of the newest event
        self._window_ns = 0
        self._offsets_ns: list[int] = []  # the least of this window, and of the one before

    def stamps(self, time_us: IntArray, now_ns: int) -> IntArray:
        """Stamps (N,) [ns] of events.

        Args:
            time_us: (N,) the board's clock, unwrapped [us], N > 0.
            now_ns: When their bytes came.
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
        """Silences longer than the timestamps' span cannot be told from shorter ones by the board's clock."""
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
    """Times readings that come with an even period.

    Text overtakes events that wait for the wire: where a camera sees more than the wire carries, the event
    before a reading is up to 50 ms older than it. But no reading is older than that event, nor made before
    a period has passed since the last one.

    Args:
        period_ms: Of readings [ms].
    """

    def __init__(self, period_ms: int) -> None:
        self._step_us = _US * period_ms * (1.0 - _LEAK)
        self._last_us: float | None = None
        self._event: tuple[int, int] | None = None

    def pass_event(self, time_us: int, stamp_ns: int) -> None:
        """An event has come: its time by the board's clock, not wrapped [us], and its stamp [ns]."""
        self._event = time_us, stamp_ns

    def stamp_ns(self, now_ns: int) -> int:
        """Stamp of a reading that has come now [ns]; now itself if there was no event yet."""
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
