"""Where a light is among the events in time with it: their densest place, and the centre of those around."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_vision.events.bursts import Hits
from swarm_loc_vision.events.settings import LightSource, Sighting, TrackerSettings

_ITERATIONS = 8
_MAX_SHIFT_PX, _SETTLED_PX = 3.0, 1e-3
_PIXEL_VARIANCE = 1.0 / 12.0
"""Of a place within its pixel [px^2]."""
_MOMENTS = 8
_COUNT, _BURSTS, _U, _V, _UU, _UV, _VV, _TIME = range(_MOMENTS)


class Localizer:
    """Finds the place of each light, once for each window.

    Args:
        sources: The lights.
        size: Width and height of the sensor [px].
        settings: Radius, smallest number of events, floor of the standard deviation.
    """

    def __init__(
        self, sources: Sequence[LightSource], size: tuple[int, int], settings: TrackerSettings
    ) -> None:
        self._density = np.zeros((len(sources), size[1] + 2, size[0] + 2), np.int32)
        self._switches = [max(1.0, 2.0 * settings.window * source.frequency) for source in sources]
        self._settings = settings

    def locate(self, hits: Hits) -> list[Sighting]:
        """The lights that events show, by source."""
        moments = np.zeros((len(self._density), _MOMENTS))
        _locate(hits, self._density, self._settings.radius, self._settings.min_events, moments)
        return _without_echoes(
            [self._sighting(source, row) for source, row in enumerate(moments) if row[_COUNT]],
            self._settings.radius,
        )

    def _sighting(self, source: int, row: FloatArray) -> Sighting:
        """Noise averages out over bursts, where the pixels are only over the events of one switch.

        Each time the same pixels tell, and each of their events knows its place to a pixel.
        """
        scatter = np.array([[row[_UU], row[_UV]], [row[_UV], row[_VV]]]) / row[_COUNT]
        at_a_switch = max(1.0, row[_COUNT] / self._switches[source])
        locking = float(_PIXEL_VARIANCE / at_a_switch)
        lasting = locking + self._settings.sigma_floor**2
        covariance = scatter / max(row[_BURSTS], 1.0) + lasting * np.eye(2)
        place = float(row[_U]), float(row[_V])
        return Sighting(source, int(row[_TIME]), *place, covariance, locking, int(row[_COUNT]))


def _without_echoes(sightings: list[Sighting], radius: float) -> list[Sighting]:
    """Without those that a stronger light makes at multiples of its period, where bursts of it are lost."""
    return [
        one
        for one in sightings
        if not any(
            other.events > 2 * one.events and np.hypot(one.u - other.u, one.v - other.v) < radius
            for other in sightings
        )
    ]


@cached_njit
def _locate(
    hits: Hits, density: NDArray[np.int32], radius: float, min_events: int, moments: FloatArray
) -> None:
    """Fill the moments (S, 8) of each light: events, bursts, centre, sums of scatter about it, time [ns]."""
    peak = np.zeros((len(density), 3), np.int64)
    for k in range(len(hits.x)):
        source, x, y = hits.source[k], hits.x[k], hits.y[k]
        for row in range(y, y + 3):
            for column in range(x, x + 3):
                density[source, row, column] += 1
                if density[source, row, column] > peak[source, 0]:
                    peak[source, 0] = density[source, row, column]
                    peak[source, 1], peak[source, 2] = column - 1, row - 1
    for k in range(len(hits.x)):
        for row in range(hits.y[k], hits.y[k] + 3):
            for column in range(hits.x[k], hits.x[k] + 3):
                density[hits.source[k], row, column] = 0
    near = np.empty(len(hits.x), np.int64)
    for source in range(len(density)):
        if peak[source, 0] >= min_events:
            count = _near(hits, source, peak[source], radius + _MAX_SHIFT_PX, near)
            _centre(hits, near[:count], peak[source], radius, moments[source])


@cached_njit
def _near(hits: Hits, source: int, peak: IntArray, reach: float, near: IntArray) -> int:
    """Fill the indices of the events of a light around its peak; how many they are."""
    count = 0
    for k in range(len(hits.x)):
        if hits.source[k] == source:
            du, dv = float(hits.x[k] - peak[1]), float(hits.y[k] - peak[2])
            if du * du + dv * dv <= reach * reach:
                near[count] = k
                count += 1
    return count


@cached_njit
def _centre(hits: Hits, near: IntArray, peak: IntArray, radius: float, row: FloatArray) -> None:
    """Centre of the events within a radius of itself."""
    u, v = float(peak[1]), float(peak[2])
    step_u, step_v = 0.0, 0.0
    for _ in range(_ITERATIONS):
        row[:] = 0.0
        for k in near:
            du, dv = hits.x[k] - u, hits.y[k] - v
            if du * du + dv * dv <= radius * radius:
                row[_COUNT] += 1.0
                row[_BURSTS] += hits.begins[k]
                row[_U] += du
                row[_V] += dv
                row[_UU] += du * du
                row[_UV] += du * dv
                row[_VV] += dv * dv
                row[_TIME] += hits.time_ns[k] - hits.time_ns[0]
        step_u, step_v = row[_U] / row[_COUNT], row[_V] / row[_COUNT]
        u, v = u + step_u, v + step_v
        if abs(step_u) + abs(step_v) < _SETTLED_PX:
            break
    row[_UU] -= row[_COUNT] * step_u * step_u
    row[_UV] -= row[_COUNT] * step_u * step_v
    row[_VV] -= row[_COUNT] * step_v * step_v
    row[_U], row[_V] = u, v
    row[_TIME] = hits.time_ns[0] + row[_TIME] / row[_COUNT]
