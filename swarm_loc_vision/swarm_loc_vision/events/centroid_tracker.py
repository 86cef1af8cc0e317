"""The tracker of blinking lights that is used: the centre of all events in time with each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_vision.events.bursts import BurstMatcher, Hits
from swarm_loc_vision.events.localization import Localizer
from swarm_loc_vision.events.settings import LightSource, Sighting, TrackerSettings
from swarm_loc_vision.events.windows import WindowedTracker


class CentroidTracker(WindowedTracker):
    """Finds each light anew in every window, at the centre of all events in time with it.

    Args:
        sources: The lights.
        size: Width and height of the sensor [px].
        settings: How they are looked for.
    """

    def __init__(
        self, sources: Sequence[LightSource], size: tuple[int, int], settings: TrackerSettings
    ) -> None:
        super().__init__(settings.window)
        self._matcher = BurstMatcher(sources, size, settings)
        self._localizer = Localizer(sources, size, settings)
        self._hits: list[Hits] = []

    def _take(
        self, x: NDArray[np.uint16], y: NDArray[np.uint16], is_on: BoolArray, time_ns: IntArray
    ) -> None:
        self._hits.append(self._matcher.match(x, y, is_on, time_ns))

    def _report(self) -> list[Sighting]:
        hits = Hits(*(np.concatenate(column) for column in zip(*self._hits, strict=True)))
        self._hits.clear()
        return self._localizer.locate(hits)

    def _reset(self) -> None:
        self._matcher.reset()
        self._hits.clear()
