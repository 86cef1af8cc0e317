"""The cooperative mapper: computes poses, one map and next goals from the readings of many robots.

A robot with a laser pointer stops, scans by turning in place, and drives on; one with a lidar scans while it
drives. Each stop, and a sweep of a lidar wherever its robot has moved on, becomes a node of the pose graph;
its beams are matched against those of stops of all robots. Robots may join and leave at any time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.se2 import between, compose, wrap_angle
from swarm_loc_estimator.mapping.exploration import Goal, goal_by_odometry, next_stop
from swarm_loc_estimator.mapping.grid import OccupancyMap, VisitationMap, draw_map
from swarm_loc_estimator.mapping.localization import (
    LOST,
    LightBetween,
    LightBook,
    Visit,
    align,
    align_all,
    align_start,
    close_loop,
    driven_share,
    find_slip,
)
from swarm_loc_estimator.mapping.pose_graph import PoseGraph
from swarm_loc_estimator.mapping.relocation import RATES, Light, Search
from swarm_loc_estimator.mapping.scans import (
    MIN_TURN,
    UNSEEN,
    LightSightings,
    MotionTracker,
    Readings,
    ScanStop,
    turn_ratio,
)
from swarm_loc_estimator.mapping.settings import MapperSettings
from swarm_loc_estimator.mapping.sweep_map import SweepMap


class Located(NamedTuple):
    """Where a robot was: its pose (3,) in map at a time."""

    stamp_ns: int
    pose: FloatArray


@dataclass
class Track:
    """State of one robot."""

    prior: FloatArray  # (3,) start pose
    prior_sigma: FloatArray  # (3,) standard deviations of the start pose
    motion: MotionTracker = field(default_factory=MotionTracker)  # Detects stops
    stop: ScanStop | None = None  # The current stop
    node: int | None = None  # Its newest stop in the graph
    is_known: bool = False  # Whether `stop` is in the graph, as `node`
    passes: bool = False  # Whether the next stop replaces `node` because the graph is full
    # (3,) pose by odometry at departure from `node`
    left: FloatArray = field(default_factory=lambda: np.zeros(3))
    last: FloatArray | None = None  # (3,) newest pose by odometry
    path: float = 0.0  # Length driven since the departure [m]
    target: FloatArray | None = None  # (2,) final target position [m]
    goal: Goal | None = None  # Its next stop
    located: Located | None = None  # Where its newest scan says that it was
    home: FloatArray | None = None  # (2,) old stop to which it returns to reduce its position uncertainty [m]
    last_ns: int = 0  # Its newest reading
    search: Search | None = None  # Since its odometry restarted, until no doubt is left


START_TURN = 4.5 * math.pi
"""Turn by odometry of a complete first scan [rad]: a slow quarter that fixes the heading, then two turns."""
SCAN_TURN = 2.14 * math.pi  #: Turn by odometry at every later stop [rad]; enough for a full turn despite slip
_SWEEP_STEP, _SWEEP_TURN = 0.3, math.radians(20.0)
"""Motion by odometry after which the next sweep of a lidar is used: path [m], turn [rad]."""
_SWEEP_DISTANCE_NOISE = 0.2
"""Error of paths between sweeps, per path: slip is the same in all, so they must not count as many."""
_LOCATED_SIGMA = np.array([0.05, 0.05, 0.02])
"""Standard deviations of a sweep that is located in the map without becoming part of it [m, m, rad]."""
_UNKNOWN_MOTION = np.array([2.0, 2.0, 1.0])  # Deviations of a motion of which odometry says nothing [m, rad]
_START_PARTS = (0.25 * math.pi, *(0.5 * math.pi * k for k in range(1, 9)))
"""Turns at which a first scan is split into parts, each a stop [rad]."""
# The constants of the mapper are checked by `make bench-pushbot`: corridor, office and ring, 20 seeds each.
_TURN_TOLERANCE = 0.03  # By which a scan may turn less than it should [rad]
# Standard deviations between the parts of a first scan [m, m, rad]
_PART_SIGMA = np.array([0.002, 0.002, 0.002])
_LEAST_SIGMA = 0.003  # Minimum standard deviation of a drive, along and across [m]
_LOST_SIGMA, _CHECK_EVERY = 0.15, 4
"""Maximum position standard deviation [m]; above it a robot returns to an old stop nearby (home)."""
_FOUND_SIGMA, _UNKNOWN_HEADING = np.array([0.10, 0.10, math.radians(5.0)]), 1.8
"""Standard deviations of a place found after a restart [m, m, rad], and of a heading that nothing tells."""
_HOME_AGE, _HOME_RADIUS, _AT_HOME = 10, 4.0, 0.5
"""Minimum age in stops and maximum distance [m] of that stop, and the distance at which it is reached [m]."""


class CooperativeMapper:
    """Poses, map and goals of many robots.

    Attributes:
        settings: Noise and limits.
        graph: The pose graph.
        visits: Visit counts of cells.
        counters: Event -> count.
        tracks: Robot -> its state.
        background: An earlier map, drawn below the stops.
        begin_ns: Stop in the graph -> its first reading [ns].
    """

    def __init__(self, settings: MapperSettings | None = None) -> None:
        self.settings = settings or MapperSettings()
        self.graph = PoseGraph(self.settings)
        self.visits = VisitationMap()
        self.sweeps = SweepMap(self.graph)
        self.counters = {"scans": 0, "scans_refused": 0, "loops_closed": 0, "odometry_restarts": 0}
        self.counters |= {"drives_held": 0, "scans_not_located": 0, "places_taken_back": 0}
        self.counters |= {"loops_taken_back": 0, "odometry_contradicted": 0}
        self.tracks: dict[int, Track] = {}
        self._lights = LightBook()
        self.background: OccupancyMap | None = None
        self.begin_ns: dict[int, int] = {}
        self._map: OccupancyMap | None = None

    def join(self, pose: FloatArray, sigma: FloatArray) -> int:
        """Add a robot with a start pose (3,) in map and standard deviations (3,); returns its number.

        Where these are infinite, a robot with a lidar is located by its scans in the map of others.
        """
        robot = self.graph.add_robot()
        self.tracks[robot] = Track(np.asarray(pose, dtype=float), np.asarray(sigma, dtype=float))
        return robot

    def leave(self, robot: int) -> None:
        """Remove a robot; its scans stay in the map."""
        self._depart(robot, self.tracks[robot])
        del self.tracks[robot]

    def add_readings(self, robot: int, readings: Readings) -> None:
        """Process readings (n,) of a robot, newer than all before."""
        track = self.tracks[robot]
        for run in track.motion.runs(readings):
            if run.arrives or not run.stands:
                self._depart(robot, track)
            if run.jumps:
                self._restart_track(robot, track, int(run.readings.stamp_ns[0]))
            elif run.arrives:
                self._drive(track, run.readings.odometry[:1])
            if run.arrives:
                track.stop, track.is_known = ScanStop(run.readings.odometry[0]), False
            if run.stands and track.stop is not None:
                track.stop.extend(run.readings)
                track.last = run.readings.odometry[-1]
                self._look(robot, track, track.stop)
            else:
                self._drive(track, run.readings.odometry)
                self._lights.note_time(robot, int(run.readings.stamp_ns[-1]))
            track.last_ns = int(run.readings.stamp_ns[-1])

    def add_sweep(self, robot: int, sweep: ScanStop) -> None:
        """Process a sweep of a robot's lidar, newer than all before, if the robot has moved since."""
        track, place = self.tracks[robot], sweep.arrival[None]
        step = Readings(sweep.stamp_ns[:1], place, np.full(1, UNSEEN), math.nan)
        jumps = any(run.jumps for run in track.motion.runs(step))
        found = self.sweeps.place(track.node, sweep) if jumps and track.node is not None else None
        if found is not None and track.node is not None:
            self.counters["odometry_restarts"] += 1
            back = between(found, self.graph.states[track.node, :3])
            track.left, track.last = compose(sweep.arrival, back), sweep.arrival
        elif jumps:
            self._restart_track(robot, track, int(sweep.stamp_ns[0]))
        self._drive(track, place)
        track.last_ns = int(sweep.stamp_ns[0])
        if track.node is not None or (track.search is not None and track.search.left is not None):
            x, y, turn = between(track.left, sweep.arrival)
            if math.hypot(x, y) < _SWEEP_STEP and abs(turn) < _SWEEP_TURN:
                return
        self.graph.known_slips.add(robot)  # no turn by odometry is in a sweep
        self._enter_sweep(robot, track, sweep, jumps=jumps)
        track.left, track.path = sweep.arrival, 0.0
        if track.node is not None and not self.sweeps.floats(robot):
            track.located = Located(track.last_ns, self.graph.poses[track.node].copy())

    def _restart_track(self, robot: int, track: Track, stamp_ns: int) -> None:
        """Lose a robot, whose odometry has jumped, as by a restart of its driver."""
        self.counters["odometry_restarts"] += 1
        pause_s, lost = (stamp_ns - track.last_ns) * 1e-9, track.search
        if lost is None:
            pose = self.pose(robot)
            self._lose(track, Search(track.prior if pose is None else pose, pause_s))
        else:
            self._withdraw(robot, lost)
            self._lose(track, lost.again(pause_s + track.path / RATES[0]))
        track.last = None

    def _lose(self, track: Track, search: Search) -> None:
        """Begin to search a robot, none of whose scans is used until it is found."""
        track.search, track.node, track.path, track.home, track.target = search, None, 0.0, None, None
        track.is_known = track.passes = False

    def _is_found(self, robot: int, track: Track, stop: ScanStop) -> bool:
        """Whether the one place is found that explains the scans of a lost robot; it becomes its prior."""
        search = track.search
        if search is None:
            return True
        if not stop.reach and robot not in self.graph.known_slips:
            self._learn_slip(robot, stop, len(stop.turn))
        is_whole = search.add(stop, 1.0 - self.graph.slip[robot], self._map_of_others())
        track.path = 0.0
        if is_whole and not self.graph.count and all(one.search is not None for one in self.tracks.values()):
            track.prior_sigma = np.array([*track.prior_sigma[:2], _UNKNOWN_HEADING])
            track.search = None  # it begins the map
            return True
        search.found = search.verdict() if is_whole else -1
        if search.found < 0:
            return False
        track.prior, track.prior_sigma = search.poses[search.found, -1], _FOUND_SIGMA
        search.first = self.graph.count
        return True

    def _learn_slip(self, robot: int, stop: ScanStop, count: int) -> None:
        """Find the slip of a robot from the first `count` readings of a stop, if they tell it."""
        ratio = turn_ratio(stop.turn[:count], stop.inverse[:count], stop.sigma)
        if not math.isnan(ratio):
            self.graph.slip[robot] = 1.0 - ratio
            self.graph.known_slips.add(robot)

    def _under_test(self, robot: int, search: Search) -> IntArray:
        """Stops of a robot at the place where it was found."""
        mine = np.flatnonzero(self.graph.robot[: self.graph.count] == robot)
        return mine[mine >= search.first] if search.first >= 0 else mine[:0]

    def _map_of_others(self) -> OccupancyMap:
        """The map without robots that are under test."""
        tested = [self._under_test(robot, one.search) for robot, one in self.tracks.items() if one.search]
        without = frozenset(np.concatenate(tested).tolist()) if tested else frozenset()
        graph, limit = self.graph, self.settings.max_cells
        return (
            draw_map(graph.scans, graph.count, limit, self.background, without, self.sweeps.drawn)
            if without
            else self.occupancy()
        )

    def _check_place(self, robot: int, track: Track, stop: ScanStop, *, fits: bool = True) -> None:
        """Take back the place where a robot was found, and all scans since, if its newest one contradicts."""
        search = track.search
        if search is None or track.node is None:
            return
        if stop not in search.stops:
            search.add(stop, self.graph.states[track.node, 3], self._map_of_others())
        if fits and not search.is_contradicted:
            track.search = None if search.is_over else search
            return
        self.counters["places_taken_back"] += 1
        self._withdraw(robot, search)
        self._lose(track, search.again())

    def _withdraw(self, robot: int, search: Search) -> None:
        """Take all out of the graph that a robot has added since it was found."""
        tested = self._under_test(robot, search).tolist()
        for one in tested:
            self.graph.drop_stop(one)
            self.sweeps.drop(one)
            self._lights.forget_node(one)
            self.begin_ns.pop(one, None)
        if tested:
            self.graph.solve(4)
            self._map = None

    def add_lights(self, robot: int, sightings: LightSightings) -> None:
        """Process sightings (m,) of other robots by one robot."""
        self._lights.add(robot, sightings)

    def pose(self, robot: int) -> FloatArray | None:
        """The pose (3,) of a robot in map at its newest reading; None before it is located."""
        track = self.tracks[robot]
        if track.node is None or track.last is None or self.sweeps.floats(robot):
            return None
        if track.is_known and track.stop is not None:
            x, y, theta, ratio = self.graph.states[track.node]
            theta += ratio * (track.stop.turn[-1] - track.stop.begin_turn)
            return np.array([x, y, wrap_angle(theta)])
        return self._driven(track, track.last)

    def covariance(self, robot: int) -> FloatArray:
        """Covariance (3, 3) of the newest stop of a robot; NaN before its first scan."""
        node = self.tracks[robot].node
        return np.full((3, 3), np.nan) if node is None else self.graph.covariance(node)

    def goal(self, robot: int) -> Goal | None:
        """The goal of a robot; None unless it is stopped and its scan is complete."""
        track = self.tracks[robot]
        return track.goal if track.is_known else None

    def occupancy(self) -> OccupancyMap:
        """The map from the current poses of the stops."""
        if self._map is None:
            limit = self.settings.max_cells
            graph, sweeps = self.graph, self.sweeps.drawn
            floating = np.flatnonzero(self.sweeps.floating()).tolist()
            self._map = draw_map(graph.scans, graph.count, limit, self.background, floating, sweeps)
        return self._map

    def finish(self) -> None:
        """Solve the whole graph with all beams."""
        for track in self.tracks.values():
            self._update_scan(track)
        self.sweeps.refine()
        align_all(self.graph)
        self._map = None

    def _driven(self, track: Track, odometry: FloatArray) -> FloatArray:
        """Poses (..., 3) in map of odometry poses (..., 3) since the newest stop."""
        left = self.graph.states[track.node, :3].copy()
        left[2] = self.graph.heading_at_departure(track.node) if track.node is not None else 0.0
        return compose(left, between(track.left, odometry))

    def _drive(self, track: Track, odometry: FloatArray) -> None:
        """Process odometry poses (n, 3) of a driving robot."""
        if track.last is not None:
            steps = np.diff(np.vstack([track.last, odometry])[:, :2], axis=0)
            paths = np.concatenate([[track.path], np.hypot(steps[:, 0], steps[:, 1])])
            track.path = float(np.cumsum(paths)[-1])  # independent of how readings are split
        track.last = odometry[-1]
        if track.node is not None:
            self.visits.add(self._driven(track, odometry)[:, :2])

    def _look(self, robot: int, track: Track, stop: ScanStop) -> None:
        """Add a stop to the graph when its scan is complete."""
        around = min(2.02 * math.pi / (1.0 - self.graph.slip[robot]), SCAN_TURN - _TURN_TOLERANCE)
        if not track.is_known:
            count = stop.completed(START_TURN - _TURN_TOLERANCE if track.node is None else around)
            if count:
                self._enter(robot, track, stop, count)
                self._choose_goal(robot, track, stop)
                if not track.is_known:
                    track.stop = ScanStop(stop.departure)
        again = stop.split(around) if track.is_known else None
        if again is not None:  # the robot could not leave and turned again: a new stop and a new goal
            self._depart(robot, track)
            track.stop = again
            self._look(robot, track, again)

    def _depart(self, robot: int, track: Track) -> None:
        """Finish a stop when the robot departs."""
        stop, track.stop = track.stop, None
        if stop is None or not len(stop.turn):
            return
        if not track.is_known and stop.turned >= MIN_TURN:
            track.stop = stop
            self._enter(robot, track, stop, len(stop.turn))
        if track.is_known:
            track.stop = stop
            self._update_scan(track)
            self._note_visit(robot, track, stop)
            # relative to the node: includes the first steps of the drive
            track.left = np.array([*stop.arrival[:2], stop.departure[2]])
            self.visits.add(np.tile(self.graph.states[track.node, :2], (stop.total, 1)))
            track.path = math.dist(stop.arrival[:2], stop.departure[:2])
        track.stop, track.is_known = None, False

    def _note_visit(self, robot: int, track: Track, stop: ScanStop) -> None:
        """Record a finished stop, for light bearings by and of this robot."""
        if track.node is not None:
            begin_ns, end_ns = int(stop.stamp_ns[stop.begin]), int(stop.stamp_ns[-1])
            self._lights.note_visit(Visit(robot, track.node, begin_ns, end_ns, stop, stop.begin_turn))
            self._lights.note_time(robot, end_ns)
            for sighting in self._lights.settle(self.graph):
                self._note_light(sighting.seer, sighting.seen, sighting, is_seen=True)
                self._note_light(sighting.seen, sighting.seer, sighting, is_seen=False)

    def _note_light(self, lost: Visit, other: Visit, sighting: LightBetween, *, is_seen: bool) -> None:
        """Note a light that a robot that is searched sees of a located one, or the other way around."""
        track, other_track = self.tracks.get(lost.robot), self.tracks.get(other.robot)
        tested = other_track is not None and other_track.search is not None
        if track is None or track.search is None or tested or other.node == LOST:
            return
        graph = self.graph
        there = graph.states[other.node, :3].copy()
        turn = sighting.turn
        if is_seen:
            turn = (1.0 - graph.slip[lost.robot]) * (turn + lost.turn_begin)
        else:
            there[2] += graph.states[other.node, 3] * turn
        track.search.lights.append(Light(lost.stop, there, is_seen, turn, sighting.bearing))

    def _update_scan(self, track: Track) -> None:
        """Set all readings of the newest stop as its scan."""
        stop = track.stop
        if stop is not None and track.is_known and track.node is not None:
            self.graph.set_scan(track.node, stop.scan(stop.begin, len(stop.turn)))
            self._map = None

    def _enter(self, robot: int, track: Track, stop: ScanStop, count: int) -> None:
        """Add the first `count` readings of a stop as a node (several for a first scan) and align it."""
        if track.node is None and not self._is_found(robot, track, stop):
            self.counters["scans_not_located"] += 1
            begin_ns, end_ns = int(stop.stamp_ns[0]), int(stop.stamp_ns[-1])
            self._lights.note_visit(Visit(robot, LOST, begin_ns, end_ns, stop, 0.0))
            return
        self.counters["scans"] += 1
        self._map = None
        track.is_known, stop.looked = True, count
        if track.node is None:
            fits = self._enter_first(robot, track, stop, count)
            self._check_place(robot, track, stop, fits=fits)
            return
        # Add it where odometry has it, or in place of the last one where the graph is full.
        graph, begin, pose = self.graph, track.node, self._driven(track, stop.arrival)
        motion, left = between(track.left, stop.arrival), graph.states[begin, :2].copy()
        known = np.diag(graph.covariance(begin)) if track.passes else np.zeros(3)
        if track.passes:
            node = begin
            self._lights.forget_node(node)
            graph.reuse_stop(node, pose, stop.sigma)
        else:
            node = graph.add_stop(robot, pose, stop.sigma)
        self.begin_ns[node] = int(stop.stamp_ns[0])
        graph.set_scan(node, stop.scan(0, count))
        # Believe odometry as far as the scan does.
        share = driven_share(graph, left, node)
        sigma = self._motion_sigma(track.path, abs(float(motion[2])))
        sigma[0] += (1.0 - share) * track.path
        if share < 1.0:
            self.counters["drives_held"] += 1
            motion[:2] *= share
        if track.passes:
            drive = np.array([*np.full(2, sigma[:2].max()), sigma[2]])
            graph.constraints.priors.add(
                node, node, graph.states[node, :3], np.hypot(np.sqrt(np.maximum(known, 0.0)), drive)
            )
        else:
            graph.constraints.departures.add(begin, node, graph.turned[begin], motion, sigma)
        # Align it, and close loops.
        track.node, track.passes = node, graph.count > self.settings.max_stops
        if node != begin and not find_slip(graph, begin, node):
            return
        if not align(graph, node, track.path):
            self.counters["scans_refused"] += 1
        if close_loop(graph, node):
            self.counters["loops_closed"] += 1
        self._check_place(robot, track, stop)

    def _enter_sweep(self, robot: int, track: Track, sweep: ScanStop, *, jumps: bool) -> None:
        """Add a sweep of a lidar as a node, and match it; `jumps`: its odometry says nothing."""
        graph, begin, loops = self.graph, track.node, len(self.sweeps.loops)
        if begin is None and not self._is_found(robot, track, sweep):
            self.counters["scans_not_located"] += 1
            return
        self.counters["scans"] += 1
        self._map = None
        pose, motion = track.prior, between(track.left, sweep.arrival)
        if begin is not None:
            pose = self._driven(track, sweep.arrival)
            pose[2] -= graph.slip[robot] * motion[2]
        if begin is not None and track.passes:
            self.sweeps.drop(begin)
            pose = self.sweeps.locate(sweep, pose, motion)
            graph.reuse_stop(begin, pose, sweep.sigma)
            graph.constraints.priors.add(begin, begin, pose, _LOCATED_SIGMA)
            return
        node = track.node = graph.add_stop(robot, pose, sweep.sigma)
        track.passes = graph.count > self.settings.max_stops
        self.begin_ns[node] = int(sweep.stamp_ns[0])
        if begin is None:
            graph.constraints.priors.add(node, node, track.prior, np.minimum(track.prior_sigma, 1.0))
            self.sweeps.begin(node, sweep, floats=not np.isfinite(track.prior_sigma).all())
        else:
            sigma = self._motion_sigma(track.path, abs(float(motion[2])))
            sigma[:2] += track.path * np.array([_SWEEP_DISTANCE_NOISE, sigma[2]])
            sigma = _UNKNOWN_MOTION if jumps else sigma
            if not self.sweeps.add(begin, node, sweep, motion, sigma):
                self.counters["scans_refused"] += 1
        self.counters["loops_closed"] += len(self.sweeps.loops) - loops
        self.counters["loops_taken_back"] = self.sweeps.taken_back
        self.counters["odometry_contradicted"] = len(self.sweeps.contradicted)
        self._check_place(robot, track, sweep)

    def _motion_sigma(self, path: float, turn: float) -> FloatArray:
        """Standard deviations (3,) of a drive: along [m], across [m], heading [rad]."""
        noise = self.settings
        heading = noise.heading_noise
        return np.array(
            [
                noise.distance_noise * path + _LEAST_SIGMA,
                heading * path + _LEAST_SIGMA,
                math.hypot(heading, noise.course_noise * math.sqrt(path)) + noise.slip_sigma * turn,
            ]
        )

    def _enter_first(self, robot: int, track: Track, stop: ScanStop, count: int) -> bool:
        """Add the parts of a first scan as nodes, of which the first fixes the heading; see `align_start`."""
        self._learn_slip(robot, stop, count)
        furthest = np.maximum.accumulate(np.abs(stop.turn[:count]))
        cuts = np.searchsorted(furthest, np.array(_START_PARTS) + 1e-6)
        bounds = sorted({0, *cuts[cuts < count].tolist(), count})
        nodes: list[int] = []
        pose = track.prior
        for first, last in pairwise(bounds):
            node = self.graph.add_stop(robot, pose, stop.sigma)
            self.graph.set_scan(node, stop.scan(first, last))
            if nodes:
                turned = self.graph.turned[nodes[-1]]
                self.graph.constraints.departures.add(nodes[-1], node, turned, np.zeros(3), _PART_SIGMA)
            else:
                self.graph.constraints.priors.add(node, node, track.prior, track.prior_sigma)
            pose = np.array([pose[0], pose[1], self.graph.heading_at_departure(node)])
            stop.begin = first
            self.begin_ns[node] = int(stop.stamp_ns[first])
            nodes.append(node)
        track.node = nodes[-1]
        self.graph.starts.update(nodes)
        self.graph.place[nodes] = nodes[0]
        return align_start(self.graph, nodes, track.prior_sigma, is_found=track.search is not None)

    def _choose_goal(self, robot: int, track: Track, stop: ScanStop) -> None:
        node = track.node
        if node is None:
            return
        self._look_for_home(track, node)
        x, y, theta, ratio = self.graph.states[node]
        others = [other for key, other in self.tracks.items() if key != robot]
        places = [self.pose(key) for key in self.tracks if key != robot]
        hop, track.target = next_stop(
            self.occupancy(),
            np.array([x, y]),
            self.graph.poses[:, :2],
            np.array([place[:2] for place in places if place is not None]).reshape(-1, 2),
            np.array([other.target for other in others if other.target is not None]).reshape(-1, 2),
            self.settings,
            track.home,
        )
        turned = float(stop.turn[stop.looked - 1])
        pose = np.array([x, y, theta + ratio * (turned - stop.begin_turn)])
        odometry = stop.arrival + np.array([0.0, 0.0, turned])
        number = track.goal.number + 1 if track.goal else 1
        there = goal_by_odometry(pose, odometry, hop, ratio)
        track.goal = Goal(number, hop, there, int(stop.stamp_ns[stop.looked - 1]), pose)
        track.located = Located(track.goal.stamp_ns, pose)

    def _look_for_home(self, track: Track, node: int) -> None:
        """Send a robot with a large position sigma back to an old stop nearby from which walls were seen."""
        graph = self.graph
        if track.home is not None and math.dist(track.home, graph.states[node, :2]) < _AT_HOME:
            track.home = None
        if graph.count <= _HOME_AGE or graph.count % _CHECK_EVERY:
            return
        variances = np.diag(graph.covariance(node))[:2]
        if variances.max() <= _LOST_SIGMA**2:
            return
        away = graph.distances(node)
        old = (away < _HOME_RADIUS) & (np.arange(graph.count) < node - _HOME_AGE) & graph.sees_walls
        if old.any():
            cost = np.where(old, away + 0.02 * np.arange(graph.count), np.inf)
            track.home = graph.states[int(np.argmin(cost)), :2].copy()
