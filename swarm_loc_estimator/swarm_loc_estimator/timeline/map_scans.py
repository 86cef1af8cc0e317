"""Localization of robots with lidars in a known map: each scan becomes an absolute fix.

The timeline matches a scan when its turn comes, at its stamp, from the pose predicted then, and again when
older data arrive. So poses do not depend on the order of arrival. Scans of a robot that is not located
search the map for its place, see `map_search.py`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import between, compose
from swarm_loc_estimator.filter.measurements import LossReason, Measurements, Verdict
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.sources import CONFIRMED, RELIEF
from swarm_loc_estimator.filter.state import SwarmState, robot_columns
from swarm_loc_estimator.mapping.map_file import load_map
from swarm_loc_estimator.mapping.messages import LidarSweep
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.fix import about_robots
from swarm_loc_estimator.sensors.lidar import at_odometry, described_delay, learned_delay
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimate import TrackedLimits, estimate_at
from swarm_loc_estimator.timeline.map_matching import BLOCKED, FAR, FITS, OFF_MAP, WallMap, match, wall_map
from swarm_loc_estimator.timeline.map_search import FoundPlace, MapSearch, PossiblePlaces, SweptBeams
from swarm_loc_estimator.timeline.settings import Settings

_SYSTEMATIC_SHARE = 0.7
"""Share of a match's variance that the next scans have, too: what is wrong with the map at a place."""
_ALIKE_M = 2.0  # Distance within which errors of a map are alike [m]
_MAX_MISSED, _MAX_AT_START = 10.0, 3.0
"""Fault scores at which a robot is lost whose scans contradict the map, and before its start is confirmed."""
_ALL, _SURE_FIT = 3, 0.65
"""Number of directions and share of fitting beams with which a scan confirms a start: elsewhere, walls like
those at home are seen now and then."""
_ORDER_TURN, _ORDER_KNOWN = 0.03, 12.0
"""Turn during a sweep that tells in which order its beams are measured [rad], and log odds that settle it."""
_SEARCH_TURN = 0.1  # Turn during a sweep beyond which it searches no place [rad]
_ORDER_WEIGHT, _ORDER_NEWS = 10.0, 4.0
"""Log odds of this order by the misfit of a scan, whose beams err together, and the most by a scan."""
Sweeps = Mapping[tuple[int, int], LidarSweep]  # Sweeps by robot and stamp of the first beam [ns]


def walls_of(swarm: Swarm) -> WallMap | None:
    """Read the map of a swarm, if it has one, and compile the matching before data come.

    Raises:
        UserError: The map cannot be read, or has no walls or no free space.
    """
    if swarm.map is None:
        return None
    drawn = load_map(swarm.map)
    walls = wall_map(replace(drawn, corner=drawn.corner - swarm.origin), swarm.map)
    match(walls, np.zeros((0, 2)), np.zeros(2), np.zeros(0), np.zeros(3), np.eye(3))
    return walls


def _why_nowhere(places: PossiblePlaces | None) -> Verdict:
    """Why the scans of a robot do not locate it."""
    if places is None:
        return Verdict.NOT_LOCALIZED
    if not len(places.transform):
        return Verdict.NO_PLACE
    return Verdict.SEVERAL_PLACES if places.is_ambiguous else Verdict.NOT_LOCALIZED


class MapScans:
    """Matches scans to the map of a swarm.

    Args:
        swarm: The map, and robots with lidars.
        settings: Thresholds of lost robots.
        tracks: Odometry of the robots.
        sweeps: Sweeps by robot and stamp.

    Raises:
        UserError: The map cannot be read, or has no walls or no free space.
    """

    def __init__(self, swarm: Swarm, settings: Settings, tracks: OdometryTracks, sweeps: Sweeps) -> None:
        self._tracks, self._sweeps = tracks, sweeps
        self._lidars = [robot.lidar for robot in swarm.robots]
        self._may_search = [not robot.stands for robot in swarm.robots]
        self._limits = TrackedLimits.of(swarm, settings)
        self._walls = walls_of(swarm)
        self._search = None if self._walls is None else MapSearch(self._walls)

    def place_of(self, state: SwarmState, one: Measurements) -> tuple[FoundPlace | None, Verdict]:
        """Search the place of a robot that is not located, by its scan; returns it once it is found.

        Args:
            state: What is known of places is changed.
            one: Row of the scan.
        """
        robot, stamp_ns = int(one.target), int(one.stamp_ns)
        sweep = self._sweeps.get((robot, int(one.reading)))
        if self._walls is None or self._search is None or sweep is None or not self._may_search[robot]:
            return None, Verdict.NOT_LOCALIZED
        if not self._tracks.has_started(robot, sweep.stamp_ns):
            return None, Verdict.NOT_LOCALIZED
        delay = state.delays.get(robot) or described_delay(self._lidars[robot].delay_s)
        if self._turned(robot, sweep) > _SEARCH_TURN:
            return None, _why_nowhere(state.places.get(robot))  # its delay and order of beams may be wrong
        sweep = sweep.backwards() if delay.backwards > 0.0 else sweep
        beams, now, _ = self._beams(robot, stamp_ns, sweep, delay.lag_s, int(delay.chance.argmax()))
        places, found = self._search.add(
            state.places.get(robot),
            stamp_ns,
            SweptBeams.thinned(*beams),
            now,
            self._walls_of(self._walls, robot),
        )
        state.places[robot] = places
        if found is not None:
            del state.places[robot]
            return found, Verdict.USED
        return None, _why_nowhere(places)

    def _walls_of(self, walls: WallMap, robot: int) -> WallMap:
        """The map with the error that the description of a robot says."""
        return walls._replace(variance=walls.variance + self._lidars[robot].map_sigma ** 2)

    def fix_of(self, state: SwarmState, one: Measurements) -> tuple[Measurements | None, Verdict, bool]:
        """Match a scan; returns its fix (1,), or None and why there is none, and if it confirms a start.

        Args:
            state: Its fault scores are changed.
            one: Row of the scan, whose robot is located in the map.
        """
        robot, stamp_ns = int(one.target), int(one.stamp_ns)
        sweep = self._sweeps.get((robot, int(one.reading)))
        if self._walls is None or sweep is None:
            return None, Verdict.NOT_LOCALIZED, False
        estimate = estimate_at(state, self._tracks.arrays, self._limits, stamp_ns)
        pose, covariance = estimate.poses[robot], estimate.covariances[robot]
        walls = self._walls_of(self._walls, robot)
        # The scan may be older than its stamp says.
        delay = state.delays.get(robot) or described_delay(self._lidars[robot].delay_s)
        best = int(delay.chance.argmax())
        beams, now, track = self._beams(robot, stamp_ns, sweep, delay.lag_s, best)
        back = between(now, track[best])
        _, doubt = at_odometry(delay._replace(seen=compose(pose, back), track=track), now)
        found = match(walls, *beams, pose, covariance + doubt)
        if abs(delay.backwards) < _ORDER_KNOWN and self._turned(robot, sweep) > _ORDER_TURN:
            beams, _, _ = self._beams(robot, stamp_ns, sweep.backwards(), delay.lag_s, best)
            other = match(walls, *beams, pose, covariance + doubt)
            news = min(max(_ORDER_WEIGHT * (found.misfit - other.misfit), -_ORDER_NEWS), _ORDER_NEWS)
            delay = delay._replace(backwards=delay.backwards + news)
            found = other if delay.backwards > 0.0 else found
        elif delay.backwards > 0.0:
            beams, _, _ = self._beams(robot, stamp_ns, sweep.backwards(), delay.lag_s, best)
            found = match(walls, *beams, pose, covariance + doubt)
        state.delays[robot], driven = delay, 0.0
        confirmed = state.sources.confirmations[robot] >= CONFIRMED
        if found.outcome == FITS or (found.outcome == FAR and confirmed):
            if delay.stamp_ns > 0:
                driven = math.dist(delay.track[best, :2], track[best, :2])
            delay = learned_delay(delay, stamp_ns, compose(found.pose, back), found.covariance, track)
            state.delays[robot] = delay
        if found.outcome in (OFF_MAP, FAR):
            state.sources.score[robot] += 1.0
            if state.sources.score[robot] >= (_MAX_MISSED if confirmed else _MAX_AT_START):
                state.deinitialize(
                    robot, LossReason.OFF_MAP, stamp_ns
                )  # later ones may fit by chance, elsewhere
            return None, Verdict.OFF_MAP, False
        if found.outcome == BLOCKED:
            return None, Verdict.BLOCKED, False
        state.sources.score[robot] = max(0.0, state.sources.score[robot] - 4.0 * RELIEF)
        # walls err otherwise where it is now than where it was: the error that it shares with them fades
        fading = 2.0 * _SYSTEMATIC_SHARE * walls.variance * min(1.0, driven / _ALIKE_M)
        state.filter.add(robot_columns(np.array([robot]))[0], np.diag([fading, fading, 0.0]))
        pose, doubt = at_odometry(delay, now)
        fix = about_robots(robot, stamp_ns, pose[None], (found.covariance + doubt)[None], CARTESIAN)
        fix.systematic_share[:] = _SYSTEMATIC_SHARE
        # with a second solution it locates no robot alone: it was sought near the pose that may be wrong
        fix.has_second[:], fix.second[:] = True, fix.value
        return fix, Verdict.OPEN, found.determined >= _ALL and found.fitting >= _SURE_FIT

    def _turned(self, robot: int, sweep: LidarSweep) -> float:
        """How far a robot turned during a sweep, by odometry [rad]."""
        ends_ns = np.array([sweep.stamp_ns, sweep.stamp_ns + sweep.duration_ns])
        first, last = self._tracks.at(np.array([robot, robot]), ends_ns).pose[:, 2]
        return abs(float(last - first))

    def _beams(
        self, robot: int, stamp_ns: int, sweep: LidarSweep, lag_s: FloatArray, best: int
    ) -> tuple[tuple[FloatArray, FloatArray, FloatArray], FloatArray, FloatArray]:
        """Beams of a sweep at a lag that met something, from the robot's pose at an instant, see `match`.

        And poses by odometry: then (3,), and in the middle of the sweep at each lag (L, 3).
        """
        lidar, seen, beams = self._lidars[robot], sweep.seen, sweep.beam_ns.size
        lag_ns, middle_ns = np.round(1e9 * lag_s).astype(np.int64), sweep.stamp_ns + sweep.duration_ns // 2
        at_ns = np.concatenate([sweep.beam_ns - lag_ns[best], [stamp_ns], middle_ns - lag_ns])
        poses = self._tracks.at(np.full(at_ns.size, robot), at_ns).pose
        ends = sweep.ends(lidar, between(poses[beams], poses[:beams]))[seen]
        sigma = lidar.range_sigma + lidar.range_sigma_per_m * sweep.distance[seen]
        return (ends, np.array([lidar.x, lidar.y]), sigma**2), poses[beams], poses[beams + 1 :]
