"""Align new scans with those made before, and the scans around with the new one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.mapping.matching.correlative_search import Lattice, search_offsets
from swarm_loc_estimator.mapping.pose_graph.graph import PoseGraph

_TARGETS, _MIN_OVERLAP = 7, 0.2
_START_TARGETS, _MIN_START_OVERLAP = 8, 0.08
_FINAL_TARGETS, _MIN_FINAL_OVERLAP = 9, 0.35
_GATE = 0.06
_MAX_SHIFT, _MAX_SHIFT_PER_METRE, _MAX_TURN = 0.10, 0.08, math.radians(5.0)
"""A scan that alignment moves further than odometry can be wrong is left where odometry put it."""
_SOLVE_ALL_EVERY = 4
"""At every stop it is worse: a closed ring then gets half as precise again."""
_RECENT = 8
_START_SEARCH = Lattice(0.3, 0.05, math.radians(12.0), math.radians(1.5))
_START_RADIUS, _START_AGAINST, _MIN_START_SCORE = 2.5, 48, 0.35
"""A first scan has ten parts: against a dozen would be against those of the nearest robot alone."""
_MAX_START_SIGMAS, _LEAST_START_SHIFT = 4.0, 0.02


def align(graph: PoseGraph, stop: int, path: float) -> bool:
    """Align the scan of a new stop with those around; whether it fitted where odometry had put it.

    Args:
        graph: Is changed.
        stop: The newest.
        path: Driven from the stop before [m].
    """
    graph.targets[stop] = graph.neighbours(stop, _TARGETS, _MIN_OVERLAP)
    fitted = _align_alone(graph, stop, path) if graph.targets[stop] else True
    graph.targets[stop] = graph.neighbours(stop, _TARGETS, _MIN_OVERLAP)
    graph.match_both_ways(stop)
    if graph.count % _SOLVE_ALL_EVERY == 0:
        graph.solve(3)
    else:
        recent = range(max(0, graph.count - _RECENT * len(graph.slip)), graph.count)
        graph.solve(2, {*recent, *graph.targets[stop]})
    return fitted


def _align_alone(graph: PoseGraph, stop: int, path: float) -> bool:
    """Move the newest stop only, and back again where that cannot be."""
    predicted, slip = graph.states[stop].copy(), graph.slip.copy()
    graph.solve(4, [stop], _GATE)
    shift, turn = np.hypot(*(graph.states[stop] - predicted)[:2]), graph.states[stop, 2] - predicted[2]
    if shift <= _MAX_SHIFT + _MAX_SHIFT_PER_METRE * path and abs(turn) <= _MAX_TURN:
        return True
    graph.states[stop], graph.slip = predicted, slip
    graph.fit(stop)
    return False


def align_start(graph: PoseGraph, parts: Sequence[int], sigma: FloatArray) -> None:
    """Align the parts of a robot's first scan with each other and, as one body, with older scans.

    Args:
        graph: Is changed.
        parts: The newest stops, all at one place.
        sigma: (3,) how well that is known. Where older scans would move it further than four of these, they
            are not believed, and the robot is left where it was said to be.
    """
    away = graph.distances(parts[0])
    others = [one for one in np.argsort(away, kind="stable") if one < parts[0] and away[one] < _START_RADIUS]
    told, states, slip = graph.states[parts[0]].copy(), graph.states.copy(), graph.slip.copy()
    if others:
        against = np.array(others[:_START_AGAINST])
        found = search_offsets(graph.scans, np.array(parts), against, _START_SEARCH)
        if found.score > _MIN_START_SCORE:
            graph.states[parts, :3] += found.offset
    _match_parts(graph, parts, 0)
    if (np.abs(graph.states[parts[0], :3] - told[:3]) > _MAX_START_SIGMAS * sigma + _LEAST_START_SHIFT).any():
        graph.states[:], graph.slip = states, slip
        for one, targets in graph.targets.items():
            graph.targets[one] = [other for other in targets if (one in parts) == (other in parts)]
        _match_parts(graph, parts, parts[0])


def _match_parts(graph: PoseGraph, parts: Sequence[int], oldest: int) -> None:
    """Match parts of a first scan with stops from the oldest on, and solve."""
    for stop in parts:
        near = graph.neighbours(stop, _START_TARGETS, _MIN_START_OVERLAP)
        graph.targets[stop] = [other for other in near if other >= oldest]
        graph.match_both_ways(stop)
    graph.solve(6, gate=_GATE, stride=1)
    for stop in range(graph.count):
        graph.fit(stop)


def align_all(graph: PoseGraph) -> None:
    """Align all scans anew with all their beams: the final solution."""
    for stop in range(graph.count):
        graph.targets[stop] = graph.neighbours(stop, _FINAL_TARGETS, _MIN_FINAL_OVERLAP)
    graph.solve(5, stride=1)
    for stop in range(graph.count):
        graph.fit(stop)
