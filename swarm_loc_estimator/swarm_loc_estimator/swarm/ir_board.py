"""Infrared boards as data: arrangement, curves and errors of the elements.

Sensor and emitter of the same number are side by side on a circle about the origin of base_link, both facing
outwards. There are at least three of each.
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
"""Powers of the emitters in the order of BrightnessMatrix's POWER_* constants; the second is optional."""
MAX_ELEMENTS = 32
GAIN_RANGE = (0.05, 20.0)
_TOGETHER = 1e-3  # Minimum angle between two elements [rad]


class ReadingErrors(NamedTuple):
    """Error model of readings; a separate tuple, because passing a whole model per reading is slow."""

    noise: float  # Standard deviation of a reading [count]
    relative: float  # Additional standard deviation relative to the expected reading [1]
    systematic: float  # Share of the relative variance that is systematic
    blocked: float  # Maximum cost of a reading that may be blocked; infinite: never blocked
    bright: float  # Maximum cost of a reading that may be too bright


class IrModel(NamedTuple):
    """A platform for compiled code."""

    radius: float  # Distance from the centre to the elements [m]
    angles: FloatArray  # (n,) directions of the elements in base_link [rad]
    units: FloatArray  # (n, 2) their unit vectors
    sensor: CurveTable  # The curve S
    emitter: CurveTable  # The curve E
    amplitudes: FloatArray  # (modes, 5) the fields of `Amplitude`
    saturation: float  # Readings at or above are only lower bounds [count]
    noise: float  # Standard deviation of a reading [count]
    errors: ReadingErrors  # Error model of readings
    stray: float  # Additional noise, relative to the brightest reading of an exchange
    scale: float  # Factor on covariances


@dataclass(frozen=True)
class IrPlatform:
    """An infrared board.

    Raises:
        IrPlatformError: A number is out of range, elements coincide, or dark_level reaches saturation.
    """

    # (n,) directions of the elements in base_link [rad], counter-clockwise positive
    angles: tuple[float, ...]
    sensor: AngleCurve  # S, sensor reading over the angle of incidence
    emitter: AngleCurve  # E, emitted light over the angle to the emitter's axis
    amplitudes: tuple[Amplitude, ...]  # A for each power of the emitters, in the order of `POWERS`
    radius: float = number(0.022, "m", 0.0, 10.0, "from the centre to the elements", above=True)
    saturation: float = number(255.0, "count", 0.0, 1e9, "readings from here on are lower bounds", above=True)
    dark_level: float = number(0.0, "count", -1e6, 1e6, "mean reading without light")
    noise: float = number(1.0, "count", 0.0, 1e6, "standard deviation of every reading", above=True)
    relative_noise: float = number(0.0, "1", 0.0, 1.0, "additional noise, relative to the reading")
    stray_noise: float = number(
        0.0,
        "1",
        0.0,
        1.0,
        "additional noise, relative to the brightest reading: light reflected by bodies and floor",
    )
    curve_sigma: float = number(
        0.0, "1", 0.0, 1.0, "relative systematic error of the curves, one standard deviation"
    )
    blocked_share: float = number(0.02, "1", 0.0, 0.5, "share of readings darkened by an obstacle; 0: none")
    bright_share: float = number(
        0.0, "1", 0.0, 0.5, "share of readings with light that is not in the model; 0: none"
    )
    covariance_scale: float = number(
        1.0, "1", 1.0, 1e3, "factor on covariances, for errors with longer tails than the noise"
    )
    element_sigma: float = number(
        0.1, "1", 0.0, 1.0, "relative standard deviation of the gains of elements; 0: equal elements"
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
        """Number of sensors, and of emitters."""
        return len(self.angles)

    @property
    def powers(self) -> tuple[str, ...]:
        """Names of its powers, in the order of the first axis of readings."""
        return POWERS[: len(self.amplitudes)]

    @property
    def relative(self) -> float:
        """Relative standard deviation of readings, in addition to `noise`."""
        return math.hypot(self.relative_noise, self.curve_sigma)

    @cached_property
    def model(self) -> IrModel:
        """The platform for compiled code."""
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

    Raises:
        IrPlatformError: A factor is not in [0.05, 20], sizes differ, or an element does not exist.
    """

    sensor: tuple[float, ...]  # (n,) factors of the sensors [1]
    emitter: tuple[float, ...]  # (n,) factors of the emitters [1]
    sigma: float = number(0.0, "1", 0.0, 1.0, "how unsure each factor still is, relative, by itself")
    common_sigma: float = number(0.0, "1", 0.0, 1.0, "how unsure all of a robot's factors are together")
    dead_sensors: tuple[int, ...] = ()  # Numbers of sensors to ignore
    dead_emitters: tuple[int, ...] = ()  # Numbers of emitters to ignore

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
        """Gains of a robot that was never calibrated."""
        ones = (1.0,) * platform.n
        return cls(ones, ones, platform.element_sigma)


class PairGains(NamedTuple):
    """Gains of k pairs of robots, for the models."""

    sensor: FloatArray  # (k, n) gains of each receiver's sensors; NaN: dead
    emitter: FloatArray  # (k, n) gains of each transmitter's emitters; NaN: dead
    sigma: FloatArray  # (k, 4) individual and common sigma of the receiver's sensors, then of the emitters

    @classmethod
    def of(cls, receivers: list[IrGains], transmitters: list[IrGains]) -> PairGains:
        """Gains of pairs of a receiver and a transmitter."""
        pairs = list(zip(receivers, transmitters, strict=True))
        return cls(
            _without(np.array([r.sensor for r, _ in pairs]), [r.dead_sensors for r, _ in pairs]),
            _without(np.array([t.emitter for _, t in pairs]), [t.dead_emitters for _, t in pairs]),
            np.array([(r.sigma, r.common_sigma, t.sigma, t.common_sigma) for r, t in pairs]),
        )


def _without(factors: FloatArray, dead: list[tuple[int, ...]]) -> FloatArray:
    """Factors (k, n) with NaN for dead elements."""
    for row, elements in zip(factors, dead, strict=True):
        row[list(elements)] = np.nan
    return factors


class IrMethod(Enum):
    """Method to estimate a relative pose from brightness."""

    LIKELIHOOD = "likelihood"  # maximum likelihood over all readings of all powers
    CLOSED_FORM = "closed_form"  # eqs (9)-(18) of the Droplet paper, corrected


@dataclass(frozen=True)
class RobotIr:
    """The infrared board of one robot."""

    id: int  #: Id in its exchanges, 1 to 65535, unique in the swarm
    platform: IrPlatform  #: Model of the board
    source: str  #: Name of a packaged platform, or absolute path of its file
    estimator: IrMethod = IrMethod.LIKELIHOOD  #: Method to estimate poses
    gains: IrGains | None = None  #: Calibrated gains of its elements; None: never calibrated
    dead_sensors: tuple[int, ...] = ()  #: Numbers of sensors to ignore
    dead_emitters: tuple[int, ...] = ()  #: Numbers of emitters to ignore
    gate_probability: float = number(
        0.9999, "1", 0.5, 1.0, "share of good measurements that must pass the gate; 1 passes all"
    )

    @property
    def believed_gains(self) -> IrGains:
        """Gains of the description, or unknown gains, with the dead elements."""
        gains = self.gains or IrGains.unknown(self.platform)
        return replace(gains, dead_sensors=self.dead_sensors, dead_emitters=self.dead_emitters)
