"""When wheel ticks were read: stamps by the board's clock, from the events among which readings stand."""

from __future__ import annotations

_MAX_AHEAD_US = 250_000
"""The board keeps 4092 events; none waits for longer than that."""
_LEAK = 1e-4
"""Of a period, so that a time that has come too late gets right again."""
_US = 1000


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
