"""Events cut into windows of equal length, of which a tracker reports one after the other."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_vision.events.settings import Sighting, WindowReport


class WindowedTracker(ABC):
    """Cuts time at whole multiples of the window, and asks for a report wherever events go beyond one.

    Args:
        window_s: [s].

    Attributes:
        time_jumps: How often time stepped back by more than a window, which makes it begin anew.
    """

    def __init__(self, window_s: float) -> None:
        self._window_ns = round(1e9 * window_s)
        self._begin_ns: int | None = None
        self.time_jumps = 0

    def track(
        self, x: NDArray[np.uint16], y: NDArray[np.uint16], is_on: BoolArray, time_ns: IntArray
    ) -> list[WindowReport]:
        """Take events (N,) in the order of their time [ns]; the reports of windows that have ended."""
        reports = []
        if not len(x):
            return []
        if self._begin_ns is not None and time_ns[0] < self._begin_ns - self._window_ns:
            self.time_jumps += 1
            self._begin_ns = None
            self._reset()
        first = 0
        while first < len(x):
            if self._begin_ns is None:
                self._begin_ns = int(time_ns[first]) // self._window_ns * self._window_ns
            end_ns = self._begin_ns + self._window_ns
            last = first + int(np.searchsorted(time_ns[first:], end_ns))
            if last > first:
                self._take(x[first:last], y[first:last], is_on[first:last], time_ns[first:last])
            if last < len(x):
                reports.append(WindowReport(end_ns - self._window_ns // 2, tuple(self._report())))
                self._begin_ns = int(time_ns[last]) // self._window_ns * self._window_ns
            first = last
        return reports

    @abstractmethod
    def _take(
        self, x: NDArray[np.uint16], y: NDArray[np.uint16], is_on: BoolArray, time_ns: IntArray
    ) -> None:
        """Take events (N,) of the window that is open."""

    @abstractmethod
    def _report(self) -> list[Sighting]:
        """The lights in the window that ends here."""

    @abstractmethod
    def _reset(self) -> None:
        """Forget everything."""
