"""Events that blink in time: bursts of a pixel that follow each other by the period of a light.

A light that is switched makes each pixel of its image send a burst of events of one polarity. Whether a
burst belongs to a light is told by the time since the burst before, of the same pixel and polarity: noise,
and edges that move, hardly ever keep a period. G. R. Mueller and J. Conradt, "A miniature low-power sensor
system for real time 2D visual tracking of LED markers", ROBIO 2011, do so for single events.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.events.settings import MAX_SOURCES, LightSource, TrackerSettings

_LONG_AGO_NS = -(1 << 62)


class Hits(NamedTuple):
    """Events in time with a light, in their order.

    Attributes:
        source: (H,) index of the light.
        x: (H,) column [px].
        y: (H,) row [px].
        time_ns: (H,) [ns].
        begins: (H,) whether the event is the first of its burst.
    """

    source: NDArray[np.int32]
    x: NDArray[np.int32]
    y: NDArray[np.int32]
    time_ns: IntArray
    begins: BoolArray


class BurstMatcher:
    """Remembers the last burst of each pixel and polarity.

    Args:
        sources: The lights, at most `MAX_SOURCES`.
        size: Width and height of the sensor [px].
        settings: Gap between bursts, gate of the period.
    """

    def __init__(
        self, sources: Sequence[LightSource], size: tuple[int, int], settings: TrackerSettings
    ) -> None:
        if len(sources) > MAX_SOURCES:
            raise ValueError(f"{len(sources)} lights are more than {MAX_SOURCES}")
        width, height = size
        self._periods = np.array([source.period_ns for source in sources], np.int64)
        self._is_above = np.array([source.is_above for source in sources], bool)
        self._limits = np.array(
            [round(1e9 * settings.burst_gap), round(1e9 * settings.period_gate), width, height], np.int64
        )
        self._times = np.empty((2, 2 * width * height), np.int64)
        self._lights = np.empty(2 * width * height, np.int32)
        self.reset()

    def reset(self) -> None:
        """Forget all bursts, as after a jump of time."""
        self._times[:] = _LONG_AGO_NS
        self._lights[:] = -1

    def match(
        self, x: NDArray[np.uint16], y: NDArray[np.uint16], is_on: BoolArray, time_ns: IntArray
    ) -> Hits:
        """The events (N,) in time with a light; each counts for one at most, the nearest period."""
        room = len(x)
        columns, times, begins = np.empty((3, room), np.int32), np.empty(room, np.int64), np.empty(room, bool)
        count = _match(
            (x, y, is_on, time_ns),
            (self._periods, self._is_above, self._limits),
            (self._times, self._lights),
            (columns, times, begins),
        )
        source, hit_x, hit_y = columns[:, :count]
        return Hits(source, hit_x, hit_y, times[:count], begins[:count])


@cached_njit
def _match(
    events: tuple[NDArray[np.uint16], NDArray[np.uint16], BoolArray, IntArray],
    lights: tuple[IntArray, BoolArray, IntArray],
    memory: tuple[IntArray, NDArray[np.int32]],
    hits: tuple[NDArray[np.int32], IntArray, BoolArray],
) -> int:
    """Fill hits; how many they are."""
    x, y, is_on, time_ns = events
    periods, is_above, limits = lights
    times, of_light = memory
    columns, hit_ns, begins = hits
    gap, gate, width, height = limits[0], limits[1], limits[2], limits[3]
    count = 0
    for k in range(len(x)):
        pixel = (int(is_on[k]) * height + y[k]) * width + x[k]
        now = time_ns[k]
        is_new = now - times[0, pixel] > gap
        if is_new:
            of_light[pixel] = _light(now - times[1, pixel], 2 * y[k] < height, periods, is_above, gate)
            times[1, pixel] = now
        times[0, pixel] = now
        if of_light[pixel] >= 0:
            columns[0, count], columns[1, count], columns[2, count] = of_light[pixel], x[k], y[k]
            hit_ns[count], begins[count] = now, is_new
            count += 1
    return count


@cached_njit
def _light(elapsed: int, above: bool, periods: IntArray, is_above: BoolArray, gate: int) -> int:
    """The light of a half of the image whose period is nearest to a time between bursts; -1: none."""
    nearest, found = gate, -1
    for k in range(len(periods)):
        if is_above[k] == above and abs(elapsed - periods[k]) < nearest:
            nearest, found = abs(elapsed - periods[k]), k
    return found
