"""Events of a simulated event camera: blinking spots, edges that move, noise; refractory pixels, one bus.

A pixel sends an event when the logarithm of its brightness has changed by its threshold. Switching
a light on causes a burst at each pixel of its image, one event per refractory time; the brighter the light,
the longer the burst.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.pushbot.protocol import SENSOR_PX
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.parameters import number


class Blinking(NamedTuple):
    """A light that is lit in the first part of each period; with a period of 0 it is dark."""

    period_us: int = 0  # [us]
    lit_us: int = 0  # [us]


_REACH_PX = 4  # Half width of the window in which a spot is computed [px]
_WINDOW = np.arange(-_REACH_PX, _REACH_PX + 1)
_MAX_BURST = 6
_LATENCY_US = 20.0
_DIM_LATENCY_US = 60.0  # Of a pixel that is as bright as its surroundings; brighter ones are faster
_US = 1e-6

_Raw = tuple[IntArray, IntArray, IntArray, FloatArray]
"""Columns, rows, polarity bits and times [us] of events, in no order."""


@dataclass(frozen=True)
class CameraNoise:
    """Noise and limits of an event camera."""

    noise_rate: float = number(
        1.0, "1/s", 0.0, 100.0, "noise events of each pixel of an event camera per second"
    )
    blur: float = number(0.8, "px", 0.3, 2.0, "standard deviation of the image of a point")
    threshold: float = number(0.5, "1", 0.1, 2.0, "change of the logarithm of brightness that makes an event")
    mismatch: float = number(
        0.05, "1", 0.0, 0.5, "standard deviation of the pixels' thresholds, of their mean"
    )
    jitter: float = number(15.0, "us", 0.0, 200.0, "standard deviation of the time of an event")
    refractory: float = number(50.0, "us", 1.0, 1000.0, "dead time of a pixel after an event")


class Spot(NamedTuple):
    """The image of a light during a step."""

    begin: tuple[float, float]  # Column and row at the begin of the step [px]
    end: tuple[float, float]  # Column and row at the end of the step [px]
    amplitude: float  # Its brightness in the middle over that of the surroundings [1]
    blinking: Blinking  # How it blinks; periods begin at whole multiples since the world's time zero


class CameraEvents(NamedTuple):
    """Events in order (N,): column, row [px], the polarity bit 0 where it became brighter, time [us]."""

    x: IntArray
    y: IntArray
    polarity: IntArray
    time_us: IntArray

    def words(self) -> NDArray[np.uint16]:
        """As the camera's bus has them: `0yyyyyyy pxxxxxxx`."""
        return (self.y << 8 | self.polarity << 7 | self.x).astype(np.uint16)


class EventCamera:
    """One sensor of 128 x 128 pixels; its seed gives the fixed properties of its pixels."""

    def __init__(self, noise: CameraNoise, rng: np.random.Generator, sensor: int) -> None:
        self._noise = noise
        self._rng = rng
        spread = np.random.default_rng(sensor).standard_normal((SENSOR_PX, SENSOR_PX)) * noise.mismatch
        self._threshold = noise.threshold * np.exp(spread)
        self._last_us = np.full(2 * SENSOR_PX * SENSOR_PX, -1e9)
        self._bus_us = 0
        self._later: _Raw = (np.zeros(0, int), np.zeros(0, int), np.zeros(0, int), np.zeros(0))

    def look(self, begin_us: int, end_us: int, spots: Sequence[Spot], edges: FloatArray) -> CameraEvents:
        """The events of a step between two times [us].

        `spots` are images of lights. Upright edges (E, 3) have columns at the begin and at the end [px], and
        brightness left minus right.
        """
        parts = [self._noise_events(begin_us, end_us), self._edge_events(begin_us, end_us, edges)]
        parts += [self._later, *(self._spot_events(begin_us, end_us, spot) for spot in spots)]
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        is_later = columns[3] >= end_us
        self._later = _columns(columns, is_later)
        x, y, polarity, time_us = _columns(columns, ~is_later)
        is_inside = (x >= 0) & (x < SENSOR_PX) & (y >= 0) & (y < SENSOR_PX)
        x, y, polarity, time_us = _columns((x, y, polarity, time_us), is_inside)
        kept = self._without_refractory(x, y, polarity, time_us)
        x, y, polarity, time_us = _columns((x, y, polarity, time_us), kept)
        return CameraEvents(x, y, polarity, self._on_the_bus(time_us))

    def _noise_events(self, begin_us: int, end_us: int) -> _Raw:
        rng = self._rng
        count = rng.poisson(self._noise.noise_rate * SENSOR_PX**2 * (end_us - begin_us) * _US)
        x, y = rng.integers(0, SENSOR_PX, (2, count))
        return x, y, rng.integers(0, 2, count), rng.uniform(begin_us, end_us, count)

    def _edge_events(self, begin_us: int, end_us: int, edges: FloatArray) -> _Raw:
        """Events of edges that sweep over columns; a pixel notices one with the contrast as probability."""
        rng = self._rng
        first, last = np.floor(edges[:, 0]).astype(int), np.floor(edges[:, 1]).astype(int)
        crossed = np.minimum(np.abs(last - first), SENSOR_PX)
        edge = np.repeat(np.arange(len(edges)), crossed)
        step = np.arange(len(edge)) - np.repeat(np.cumsum(crossed) - crossed, crossed)
        ahead = np.sign(last - first)[edge]
        column = first[edge] + np.where(ahead > 0, step + 1, -step)
        share = (column - edges[edge, 0]) / (edges[edge, 1] - edges[edge, 0])
        tells = rng.random((len(edge), SENSOR_PX)) < np.minimum(1.0, np.abs(edges[edge, 2]))[:, None]
        which, row = np.nonzero(tells)
        at_us = begin_us + share[which] * (end_us - begin_us) + rng.normal(0.0, 300.0, len(which))
        polarity = (edges[edge, 2] * ahead < 0.0)[which].astype(int)
        return column[which], row, polarity, np.clip(at_us, begin_us, end_us)

    def _spot_events(self, begin_us: int, end_us: int, spot: Spot) -> _Raw:
        """Bursts at each time that a light is switched."""
        switched_us, is_off = _switches(begin_us, end_us, spot.blinking)
        share = ((switched_us - begin_us) / (end_us - begin_us))[:, None]
        u, v = (np.array(spot.begin) + share * (np.array(spot.end) - np.array(spot.begin))).T
        x = np.rint(u).astype(int)[:, None, None] + _WINDOW[None, None, :]
        y = np.rint(v).astype(int)[:, None, None] + _WINDOW[None, :, None]
        x, y = np.broadcast_arrays(x, y)
        square = (x - u[:, None, None]) ** 2 + (y - v[:, None, None]) ** 2
        bright = spot.amplitude * np.exp(-0.5 * square / self._noise.blur**2)
        threshold = self._threshold[np.clip(y, 0, SENSOR_PX - 1), np.clip(x, 0, SENSOR_PX - 1)]
        strength = np.log1p(bright) / threshold + self._rng.normal(0.0, 0.15, x.shape)
        burst = np.clip(np.floor(strength), 0, _MAX_BURST).astype(int).ravel()
        pixel = np.repeat(np.arange(burst.size), burst)
        number_in_burst = np.arange(len(pixel)) - np.repeat(np.cumsum(burst) - burst, burst)
        latency = _LATENCY_US + _DIM_LATENCY_US / (1.0 + bright.ravel()[pixel])
        switch = pixel // (len(_WINDOW) ** 2)
        at_us = switched_us[switch] + latency + 1.1 * number_in_burst * self._noise.refractory
        at_us += self._rng.normal(0.0, self._noise.jitter, len(pixel))
        return x.ravel()[pixel], y.ravel()[pixel], is_off[switch].astype(int), at_us

    def _without_refractory(
        self, x: IntArray, y: IntArray, polarity: IntArray, time_us: FloatArray
    ) -> IntArray:
        """Indices of the events outside the dead times of pixels and polarities, by time."""
        pixel = (polarity * SENSOR_PX + y) * SENSOR_PX + x
        order = np.lexsort((time_us, pixel))
        sorted_pixel, sorted_us = pixel[order], time_us[order]
        before = np.empty_like(sorted_us)
        before[1:] = sorted_us[:-1]
        begins = np.ones(len(order), bool)
        begins[1:] = sorted_pixel[1:] != sorted_pixel[:-1]
        before[begins] = self._last_us[sorted_pixel[begins]]
        remains = sorted_us - before >= self._noise.refractory
        self._last_us[sorted_pixel[remains]] = sorted_us[remains]
        kept: IntArray = order[remains]
        return kept[np.argsort(time_us[kept], kind="stable")]

    def _on_the_bus(self, time_us: FloatArray) -> IntArray:
        """Times at which the board takes the events (N,): one a microsecond, in order."""
        place = np.arange(len(time_us))
        wanted = np.floor(time_us).astype(np.int64) - place
        if len(wanted):
            wanted[0] = max(wanted[0], self._bus_us + 1)
        taken: IntArray = np.maximum.accumulate(wanted) + place
        self._bus_us = int(taken[-1]) if len(taken) else self._bus_us
        return taken


def _columns(columns: Sequence[NDArray[Any]], chosen: NDArray[Any]) -> _Raw:
    x, y, polarity, time_us = (column[chosen] for column in columns)
    return x, y, polarity, time_us


def _switches(begin_us: int, end_us: int, blinking: Blinking) -> tuple[IntArray, BoolArray]:
    """Times within a step at which a light is switched on or off (N,), and whether off."""
    period, lit = blinking
    if not 0 < lit < period:
        return np.zeros(0, np.int64), np.zeros(0, bool)
    on = period * np.arange(-(-begin_us // period), -(-end_us // period))
    off = lit + period * np.arange(-((lit - begin_us) // period), -((lit - end_us) // period))
    return np.concatenate([on, off]), np.repeat([False, True], [len(on), len(off)])
