"""Align new scans with those made before, and the scans around with the new one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarm_loc_estimator.core.mapping.matching.correlative_search import Lattice, search_offsets
from swarm_loc_estimator.core.mapping.pose_graph.graph import PoseGraph

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
_START_RADIUS, _START_AGAINST, _MIN_START_SCORE = 2.5, 6, 0.15


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


def align_start(graph: PoseGraph, parts: Sequence[int]) -> None:
    """Align the parts of a robot's first scan with each other and, as one body, with older scans."""
    others = [
        int(other)
        for other in np.argsort(graph.distances(parts[0]), kind="stable")
        if other < parts[0] and graph.distances(parts[0])[other] < _START_RADIUS
    ][:_START_AGAINST]
    if others:
        found = search_offsets(graph.scans, np.array(parts), np.array(others), _START_SEARCH)
        if found.score > _MIN_START_SCORE:
            graph.states[parts, :3] += found.offset
    for stop in parts:
        graph.targets[stop] = graph.neighbours(stop, _START_TARGETS, _MIN_START_OVERLAP)
        graph.match_both_ways(stop)
    graph.solve(6, gate=_GATE, stride=1)


def align_all(graph: PoseGraph) -> None:
    """Align all scans anew with all their beams: the final solution."""
    for stop in range(graph.count):
        graph.targets[stop] = graph.neighbours(stop, _FINAL_TARGETS, _MIN_FINAL_OVERLAP)
    graph.solve(5, stride=1)
    for stop in range(graph.count):
        graph.fit(stop)
