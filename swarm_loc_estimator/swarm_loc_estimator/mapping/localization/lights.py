"""Lights of other robots: bearings from stop to stop, once it is known where both robots stood."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from dataclasses import dataclass

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.mapping.pose_graph.graph import PoseGraph
from swarm_loc_estimator.mapping.readings import LightSightings
from swarm_loc_estimator.mapping.stops import Stop

_MAX_PENDING = 20_000
_MAX_VISITS = 50
_LIGHT_OFFSET = 0.03
"""How far a robot's lights are from its middle, of which turning leaves this [m]."""
_LEAST_SIGMA = math.radians(1.0)


@dataclass(frozen=True)
class Visit:
    """When a robot stood where.

    Attributes:
        node: Number of its stop in the graph.
        begin_ns: First reading.
        end_ns: Last reading.
        stop: Its readings.
        turn_begin: Turn by odometry at which the node begins [rad].
    """

    node: int
    begin_ns: int
    end_ns: int
    stop: Stop
    turn_begin: float


class LightBook:
    """Sightings that wait until the stops of both robots are known, the newest `_MAX_PENDING` of them."""

    def __init__(self) -> None:
        self._pending: deque[tuple[int, int, int, float]] = deque(maxlen=_MAX_PENDING)
        self._visits: dict[int, deque[Visit]] = {}
        self._until_ns: dict[int, int] = {}
        self.dropped = 0

    def add(self, robot: int, sightings: LightSightings) -> None:
        """Take sightings (m,) by a robot."""
        columns = (sightings.stamp_ns.tolist(), sightings.target.tolist(), sightings.bearing.tolist())
        for stamp_ns, target, bearing in zip(*columns, strict=True):
            self.dropped += len(self._pending) == _MAX_PENDING
            self._pending.append((robot, target, stamp_ns, bearing))

    def note_visit(self, robot: int, visit: Visit) -> None:
        """A robot has left where it stood."""
        self._visits.setdefault(robot, deque(maxlen=_MAX_VISITS)).append(visit)

    def forget_node(self, node: int) -> None:
        """The number of a stop is given to another one."""
        for robot, visits in self._visits.items():
            self._visits[robot] = deque((one for one in visits if one.node != node), maxlen=_MAX_VISITS)

    def note_time(self, robot: int, stamp_ns: int) -> None:
        """Where a robot stood until a time is known."""
        self._until_ns[robot] = stamp_ns

    def settle(self, graph: PoseGraph) -> None:
        """Give the graph the bearings that are known now; one for each pair of stops."""
        found: dict[tuple[int, int], list[float]] = defaultdict(list)
        for _ in range(len(self._pending)):
            one = self._pending.popleft()
            robot, target, stamp_ns, bearing = one
            if stamp_ns > min(self._until_ns.get(robot, 0), self._until_ns.get(target, 0)):
                self._pending.append(one)
                continue
            seer, seen = self._visit(robot, stamp_ns), self._visit(target, stamp_ns)
            if seer is not None and seen is not None:
                turn = seer.stop.turn_at(stamp_ns) - seer.turn_begin
                found[seer.node, seen.node].append(turn + bearing)
        for (seer_node, seen_node), turns in found.items():
            _add_bearing(graph, seer_node, seen_node, np.array(turns))

    def _visit(self, robot: int, stamp_ns: int) -> Visit | None:
        """The stop of a robot at a time; None: it drove."""
        for visit in self._visits.get(robot, ()):
            if visit.begin_ns <= stamp_ns <= visit.end_ns:
                return visit
        return None


def _add_bearing(graph: PoseGraph, seer: int, seen: int, turns: FloatArray) -> None:
    """One bearing from the directions (n,) in which a light was seen, as turns by odometry [rad]."""
    middle = turns[0] + float(np.median(wrap_angle(turns - turns[0])))
    away = math.dist(graph.states[seer, :2], graph.states[seen, :2])
    if away > 2.0 * _LIGHT_OFFSET:
        sigma = math.hypot(_LEAST_SIGMA, _LIGHT_OFFSET / away)
        graph.constraints.add_bearing(seer, seen, middle, sigma)
