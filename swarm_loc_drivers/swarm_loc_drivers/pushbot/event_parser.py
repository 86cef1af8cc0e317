"""Parser of a PushBot's bytes: events with their timestamps, in packets, and lines of text between them.

An event is `1yyyyyyy pxxxxxxx` and its timestamp, most significant byte first. Text never lies within an
event: at a boundary a byte below 0x80 begins a line, any other byte an event. After lost bytes this rule soon
finds a boundary again. Until then wrong events show by their timestamps: events after a jump of time are kept
only if the following events confirm it, without invalid bytes in between.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.protocol import TIMESTAMPS
from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit, note_precompiled
from swarm_loc_estimator.common.messages.event_encoding import Events, encode_events

# Checked by lost bytes in test_pushbot_events.py.
CONFIRMATIONS = 8  # Consecutive events that confirm a jump of time
MAX_LINE = 256  # Longer lines are dropped
_MAX_HELD = 1024  # Most bytes that wait for the confirmation of a jump; then it is accepted
_MAX_GAP_US = 250_000
_MAX_SHORT_GAP_US = 16_384
"""A longer silence of the camera counts as a jump of time; the second value is for 16-bit timestamps."""
_HIGH, _NEWLINE, _SPACE, _DELETE = 0x80, 0x0A, 0x20, 0x7F
_COUNTS = ("corrupt_events", "time_jumps", "skipped_bytes", "long_lines")
_CORRUPT, _JUMPS, _SKIPPED, _LONG = range(4)
_TIME, _RAW, _STARTED = range(3)


class Parsed(NamedTuple):
    """Content of a piece of bytes."""

    x: NDArray[np.uint8]  # (N,) columns of events [px]
    y: NDArray[np.uint8]  # (N,) rows of events [px]
    polarity: NDArray[np.uint8]  # (N,) the polarity bit as sent, 0 or 1
    # (N,) the board's clock, unwrapped, from an arbitrary instant on [us]; zeros without one
    time_us: IntArray
    lines: list[tuple[int, bytes]]  # Lines without their end, each with the number of events before it


class EventParser:
    """Parses bytes in pieces of any size; the sizes do not affect the result.

    `timestamps` is a key of `TIMESTAMPS`. Counts `corrupt_events` (dropped), `time_jumps` (accepted),
    `skipped_bytes` and `long_lines`.
    """

    def __init__(self, timestamps: str, counts: Counter[str]) -> None:
        self._stamp_bytes = TIMESTAMPS[timestamps]
        self._counts = counts
        self._rest = b""
        self._state = np.zeros(3, np.int64)

    @property
    def span_us(self) -> int:
        """Time after which the timestamps wrap [us]; 0: never, or there are none."""
        return 1 << (8 * self._stamp_bytes) if self._stamp_bytes > 0 else 0

    def feed(self, data: bytes) -> Parsed:
        """Take bytes; the events and lines that are complete and confirmed."""
        buffer = np.frombuffer(self._rest + data, np.uint8)
        capacity = len(buffer) // 2 + 1
        columns = np.empty((3, capacity), np.uint8)
        times = np.empty(capacity, np.int64)
        spans = np.empty((len(buffer) + 1, 3), np.int64)
        tally = np.zeros(len(_COUNTS), np.int64)
        used, events, lines = _parse(buffer, self._stamp_bytes, self._state, columns, times, spans, tally)
        self._counts.update({name: int(count) for name, count in zip(_COUNTS, tally, strict=True) if count})
        content = buffer.tobytes()
        self._rest = content[used:]
        texts = [(int(before), content[begin:end]) for begin, end, before in spans[:lines]]
        x, y, polarity = columns[:, :events]
        return Parsed(x, y, polarity, times[:events], texts)


@cached_njit
def _parse(
    data: NDArray[np.uint8],
    stamp_bytes: int,
    state: IntArray,
    columns: NDArray[np.uint8],
    times: IntArray,
    spans: IntArray,
    tally: IntArray,
) -> tuple[int, int, int]:  # fmt: skip
    """Fill columns, times and spans of lines; returns the bytes used and the numbers of events and lines."""
    at, events, lines = 0, 0, 0
    run_at, run_events, run_lines = -1, 0, 0  # where an unconfirmed jump of time began
    before, tally_before = state.copy(), tally.copy()
    while at < len(data):
        # a line of text, up to its newline
        if data[at] < _HIGH:
            end, verdict = _line_end(data, at)
            if verdict == 0:
                break
            if verdict == 1:
                if end > at:
                    spans[lines, 0], spans[lines, 1], spans[lines, 2] = at, end, events
                    lines += 1
                at = end + 1
                continue
            if run_at >= 0:  # invalid bytes: the events of the run did not begin at a boundary
                tally[_CORRUPT] += events - run_events
                spans[run_lines:lines, 2] = events = run_events
                run_at, state[:] = -1, before
            tally[_LONG if verdict == 3 else _SKIPPED] += 1 if verdict == 3 else end - at
            at = end
            continue
        # an event: its stamp must follow plausibly, or begins a run that others must confirm
        size, stamp = _stamp(data, at, stamp_bytes)
        if size == 0:
            break
        if size < 0:  # a time difference without an end
            tally[_SKIPPED] += 2
            at += 2
            continue
        if stamp_bytes:
            elapsed = _elapsed(stamp, state, stamp_bytes)
            if run_at >= 0 and not _is_plausible(elapsed, stamp_bytes):
                tally[_CORRUPT] += events - run_events
                spans[run_lines:lines, 2] = events = run_events
                state[:] = before
                elapsed = _elapsed(stamp, state, stamp_bytes)
                if state[_STARTED] == 0 or not _is_plausible(elapsed, stamp_bytes):
                    at, lines, run_at = run_at + 1, run_lines, -1  # no boundary: search after it
                    tally[_SKIPPED] += 1
                    continue
                run_at = -1
            if run_at < 0 and (state[_STARTED] == 0 or not _is_plausible(elapsed, stamp_bytes)):
                run_at, run_events, run_lines = at, events, lines
                before[:] = state
                tally_before[:] = tally
            state[_TIME] += elapsed
            state[_RAW], state[_STARTED] = stamp, 1
        # take the event
        columns[0, events], columns[1, events] = data[at + 1] & 0x7F, data[at] & 0x7F
        columns[2, events] = data[at + 1] >> 7
        times[events] = state[_TIME]
        events += 1
        at += size
        if run_at >= 0 and events - run_events >= CONFIRMATIONS:
            tally[_JUMPS] += before[_STARTED]
            run_at = -1
    if run_at >= 0 and len(data) - run_at < _MAX_HELD:  # parse it again when there is more
        state[:] = before
        tally[:] = tally_before
        return run_at, run_events, run_lines
    return at, events, lines


@cached_njit
def _line_end(data: NDArray[np.uint8], at: int) -> tuple[int, int]:
    """Where a line ends, and 0: incomplete, 1: by a newline, 2: by a byte that is no text, 3: too long."""
    for end in range(at, min(len(data), at + MAX_LINE)):
        byte = data[end]
        if byte == _NEWLINE:
            return end, 1
        if byte >= _HIGH:
            return end, 2
        if byte >= _DELETE or (byte < _SPACE and not 8 <= byte <= 13):
            return end + 1, 2
    return (at + MAX_LINE, 3) if len(data) >= at + MAX_LINE else (len(data), 0)


@cached_njit
def _stamp(data: NDArray[np.uint8], at: int, stamp_bytes: int) -> tuple[int, int]:
    """Bytes of the event at `at` and its timestamp as sent; 0: incomplete, -1: without an end."""
    left = len(data) - at - 2
    stamp = 0
    if stamp_bytes >= 0:
        if left < stamp_bytes:
            return 0, 0
        for k in range(stamp_bytes):
            stamp = (stamp << 8) | data[at + 2 + k]
        return 2 + stamp_bytes, stamp
    for k in range(min(left, 4)):
        byte = data[at + 2 + k]
        stamp = (stamp << 7) | (byte & 0x7F)
        if byte >= _HIGH:
            return 3 + k, stamp
    return (-1, 0) if left >= 4 else (0, 0)


@cached_njit
def _elapsed(stamp: int, state: IntArray, stamp_bytes: int) -> int:
    """Time since the last event [us]; long timestamps may step back."""
    if stamp_bytes < 0:
        return stamp
    if state[_STARTED] == 0:
        return 0
    span = 1 << (8 * stamp_bytes)
    forward = (stamp - int(state[_RAW])) % span
    return forward - span if stamp_bytes > 2 and 2 * forward > span else forward


@cached_njit
def _is_plausible(elapsed: int, stamp_bytes: int) -> bool:
    """Whether events can be so far apart [us]."""
    longest = _MAX_SHORT_GAP_US if stamp_bytes == 2 else _MAX_GAP_US
    return 0 <= elapsed <= longest


def precompile() -> None:
    """Compile the parser, before the first bytes arrive, by parsing an event and a line."""
    EventParser("16bit", Counter()).feed(b"\xe4\xa5\xe2\x40-S28 1 2\n")
    note_precompiled(precompile)


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
                count, part_ns = part.stop - first, stamps_ns[part]
                # end the packet where time steps back, or where it would be too long
                if self._waiting:
                    since_ns = part_ns[-1] - self._waiting[0][3][0]
                    steps_back = part_ns[0] < self._waiting[-1][3][-1]
                    if steps_back or since_ns > 2 * self._period_ns or self._count + count > MAX_EVENTS:
                        self.flush()
                if not self._waiting:
                    self._board_ns = 1000 * int(board_us[first])
                self._waiting.append((x[part], y[part], polarity[part] == self._on_bit, part_ns))
                self._count += count
                if part_ns[-1] - self._waiting[0][3][0] >= self._period_ns:
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
