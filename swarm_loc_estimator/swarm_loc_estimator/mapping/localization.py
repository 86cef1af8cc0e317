"""Localization of scans: alignment with the map, loop closure, bearings of other robots' lights."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import between, wrap_angle
from swarm_loc_estimator.mapping.matching import (
    SEARCH_BEAMS,
    Lattice,
    accumulate,
    agreement,
    score,
    search_offsets,
)
from swarm_loc_estimator.mapping.pose_graph import PoseGraph
from swarm_loc_estimator.mapping.scans import LightSightings, ScanStop

# The constants of localization are checked by `make bench-pushbot`: corridor, office and ring, 20 seeds each.
_TARGETS, _MIN_OVERLAP = 7, 0.2  # Maximum number of stops that a stop is matched with; minimum share of beams
_START_TARGETS, _MIN_START_OVERLAP = 8, 0.08  # The same for a first scan
_FINAL_TARGETS, _MIN_FINAL_OVERLAP = 9, 0.35  # The same for the final solution
_GATE = 0.06  # Maximum distance of a matched beam from its line before a stop is aligned [m]
_MAX_SHIFT, _MAX_SHIFT_PER_METRE, _MAX_TURN = 0.10, 0.08, math.radians(5.0)
"""Maximum correction by alignment; larger ones are rejected in favour of odometry."""
_SOLVE_ALL_EVERY = 4
"""Number of stops between solutions; solving at every stop increases errors of closed loops by half."""
_RECENT = 8  # Number of newest stops per robot that are solved in between
_START_SEARCH = Lattice(0.3, 0.05, math.radians(12.0), math.radians(1.5))
_START_RADIUS, _START_AGAINST, _MIN_START_SCORE = 2.5, 48, 0.35
"""Radius [m], maximum number of targets (a first scan has ten parts), and minimum score of a start search."""
_MAX_START_SIGMAS, _LEAST_START_SHIFT = 4.0, 0.02
"""Maximum shift of a start pose: standard deviations, and in addition [m, rad]."""


_HELD_STEP, _HELD_TARGETS, _MIN_HELD_SCORE, _MIN_HELD_GAIN = 0.04, 6, 0.5, 1.0 / 3.0
"""Drives of a body that is held: step of the search along them [m], number of stops near each end that are
compared, minimum score of the place where it is, and by how much the score near the end is less."""


def driven_share(graph: PoseGraph, left: FloatArray, stop: int) -> float:
    """The share of a drive by odometry from a place (2,) that a robot has moved, by its scan at a new stop.

    An obstacle may hold a body whose wheels turn on. Then its scan fits at an earlier place of the drive, and
    clearly worse at its end. The stop is moved to where it fits.
    """
    place = graph.states[stop, :2]
    arrival, against = place.copy(), dict[int, None]()
    for end in (left, arrival):
        place[:] = end
        nearest = np.argsort(graph.distances(stop), kind="stable")[: _HELD_TARGETS + 1].tolist()
        against |= dict.fromkeys(one for one in nearest if one != stop)
    others, count = np.array(list(against)), math.ceil(math.dist(left, arrival) / _HELD_STEP)
    stride = max(1, int(graph.scans.beams.counts[stop]) // SEARCH_BEAMS)
    scores = np.zeros(count + 1)
    for step in range(count + 1):
        place[:] = arrival - (1.0 - step / max(1, count)) * (arrival - left)
        scores[step] = score(graph.scans, stop, others, stride)
    best = int(scores.argmax())
    is_held = scores[best] > max(_MIN_HELD_SCORE, scores[-3:].max() + _MIN_HELD_GAIN)
    share = best / count if is_held else 1.0
    place[:] = arrival - (1.0 - share) * (arrival - left)
    return share


def align(graph: PoseGraph, stop: int, path: float) -> bool:
    """Align the scan of a new stop with its neighbours; returns whether the correction was accepted.

    Args:
        graph: The graph; modified.
        stop: The newest stop.
        path: Length driven from the previous stop [m].
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
    """Align only the newest stop; restores it if the shift exceeds the limits."""
    predicted, slip = graph.states[stop].copy(), graph.slip.copy()
    graph.solve(4, [stop], _GATE)
    shift, turn = np.hypot(*(graph.states[stop] - predicted)[:2]), graph.states[stop, 2] - predicted[2]
    if shift <= _MAX_SHIFT + _MAX_SHIFT_PER_METRE * path and abs(turn) <= _MAX_TURN:
        return True
    graph.states[stop], graph.slip = predicted, slip
    graph.fit(stop)
    return False


def align_start(graph: PoseGraph, parts: Sequence[int], sigma: FloatArray, *, is_found: bool) -> bool:
    """Align the parts of a robot's first scan with each other and, as one body, with older scans.

    Returns whether older scans agree with the start pose.

    Args:
        graph: The graph; modified.
        parts: The newest stops, all at one place.
        sigma: (3,) standard deviations of the start pose. If older scans would move the robot by more than
            four of these, the alignment is rejected and the start pose is kept.
        is_found: Whether the start pose has been found in the map already, and is not searched again.
    """
    away = graph.distances(parts[0])
    others = [one for one in np.argsort(away, kind="stable") if one < parts[0] and away[one] < _START_RADIUS]
    given, states, slip = graph.states[parts[0]].copy(), graph.states.copy(), graph.slip.copy()
    if others and not is_found:
        against = np.array(others[:_START_AGAINST])
        found = search_offsets(graph.scans, np.array(parts), against, _START_SEARCH)
        if found.score > _MIN_START_SCORE:
            graph.states[parts, :3] += found.offset
    _match_parts(graph, parts, 0)
    off = np.abs(graph.states[parts[0], :3] - given[:3])
    if (off <= _MAX_START_SIGMAS * sigma + _LEAST_START_SHIFT).all():
        return True
    graph.states[:], graph.slip = states, slip
    for one, targets in graph.targets.items():
        graph.targets[one] = [other for other in targets if (one in parts) == (other in parts)]
    _match_parts(graph, parts, parts[0])
    return False


def _match_parts(graph: PoseGraph, parts: Sequence[int], oldest: int) -> None:
    """Match parts of a first scan with all stops from `oldest` on, and solve."""
    for stop in parts:
        near = graph.neighbours(stop, _START_TARGETS, _MIN_START_OVERLAP)
        graph.targets[stop] = [other for other in near if other >= oldest]
        graph.match_both_ways(stop)
    graph.solve(6, gate=_GATE, stride=1)
    for stop in range(graph.count):
        graph.fit(stop)


def align_all(graph: PoseGraph) -> None:
    """Align all scans with all their beams: the final solution."""
    scanned = np.flatnonzero(graph.scans.beams.counts[: graph.count]).tolist()
    for stop in scanned:
        graph.targets[stop] = graph.neighbours(stop, _FINAL_TARGETS, _MIN_FINAL_OVERLAP)
    graph.solve(5, stride=1)
    for stop in scanned:
        graph.fit(stop)


_KNOWN_SLIP, _SLIP_SIGMAS, _SLIP_STEP = 0.006, 3.5, 0.002
"""Standard deviation below which a slip counts as known, how far it is searched, and in which steps."""
_MIN_SLIP_BEAMS, _OFF_LOSS, _SLIP_WEIGHT = 50, 1.3, 0.5
"""Minimum number of matched beams, loss of a beam off its line, and weight of the losses (shared errors)."""


def find_slip(graph: PoseGraph, begin: int, stop: int) -> bool:
    """Search the slip of a robot that saw no wall twice so far, by its two newest scans.

    In the open nothing tells how much the wheels slip, and the heading becomes unknown with every scan. The
    slip that makes two scans of the same walls agree tells all headings since the start.

    Returns:
        Whether the slip is known, so that scans can be matched at the poses that odometry predicts.
    """
    robot = int(graph.robot[stop])
    if robot in graph.known_slips:
        return True
    sigma = graph.slip_sigma(robot)
    count = math.ceil(_SLIP_SIGMAS * sigma / _SLIP_STEP)
    changes = _SLIP_STEP * np.arange(-count, count + 1)
    before = graph.states[[begin, stop]].copy()
    costs, matched = np.zeros((2, changes.size))
    for number, change in enumerate(changes.tolist()):
        graph.change_slip(robot, change, (begin, stop))
        costs[number], matched[number] = _misfit(graph, begin, stop)
        graph.states[[begin, stop]] = before
    graph.change_slip(robot, 0.0, (begin, stop))
    chances = np.exp(-_SLIP_WEIGHT * (costs - costs.min()) - 0.5 * (changes / sigma) ** 2)
    mean = float(np.average(changes, weights=chances))
    spread = math.sqrt(float(np.average((changes - mean) ** 2, weights=chances)))
    if matched[np.argmin(costs)] < _MIN_SLIP_BEAMS or spread > _KNOWN_SLIP:
        return False
    graph.known_slips.add(robot)
    graph.slip[robot] += mean
    graph.change_slip(robot, mean)
    for one in (begin, stop):
        graph.targets[one] = graph.neighbours(one, _TARGETS, _MIN_OVERLAP)
        graph.match_both_ways(one)
    graph.solve(6, gate=_GATE)
    return True


def _misfit(graph: PoseGraph, begin: int, stop: int) -> tuple[float, int]:
    """Loss of the beams of two stops at the lines of the other one, and number of those that match."""
    pairs = [agreement(graph.scans, *pair, 0.0, 1) for pair in ((begin, stop), (stop, begin))]
    matched, tried, loss = (sum(values) for values in zip(*pairs, strict=True))
    return loss + _OFF_LOSS * (tried - matched), matched


_RADIUS, _MIN_AGE, _MIN_STOPS = 1.8, 10, 12
"""Loops: maximum distance [m] and minimum age in stops of an old stop, and minimum number of stops."""
_REACH, _MIN_REACH, _SIGMAS = 0.55, 0.15, 3.5  # Search: maximum and minimum reach [m], standard deviations
_TURN_REACH, _MIN_TURN_REACH = math.radians(9.0), math.radians(3.0)
_STEP, _TURN_STEP = 0.06, math.radians(1.5)
_MIN_SCORE, _MAX_OTHER = 0.35, 0.9  # Minimum score, and maximum score of another place relative to it
_MIN_FIT, _MAX_SIGMA, _MAX_SIGMAS = 0.5, 0.03, 4.0
"""Minimum share of matched beams, maximum sigma of the position [m], and maximum shift in sigmas."""
_TIE_ROOT = np.diag([1.0 / 0.03, 1.0 / 0.03, 1.0 / 0.012])
_LOOP_TARGETS, _MIN_LOOP_OVERLAP = 9, 0.2
_LOOP_GATE = 0.05  # Maximum distance of a matched beam from its line [m]


def close_loop(graph: PoseGraph, stop: int) -> bool:
    """Loop closure: tie the newest stop to unconnected old stops nearby; returns whether it succeeded.

    Afterwards the whole graph is solved.
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
    """Add a tie of a stop at a pose (3,) to the first of `against`, and solve the whole graph."""
    relative = between(graph.states[against[0], :3], pose)
    graph.constraints.ties.add(against[0], stop, relative, _TIE_ROOT)
    graph.solve(4)
    for one in dict.fromkeys([stop, *against]):
        graph.targets[one] = graph.neighbours(one, _LOOP_TARGETS, _MIN_LOOP_OVERLAP)
    graph.solve(4)


def refine(graph: PoseGraph, stop: int, against: list[int]) -> bool:
    """Align a stop with others, without odometry; returns whether it fits and is fully determined."""
    fit, H = 0.0, np.zeros((8, 8))
    for _ in range(4):
        H, g, fit = np.zeros((8, 8)), np.zeros(8), 0.0
        for other in against:
            matched, tried, _ = accumulate(graph.scans, stop, other, _LOOP_GATE, 1, H, g)
            fit = max(fit, matched / max(1, tried))
        held = H[:3, :3] + np.diag([1.0 / 0.05**2, 1.0 / 0.05**2, 1.0 / 0.03**2])
        graph.states[stop, :3] += np.linalg.solve(held, g[:3])
    return fit >= _MIN_FIT and bool(np.linalg.eigvalsh(H[:2, :2])[0] >= _MAX_SIGMA**-2.0)


def _unconnected(graph: PoseGraph, stop: int) -> list[int]:
    """Old stops nearby, nearest first, that are connected with this stop only over many others."""
    connected = {stop, *graph.targets.get(stop, ())}
    connected = connected.union(*(graph.targets.get(one, ()) for one in connected))
    away, robot = graph.distances(stop), graph.robot
    return [
        int(one)
        for one in np.argsort(away, kind="stable")
        if one not in connected
        and graph.scans.beams.counts[one]
        and away[one] < _RADIUS
        and (robot[one] != robot[stop] or stop - one > _MIN_AGE)
    ]


_MAX_PENDING = 20_000
_MAX_VISITS = 50
_LIGHT_OFFSET = 0.03  # Effective offset of a robot's lights from its centre, averaged over turns [m]
_LEAST_SIGMA = math.radians(1.0)


LOST = -1  #: In place of a stop in the graph


@dataclass(frozen=True)
class Visit:
    """A robot's stay at a stop."""

    robot: int  # Its number
    node: int  # Number of its stop in the graph; `LOST`: it is in none
    begin_ns: int  # First reading
    end_ns: int  # Last reading
    stop: ScanStop  # Its readings
    turn_begin: float  # Turn by odometry at which the node begins [rad]


class LightBetween(NamedTuple):
    """A bearing of a light between two stops."""

    seer: Visit  # Of the robot that sees it
    seen: Visit  # Of the other one
    turn: float  # Turn by odometry of the robot that sees it, since its node begins [rad]
    bearing: float  # In the frame of that robot [rad]


class LightBook:
    """Queue of the newest `_MAX_PENDING` sightings that wait until the stops of both robots are known."""

    def __init__(self) -> None:
        self._pending: deque[tuple[int, int, int, float]] = deque(maxlen=_MAX_PENDING)
        self._visits: dict[int, deque[Visit]] = {}
        self._until_ns: dict[int, int] = {}
        self.dropped = 0

    def add(self, robot: int, sightings: LightSightings) -> None:
        """Queue sightings (m,) by a robot."""
        columns = (sightings.stamp_ns.tolist(), sightings.target.tolist(), sightings.bearing.tolist())
        for stamp_ns, target, bearing in zip(*columns, strict=True):
            self.dropped += len(self._pending) == _MAX_PENDING
            self._pending.append((robot, target, stamp_ns, bearing))

    def note_visit(self, visit: Visit) -> None:
        """Record a stop that a robot has left."""
        self._visits.setdefault(visit.robot, deque(maxlen=_MAX_VISITS)).append(visit)

    def forget_node(self, node: int) -> None:
        """Remove a node's visits, as when its number is reused for another stop."""
        for robot, visits in self._visits.items():
            self._visits[robot] = deque((one for one in visits if one.node != node), maxlen=_MAX_VISITS)

    def note_time(self, robot: int, stamp_ns: int) -> None:
        """Mark all stops of a robot until this time as recorded."""
        self._until_ns[robot] = stamp_ns

    def settle(self, graph: PoseGraph) -> list[LightBetween]:
        """Add bearings with known stops to the graph, one per pair of stops; returns those of all stops."""
        found: dict[tuple[Visit, Visit], list[tuple[float, float]]] = defaultdict(list)
        for _ in range(len(self._pending)):
            one = self._pending.popleft()
            robot, target, stamp_ns, bearing = one
            if stamp_ns > min(self._until_ns.get(robot, 0), self._until_ns.get(target, 0)):
                self._pending.append(one)
                continue
            seer, seen = self._visit(robot, stamp_ns), self._visit(target, stamp_ns)
            if seer is not None and seen is not None:
                turn = seer.stop.turn_at(stamp_ns) - seer.turn_begin
                found[seer, seen].append((turn, bearing))
        sightings = []
        for (seer, seen), sighted in found.items():
            is_known = LOST not in (seer.node, seen.node)
            ratio = graph.states[seer.node, 3] if is_known else 1.0 - graph.slip[seer.robot]
            sightings.append(LightBetween(seer, seen, *_median(ratio, *np.array(sighted).T)))
            if is_known:
                _add_bearing(graph, sightings[-1])
        return sightings

    def _visit(self, robot: int, stamp_ns: int) -> Visit | None:
        """The stop of a robot at a time; None if it was driving."""
        for visit in self._visits.get(robot, ()):
            if visit.begin_ns <= stamp_ns <= visit.end_ns:
                return visit
        return None


def _median(ratio: float, turn: FloatArray, bearing: FloatArray) -> tuple[float, float]:
    """The turn by odometry, and median there, of bearings (n,) of a light: wheels slip, so of one passage."""
    off = wrap_angle(ratio * (turn - turn[0]) + bearing - bearing[0])
    middle = int(np.argsort(off, kind="stable")[len(off) // 2])
    passes = np.abs(turn - turn[middle]) < math.pi
    return float(turn[middle]), float(bearing[middle] + float(np.median(off[passes])) - off[middle])


def _add_bearing(graph: PoseGraph, sighting: LightBetween) -> None:
    """Add a bearing to the graph, unless the robots are too close."""
    seer, seen = sighting.seer.node, sighting.seen.node
    away = math.dist(graph.states[seer, :2], graph.states[seen, :2])
    if away > 2.0 * _LIGHT_OFFSET:
        sigma = math.hypot(_LEAST_SIGMA, _LIGHT_OFFSET / away)
        graph.constraints.bearings.add(seer, seen, sighting.turn, sighting.bearing, sigma)
