"""Evaluation of the curves S, E and A of a board in compiled code: values and slopes."""

from __future__ import annotations

import math

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.swarm.ir_curves import CurveTable


@cached_njit
def curve_at(table: CurveTable, angle: float) -> tuple[float, float]:
    """The value and slope [1/rad] of a curve at an angle [rad] of any size."""
    a = angle - 2.0 * math.pi * math.floor(angle * (0.5 / math.pi) + 0.5)
    edges = table.edges
    piece = 0
    while piece < edges.size - 2 and a >= edges[piece + 1]:
        piece += 1
    per_radian = table.per_radian[piece]
    place = (a - edges[piece]) * per_radian
    cell = min(max(int(place), 0), table.cubics.shape[1] - 1)
    return _cubic_at(table.cubics[piece, cell], place - cell, per_radian)


@cached_njit
def curves_at(
    table: CurveTable, angles: FloatArray, piece: FloatArray, values: FloatArray, slopes: FloatArray
) -> None:
    """Write the values and slopes of `curve_at` at many angles (k,), without a branch.

    Args:
        table: The curve.
        angles: Any angles [rad]; wrapped in place.
        piece: (k,) workspace for the index of the piece that contains each angle.
        values: (k,) written.
        slopes: (k,) written [1/rad].
    """
    edges, cells = table.edges, table.cubics.shape[1]
    for k in range(angles.size):
        angles[k] -= 2.0 * math.pi * math.floor(angles[k] * (0.5 / math.pi) + 0.5)
        piece[k] = 0.0
    for edge in edges[1:-1]:
        for k in range(angles.size):
            piece[k] += 1.0 if angles[k] >= edge else 0.0
    for k in range(angles.size):
        here = int(piece[k])
        per_radian = table.per_radian[here]
        place = (angles[k] - edges[here]) * per_radian
        cell = min(max(int(place), 0), cells - 1)
        values[k], slopes[k] = _cubic_at(table.cubics[here, cell], place - cell, per_radian)


@cached_njit
def _cubic_at(c: FloatArray, t: float, per_radian: float) -> tuple[float, float]:
    """The value and slope [1/rad] of one cell's cubic at t in [0, 1]."""
    return c[0] + t * (c[1] + t * (c[2] + t * c[3])), (c[1] + t * (2.0 * c[2] + 3.0 * t * c[3])) * per_radian


@cached_njit
def amplitude_at(law: FloatArray, r: float) -> tuple[float, float]:
    """The brightness [count] of an aligned pair at a distance [m], and its slope [count/m].

    Args:
        law: (5,) the fields of `Amplitude` in their order.
        r: The distance.
    """
    closeness = _closeness(law, r)
    return _amplitude(law, r, closeness, closeness * closeness if law[2] == 2.0 else closeness ** law[2])


@cached_njit
def amplitudes_at(law: FloatArray, r: FloatArray, values: FloatArray, slopes: FloatArray) -> None:
    """Write the values and slopes of `amplitude_at` at many distances (k,)."""
    if law[2] == 2.0:  # a separate loop, since one with a power is not vectorized
        for k in range(r.size):
            closeness = _closeness(law, r[k])
            values[k], slopes[k] = _amplitude(law, r[k], closeness, closeness * closeness)
    else:
        for k in range(r.size):
            values[k], slopes[k] = amplitude_at(law, r[k])


@cached_njit
def _closeness(law: FloatArray, r: float) -> float:
    """One over the distance from the law's pole [1/m]."""
    return 1.0 / float(max(r, law[4]) + law[1])


@cached_njit
def _amplitude(law: FloatArray, r: float, closeness: float, power: float) -> tuple[float, float]:
    """The law's value and slope; `power` is the closeness raised to the law's exponent."""
    value = law[0] * power
    slope = -law[2] * value * closeness
    return value + law[3] + slope * min(r - law[4], 0.0), slope


@cached_njit
def distance_at(law: FloatArray, brightness: float) -> float:
    """The distance [m] at which an aligned pair has this brightness [count], eq. (22); infinite if none.

    The printed 118 is the root of 14000, rounded.
    """
    above = brightness - law[3]
    if above <= 0.0:
        return math.inf
    top, slope = amplitude_at(law, law[4])
    if brightness > top:
        return float(max(law[4] + (brightness - top) / slope, 0.0))
    ratio = law[0] / above
    return float((math.sqrt(ratio) if law[2] == 2.0 else ratio ** (1.0 / law[2])) - law[1])
