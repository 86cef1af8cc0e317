"""Which blinking lights are looked for, and how."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.number_spec import number

MAX_SOURCES = 32
"""A pixel's burst remembers by bits which lights it may belong to."""


@dataclass(frozen=True)
class LightSource:
    """A light that blinks.

    Attributes:
        frequency: [Hz].
        is_above: Whether it is in the upper half of the image, as LEDs of other robots, or in the lower half,
            as the own laser's spot.
    """

    frequency: float
    is_above: bool

    @property
    def period_ns(self) -> int:
        """[ns]."""
        return round(1e9 / self.frequency)


@dataclass(frozen=True)
class TrackerSettings:
    """How blinking lights are tracked."""

    window: float = number(0.02, "s", 0.002, 1.0, "of events that make one report")
    burst_gap: float = number(
        2.5e-4, "s", 1e-5, 0.01, "silence of a pixel before an event that begins a burst"
    )
    period_gate: float = number(
        6e-5, "s", 1e-6, 1e-3, "how far the time between two bursts may be from the light's period"
    )
    radius: float = number(3.5, "px", 1.0, 20.0, "of the part of the image whose events make a light's place")
    min_events: int = number(8, "1", 2, 1000, "in time within 3 x 3 pixels, fewer are no light")
    sigma_floor: float = number(
        0.02, "px", 0.0, 2.0, "standard deviation of a place that more events do not reduce, per axis"
    )


class Sighting(NamedTuple):
    """A light in one window.

    Attributes:
        source: Index of the light.
        stamp_ns: Mean time of its events [ns].
        u: Column of its centre [px].
        v: Row [px].
        covariance: (2, 2) over u, v [px^2].
        locking: What of each variance is the bias within pixels, the same whenever the light is there [px^2].
        events: That its place was computed from.
    """

    source: int
    stamp_ns: int
    u: float
    v: float
    covariance: FloatArray
    locking: float
    events: int


class WindowReport(NamedTuple):
    """What one window showed.

    Attributes:
        stamp_ns: Its middle [ns].
        sightings: Of the lights that were seen, at most one each, by source.
    """

    stamp_ns: int
    sightings: tuple[Sighting, ...]
