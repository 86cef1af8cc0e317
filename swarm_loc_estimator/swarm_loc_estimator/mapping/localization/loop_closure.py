"""Loop closure: search a scan among old ones that it should overlap, and tie it to them if it fits there."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import between
from swarm_loc_estimator.mapping.matching.beam_matching import accumulate
from swarm_loc_estimator.mapping.matching.correlative_search import Lattice, search_offsets
from swarm_loc_estimator.mapping.pose_graph.graph import PoseGraph

_RADIUS, _MIN_AGE, _MIN_STOPS = 1.8, 10, 12
_REACH, _MIN_REACH, _SIGMAS = 0.55, 0.15, 3.5
_TURN_REACH, _MIN_TURN_REACH = math.radians(9.0), math.radians(3.0)
_STEP, _TURN_STEP = 0.06, math.radians(1.5)
_MIN_SCORE, _MAX_OTHER = 0.35, 0.9
_MIN_FIT, _MAX_SIGMA, _MAX_SIGMAS = 0.5, 0.03, 4.0
_TIE_SIGMA = np.array([0.03, 0.03, 0.012])
_TARGETS, _MIN_OVERLAP = 9, 0.2
_GATE = 0.05


def close_loop(graph: PoseGraph, stop: int) -> bool:
    """Tie the newest stop to old ones nearby that nothing connects it with; whether it was tied.

    The whole graph is solved anew then.
    """
    if graph.count < _MIN_STOPS:
        return False
    candidates = _unconnected(graph, stop)
    if not candidates:
        return False
    nearest = candidates[0]
    against = [one for one in candidates if abs(one - nearest) <= 6][:2]
    sigma, turn_sigma = graph.relative_sigma(stop, nearest)
    lattice = Lattice(
        min(_REACH, max(_MIN_REACH, _SIGMAS * sigma)),
        _STEP,
        min(_TURN_REACH, max(_MIN_TURN_REACH, _SIGMAS * turn_sigma)),
        _TURN_STEP,
    )
    found = search_offsets(graph.scans, np.array([stop]), np.array(against), lattice)
    if found.score < _MIN_SCORE or found.other > _MAX_OTHER * found.score:
        return False
    before = graph.states[stop].copy()
    graph.states[stop, :3] += found.offset
    fits = refine(graph, stop, against)
    pose, shift = graph.states[stop, :3].copy(), np.hypot(*(graph.states[stop] - before)[:2])
    graph.states[stop] = before
    if not fits or shift > _MAX_SIGMAS * max(sigma, 0.04) + 0.05:
        return False
    tie(graph, stop, pose, against)
    return True


def tie(graph: PoseGraph, stop: int, pose: FloatArray, against: list[int]) -> None:
    """Tie a stop, whose pose (3,) has been found, to the first of others, and solve everything."""
    relative = between(graph.states[against[0], :3], pose)
    graph.constraints.add_tie(against[0], stop, relative, _TIE_SIGMA)
    graph.solve(4)
    for one in dict.fromkeys([stop, *against]):
        graph.targets[one] = graph.neighbours(one, _TARGETS, _MIN_OVERLAP)
    graph.solve(4)


def refine(graph: PoseGraph, stop: int, against: list[int]) -> bool:
    """Align a stop with others only, without odometry; whether it fits and is held in all directions."""
    fit, H = 0.0, np.zeros((8, 8))
    for _ in range(4):
        H, g, fit = np.zeros((8, 8)), np.zeros(8), 0.0
        for other in against:
            matched, tried = accumulate(graph.scans, stop, other, _GATE, 1, H, g)
            fit = max(fit, matched / max(1, tried))
        held = H[:3, :3] + np.diag([1.0 / 0.05**2, 1.0 / 0.05**2, 1.0 / 0.03**2])
        graph.states[stop, :3] += np.linalg.solve(held, g[:3])
    return fit >= _MIN_FIT and bool(np.linalg.eigvalsh(H[:2, :2])[0] >= _MAX_SIGMA**-2.0)


def _unconnected(graph: PoseGraph, stop: int) -> list[int]:
    """Old stops nearby, the nearest first, that are neither matched with this one nor with its targets."""
    near = {stop, *graph.targets.get(stop, ())}
    connected = near.union(*(graph.targets.get(one, ()) for one in near))
    away, robot = graph.distances(stop), graph.robot
    return [
        int(one)
        for one in np.argsort(away, kind="stable")
        if one not in connected
        and away[one] < _RADIUS
        and (robot[one] != robot[stop] or stop - one > _MIN_AGE)
    ]
