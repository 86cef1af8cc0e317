"""The frames of the last minutes, thinned out and bounded, for pages that are opened later."""

from __future__ import annotations

from collections import deque

from swarm_loc_estimator.watch.frames import Frame

SPAN_NS = 180_000_000_000
MAX_BYTES = 24_000_000
_SPACING_NS = {"poses": 200_000_000, "truth": 200_000_000, "map": 5_000_000_000}
_ELSE_NS = 500_000_000


class History:
    """A ring of frames.

    Args:
        span_ns: How far it reaches back.
        max_bytes: How much it may hold; the oldest frames go first.
    """

    def __init__(self, span_ns: int = SPAN_NS, max_bytes: int = MAX_BYTES) -> None:
        self._span_ns = span_ns
        self._max_bytes = max_bytes
        self._frames: deque[Frame] = deque()
        self._bytes = 0
        self._newest_of: dict[str, Frame] = {}
        self._kept_ns: dict[str, int] = {}

    def add(self, frame: Frame) -> bool:
        """Take a frame in; returns whether time has jumped back, which begins the history anew."""
        before = self._newest_of.get(frame.kind)
        jumped = before is not None and frame.kind == "poses" and frame.stamp_ns < before.stamp_ns
        if jumped:
            self.clear()
        self._newest_of[frame.kind] = frame
        spacing_ns = _SPACING_NS.get(frame.kind, _ELSE_NS)
        if frame.stamp_ns < self._kept_ns.get(frame.kind, -spacing_ns) + spacing_ns:
            return jumped
        self._kept_ns[frame.kind] = frame.stamp_ns
        self._frames.append(frame)
        self._bytes += len(frame.data)
        first_ns = frame.stamp_ns - self._span_ns
        while self._frames and (self._bytes > self._max_bytes or self._frames[0].stamp_ns < first_ns):
            self._bytes -= len(self._frames.popleft().data)
        return jumped

    def clear(self) -> None:
        """Forget everything."""
        self._frames.clear()
        self._newest_of.clear()
        self._kept_ns.clear()
        self._bytes = 0

    def frames(self) -> list[Frame]:
        """All that is kept, and the newest of each kind, in the order of their arrival."""
        kept = list(self._frames)
        known = set(map(id, kept))
        return kept + [frame for frame in self._newest_of.values() if id(frame) not in known]

    @property
    def size(self) -> int:
        """Bytes held in the ring."""
        return self._bytes
