"""How good a map is: its walls against a floor plan, its stops against ground truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.mapping.mapper import CooperativeMapper

COVERED_M = 0.06
"""A piece of wall is covered if a cell so near is occupied."""
_SPACING_M = 0.01


class MapFigures(NamedTuple):
    """Figures of a map; NaN where there is nothing to compare with.

    Attributes:
        stops: How many stops have ground truth.
        position_m: RMS error of these.
        heading_rad: Likewise of their headings.
        wall_m: Mean distance of occupied cells from the nearest wall.
        coverage: Share of the walls with an occupied cell nearby.
    """

    stops: int
    position_m: float
    heading_rad: float
    wall_m: float
    coverage: float

    def sentence(self) -> str:
        """For people."""
        parts = []
        if self.stops:
            parts.append(
                f"{self.stops} stops within {100.0 * self.position_m:.1f} cm and"
                f" {math.degrees(self.heading_rad):.2f} deg RMS"
            )
        if not math.isnan(self.coverage):
            parts.append(f"{100.0 * self.coverage:.0f} % of the walls, {100.0 * self.wall_m:.1f} cm off")
        return "; ".join(parts)


def map_figures(mapper: CooperativeMapper, truth: Mapping[int, Trajectory], walls: FloatArray) -> MapFigures:
    """Figures of the map that a mapper has now.

    Args:
        mapper: Holds the map and the stops.
        truth: Number of a robot -> where it truly was, in map.
        walls: (S, 4) segments x0, y0, x1, y1 of the floor plan [m]; may be empty.
    """
    off = _stop_errors(mapper, truth)
    position = math.sqrt(np.mean(np.square(off[:, :2]).sum(axis=1))) if len(off) else math.nan
    heading = math.sqrt(np.mean(np.square(off[:, 2]))) if len(off) else math.nan
    occupancy = mapper.occupancy()
    cells = occupancy.centres(occupancy.occupied)
    if not len(walls) or not len(cells):
        return MapFigures(len(off), position, heading, math.nan, math.nan)
    points = _wall_points(walls)
    wall = float(cKDTree(points).query(cells)[0].mean())
    coverage = float((cKDTree(cells).query(points)[0] < COVERED_M).mean())
    return MapFigures(len(off), position, heading, wall, coverage)


def _stop_errors(mapper: CooperativeMapper, truth: Mapping[int, Trajectory]) -> FloatArray:
    """Estimated minus true poses (n, 3) of the stops that have ground truth."""
    errors = []
    for stop, begin_ns in mapper.begin_ns.items():
        track = truth.get(int(mapper.graph.robot[stop]))
        if track is not None:
            pose, known = interpolate(track, np.array([begin_ns]), DEFAULT_GAP_NS)
            errors += [mapper.graph.states[stop, :3] - pose[0]] if known[0] else []
    off = np.array(errors).reshape(-1, 3)
    off[:, 2] = wrap_angle(off[:, 2])
    return off


def _wall_points(walls: FloatArray) -> FloatArray:
    """Points (p, 2) in the middle of equal pieces of walls (S, 4)."""
    pieces = []
    for x0, y0, x1, y1 in walls:
        count = max(1, math.ceil(math.hypot(x1 - x0, y1 - y0) / _SPACING_M))
        share = ((np.arange(count) + 0.5) / count)[:, None]
        pieces.append(np.array([x0, y0]) + share * np.array([x1 - x0, y1 - y0]))
    return np.concatenate(pieces)
