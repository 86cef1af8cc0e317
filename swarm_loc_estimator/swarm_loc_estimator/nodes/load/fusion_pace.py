"""Limit the load of fusion: the ticks at which measurements of a large swarm are fused. No ROS here."""

from __future__ import annotations

_LONGEST_WAIT = 0.25
"""Share of the horizon that data may wait to be fused; they have come late already."""


class FusionPace:
    """Lets fusing take its share of a core and no more, unless data would grow too old meanwhile.

    Args:
        load: Share of a core.
        horizon_s: Data older than this are dropped [s].
    """

    def __init__(self, load: float, horizon_s: float) -> None:
        self._load = load
        self._longest_ns = round(_LONGEST_WAIT * horizon_s * 1e9)
        self._rested_s = 0.0
        self._fused_ns: int | None = None

    def is_due(self, wall_s: float, now_ns: int) -> bool:
        """Whether to fuse now.

        Args:
            wall_s: A steady clock, that of the core.
            now_ns: The node's time, that of the data.
        """
        if wall_s >= self._rested_s or self._fused_ns is None:
            return True
        return not 0 <= now_ns - self._fused_ns < self._longest_ns

    def waited_s(self, now_ns: int) -> float:
        """How long data have waited at most since fusing began last [s]."""
        return 0.0 if self._fused_ns is None else max(0, now_ns - self._fused_ns) * 1e-9

    def begin(self, wall_s: float, now_ns: int) -> None:
        """Fusing begins at these times."""
        self._rested_s, self._fused_ns = wall_s, now_ns

    def note(self, cpu_s: float) -> None:
        """It took so much of a core [s], all of it or a part."""
        self._rested_s += cpu_s / self._load
