"""Sweeps of lidars in the pose graph: each is matched with the newest ones and with old ones near.

A match is a tie of the graph with the covariance of its score. Ties with old sweeps are loops: they are
believed if several places in a row say the same, and taken back if the graph contradicts them.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import between, compose, inverse, transform_points, wrap_angle
from swarm_loc_estimator.mapping.correlation import (
    BestPose,
    PointField,
    PoseWindow,
    field_of,
    gather,
    match,
    outline,
    score_at,
    thin,
)
from swarm_loc_estimator.mapping.grid import DrawnSweep
from swarm_loc_estimator.mapping.pose_graph import PairRows, PoseGraph, doubled
from swarm_loc_estimator.mapping.scans import MAX_BEAMS, ScanStop

# The constants were chosen on freiburg-101, acapulco and intel, `_LOOK_EVERY` by the cost in freiburg-079.
_APART, _FAR, _MIN_POINTS = 0.08, 18.0, 20
"""Distance of points of a sweep [m], up to which distance they are matched [m], and their least number."""
_RECENT, _RECENT_PATH = 15, 10.0  # Newest sweeps that the next one is matched with: number, path [m]
_REACH, _REACH_PER_M, _MAX_REACH = 0.35, 1.2, 2.0  # Search for a sweep: offset, per path, and greatest [m]
_TURN, _TURN_SHARE, _MAX_TURN = math.radians(30.0), 0.5, math.radians(50.0)
"""Search for its heading: turn [rad], share of the turn by odometry, and greatest [rad]."""
_PREDICTED, _PREDICTED_PER_M, _PREDICTED_TURN = 0.10, 0.25, math.radians(5.0)
"""Standard deviations of the prediction [m], per path, and of its heading [rad]."""
_ANYWHERE = PoseWindow(2.5, math.pi, math.inf, math.inf)  # For a sweep that does not fit the prediction
_GOOD, _LESS, _BETTER = 0.5, 0.8, 0.15
"""Score, and share of the usual one, below which it is searched elsewhere, and is there if so much better."""
_MIN_SCORE = 0.30  # Least score of a sweep among the newest ones
_CONTRADICTS = 16.0
"""Squared difference, in variances, from which a match and odometry, or a tie and all else, contradict."""
_MEMORY, _MAX_SQUARE = 0.05, 400.0  # Weight of a new difference in the noise of odometry, and its maximum
_KNOWN = 0.3  # Greatest deviation of a match from which that noise is learned [m]
_LOOK_EVERY = 1.5  # Path after which old sweeps are looked for again [m]
_OLD = 20  # Sweeps of the same robot in between from which one is old
_NEAR, _REFERENCE, _REFERENCE_WAY = 3.0, 20, 5.0
"""Distance of old sweeps that are matched [m], their number, and greatest way between them [m]."""
_QUERY, _QUERY_PATH, _QUERY_POINTS = 6, 3.5, 300
"""Newest sweeps that are matched as one body: number, path [m], and number of points."""
_DRIFT, _DRIFT_PER_M, _MAX_DRIFT = 0.3, 0.04, 4.0
"""Search for loops: offset [m], per way through the graph, and greatest [m]."""
_SPIN, _SPIN_PER_M, _MAX_SPIN = math.radians(4.0), math.radians(0.4), math.radians(30.0)
_LOOP_SCORE, _RIVAL, _LOOP_RIDGE = 0.5, 0.88, 0.16
"""Least score of a loop, share of it that no other place reaches, and its greatest deviation [m]."""
_SHORT = 12.0  # Way up to which one tie is believed [m]
_AGREE, _AGREE_PER_M, _AGREE_TURN = 0.15, 0.04, math.radians(2.5)
"""By how much ties of loops may differ [m], per way between them, and in heading [rad]."""
_TOGETHER, _SPAN, _MAX_GAP = 3, 1.0, 8.0
"""Ties of a loop that must agree: number, least way between the first and the last, and greatest [m]."""
_EVERYWHERE_EVERY, _EVERYWHERE_PATH, _EVERYWHERE_SCORE = 2.0, 12.0, 0.6
"""Path after which a robot with an unknown start is looked for again [m], its newest path of which sweeps are
compared [m], and its least score."""
_SOLVE, _SOLVE_SHARE = 9.0, 0.03
"""Squared residual of a tie, in variances, and share of the stops with new ties, from which all is solved."""
_DOUBT_EVERY, _DOUBT_NEAR, _DOUBT_SHARE, _DOUBT_APART = 4, 1.0, 0.6, 2.0
"""Sweeps that are checked, how near others are that see the same [m], share of the best score that they must
have, and distance of places [m]."""
_TORN_M, _TORN_TURN = 0.25, math.radians(5.0)  # Offset from which a place is torn, and no wall just blurred
_DOUBT_WINDOW = PoseWindow(1.0, math.radians(10.0), math.inf, math.inf)
_REFINED = PoseWindow(0.35, math.radians(4.0), math.inf, math.inf)  # Search of `SweepMap.refine`
_UNTIED_M = 1.0  # Way that counts for a sweep that fits nothing [m], and three times its path


class LoopTie(NamedTuple):
    """A match of a new sweep with an old one."""

    begin: int  # The old one
    end: int  # The new one
    pose: FloatArray  # (3,) of the new one in the frame of the old one
    root: FloatArray  # (3, 3) square root of its information
    way: float  # Path through the graph between them before [m]


@dataclass
class Chain:
    """The sweeps of one robot."""

    nodes: list[int] = field(default_factory=list)
    path: list[float] = field(default_factory=list)  # Driven until each [m]
    noise: FloatArray = field(default_factory=lambda: np.ones(2))  # Of paths and turns, over the described
    searched: float = 0.0  # Driven until it was looked for everywhere [m]
    score: float = 0.0  # Usual one of its sweeps
    looked: float = 0.0  # Driven until old ones were looked for [m]
    floats: bool = False  # Whether nobody knows where its robot began
    pending: list[LoopTie] = field(default_factory=list)  # That are not believed yet

    def newest(self, count: int, path: float) -> list[int]:
        """The newest sweeps, at most `count` on the last `path` [m]."""
        since = self.path[-1] - path
        pairs = zip(self.nodes[-count:], self.path[-count:], strict=True)
        return [node for node, driven in pairs if driven > since]


class _Points:
    """Points on walls of all sweeps, in the frames of their robots."""

    def __init__(self) -> None:
        self._points = np.zeros((4096, 2))
        self._used = 0
        self._first: IntArray = np.zeros(64, dtype=np.int64)
        self.counts: IntArray = np.zeros(64, dtype=np.int64)  # (capacity,) of each node
        self.middle = np.zeros((64, 2))  # (capacity, 2) median of each node [m]

    def set(self, node: int, points: FloatArray) -> None:
        """Set the points (n, 2) of a node."""
        while node >= len(self.counts):
            self._first, self.counts, self.middle = map(doubled, (self._first, self.counts, self.middle))
        while self._used + len(points) > len(self._points):
            self._points = doubled(self._points)
        self._points[self._used : self._used + len(points)] = points
        self._first[node], self.counts[node] = self._used, len(points)
        self._used += len(points)
        self.middle[node] = np.median(points, axis=0) if len(points) else 0.0

    def at(self, nodes: IntArray, poses: FloatArray) -> FloatArray:
        """Points (m, 2) of nodes (n,) at poses (n, 3)."""
        moved: FloatArray = gather(self._points, self._first[nodes], self.counts[nodes], poses)
        return moved


class _GraphWays:
    """Ways through the graph: edges of which the length says how much two stops may be off."""

    def __init__(self) -> None:
        self._edges = PairRows(1)

    def add(self, begin: int, end: int, length: float) -> None:
        """Add an edge with a length [m]."""
        self._edges.add(begin, end, length + 1e-3)

    def cut(self, *stops: int) -> None:
        """Remove all edges of one stop, or those of two."""
        begin, end, _ = self._edges.columns
        self._edges.remove(np.isin(begin, stops).astype(int) + np.isin(end, stops) == len(stops))

    def lengths(self, node: int, count: int, limit: float = np.inf) -> FloatArray:
        """Lengths (count,) of the shortest ways from a stop, up to a limit [m]."""
        begin, end, length = self._edges.columns
        graph = csr_matrix((length[:, 0], (begin, end)), shape=(count, count))
        lengths: FloatArray = dijkstra(graph, directed=False, indices=node, limit=limit)
        return lengths


class SweepMap:
    """Matches sweeps of all robots; see the module.

    Args:
        graph: The pose graph; modified.

    Attributes:
        drawn: Node -> its beams.
        loops: Ties with old sweeps that are believed.
        contradicted: Nodes to which odometry and scans say different motions.
        refused: Nodes of which the sweeps fit nothing.
        taken_back: Number of ties that were believed and then contradicted.
        matched: Robot -> the newest node of which the sweep fits, and the covariance (3, 3) of its match.
    """

    def __init__(self, graph: PoseGraph) -> None:
        self.drawn: dict[int, DrawnSweep] = {}
        self.loops: list[LoopTie] = []
        self.contradicted: list[int] = []
        self.refused: list[int] = []
        self.taken_back = 0
        self.matched: dict[int, tuple[int, FloatArray]] = {}
        self._graph = graph
        self._chains: defaultdict[int, Chain] = defaultdict(Chain)
        self._points, self._walls, self._ways = _Points(), _Points(), _GraphWays()
        self._unsolved = 0
        self._refined: list[LoopTie] = []  # Ties of the last solution, and for how many stops and loops
        self._refined_for = (0, 0)

    def begin(self, node: int, stop: ScanStop, *, floats: bool = False) -> None:
        """Note the first sweep of a robot, or the first since it was lost; `floats`: its start is unknown."""
        chain = self._chains[int(self._graph.robot[node])]
        chain.floats = floats
        chain.nodes, chain.path, chain.pending = [node], [0.0], []
        self._note(node, stop)

    def add(self, begin: int, node: int, stop: ScanStop, motion: FloatArray, sigma: FloatArray) -> bool:
        """Match the newest sweep, at its pose by odometry; returns whether it fits.

        Args:
            begin: The robot's sweep before.
            node: The new stop in the graph.
            stop: Its beams.
            motion: (3,) by odometry since `begin`.
            sigma: (3,) standard deviations of it as described: along [m], across [m], heading [rad].
        """
        chain = self._chains[int(self._graph.robot[node])]
        points = self._note(node, stop)
        path = math.hypot(motion[0], motion[1])
        found = self._match_newest(chain, node, points, motion)
        odometry = sigma * chain.noise[[0, 0, 1]]
        fits = found is not None and found.score >= _MIN_SCORE
        if found is not None and fits:
            usual = chain.score or found.score
            chain.score = usual + _MEMORY * (found.score - usual)
            self.matched[int(self._graph.robot[node])] = node, found.covariance
            odometry = self._fuse(chain, begin, node, found, motion, sigma)
        elif len(points) >= _MIN_POINTS:
            self.refused.append(node)
            odometry = np.maximum(odometry, [0.1 + 0.3 * path, 0.1 + 0.3 * path, _PREDICTED_TURN])
        self._graph.constraints.departures.add(begin, node, 0.0, motion, odometry)
        self._ways.add(begin, node, path if fits else 3.0 * path + _UNTIED_M)
        chain.nodes.append(node)
        chain.path.append(chain.path[-1] + path)
        if fits and chain.path[-1] - chain.looked > _LOOK_EVERY:
            chain.looked = chain.path[-1]
            self._close_loops(chain, node)
        return fits

    def place(self, node: int, stop: ScanStop) -> FloatArray | None:
        """The only pose (3,) near a robot's newest sweep that explains the next one; None: none does.

        It is for robots of whose motion nothing is known.
        """
        newest = self._newest(self._chains[int(self._graph.robot[node])])
        points = _outlines(beams_of(stop))[0]
        if newest is None or len(points) < _MIN_POINTS:
            return None
        found = match(newest, points, self._graph.states[node, :3], _ANYWHERE, _RIVAL, _GOOD)
        return found.pose if found.score > _GOOD and not found.rival else None

    def drop(self, node: int) -> None:
        """Take back a sweep."""
        if self.drawn.pop(node, None) is None:  # the stop of a robot with a laser pointer
            return
        self._points.counts[node] = self._walls.counts[node] = 0
        self._ways.cut(node)
        self.loops = [one for one in self.loops if node not in one[:2]]
        for chain in self._chains.values():
            chain.pending = [one for one in chain.pending if node not in one[:2]]

    def _note(self, node: int, stop: ScanStop) -> FloatArray:
        """Keep a sweep; returns its points (n, 2)."""
        beams = self.drawn[node] = beams_of(stop)
        points, walls = _outlines(beams)
        self._points.set(node, points)
        self._walls.set(node, walls)
        return points

    def locate(self, stop: ScanStop, pose: FloatArray, motion: FloatArray) -> FloatArray:
        """The pose (3,) of a sweep in the map, near one by odometry after a motion (3,)."""
        points = _outlines(beams_of(stop))[0]
        nodes = np.flatnonzero(self._points.counts[: self._graph.count])
        if len(points) < _MIN_POINTS or not len(nodes):
            return pose
        off = self._middles(nodes) - transform_points(pose, np.median(points, axis=0))
        nearest = int(nodes[np.argmin(np.hypot(off[:, 0], off[:, 1]))])
        field = self._around(nearest, self._points.counts[: self._graph.count] > 0)
        found = match(field, points, pose, _window(motion))
        return found.pose if found.score >= _MIN_SCORE else pose

    def _revisits(self, nodes: IntArray, near: float) -> Iterator[tuple[int, int, FloatArray, PointField]]:
        """Nodes whose places were seen at another time: also a sweep of then, own points, and the field."""
        counts = self._points.counts[: self._graph.count]
        all_nodes = np.flatnonzero(counts >= _MIN_POINTS)
        for node in nodes.tolist():
            is_other = counts >= _MIN_POINTS
            is_other[max(0, node - _OLD) : node + _OLD] = False
            off = self._middles(all_nodes) - self._middles(np.array([node]))
            away = np.where(is_other[all_nodes], np.hypot(*off.T), np.inf)
            if away.min(initial=np.inf) <= near:
                other = int(all_nodes[np.argmin(away)])
                points = self._points.at(np.array([node]), np.zeros((1, 3)))
                yield node, other, points, self._around(other, is_other)

    def refine(self) -> None:
        """Tie all sweeps with those that saw the same at other times, where they fit best near by.

        It is done twice, the second time from better poses; nothing is done if nothing is new.
        """
        new = self._graph.count, len(self.loops)
        for _ in range(2 * (new != self._refined_for)):
            self._tie_revisits()
        self._refined_for = new

    def _tie_revisits(self) -> None:
        graph, tied = self._graph, {frozenset(one[:2]) for one in self.loops}
        self._drop_refined(self._refined)
        nodes = np.flatnonzero(self._points.counts[: graph.count] >= _MIN_POINTS)
        nodes = nodes[~self.floating()[nodes]]  # stops of robots without a lidar have no points
        for node, other, points, known in self._revisits(nodes, _DOUBT_NEAR):
            found = match(known, points, graph.states[node, :3], _REFINED)
            is_sure = found.score >= _LOOP_SCORE and _ridge(found.covariance) < _LOOP_RIDGE
            if is_sure and frozenset((other, node)) not in tied:
                tied.add(frozenset((other, node)))
                there = graph.states[other, :3]
                root = root_of(_turned(found.covariance, -there[2]))
                self._refined.append(LoopTie(other, node, between(there, found.pose), root, 0.0))
        for one in self._refined:
            graph.constraints.ties.add(*one[:4])
        if self._refined:
            graph.solve(3)
            self._drop_refined([one for one in self._refined if _square(one, graph.states) > _CONTRADICTS])

    def _drop_refined(self, ties: list[LoopTie]) -> None:
        self._untie(ties)
        self._refined = [one for one in self._refined if one not in ties]

    def doubts(self) -> FloatArray:
        """Places (n, 2) in map where sweeps fit nothing, or fit others elsewhere better [m]."""
        graph, count = self._graph, self._graph.count
        nodes = np.flatnonzero(self._points.counts[:count] >= _MIN_POINTS)
        refused = np.array([one for one in self.refused if self._points.counts[one]], dtype=np.int64)
        alone, places = set(refused.tolist()), []
        for some, near in ((nodes[::_DOUBT_EVERY], _DOUBT_NEAR), (refused, _NEAR)):
            for node, _, points, known in self._revisits(some, near):
                alone.discard(node)
                # whether this one fits those around it clearly better elsewhere
                pose = graph.states[node, :3].copy()
                here, best = score_at(known, points, pose), match(known, points, pose, _DOUBT_WINDOW)
                x, y, turn = between(pose, best.pose)
                is_apart = math.hypot(x, y) > _TORN_M or abs(turn) > _TORN_TURN
                if is_apart and here < _GOOD and here < _DOUBT_SHARE * best.score:
                    places.append(pose[:2])
        places += [graph.states[node, :2] for node in sorted(alone)]
        kept: list[FloatArray] = []
        for place in places:
            if all(math.dist(place, one) > _DOUBT_APART for one in kept):
                kept.append(place)
        return np.array(kept).reshape(-1, 2)

    def _at(self, points: _Points, nodes: list[int]) -> FloatArray:
        """Points (n, 2) of sweeps, or along walls that they have met, in map [m]."""
        return points.at(np.array(nodes, dtype=np.int64), self._graph.poses[nodes])

    def _newest(self, chain: Chain) -> PointField | None:
        """The field of the newest sweeps of a robot; None: too little was seen."""
        others = self._at(self._walls, chain.newest(_RECENT, _RECENT_PATH))
        return field_of(others) if len(others) >= _MIN_POINTS else None

    def _match_newest(
        self, chain: Chain, node: int, points: FloatArray, motion: FloatArray
    ) -> BestPose | None:
        """Match points (n, 2) of a sweep with the newest ones of its robot; None: too little is seen."""
        newest = self._newest(chain)
        if len(points) < _MIN_POINTS or newest is None:
            return None
        found = match(newest, points, self._graph.states[node, :3], _window(motion))
        if found.score < max(_GOOD, _LESS * chain.score):
            before, least = self._graph.states[chain.nodes[-1], :3], max(_GOOD, found.score + _BETTER)
            anywhere = match(newest, points, before, _ANYWHERE, _RIVAL, least)
            if not anywhere.rival and anywhere.score > least:
                return anywhere
        return found

    def _fuse(
        self, chain: Chain, begin: int, node: int, found: BestPose, motion: FloatArray, sigma: FloatArray
    ) -> FloatArray:
        """Tie a sweep to the one before, and move it; returns the deviations (3,) of odometry."""
        graph = self._graph
        before, predicted = graph.states[begin, :3], graph.states[node, :3].copy()
        tied, moved = between(before, found.pose), between(before, predicted)
        covariance = _turned(found.covariance, -before[2])
        off = moved - tied
        off[2] = wrap_angle(off[2])
        # whether odometry agrees, by how it has differed so far
        odometry = sigma * chain.noise[[0, 0, 1]]
        given = _turned(np.diag(odometry**2), math.atan2(motion[1], motion[0]))
        square = float(off @ np.linalg.solve(given + covariance, off))
        if np.diag(covariance)[:2].max() < _KNOWN**2:
            ratio = off**2 / (sigma**2 + np.diag(covariance))
            sample = np.minimum([0.5 * (ratio[0] + ratio[1]), ratio[2]], _MAX_SQUARE)
            chain.noise = np.sqrt(np.maximum((1.0 - _MEMORY) * chain.noise**2 + _MEMORY * sample, 1.0))
        if square > _CONTRADICTS:
            self.contradicted.append(node)
            odometry = math.sqrt(0.5 * square) * odometry[[0, 0, 2]]  # nor is its direction to be believed
            given = _turned(np.diag(odometry**2), 0.0)
        # the pose by both
        best = moved - given @ np.linalg.solve(given + covariance, off)
        graph.states[node, :3] = compose(before, best)
        graph.constraints.ties.add(begin, node, tied, root_of(covariance))
        return odometry

    def _close_loops(self, chain: Chain, node: int) -> None:
        """Match the newest sweeps of a robot with old ones near, and tie what is believed."""
        graph, count = self._graph, self._graph.count
        if chain.floats:
            self._look_everywhere(chain, node)
        is_old = self._points.counts[:count] >= _MIN_POINTS
        is_old &= self.floating() == chain.floats
        if chain.floats:
            is_old &= graph.robot[:count] == graph.robot[node]
        is_old[chain.nodes[-_OLD:]] = False
        old = np.flatnonzero(is_old)
        if not len(old):
            return
        ways = self._ways.lengths(node, count)[old]
        drift = np.minimum(_DRIFT + _DRIFT_PER_M * ways, _MAX_DRIFT)
        # old sweeps that see what the newest ones see
        newest = chain.newest(_QUERY, _QUERY_PATH)
        query = self._at(self._points, newest)
        query = query[:: max(1, len(query) // _QUERY_POINTS)]
        off = self._middles(old) - np.median(query, axis=0)
        away = np.hypot(off[:, 0], off[:, 1])
        near = np.flatnonzero(away < _NEAR + drift)
        if not len(near):
            return
        nearest = near[np.argmin(away[near] - drift[near])]
        query = transform_points(inverse(graph.states[node, :3]), query)
        one = self._match_old(node, query, int(old[nearest]), float(ways[nearest]), is_old)
        if one is None or (one.way < _SHORT and _square(one, graph.states) < _SOLVE):
            chain.looked += _LOOK_EVERY  # the next one would say the same
        if one is None:
            return
        if one.way < _SHORT:
            self.believe([one])
        else:
            chain.pending.append(one)
            self._test_together(chain)

    def floats(self, robot: int) -> bool:
        """Whether nobody knows yet where a robot began."""
        return robot in self._chains and self._chains[robot].floats

    def floating(self) -> BoolArray:
        """(count,) whether stops are of robots of which nobody knows where they began."""
        robots = [robot for robot, chain in self._chains.items() if chain.floats]
        floating: BoolArray = np.isin(self._graph.robot[: self._graph.count], robots)
        return floating

    def _look_everywhere(self, chain: Chain, node: int) -> None:
        """Look for the newest sweeps of a robot that floats in the whole map, and join it there."""
        graph, count = self._graph, self._graph.count
        others = np.flatnonzero((self._points.counts[:count] >= _MIN_POINTS) & ~self.floating())
        if chain.path[-1] < _QUERY_PATH or chain.path[-1] - chain.searched < _EVERYWHERE_EVERY:
            return
        chain.searched = chain.path[-1]
        known = self._at(self._walls, others.tolist())
        if len(known) < _MIN_POINTS:
            return
        query = self._at(self._points, chain.newest(len(chain.nodes), _EVERYWHERE_PATH))
        query = transform_points(
            inverse(graph.states[node, :3]), query[:: max(1, len(query) // _QUERY_POINTS)]
        )
        low, high = known.min(axis=0), known.max(axis=0)
        window = PoseWindow(0.5 * float((high - low).max()), math.pi, math.inf, math.inf)
        found = match(
            field_of(known), query, np.array([*(0.5 * (low + high)), 0.0]), window, _RIVAL, _EVERYWHERE_SCORE
        )
        if found.score < _EVERYWHERE_SCORE or found.rival:
            return
        old = int(others[np.argmin(np.hypot(*(graph.states[others, :2] - found.pose[:2]).T))])
        there = graph.states[old, :3]
        root = root_of(_turned(found.covariance, -there[2]))
        chain.pending.append(LoopTie(old, node, between(there, found.pose), root, math.inf))
        where = dict(zip(chain.nodes, chain.path, strict=True))
        now = where[node]
        newest = chain.pending[-1]
        agree = [one for one in chain.pending if self._agree(one, newest, now - where[one.end])]
        if len(agree) >= _TOGETHER:
            self._join(chain, found.pose, node, agree)

    def _join(self, chain: Chain, pose: FloatArray, node: int, agree: list[LoopTie]) -> None:
        """Move all sweeps of a robot so that one has a pose (3,) in map, and tie it there."""
        graph = self._graph
        shift = compose(pose, inverse(graph.states[node, :3]))
        mine = np.flatnonzero(graph.robot[: graph.count] == graph.robot[node])
        graph.states[mine, :3] = compose(shift, graph.states[mine, :3])
        priors = graph.constraints.priors
        priors.remove(np.isin(priors.columns[0], mine))
        chain.floats, chain.pending = False, []
        self.believe(agree)

    def _middles(self, nodes: IntArray) -> FloatArray:
        """Middles (n, 2) of what was seen in sweeps, in map [m]."""
        x, y, heading = self._graph.states[nodes, :3].T
        ahead, left = self._points.middle[nodes].T
        cos, sin = np.cos(heading), np.sin(heading)
        return np.stack([x + cos * ahead - sin * left, y + sin * ahead + cos * left], axis=-1)

    def _match_old(
        self, node: int, query: FloatArray, old: int, way: float, is_old: BoolArray
    ) -> LoopTie | None:
        """Match points (n, 2) seen from a sweep with those of old sweeps around one; None: not unique."""
        found = match(
            self._around(old, is_old),
            query,
            self._graph.states[node, :3],
            PoseWindow(
                min(_DRIFT + _DRIFT_PER_M * way, _MAX_DRIFT),
                min(_SPIN + _SPIN_PER_M * way, _MAX_SPIN),
                math.inf,
                math.inf,
            ),
            _RIVAL,
            _LOOP_SCORE,
        )
        if found.score < _LOOP_SCORE or found.rival or _ridge(found.covariance) > _LOOP_RIDGE:
            return None
        there = self._graph.states[old, :3]
        root = root_of(_turned(found.covariance, -there[2]))
        return LoopTie(old, node, between(there, found.pose), root, way)

    def _around(self, old: int, is_old: BoolArray) -> PointField:
        """The field of old sweeps around one of them."""
        ways = self._ways.lengths(old, self._graph.count, _REFERENCE_WAY)
        ways[~is_old] = np.inf
        nearest = np.argsort(ways, kind="stable")[:_REFERENCE]
        return field_of(self._at(self._walls, nearest[ways[nearest] < np.inf].tolist()))

    def _test_together(self, chain: Chain) -> None:
        """Believe ties of which several in a row say the same."""
        newest = chain.pending[-1]
        where = dict(zip(chain.nodes, chain.path, strict=True))
        now = where[newest.end]
        chain.pending = [one for one in chain.pending if where[one.end] > now - _MAX_GAP]
        agree = [one for one in chain.pending if self._agree(one, newest, now - where[one.end])]
        if len(agree) >= _TOGETHER and now - where[agree[0].end] >= _SPAN:
            chain.pending = []
            self.believe(agree)

    def _agree(self, one: LoopTie, other: LoopTie, way: float) -> bool:
        """Whether two ties move the newest sweeps to the same place."""
        states = self._graph.states
        here = between(states[one.end, :3], states[other.end, :3])  # as matched with each other
        first = compose(compose(states[one.begin, :3], one.pose), here)
        off = between(first, compose(states[other.begin, :3], other.pose))
        return bool(math.hypot(off[0], off[1]) < _AGREE + _AGREE_PER_M * way and abs(off[2]) < _AGREE_TURN)

    def believe(self, new: list[LoopTie]) -> None:
        """Add ties; those that the graph contradicts when it is solved are taken back."""
        graph = self._graph
        states, slip = graph.states[: graph.count].copy(), graph.slip.copy()
        squares = [_square(one, graph.states) for one in new]
        for one in new:
            graph.constraints.ties.add(one.begin, one.end, one.pose, one.root)
            self._ways.add(one.begin, one.end, 0.1)
        self.loops += new
        self._unsolved += len(new)
        if max(squares) < _SOLVE and self._unsolved < _SOLVE_SHARE * graph.count:
            return
        self._unsolved = 0
        if sum(squares) + graph.solve(3) > _CONTRADICTS * len(new):  # what all has to give way to these
            graph.states[: graph.count], graph.slip = states, slip
            self.taken_back += len(new)
            self._untie(new)
            for one in new:
                self._ways.cut(one.begin, one.end)
                self.loops.remove(one)

    def _untie(self, ties: list[LoopTie]) -> None:
        rows = self._graph.constraints.ties
        for one in ties:
            first, last, _ = rows.columns
            rows.remove((first == one.begin) & (last == one.end))


def _window(motion: FloatArray) -> PoseWindow:
    """What is searched after a motion (3,) by odometry."""
    path, turn = math.hypot(motion[0], motion[1]), abs(float(motion[2]))
    return PoseWindow(
        min(_REACH + _REACH_PER_M * path, _MAX_REACH),
        min(_TURN + _TURN_SHARE * turn, _MAX_TURN),
        _PREDICTED + _PREDICTED_PER_M * path,
        _PREDICTED_TURN + 0.1 * turn,
    )


def _ridge(covariance: FloatArray) -> float:
    """Greatest standard deviation of a position by a covariance (3, 3) [m]."""
    return math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))


def _square(tie: LoopTie, states: FloatArray) -> float:
    """The squared residual of a tie, in variances."""
    off = between(states[tie.begin, :3], states[tie.end, :3]) - tie.pose
    off[2] = wrap_angle(off[2])
    return float(np.square(tie.root @ off).sum())


def beams_of(stop: ScanStop) -> DrawnSweep:
    """The beams of a sweep, in the frame of its robot."""
    every = slice(None, None, -(-len(stop.turn) // MAX_BEAMS) or 1)
    ends = stop.ends
    square = np.square(ends).sum(axis=1)
    sigma = np.where(stop.inverse > 0.0, square * stop.sigma / np.sqrt(stop.weight), np.inf)
    return DrawnSweep(ends[every].astype(np.float32), sigma[every].astype(np.float32))


def _outlines(beams: DrawnSweep) -> tuple[FloatArray, FloatArray]:
    """Points (n, 2) on walls that beams met, thinned, and points (m, 2) along these walls [m]."""
    ends = beams.ends.astype(float)
    met: BoolArray = np.isfinite(beams.sigma) & (np.hypot(ends[:, 0], ends[:, 1]) < _FAR)
    return thin(ends[met], _APART), outline(ends, met, _APART)


def root_of(covariance: FloatArray) -> FloatArray:
    """Square root (3, 3) of the inverse of a covariance."""
    root: FloatArray = np.linalg.cholesky(np.linalg.inv(covariance)).T
    return root


def _turned(covariance: FloatArray, angle: float) -> FloatArray:
    """A covariance (3, 3) of x, y, heading in a frame turned by an angle."""
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turned: FloatArray = turn @ covariance @ turn.T
    return turned
