"""Choose the share of all sightings that a live estimator has time for. No ROS here."""

from __future__ import annotations

MIN_SHARE = 0.01
"""So much is used however busy the node is: with nothing at all, robots would be lost for good."""
_WINDOW_S = 0.5
"""The load is that of so much time at least: fusing comes in bursts."""
_BEHIND = 0.9
"""A node that is busy for this share of the time and more does not keep up, or soon will not."""
_AT_EASE = 0.6
"""With less, it tries to use more. Between the two, nothing changes."""
_SMOOTHING = 0.2
"""Of what fusing takes, which comes in bursts: about five windows count."""
_AIM = 0.75
_MIN_CUT, _MAX_CUT = 0.5, 0.125
"""Factors of the share per window: what the load asks for, within these limits."""
_GROWTH = 1.3
"""Likewise at ease; from the one limit of the load it does not reach the other."""


class Shedding:
    """Cuts the share of sightings used while the node is busy all the time, and lets it grow again.

    Only what fusing takes can be saved by using less. So where it takes no more than its guaranteed share of
    a core, the node is kept busy by something else, and no more is left out; where it takes less than half of
    that, less is.

    Args:
        fusion_load: That guaranteed share of a core.

    Attributes:
        share: Of the sightings to use, in [MIN_SHARE, 1].
    """

    def __init__(self, fusion_load: float) -> None:
        self.share = 1.0
        self._fusion_load = fusion_load
        self._ticked_s: float | None = None
        self._fusing_load = fusion_load
        self._begin_window(0.0)

    def _begin_window(self, wall_s: float) -> None:
        self._begin_s = wall_s
        self._handled_s = self._busy_s = self._fusing_s = 0.0

    def begin_tick(self, wall_s: float) -> None:
        """A tick begins, by a steady clock."""
        if self._ticked_s is None:
            self._ticked_s = self._begin_s = wall_s
        if wall_s - self._begin_s >= _WINDOW_S:
            self._adapt(wall_s - self._begin_s)
            self._begin_window(wall_s)
        self._handled_s += wall_s - self._ticked_s  # what came since the tick before is this one's work
        self._ticked_s = wall_s

    def _adapt(self, elapsed_s: float) -> None:
        load, fusing_load = self._busy_s / elapsed_s, self._fusing_s / elapsed_s
        self._fusing_load += _SMOOTHING * (fusing_load - self._fusing_load)
        if load < _AT_EASE or self._fusing_load < 0.5 * self._fusion_load:
            self.share = min(1.0, _GROWTH * self.share)
        elif load >= _BEHIND and fusing_load > self._fusion_load:
            cut = _AIM * self._handled_s / self._busy_s  # ticks that become longer have more to do than time
            self.share = max(MIN_SHARE, self.share * min(max(cut, _MAX_CUT), _MIN_CUT))

    def note(self, busy_s: float, fusing_s: float = 0.0) -> None:
        """The node was busy for so long, and with fusing for so much of it."""
        self._busy_s += busy_s
        self._fusing_s += fusing_s
