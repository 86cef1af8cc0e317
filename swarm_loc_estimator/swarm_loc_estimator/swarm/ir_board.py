"""Infrared boards as data: arrangement, curves and errors of the elements.

The sensor and the emitter of one number sit side by side, on a circle about the origin of base_link, both
looking outwards. Any number of them from three on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import number, number_specs
from swarm_loc_estimator.swarm.ir_curves import (
    Amplitude,
    AngleCurve,
    CurveTable,
    IrPlatformError,
    check_numbers,
)

POWERS = ("far", "near")
"""Powers of the emitters in the order of BrightnessMatrix's POWER_* constants; only the first is a must."""
MAX_ELEMENTS = 32
GAIN_RANGE = (0.05, 20.0)
_TOGETHER = 1e-3
"""Two elements closer than this are one [rad]."""


class ReadingErrors(NamedTuple):
    """Errors of readings, as numbers only, since passing a whole model for every reading is slow.

    Attributes:
        noise: Of every reading, one standard deviation [count].
        relative: Standard deviation besides, relative to the expectation [1].
        systematic: The share of this in variance that is the same every time.
        blocked: The scale on which the cost of a reading that may be blocked ends; infinite: none is.
        bright: That scale for a reading that may be too bright.
    """

    noise: float
    relative: float
    systematic: float
    blocked: float
    bright: float


class IrModel(NamedTuple):
    """A platform as compiled code reads it.

    Attributes:
        radius: From the centre to the elements [m].
        angles: (n,) directions of the elements in base_link [rad].
        units: (n, 2) their unit vectors.
        sensor: The curve S.
        emitter: The curve E.
        amplitudes: (modes, 5) the fields of `Amplitude`.
        saturation: Readings at or above are only lower bounds [count].
        noise: Of every reading, one standard deviation [count].
        errors: How readings err.
        stray: Noise besides, relative to the brightest reading of an exchange.
        scale: What covariances are multiplied by.
    """

    radius: float
    angles: FloatArray
    units: FloatArray
    sensor: CurveTable
    emitter: CurveTable
    amplitudes: FloatArray
    saturation: float
    noise: float
    errors: ReadingErrors
    stray: float
    scale: float


@dataclass(frozen=True)
class IrPlatform:
    """An infrared board.

    Attributes:
        angles: (n,) directions of the elements in base_link [rad], counter-clockwise positive.
        sensor: S, how a sensor's reading falls with the angle of incidence.
        emitter: E, how an emitter's light falls with the angle to its axis.
        amplitudes: A for each power of the emitters, in the order of `POWERS`.

    Raises:
        IrPlatformError: A number is out of its range, elements coincide, or it is too bright in the dark.
    """

    angles: tuple[float, ...]
    sensor: AngleCurve
    emitter: AngleCurve
    amplitudes: tuple[Amplitude, ...]
    radius: float = number(0.022, "m", 0.0, 10.0, "from the centre to the elements", above=True)
    saturation: float = number(255.0, "count", 0.0, 1e9, "a reading tells no more from here on", above=True)
    dark_level: float = number(
        0.0, "count", -1e6, 1e6, "what sensors read on average where there is no light"
    )
    noise: float = number(1.0, "count", 0.0, 1e6, "standard deviation of every reading", above=True)
    relative_noise: float = number(0.0, "1", 0.0, 1.0, "noise besides, relative to the reading")
    stray_noise: float = number(
        0.0,
        "1",
        0.0,
        1.0,
        "noise besides, relative to the brightest reading: light by way of bodies and floor",
    )
    curve_sigma: float = number(
        0.0, "1", 0.0, 1.0, "how far readings are off the curves, relative, the same every time"
    )
    blocked_share: float = number(
        0.02, "1", 0.0, 0.5, "share of readings that something in between darkens; 0: none ever"
    )
    bright_share: float = number(
        0.0, "1", 0.0, 0.5, "share of readings that show light which the model has not; 0: none ever"
    )
    covariance_scale: float = number(
        1.0, "1", 1.0, 1e3, "what covariances are multiplied by, since errors have longer tails than noise"
    )
    element_sigma: float = number(
        0.1, "1", 0.0, 1.0, "how much elements differ, relative, one standard deviation; 0: not at all"
    )

    def __post_init__(self) -> None:
        check_numbers(self)
        if not 3 <= self.n <= MAX_ELEMENTS:
            raise IrPlatformError(f"angles has {self.n} elements but must have 3 to {MAX_ELEMENTS}.")
        if not all(math.isfinite(angle) and abs(angle) <= 2.0 * math.pi for angle in self.angles):
            raise IrPlatformError(f"angles is {list(self.angles)} but must lie within [-2 pi, 2 pi] rad.")
        ahead = np.sort(np.mod(self.angles, 2.0 * math.pi))
        if np.min(np.diff(ahead, append=ahead[0] + 2.0 * math.pi)) < _TOGETHER:
            raise IrPlatformError(f"angles is {list(self.angles)} but no two elements may coincide.")
        if self.dark_level >= self.saturation:
            raise IrPlatformError(
                f"dark_level is {self.dark_level:g} count but must be below saturation, {self.saturation:g}."
            )
        if not 1 <= len(self.amplitudes) <= len(POWERS):
            raise IrPlatformError(f"amplitudes has {len(self.amplitudes)} powers but must have one or two.")

    @property
    def n(self) -> int:
        """How many sensors, and emitters."""
        return len(self.angles)

    @property
    def powers(self) -> tuple[str, ...]:
        """The names of its powers, in the order of readings' first axis."""
        return POWERS[: len(self.amplitudes)]

    @property
    def relative(self) -> float:
        """By how much readings are off besides `noise`, relative, one standard deviation."""
        return math.hypot(self.relative_noise, self.curve_sigma)

    @cached_property
    def model(self) -> IrModel:
        """What compiled code reads."""
        angles = np.array(self.angles)
        laws = [[getattr(law, name) for name in number_specs(Amplitude)] for law in self.amplitudes]
        errors = ReadingErrors(
            self.noise,
            self.relative,
            (self.curve_sigma / self.relative) ** 2 if self.relative else 0.0,
            -math.log(self.blocked_share) if self.blocked_share else math.inf,
            -math.log(self.bright_share) if self.bright_share else math.inf,
        )
        return IrModel(
            self.radius,
            angles,
            np.stack([np.cos(angles), np.sin(angles)], axis=-1),
            self.sensor.table(),
            self.emitter.table(),
            np.array(laws),
            self.saturation,
            self.noise,
            errors,
            self.stray_noise,
            self.covariance_scale,
        )

    def unknown_gains(self, count: int) -> PairGains:
        """Gains of pairs of robots that were never calibrated."""
        sigma = np.zeros((count, 4))
        sigma[:, ::2] = self.element_sigma
        ones = np.ones((count, self.n))
        return PairGains(ones, ones, sigma)


@dataclass(frozen=True)
class IrGains:
    """Gains of one robot's elements relative to its platform.

    Attributes:
        sensor: (n,) factors of the sensors [1].
        emitter: (n,) factors of the emitters [1].
        dead_sensors: Numbers of sensors whose readings mean nothing.
        dead_emitters: Numbers of emitters whose light means nothing.

    Raises:
        IrPlatformError: A factor is not in [0.05, 20], sizes differ, or there is no such element.
    """

    sensor: tuple[float, ...]
    emitter: tuple[float, ...]
    sigma: float = number(0.0, "1", 0.0, 1.0, "how unsure each factor still is, relative, by itself")
    common_sigma: float = number(0.0, "1", 0.0, 1.0, "how unsure all of a robot's factors are together")
    dead_sensors: tuple[int, ...] = ()
    dead_emitters: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if len(self.sensor) != len(self.emitter):
            raise IrPlatformError(
                f"gains have {len(self.sensor)} sensors and {len(self.emitter)} emitters"
                " but must have as many of both."
            )
        for name in ("sensor", "emitter"):
            for value in getattr(self, name):
                low, high = GAIN_RANGE
                if not low <= value <= high:
                    raise IrPlatformError(
                        f"gains.{name} has {value:g} but factors must lie in [{low:g}, {high:g}]."
                    )
        for name in ("dead_sensors", "dead_emitters"):
            if wrong := [k for k in getattr(self, name) if not 0 <= k < len(self.sensor)]:
                raise IrPlatformError(
                    f"{name} has {wrong[0]} but elements are numbered 0 to {len(self.sensor) - 1}."
                )
        check_numbers(self, "gains.")

    @classmethod
    def unknown(cls, platform: IrPlatform) -> IrGains:
        """Of a robot that was never calibrated."""
        ones = (1.0,) * platform.n
        return cls(ones, ones, platform.element_sigma)


class PairGains(NamedTuple):
    """Gains of k pairs of robots, as the models take them.

    Attributes:
        sensor: (k, n) of each receiver's sensors; NaN: dead, what it reads means nothing.
        emitter: (k, n) of each transmitter's emitters; NaN: dead.
        sigma: (k, 4) own and common sigma of the receiver's sensors, then of the transmitter's emitters.
    """

    sensor: FloatArray
    emitter: FloatArray
    sigma: FloatArray

    @classmethod
    def of(cls, receivers: list[IrGains], transmitters: list[IrGains]) -> PairGains:
        """Of pairs."""
        pairs = list(zip(receivers, transmitters, strict=True))
        return cls(
            _without(np.array([r.sensor for r, _ in pairs]), [r.dead_sensors for r, _ in pairs]),
            _without(np.array([t.emitter for _, t in pairs]), [t.dead_emitters for _, t in pairs]),
            np.array([(r.sigma, r.common_sigma, t.sigma, t.common_sigma) for r, t in pairs]),
        )


def _without(factors: FloatArray, dead: list[tuple[int, ...]]) -> FloatArray:
    """Factors (k, n) with NaN for elements that are dead."""
    for row, elements in zip(factors, dead, strict=True):
        row[list(elements)] = np.nan
    return factors


class IrMethod(Enum):
    """How brightness becomes a relative pose."""

    LIKELIHOOD = "likelihood"  # the most likely pose of all readings of all powers
    CLOSED_FORM = "closed_form"  # eqs (9)-(18) of the Droplet paper, corrected


@dataclass(frozen=True)
class RobotIr:
    """The infrared board of one robot.

    Attributes:
        id: By which its exchanges name it, 1 to 65535, unique in the swarm.
        platform: What the board is.
        source: Name of a packaged platform, or absolute path of the file that it comes from.
        estimator: How what it reads becomes a pose.
        gains: What is known of its elements; None: never calibrated.
        dead_sensors: Numbers of sensors whose readings mean nothing.
        dead_emitters: Numbers of emitters whose light means nothing.
    """

    id: int
    platform: IrPlatform
    source: str
    estimator: IrMethod = IrMethod.LIKELIHOOD
    gains: IrGains | None = None
    dead_sensors: tuple[int, ...] = ()
    dead_emitters: tuple[int, ...] = ()
    gate_probability: float = number(
        0.9999, "1", 0.5, 1.0, "share of good measurements that must pass the gate; 1 passes all"
    )

    @property
    def believed_gains(self) -> IrGains:
        """The gains to use: those described, or unknown ones, with the dead elements."""
        gains = self.gains or IrGains.unknown(self.platform)
        return replace(gains, dead_sensors=self.dead_sensors, dead_emitters=self.dead_emitters)
