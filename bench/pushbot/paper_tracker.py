"""The tracker of the PushBot paper: each event pulls a light's place towards itself, equation (1).

N. Waniek, J. Biedermann and J. Conradt, "Cooperative SLAM on Small Mobile Robots", section IV-A. What the
paper leaves open: the weights are Gaussians in the time between a pixel's bursts and in the distance; a
window starts from the place at the end of the last one. As printed the weights are summed, so that
eta (w_t + w_p) reaches 2 eta, and noise near the light, or in time with it anywhere, moves the place; their
product does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages.event_encoding import Events
from swarm_loc_vision.events.parameters import LightSource, TrackerSettings
from swarm_loc_vision.events.tracker import LightTracker, Sighting

_LONG_AGO_NS = -(1 << 62)


@dataclass(frozen=True)
class PaperSettings:
    """What the paper's equation (1) needs."""

    eta: float = 0.5  # Influence of an event; beyond 0.5 the sum of weights is not stable
    time_sigma: float = 60e-6  # Of the weight of time [s]
    distance_sigma: float = 3.0  # Of the weight of distance [px]
    is_product: bool = False  # Whether the weights are multiplied instead of summed
    sigma: float = 0.83  # Standard deviation that is reported [px]; the paper knows none


class _Lights(NamedTuple):
    """Periods (S,) of the lights, and whether each is in the upper half of the image."""

    period_ns: IntArray
    is_above: BoolArray


class PaperTracker(LightTracker):
    """Follows each light once it was found; until then it looks for it as the `LightTracker` does.

    Args:
        sources: The lights.
        size: Width and height of the sensor [px].
        settings: Window and gap between bursts, and how lights are found.
        paper: Weights.
    """

    def __init__(
        self,
        sources: Sequence[LightSource],
        size: tuple[int, int],
        settings: TrackerSettings,
        paper: PaperSettings,
    ) -> None:
        self._finder = LightTracker(sources, size, settings)
        self._paper = paper
        self._lights = _Lights(
            np.array([source.period_ns for source in sources], np.int64),
            np.array([source.is_above for source in sources], bool),
        )
        weights = [paper.eta, 1e9 * paper.time_sigma, paper.distance_sigma, paper.is_product]
        self._numbers = np.array([*weights, 1e9 * settings.burst_gap, *size], dtype=float)
        self._times = np.empty((2, 2 * size[0] * size[1]), np.int64)
        super().__init__(sources, size, settings)

    def _reset(self) -> None:
        self._times[:] = _LONG_AGO_NS
        count = len(self._lights.period_ns)
        self._places, self._events = np.full((count, 2), np.nan), np.zeros(count, np.int64)
        self._last_ns = 0

    def _take(self, events: Events) -> None:
        if np.isnan(self._places).any():
            for report in self._finder.track(events):
                for one in report.sightings:
                    if np.isnan(self._places[one.source, 0]):
                        self._places[one.source] = one.u, one.v
        _pull(events, self._lights, self._numbers, self._times, self._places, self._events)
        self._last_ns = int(events.time_ns[-1])

    def _report(self) -> list[Sighting]:
        found = [
            Sighting(
                source,
                self._last_ns,
                float(u),
                float(v),
                self._paper.sigma**2 * np.eye(2),
                0.0,
                int(self._events[source]),
            )
            for source, (u, v) in enumerate(self._places)
            if self._events[source] and not math.isnan(u)
        ]
        self._events[:] = 0
        return found


@cached_njit
def _pull(
    events: Events,
    lights: _Lights,
    numbers: FloatArray,
    times: IntArray,
    places: FloatArray,
    counts: IntArray,
) -> None:
    """Move places (S, 2) by events, and count those that were in time and near."""
    x, y, is_on, time_ns = events
    periods, is_above = lights
    eta, time_sigma, distance_sigma = numbers[0], numbers[1], numbers[2]
    is_product, gap = numbers[3], numbers[4]
    width, height = int(numbers[5]), int(numbers[6])
    for k in range(len(x)):
        pixel = (int(is_on[k]) * height + y[k]) * width + x[k]
        now = time_ns[k]
        is_new = now - times[0, pixel] > gap
        elapsed = now - times[1, pixel]
        times[0, pixel] = now
        if not is_new:
            continue
        times[1, pixel] = now
        for source in range(len(periods)):
            if is_above[source] != (2 * y[k] < height) or np.isnan(places[source, 0]):
                continue
            late = (elapsed - periods[source]) / time_sigma
            du, dv = x[k] - places[source, 0], y[k] - places[source, 1]
            in_time = math.exp(-0.5 * late * late)
            near = math.exp(-0.5 * (du * du + dv * dv) / (distance_sigma * distance_sigma))
            weight = eta * (in_time * near if is_product else in_time + near)
            places[source, 0] += weight * du
            places[source, 1] += weight * dv
            counts[source] += int(in_time * near > 0.5)
