"""Track blinking lights in the events of an event camera.

A switched light makes each pixel of its image send a burst of events of one polarity. A burst belongs to the
light whose period is nearest to the time since the previous burst of the same pixel and polarity; noise and
moving edges hardly ever keep a period. (G. R. Mueller and J. Conradt, "A miniature low-power sensor system
for real time 2D visual tracking of LED markers", ROBIO 2011, match single events in this way.) In each window
a light is at the centre of its events around the place where they are densest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages.event_encoding import Events
from swarm_loc_estimator.common.parameters import ParameterError, number, text, texts
from swarm_loc_vision.laser.calibration import LaserCalibration, load_laser

MAX_SOURCES = 32  # Bound on the lights that are looked for at once
_MIN_HZ, _MAX_HZ = 10.0, 5000.0


@dataclass(frozen=True)
class LightSource:
    """A light that blinks."""

    frequency: float  # [Hz]
    # Whether it is in the upper half of the image, as LEDs of other robots, or in the lower half, as the spot
    # of the robot's own laser
    is_above: bool


@dataclass(frozen=True)
class TrackerSettings:
    """How blinking lights are tracked."""

    window: float = number(0.02, "s", 0.002, 1.0, "length of the windows, each of which makes one report")
    burst_gap: float = number(2.5e-4, "s", 1e-5, 0.01, "pause of a pixel before the first event of a burst")
    period_gate: float = number(
        6e-5, "s", 1e-6, 1e-3, "largest difference of the time between two bursts and the light's period"
    )
    radius: float = number(3.5, "px", 1.0, 20.0, "of the circle whose events determine a light's place")
    min_events: int = number(8, "1", 2, 1000, "events of a light within 3 x 3 pixels, at least")
    sigma_floor: float = number(
        0.02, "px", 0.0, 2.0, "standard deviation of a place that more events do not reduce, per axis"
    )


@dataclass(frozen=True)
class LensSettings:
    """The event camera's lens, for bearings of lights."""

    focal_px: float = number(90.0, "px", 1.0, 10_000.0, "focal length of the event camera")
    centre_column: float = number(63.5, "px", -10_000.0, 10_000.0, "column of its optical axis")
    centre_row: float = number(63.5, "px", -10_000.0, 10_000.0, "row of its optical axis")
    camera_yaw: float = number(0.0, "rad", -3.15, 3.15, "turn of the camera on the robot, to the left")


@dataclass(frozen=True)
class EventTrackerParameters:
    """Parameters of `event_tracker_node`."""

    laser_frequency: float = number(
        450.0, "Hz", 0.0, _MAX_HZ, "of the robot's own laser, in the lower half of the image; 0: none"
    )
    light_frequencies: tuple[str, ...] = texts(
        "of other robots' LEDs, in the upper half of the image, such as 1000 [Hz]; empty: none"
    )
    calibration: str = text("", "path of the laser's calibration; empty: the spot without distances")
    base_frame: str = text("base_link", "frame of distances and bearings: <robot>/base_frame", required=True)
    lens: LensSettings = field(default_factory=LensSettings, metadata={"numbers_of": LensSettings})
    settings: TrackerSettings = field(
        default_factory=TrackerSettings, metadata={"numbers_of": TrackerSettings}
    )


def light_sources(parameters: EventTrackerParameters) -> list[LightSource]:
    """The lights that are looked for: the laser first where there is one, then LEDs by frequency.

    Raises:
        ParameterError: A frequency cannot be used.
    """
    laser = parameters.laser_frequency
    sources = [LightSource(_in_range("laser_frequency", laser), is_above=False)] if laser else []
    lights = sorted({_in_range("light_frequencies", one) for one in parameters.light_frequencies})
    sources += [LightSource(frequency, is_above=True) for frequency in lights]
    if not sources:
        raise ParameterError(
            "parameters laser_frequency = 0 and light_frequencies = [] leave nothing to track."
        )
    if len(sources) > MAX_SOURCES:
        raise ParameterError(
            f"parameter light_frequencies has {len(lights)} entries, the most are {MAX_SOURCES - 1}."
        )
    return sources


def _in_range(name: str, value: float | str) -> float:
    try:
        frequency = float(value)
    except ValueError:
        frequency = -1.0
    if not _MIN_HZ <= frequency <= _MAX_HZ:
        raise ParameterError(f"parameter {name} = {value!r} must lie in [{_MIN_HZ:g}, {_MAX_HZ:g}] Hz.")
    return frequency


def laser_calibration(parameters: EventTrackerParameters) -> LaserCalibration | None:
    """The laser's calibration; None without one.

    Raises:
        LaserFileError: It cannot be used.
    """
    return load_laser(Path(parameters.calibration)) if parameters.calibration else None


_LONG_AGO_NS = -(1 << 62)
# Checked, with the defaults of `TrackerSettings`, by test_event_tracker.py; figures: event_tracker_node.md.
_ITERATIONS = 8
_MAX_SHIFT_PX, _SETTLED_PX = 3.0, 1e-3
_PIXEL_VARIANCE = 1.0 / 12.0  # Variance of a place within its pixel [px^2]
_MOMENTS = 8
_COUNT, _BURSTS, _U, _V, _UU, _UV, _VV, _TIME = range(_MOMENTS)


class Sighting(NamedTuple):
    """A light in one window."""

    source: int  # Index of the light
    stamp_ns: int  # Mean time of its events [ns]
    u: float  # Column of its centre [px]
    v: float  # Row [px]
    covariance: FloatArray  # (2, 2) over u, v [px^2]
    locking: float  # Part of each variance that is the bias within pixels, the same at each return [px^2]
    events: int  # Number of events that the place was computed from


class WindowReport(NamedTuple):
    """The lights in one window."""

    stamp_ns: int  # Middle of the window [ns]
    sightings: tuple[Sighting, ...]  # At most one for each light, by source


class _Hits(NamedTuple):
    """Events in time with a light, in order of time, one row each."""

    source: NDArray[np.int32]  # (H,) index of the light
    x: NDArray[np.int32]  # (H,) column [px]
    y: NDArray[np.int32]  # (H,) row [px]
    time_ns: IntArray  # (H,) [ns]
    begins: BoolArray  # (H,) whether the event is the first of its burst


class _Bursts(NamedTuple):
    """The last burst of each pixel and polarity."""

    event_ns: IntArray  # (P,) time of its last event [ns]
    begin_ns: IntArray  # (P,) time of its first event [ns]
    source: NDArray[np.int32]  # (P,) the light that it belongs to; -1: none


class LightTracker:
    """Reports the lights of each window of events; windows begin at whole multiples of their length.

    There are at most `MAX_SOURCES` lights; `size` is width and height of the sensor [px].
    """

    def __init__(
        self, sources: Sequence[LightSource], size: tuple[int, int], settings: TrackerSettings
    ) -> None:
        if len(sources) > MAX_SOURCES:
            raise ValueError(f"{len(sources)} lights are more than {MAX_SOURCES}")
        self.time_jumps = 0  # How often time stepped back by more than a window, which resets the tracker
        self._settings, (self._width, self._height) = settings, size
        self._window_ns = round(1e9 * settings.window)
        self._begin_ns: int | None = None
        self._period_ns = np.array([round(1e9 / source.frequency) for source in sources], np.int64)
        self._is_above = np.array([source.is_above for source in sources], bool)
        self._switches = [max(1.0, 2.0 * settings.window * source.frequency) for source in sources]
        self._density = np.zeros((len(sources), self._height + 2, self._width + 2), np.int32)
        pixels = 2 * self._width * self._height
        event_ns, begin_ns = np.empty((2, pixels), np.int64)
        self._bursts = _Bursts(event_ns, begin_ns, np.empty(pixels, np.int32))
        self._hits: list[_Hits] = []
        self._reset()

    def track(self, events: Events) -> list[WindowReport]:
        """Take events in order of time, given since the epoch; returns the windows that have ended."""
        reports: list[WindowReport] = []
        count, time_ns = len(events.x), events.time_ns
        if not count:
            return reports
        if self._begin_ns is not None and time_ns[0] < self._begin_ns - self._window_ns:
            self.time_jumps += 1
            self._begin_ns = None
            self._reset()
        first = 0
        while first < count:
            if self._begin_ns is None:
                self._begin_ns = int(time_ns[first]) // self._window_ns * self._window_ns
            end_ns = self._begin_ns + self._window_ns
            last = first + int(np.searchsorted(time_ns[first:], end_ns))
            if last > first:
                self._take(Events._make(column[first:last] for column in events))
            if last < count:
                reports.append(WindowReport(end_ns - self._window_ns // 2, tuple(self._report())))
                self._begin_ns = int(time_ns[last]) // self._window_ns * self._window_ns
            first = last
        return reports

    def _reset(self) -> None:
        self._bursts.event_ns[:] = self._bursts.begin_ns[:] = _LONG_AGO_NS
        self._bursts.source[:] = -1
        self._hits.clear()

    def _take(self, events: Events) -> None:
        """Keep the events of the open window that are in time with a light: the one of the nearest period."""
        count = len(events.x)
        source, x, y = np.empty((3, count), np.int32)
        hits = _Hits(source, x, y, np.empty(count, np.int64), np.empty(count, bool))
        gap_ns, gate_ns = round(1e9 * self._settings.burst_gap), round(1e9 * self._settings.period_gate)
        lights, size = (self._period_ns, self._is_above), (self._width, self._height)
        found = _match(events, *lights, gap_ns, gate_ns, *size, self._bursts, hits)
        self._hits.append(_Hits._make(column[:found] for column in hits))

    def _report(self) -> list[Sighting]:
        """The lights of the open window, which is cleared."""
        hits = _Hits._make(np.concatenate(column) for column in zip(*self._hits, strict=True))
        self._hits.clear()
        moments, radius = np.zeros((len(self._density), _MOMENTS)), self._settings.radius
        _locate(hits, self._density, radius, self._settings.min_events, moments)
        found = [self._sighting(source, row) for source, row in enumerate(moments) if row[_COUNT]]

        def is_echo_of(one: Sighting, other: Sighting) -> bool:
            """Where bursts of a strong light are lost it also shows up at multiples of its period."""
            is_near = np.hypot(one.u - other.u, one.v - other.v) < radius
            return bool(is_near and other.events > 2 * one.events)

        return [one for one in found if not any(is_echo_of(one, other) for other in found)]

    def _sighting(self, source: int, row: FloatArray) -> Sighting:
        """The light of a row of moments."""
        scatter = np.array([[row[_UU], row[_UV]], [row[_UV], row[_VV]]]) / row[_COUNT]
        # noise averages out over bursts, the error within a pixel only over the events of one switch, because
        # the same pixels answer every switch
        at_a_switch = max(1.0, row[_COUNT] / self._switches[source])
        locking = float(_PIXEL_VARIANCE / at_a_switch)
        systematic = locking + self._settings.sigma_floor**2
        covariance = scatter / max(row[_BURSTS], 1.0) + systematic * np.eye(2)
        place = float(row[_U]), float(row[_V])
        return Sighting(source, int(row[_TIME]), *place, covariance, locking, int(row[_COUNT]))


@cached_njit
def _match(
    events: Events,
    period_ns: IntArray,
    is_above: BoolArray,
    gap_ns: int,
    gate_ns: int,
    width: int,
    height: int,
    bursts: _Bursts,
    hits: _Hits,
) -> int:
    """Fill hits; returns their number."""
    count = 0
    for k in range(len(events.x)):
        x, y, now = events.x[k], events.y[k], events.time_ns[k]
        pixel = (int(events.is_on[k]) * height + y) * width + x
        is_new = now - bursts.event_ns[pixel] > gap_ns
        if is_new:
            # the light of this half of the image whose period is nearest to the time between bursts
            elapsed, nearest = now - bursts.begin_ns[pixel], gate_ns
            bursts.source[pixel] = -1
            for light in range(len(period_ns)):
                off = abs(elapsed - period_ns[light])
                if is_above[light] == (2 * y < height) and off < nearest:
                    nearest, bursts.source[pixel] = off, light
            bursts.begin_ns[pixel] = now
        bursts.event_ns[pixel] = now
        if bursts.source[pixel] >= 0:
            hits.source[count], hits.x[count], hits.y[count] = bursts.source[pixel], x, y
            hits.time_ns[count], hits.begins[count] = now, is_new
            count += 1
    return count


@cached_njit
def _locate(
    hits: _Hits, density: NDArray[np.int32], radius: float, min_events: int, moments: FloatArray
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
            # its events around the peak
            count, reach = 0, radius + _MAX_SHIFT_PX
            for k in range(len(hits.x)):
                du, dv = float(hits.x[k] - peak[source, 1]), float(hits.y[k] - peak[source, 2])
                if hits.source[k] == source and du * du + dv * dv <= reach * reach:
                    near[count] = k
                    count += 1
            _centre(hits, near[:count], peak[source], radius, moments[source])


@cached_njit
def _centre(hits: _Hits, near: IntArray, peak: IntArray, radius: float, row: FloatArray) -> None:
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


def direction(u: float, v: float, focal_px: float) -> tuple[float, float]:
    """Bearing to the left and elevation [rad] of a place (u, v) [px] off a level camera's optical axis."""
    x, y = -u / focal_px, -v / focal_px
    return math.atan(x), math.atan2(y, math.hypot(1.0, x))


def direction_jacobian(u: float, v: float, focal_px: float) -> FloatArray:
    """(2, 2) derivatives of bearing and elevation by u and v [rad/px]."""
    x, y = -u / focal_px, -v / focal_px
    ground = 1.0 + x * x
    length = ground + y * y
    root = math.sqrt(ground)
    by_xy = np.array([[1.0 / ground, 0.0], [-x * y / (root * length), root / length]])
    return np.asarray(-by_xy / focal_px)
