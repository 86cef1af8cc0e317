"""Sweeps of lidars in the pose graph: each is matched with the newest ones, and with old ones at the same place.

A match is a tie of the graph with the covariance of its score. Old sweeps are tied only if several places in a
row say the same, and if all constraints agree with them afterwards: else they are taken back.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.se2 import between, compose, inverse, transform_points, wrap_angle
from swarm_loc_estimator.mapping.correlation import Field, Match, Window, field_of, match, score_at, thin
from swarm_loc_estimator.mapping.pose_graph import PoseGraph
from swarm_loc_estimator.mapping.scans import ScanStop

# The constants are checked by `make bench-lidar`: two buildings chose them, two others confirm them.
_APART, _FAR, _MIN_POINTS = 0.08, 25.0, 20
"""Distance of points of a sweep [m], up to which distance they are matched [m], and their least number."""
_RECENT, _RECENT_PATH = 15, 10.0  # Newest sweeps that the next one is matched with: number, path [m]
_REACH, _REACH_PER_M, _MAX_REACH = 0.35, 1.2, 2.0
"""Search for a sweep: offset [m], per path [m], and greatest."""
_TURN, _TURN_SHARE, _MAX_TURN = math.radians(15.0), 0.5, math.radians(50.0)
"""Search for its heading: turn [rad], share of the turn by odometry, and greatest [rad]."""
_PREDICTED, _PREDICTED_PER_M, _PREDICTED_TURN = 0.10, 0.25, math.radians(5.0)
"""Standard deviations of the prediction [m], per path, and of its heading [rad]."""
_ANYWHERE = Window(2.5, math.pi, math.inf, math.inf)  # Search for a sweep that does not fit the prediction
_GOOD, _BETTER = 0.5, 0.15  # Score from which it is not searched elsewhere, or is elsewhere if so much better
_MIN_SCORE = 0.30  # Least score of a sweep among the newest ones
_CONTRADICTS = 16.0  # Squared difference of match and odometry, in variances, from which they contradict
_MEMORY, _MAX_SQUARE = 0.05, 400.0  # Weight of a new difference in the noise of odometry, and its maximum
_OLD = 20  # Sweeps of the same robot in between from which one is old
_NEAR, _REFERENCE, _REFERENCE_WAY = 3.0, 20, 5.0
"""Distance of old sweeps that are matched [m], their number, and greatest way between them [m]."""
_QUERY, _QUERY_PATH = 6, 3.5  # Newest sweeps that are matched as one body: number, path [m]
_DRIFT, _DRIFT_PER_M, _MAX_DRIFT = 0.3, 0.04, 4.0
"""Search for loops: offset [m], per way through the graph, and greatest."""
_SPIN, _SPIN_PER_M, _MAX_SPIN = math.radians(4.0), math.radians(0.4), math.radians(30.0)
_LOOP_SCORE, _RIVAL, _LOOP_RIDGE = 0.5, 0.88, 0.16
"""Least score of a loop, share of it that no other place reaches, and its greatest deviation [m]."""
_SHORT = 12.0  # Way up to which one tie is believed [m]
_AGREE, _AGREE_PER_M, _AGREE_TURN = 0.15, 0.04, math.radians(2.5)
"""By how much ties of loops may differ [m], per way between them, and in heading [rad]."""
_TOGETHER, _SPAN, _MAX_GAP = 3, 1.0, 8.0
"""Ties of a loop that must agree: number, least way between the first and the last, and greatest [m]."""
_SOLVE = 1.0  # Squared residual of a new tie from which the graph is solved, in variances
_TORN = 25.0  # Squared residual of a tie, in variances, from which loops are taken back


class Sweep(NamedTuple):
    """A sweep in the graph, in the frame of its robot."""

    points: FloatArray  # (n, 2) thinned, on walls [m]
    middle: FloatArray  # (2,) of them [m]
    ends: NDArray[np.float32]  # (m, 2) of all beams [m]
    hits: BoolArray  # (m,) whether they met something


class LoopTie(NamedTuple):
    """An old sweep that a new one was matched with."""

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
    pending: list[LoopTie] = field(default_factory=list)  # That are not believed yet


class SweepMap:
    """Matches sweeps of all robots; see the module.

    Args:
        graph: The pose graph; modified.

    Attributes:
        sweeps: Node -> sweep.
        loops: Ties of old sweeps that are believed.
        contradicted: Nodes to which odometry and scans say different motions.
        refused: Nodes whose sweeps fit nothing.
        taken_back: Number of ties that were believed and then contradicted.
    """

    def __init__(self, graph: PoseGraph) -> None:
        self.sweeps: dict[int, Sweep] = {}
        self.loops: list[LoopTie] = []
        self.contradicted: list[int] = []
        self.refused: list[int] = []
        self.taken_back = 0
        self._graph = graph
        self._chains: defaultdict[int, Chain] = defaultdict(Chain)
        self._edges: list[tuple[int, int, float]] = []

    def begin(self, node: int, stop: ScanStop) -> None:
        """Note the first sweep of a robot, or the first after it was lost."""
        chain = self._chains[int(self._graph.robot[node])]
        chain.nodes, chain.path, chain.pending = [node], [0.0], []
        self.sweeps[node] = sweep_of(stop)

    def add(self, begin: int, node: int, stop: ScanStop, motion: FloatArray, sigma: FloatArray) -> bool:
        """Match the newest sweep, at its pose by odometry; returns whether it fits.

        Args:
            begin: The robot's sweep before.
            node: The new stop in the graph.
            stop: Its beams.
            motion: (3,) by odometry since `begin`.
            sigma: (3,) standard deviations of it as described: along [m], across [m], heading [rad].
        """
        graph, chain = self._graph, self._chains[int(self._graph.robot[node])]
        sweep = self.sweeps[node] = sweep_of(stop)
        path = math.hypot(motion[0], motion[1])
        found = self._match_newest(chain, node, sweep, motion)
        fits = found is not None and found.score >= _MIN_SCORE
        odometry = sigma * chain.noise[[0, 0, 1]]
        if found is not None and fits:
            odometry = self._fuse(chain, begin, node, found, motion, sigma)
        elif len(sweep.points) >= _MIN_POINTS:
            self.refused.append(node)
            odometry = np.maximum(odometry, [0.1 + 0.3 * path, 0.1 + 0.3 * path, _PREDICTED_TURN])
        graph.constraints.add_departure(begin, node, 0.0, motion, odometry)
        self._edges.append((begin, node, path if fits else 3.0 * path + 1.0))
        chain.nodes.append(node)
        chain.path.append(chain.path[-1] + path)
        if fits:
            self._close_loops(chain, node)
        return fits

    def _close_loops(self, chain: Chain, node: int) -> None:
        """Match the newest sweeps of a robot with old ones near, and tie what is believed."""
        graph = self._graph
        old = self._old(chain, node)
        if not len(old):
            return
        query = self._query(chain, node)
        views = self._middles(old) - transform_points(graph.states[node, :3], np.median(query, axis=0))
        away = np.hypot(views[:, 0], views[:, 1])
        ways = self._ways(node)[old]
        drift = np.minimum(_DRIFT + _DRIFT_PER_M * ways, _MAX_DRIFT)
        near = np.flatnonzero(away < _NEAR + drift)
        if not len(near):
            return
        nearest = near[np.argmin(away[near] - drift[near])]
        one = self._match_old(node, query, int(old[nearest]), float(ways[nearest]))
        if one is None:
            return
        if one.way < _SHORT:
            self._believe(chain, [one])
        else:
            chain.pending.append(one)
            self._test_together(chain)

    def _old(self, chain: Chain, node: int) -> IntArray:
        """All sweeps but the newest ones of a robot."""
        newest = set(chain.nodes[-_OLD:])
        return np.array([one for one in self.sweeps if one not in newest and one != node], dtype=np.int64)

    def _middles(self, nodes: IntArray) -> FloatArray:
        """Middles (n, 2) of what was seen in sweeps, in map [m]."""
        x, y, heading = self._graph.states[nodes, :3].T
        middle = np.array([self.sweeps[one].middle for one in nodes.tolist()])
        cos, sin = np.cos(heading), np.sin(heading)
        places: FloatArray = np.stack(
            [x + cos * middle[:, 0] - sin * middle[:, 1], y + sin * middle[:, 0] + cos * middle[:, 1]], -1
        )
        return places

    def _query(self, chain: Chain, node: int) -> FloatArray:
        """Points (n, 2) of the newest sweeps of a robot, in its frame at the newest one [m]."""
        newest = [
            one
            for one, path in zip(chain.nodes[-_QUERY:], chain.path[-_QUERY:], strict=True)
            if path > chain.path[-1] - _QUERY_PATH
        ]
        points = transform_points(inverse(self._graph.states[node, :3]), self.points_at(newest))
        return points[:: max(1, len(points) // 300)]

    def _match_old(self, node: int, query: FloatArray, old: int, way: float) -> LoopTie | None:
        """Match points (n, 2) seen from a sweep with those of old sweeps around one; None: not unique."""
        graph = self._graph
        ways = self._ways(old)
        ways[node] = np.inf
        chain = self._chains[int(graph.robot[node])]
        ways[chain.nodes[-_OLD:]] = np.inf
        reference = [int(one) for one in np.argsort(ways)[:_REFERENCE] if ways[one] < _REFERENCE_WAY]
        window = Window(
            min(_DRIFT + _DRIFT_PER_M * way, _MAX_DRIFT),
            min(_SPIN + _SPIN_PER_M * way, _MAX_SPIN),
            math.inf,
            math.inf,
        )
        found = match(field_of(self.points_at(reference)), query, graph.states[node, :3], window, _RIVAL)
        sigma = math.sqrt(float(np.linalg.eigvalsh(found.covariance[:2, :2])[-1]))
        if found.score < _LOOP_SCORE or found.rival or sigma > _LOOP_RIDGE:
            return None
        there = graph.states[old, :3]
        root = root_of(_turned(found.covariance, -there[2]))
        return LoopTie(old, node, between(there, found.pose), root, way)

    def _test_together(self, chain: Chain) -> None:
        """Believe ties of which several in a row say the same."""
        newest = chain.pending[-1]
        where = dict(zip(chain.nodes, chain.path, strict=True))
        now = where[newest.end]
        chain.pending = [one for one in chain.pending if where[one.end] > now - _MAX_GAP]
        agree = [one for one in chain.pending if self._agree(one, newest, now - where[one.end])]
        if len(agree) >= _TOGETHER and now - where[agree[0].end] >= _SPAN:
            chain.pending = []
            self._believe(chain, agree)

    def _agree(self, one: LoopTie, other: LoopTie, way: float) -> bool:
        """Whether two ties move the newest sweeps to the same place."""
        states = self._graph.states
        here = between(states[one.end, :3], states[other.end, :3])  # as matched with each other
        first = compose(compose(states[one.begin, :3], one.pose), here)
        off = between(first, compose(states[other.begin, :3], other.pose))
        return bool(math.hypot(off[0], off[1]) < _AGREE + _AGREE_PER_M * way and abs(off[2]) < _AGREE_TURN)

    def _believe(self, chain: Chain, new: list[LoopTie]) -> None:
        """Add ties, and take them back unless all constraints agree."""
        graph = self._graph
        worst = 0.0
        for one in new:
            graph.constraints.add_tie(one.begin, one.end, one.pose, one.root)
            off = between(graph.states[one.begin, :3], graph.states[one.end, :3]) - one.pose
            off[2] = wrap_angle(off[2])
            worst = max(worst, float(np.square(one.root @ off).sum()))
        self.loops += new
        if worst < _SOLVE:
            return
        states, slip = graph.states[: graph.count].copy(), graph.slip.copy()
        graph.solve(4)
        if self._stress() > _TORN:
            graph.states[: graph.count], graph.slip = states, slip
            self.taken_back += len(new)
            for one in new:
                graph.constraints.remove_tie(one.begin, one.end)
                self.loops.remove(one)

    def _stress(self) -> float:
        """The greatest squared residual of a tie, in variances."""
        return self._graph.constraints.worst_tie(self._graph.states)

    def _match_newest(self, chain: Chain, node: int, sweep: Sweep, motion: FloatArray) -> Match | None:
        """Match a sweep with the newest ones of its robot; None: too little is seen."""
        newest = self._newest(chain)
        if len(sweep.points) < _MIN_POINTS or newest is None:
            return None
        path, turn = math.hypot(motion[0], motion[1]), abs(float(motion[2]))
        window = Window(
            min(_REACH + _REACH_PER_M * path, _MAX_REACH),
            min(_TURN + _TURN_SHARE * turn, _MAX_TURN),
            _PREDICTED + _PREDICTED_PER_M * path,
            _PREDICTED_TURN + 0.1 * turn,
        )
        pose = self._graph.states[node, :3]
        found = match(newest, sweep.points, pose, window)
        if found.score < _GOOD:
            anywhere = match(newest, sweep.points, self._graph.states[chain.nodes[-1], :3], _ANYWHERE, _RIVAL)
            if not anywhere.rival and anywhere.score > max(_GOOD, found.score + _BETTER):
                return anywhere
        return found

    def _newest(self, chain: Chain) -> Field | None:
        """The field of the newest sweeps of a robot; None: too little was seen."""
        recent = [
            one
            for one, path in zip(chain.nodes[-_RECENT:], chain.path[-_RECENT:], strict=True)
            if path > chain.path[-1] - _RECENT_PATH
        ]
        others = self.points_at(recent)
        return field_of(others) if len(others) >= _MIN_POINTS else None

    def place(self, node: int, stop: ScanStop) -> FloatArray | None:
        """The only pose (3,) near a robot's newest sweep that explains the next one; None: none does.

        It is for robots of whose motion nothing is known.
        """
        sweep, newest = sweep_of(stop), self._newest(self._chains[int(self._graph.robot[node])])
        if newest is None or len(sweep.points) < _MIN_POINTS:
            return None
        found = match(newest, sweep.points, self._graph.states[node, :3], _ANYWHERE, _RIVAL)
        return found.pose if found.score > _GOOD and not found.rival else None

    def _fuse(
        self, chain: Chain, begin: int, node: int, found: Match, motion: FloatArray, sigma: FloatArray
    ) -> FloatArray:
        """Tie a sweep to the one before, and move it; returns the deviations (3,) of odometry."""
        graph = self._graph
        before, predicted = graph.states[begin, :3], graph.states[node, :3].copy()
        tied = between(before, found.pose)
        covariance = _turned(found.covariance, -before[2])
        off = between(before, predicted) - tied
        off[2] = wrap_angle(off[2])
        # how well odometry is known, from how it has differed so far
        odometry = sigma * chain.noise[[0, 0, 1]]
        given = _turned(np.diag(odometry**2), math.atan2(motion[1], motion[0]))
        square = float(off @ np.linalg.solve(given + covariance, off))
        scale = np.array([*sigma[[0, 0]], sigma[2]]) ** 2 + np.diag(covariance)
        ratio = off**2 / scale
        sample = np.minimum([0.5 * (ratio[0] + ratio[1]), ratio[2]], _MAX_SQUARE)
        if np.diag(covariance)[:2].max() < 0.3**2:
            chain.noise = np.sqrt(
                np.maximum((1.0 - _MEMORY) * chain.noise**2 + _MEMORY * sample, 1.0)
            )
        if square > _CONTRADICTS:
            self.contradicted.append(node)
            odometry = odometry * math.sqrt(square / 2.0)
            given *= square / 2.0
        gain = given @ np.linalg.inv(given + covariance)
        best = between(before, predicted) - gain @ off
        graph.states[node, :3] = compose(before, best)
        graph.states[node, 2] = before[2] + wrap_angle(best[2])
        graph.constraints.add_tie(begin, node, tied, root_of(covariance))
        return odometry

    def points_at(self, nodes: list[int]) -> FloatArray:
        """Points (n, 2) of sweeps in map [m]."""
        poses = self._graph.states[nodes, :3]
        parts = [transform_points(pose, self.sweeps[one].points) for pose, one in zip(poses, nodes, strict=True)]
        return np.concatenate([*parts, np.zeros((0, 2))])

    def ways(self, node: int) -> FloatArray:
        """Lengths (count,) of the shortest paths through the graph from a node [m]."""
        return self._ways(node)

    def _ways(self, node: int) -> FloatArray:
        count = self._graph.count
        begin, end, length = np.array([*self._edges, *((t.begin, t.end, 0.1) for t in self.loops)]).T
        index = (begin.astype(np.int64), end.astype(np.int64))
        graph = csr_matrix((length + 1e-3, index), shape=(count, count))
        ways: FloatArray = dijkstra(graph, directed=False, indices=node)
        return ways


def sweep_of(stop: ScanStop) -> Sweep:
    """The sweep of a stop of no duration."""
    hits = stop.inverse > 0.0
    distance = 1.0 / np.where(hits, stop.inverse, 1.0 / stop.reach)
    angle = stop.bearing + stop.turn
    ends = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * distance[:, None]
    points = thin(ends[hits & (distance < _FAR)], _APART)
    middle = np.median(points, axis=0) if len(points) else np.zeros(2)
    return Sweep(points, middle, ends.astype(np.float32), hits)


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
