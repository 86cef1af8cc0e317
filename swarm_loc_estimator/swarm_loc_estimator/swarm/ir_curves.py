"""Response curves of sensors, emitters and distance: the models S, E and A of a board.

Angle curves are data, either pieces of sums of powers, as the Droplet paper prints (19) and (20), or a table.
Both are sampled once into piecewise cubics with exact joints, which are fast to evaluate and have the exact
one-sided slopes at a kink.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import number, number_specs

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_CELLS = 128  # Number of cubics per piece; the error for the curves of the Droplet is 2e-6
_TABLE_CELLS = 720  # Number of cubics of a tabulated curve, which has no kinks: half a degree each
_JOINT = 0.01  # Maximum jump at a joint, relative to the curve's maximum; rounded printed joints have 1e-4


class IrPlatformError(ValueError):
    """An invalid platform; the message is one sentence with key and value."""


def check_numbers(holder: DataclassInstance, prefix: str = "") -> None:
    """Check that the numbers of a dataclass lie in their declared ranges.

    Raises:
        IrPlatformError: A number is out of range.
    """
    for name, spec in number_specs(type(holder)).items():
        value = getattr(holder, name)
        if not spec.allows(value):
            raise IrPlatformError(f"{prefix}{name} is {value:g} but must lie in {spec.range_text}.")


class CurveTable(NamedTuple):
    """A curve over [-pi, pi] in the form used by compiled code."""

    edges: FloatArray  # (P + 1,) boundaries of the pieces [rad]
    per_radian: FloatArray  # (P,) cells per radian of each piece
    cubics: FloatArray  # (P, cells, 4) coefficients of powers of t in [0, 1] across the cell, constant first

    @classmethod
    def of(cls, edges: FloatArray, cubics: FloatArray) -> CurveTable:
        """A table from the boundaries of pieces and their cubics."""
        return cls(edges, cubics.shape[1] / np.diff(edges), cubics)


@dataclass(frozen=True)
class PowerPiece:
    """A sum of powers of the absolute angle, up to a maximum."""

    below: float  # Start of the next piece [rad]; pi for the last
    terms: tuple[tuple[float, float], ...]  # Pairs (coefficient, exponent) of coefficient * |angle|^exponent


@dataclass(frozen=True)
class PowerCurve:
    """A symmetric curve in pieces, such as eqs (19) and (20) of the Droplet paper.

    Raises:
        IrPlatformError: Pieces do not ascend to pi, do not meet, or are not finite and positive.
    """

    pieces: tuple[PowerPiece, ...]

    def __post_init__(self) -> None:
        ends = [0.0, *(piece.below for piece in self.pieces)]
        if any(not low < high for low, high in itertools.pairwise(ends)) or ends[-1] != math.pi:
            raise IrPlatformError(f"pieces end at {ends[1:]} rad but must ascend from 0 to pi.")
        table = self.table()
        _check(table)
        highest = float(table.cubics[..., 0].max())
        for left, right in itertools.pairwise(self.pieces):
            before, after = (float(_powers(p.terms, np.array(left.below))[0]) for p in (left, right))
            if abs(before - after) > _JOINT * highest:
                raise IrPlatformError(
                    f"pieces do not meet at {left.below:g} rad, where they are {before:.4g} and {after:.4g}."
                )

    def table(self) -> CurveTable:
        """The curve in the form used by compiled code."""
        edges = np.array([0.0, *(piece.below for piece in self.pieces)])
        half = [
            _cubics(*_powers(piece.terms, np.linspace(begin, piece.below, _CELLS + 1)), piece.below - begin)
            for begin, piece in self._spans()
        ]
        mirror = [cubics[::-1] @ _BACKWARDS for cubics in half[::-1]]
        return CurveTable.of(np.concatenate([-edges[:0:-1], edges]), np.array([*mirror, *half]))

    def _spans(self) -> list[tuple[float, PowerPiece]]:
        """The start of each piece [rad], and the piece."""
        begins = [0.0, *(piece.below for piece in self.pieces[:-1])]
        return list(zip(begins, self.pieces, strict=True))


@dataclass(frozen=True)
class TabulatedCurve:
    """A curve given at angles, interpolated without overshoot; it need not be symmetric.

    Raises:
        IrPlatformError: Sizes do not fit, angles do not ascend, or values are not finite and positive.
    """

    # (K,) ascending within [-pi, pi] [rad]; the curve is constant beyond the first and last
    angles: tuple[float, ...]
    values: tuple[float, ...]  # (K,) non-negative values at these angles [1]

    def __post_init__(self) -> None:
        if len(self.angles) < 2 or len(self.angles) != len(self.values):
            raise IrPlatformError(
                f"table has {len(self.angles)} angles and {len(self.values)} values but must have as many of"
                " both, at least two."
            )
        ascends = all(a < b for a, b in itertools.pairwise(self.angles))
        if not ascends or self.angles[0] < -math.pi or self.angles[-1] > math.pi:
            raise IrPlatformError(f"angles are {list(self.angles)} but must ascend within [-pi, pi] rad.")
        _check(self.table())

    def table(self) -> CurveTable:
        """The curve in the form used by compiled code."""
        curve = scipy.interpolate.PchipInterpolator(self.angles, self.values)
        at = np.linspace(-math.pi, math.pi, _TABLE_CELLS + 1)
        within = np.clip(at, self.angles[0], self.angles[-1])
        slopes = np.where(at == within, curve.derivative()(within), 0.0)
        return CurveTable.of(at[[0, -1]], _cubics(curve(within), slopes, 2.0 * math.pi)[None])


AngleCurve = PowerCurve | TabulatedCurve


@dataclass(frozen=True)
class Amplitude:
    """Brightness of an aligned pair at a distance r: scale / (r + offset)^exponent + background.

    Eq. (21) of the Droplet paper has a pole at 3 cm and is invalid at shorter distances. Below `nearest` the
    curve is extrapolated along its tangent, which keeps it finite and monotonic.

    Raises:
        IrPlatformError: The pole is not nearer than `nearest`.
    """

    scale: float = number(1.4, "count m^exponent", 0.0, 1e9, "brightness at a distance of 1 m", above=True)
    offset: float = number(0.0, "m", -1.0, 1.0, "added to the distance")
    exponent: float = number(2.0, "1", 0.0, 10.0, "how fast brightness falls", above=True)
    background: float = number(0.0, "count", -1e6, 1e6, "added to every reading before S and E")
    nearest: float = number(0.0, "m", 0.0, 1.0, "closest distance of the law, nearer it is linear")

    def __post_init__(self) -> None:
        check_numbers(self)
        if self.nearest + self.offset <= 0.0:
            raise IrPlatformError(
                f"nearest is {self.nearest:g} m but must be beyond the pole at {-self.offset:g} m."
            )


def _powers(terms: tuple[tuple[float, float], ...], size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values and slopes of a sum of powers."""
    with np.errstate(divide="ignore", invalid="ignore"):
        value = sum((c * size**e for c, e in terms), np.zeros_like(size))
        slope = sum((c * e * size ** (e - 1.0) for c, e in terms if e != 0.0), np.zeros_like(size))
    return value, slope


_BACKWARDS = np.array(
    [[1.0, 0.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0], [1.0, -2.0, 1.0, 0.0], [1.0, -3.0, 3.0, -1.0]]
)
"""Right factor that converts coefficients of powers of t into those of powers of 1 - t."""


def _cubics(values: FloatArray, slopes: FloatArray, length: float) -> FloatArray:
    """(cells, 4) cubics through equidistant values with these slopes."""
    if not (np.isfinite(values).all() and np.isfinite(slopes).all()):
        raise IrPlatformError("curve is not finite everywhere within [-pi, pi] rad.")
    width = length / (len(values) - 1)
    v0, v1, s0, s1 = values[:-1], values[1:], width * slopes[:-1], width * slopes[1:]
    return np.stack([v0, s0, 3.0 * (v1 - v0) - 2.0 * s0 - s1, 2.0 * (v0 - v1) + s0 + s1], axis=-1)


def _check(table: CurveTable) -> None:
    """Check that a curve is nowhere negative and not zero everywhere."""
    values = table.cubics[..., 0]
    if values.min() < 0.0:
        raise IrPlatformError(f"curve falls to {values.min():.4g} but must not be negative.")
    if values.max() <= 0.0:
        raise IrPlatformError("curve is zero everywhere.")
