"""Limit the load of a live estimator: fuse less often, then drop a share of the measurements. No ROS here."""

from __future__ import annotations

MIN_SHARE = 0.01
"""Least share, however busy the node is: without any measurements, robots would be lost for good."""
_WINDOW_S = 0.5  # Least time over which the load is measured, since fusing comes in bursts
_BUSY = 0.9  # Load above which a node may not keep up
_MAX_WAIT = 0.5  # Share of the horizon; data that wait longer to be fused would soon be too old
_AT_EASE = 0.6  # Load below which the share grows. Between the two limits it stays.
_SMOOTHING = 0.2  # Smoothing factor of the time that fusing takes, an average over about five windows
_AIM = 0.75
_MIN_CUT, _MAX_CUT = 0.5, 0.125  # Limits of the factor by which the share is cut per window
_GROWTH = 1.3
"""Growth of the share per window at low load; it is too small to lead from one load limit past the other."""
_LONGEST_WAIT = 0.25  # Share of the horizon that data may wait to be fused


class Shedding:
    """Cuts the share of measurements used while fusing falls behind, and lets it grow again.

    A node that is busy for a while and catches up again, as at its start, drops nothing. Using less saves
    only the time of fusing: where fusing takes no more than its guaranteed share of a core, the share is not
    cut further; where it takes less than half of that, the share grows.

    Args:
        fusion_load: That guaranteed share of a core.
        horizon_s: Data older than this are dropped [s].

    Attributes:
        share: Share of the measurements to use, in [MIN_SHARE, 1].
    """

    def __init__(self, fusion_load: float, horizon_s: float) -> None:
        self.share = 1.0
        self._fusion_load = fusion_load
        self._max_wait_s = _MAX_WAIT * horizon_s
        self._ticked_s: float | None = None
        self._fusing_load = fusion_load
        self._may_cut = True
        self._begin_window(0.0)

    def _begin_window(self, wall_s: float) -> None:
        self._begin_s = wall_s
        self._handled_s = self._busy_s = self._fusing_s = 0.0

    def begin_tick(self, wall_s: float, waited_s: float) -> None:
        """Begin a tick at a steady time [s]; data have waited for at most `waited_s` to be fused."""
        if self._ticked_s is None:
            self._ticked_s = self._begin_s = wall_s
        if wall_s - self._begin_s >= _WINDOW_S:
            self._adapt(wall_s - self._begin_s, waited_s)
            self._begin_window(wall_s)
        self._handled_s += (
            wall_s - self._ticked_s
        )  # this tick handles what was received since the previous one
        self._ticked_s = wall_s

    def _adapt(self, elapsed_s: float, waited_s: float) -> None:
        load, fusing_load = self._busy_s / elapsed_s, self._fusing_s / elapsed_s
        is_behind = load >= _BUSY and waited_s >= self._max_wait_s
        self._fusing_load += _SMOOTHING * (fusing_load - self._fusing_load)
        if load < _AT_EASE or self._fusing_load < 0.5 * self._fusion_load:
            self.share = min(1.0, _GROWTH * self.share)
        elif is_behind and self._may_cut and fusing_load > self._fusion_load:
            self._may_cut = False
            cut = _AIM * self._handled_s / self._busy_s  # longer ticks are an overload
            self.share = max(MIN_SHARE, self.share * min(max(cut, _MAX_CUT), _MIN_CUT))

    def begin_fusion(self) -> None:
        """Begin fusing; from now on the effect of the previous cut is known."""
        self._may_cut = True

    def note(self, busy_s: float, fusing_s: float = 0.0) -> None:
        """Add time for which the node was busy, and for which it was fusing."""
        self._busy_s += busy_s
        self._fusing_s += fusing_s


class FusionPace:
    """Limits fusing to a share of a core, unless data would grow too old meanwhile.

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
        """Longest time that data have waited since fusing began last [s]."""
        return 0.0 if self._fused_ns is None else max(0, now_ns - self._fused_ns) * 1e-9

    def begin(self, wall_s: float, now_ns: int) -> None:
        """Record that fusing begins."""
        self._rested_s, self._fused_ns = wall_s, now_ns

    def note(self, cpu_s: float) -> None:
        """Add the core time that fusing took [s]."""
        self._rested_s += cpu_s / self._load
