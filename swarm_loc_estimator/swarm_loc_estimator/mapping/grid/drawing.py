"""Draw what stops saw into a grid of log odds: free along their rays, occupied where they end."""

from __future__ import annotations

import math

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.mapping.scans.lines import BINS, LINE, POINT, UNKNOWN, Lines

_FREE, _HIT = 0.25, 0.9
"""Log odds that one ray tells."""
_POINT_HIT = 0.25
"""Share of that where something came back but no line could be told."""
_FREE_RANGE_SHARE = 0.76
"""Where nothing came back, space is free to this share of the range."""
_SHARP_M = 0.03
"""A wall that is known worse than this tells less of a cell."""


@cached_njit
def draw_stop(
    log_odds: FloatArray,
    corner: FloatArray,
    cell: float,
    pose: FloatArray,
    stop: int,
    lines: Lines,
    max_range: float,
) -> None:
    """Add the evidence of a stop to a grid; what lies outside is left out.

    Args:
        log_odds: (nx, ny).
        corner: (2,) lower left corner of the grid in map [m].
        cell: [m].
        pose: (3,) of the stop.
        stop: Its number.
        lines: Of all stops.
        max_range: Of the laser [m].
    """
    for m in range(BINS):
        kind, distance = lines.kind[stop, m], lines.distance[stop, m]
        if kind == UNKNOWN:
            continue
        hit, end = 0.0, _FREE_RANGE_SHARE * max_range
        if kind == LINE:
            sigma = distance * distance * math.sqrt(lines.variance[stop, m])
            hit, end = _HIT / (1.0 + (sigma / _SHARP_M) ** 2), distance - 0.03 - 1.5 * sigma
        elif kind == POINT:
            hit, end = _HIT * _POINT_HIT, distance - 0.12 - 0.02 * distance * distance
        angle = pose[2] + (m + 0.5) * 2.0 * math.pi / BINS
        cos, sin = math.cos(angle) / cell, math.sin(angle) / cell
        x, y = (pose[0] - corner[0]) / cell, (pose[1] - corner[1]) / cell
        _draw_free(log_odds, x, y, cos, sin, end, 0.7 * cell)
        i, j = math.floor(x + distance * cos), math.floor(y + distance * sin)
        if hit > 0.0 and 0 <= i < log_odds.shape[0] and 0 <= j < log_odds.shape[1]:
            log_odds[i, j] += hit


@cached_njit
def _draw_free(
    log_odds: FloatArray, x: float, y: float, cos: float, sin: float, end: float, step: float
) -> None:
    """Lower each cell along a ray from (x, y) in cells, whose direction is in cells per metre, once."""
    last_i, last_j = -1, -1
    for k in range(int(end / step) + 1 if end > 0.0 else 0):
        i, j = math.floor(x + k * step * cos), math.floor(y + k * step * sin)
        if (i != last_i or j != last_j) and 0 <= i < log_odds.shape[0] and 0 <= j < log_odds.shape[1]:
            log_odds[i, j] -= _FREE
        last_i, last_j = i, j
