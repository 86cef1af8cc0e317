"""Localization of robots with lidars in a known map: each scan becomes an absolute fix.

The timeline matches a scan when its turn comes, at its stamp, from the pose predicted then, and again when
older data arrive. So poses do not depend on the order of arrival.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import between
from swarm_loc_estimator.filter.integrity import CONFIRMED, count_missed, count_seen
from swarm_loc_estimator.filter.measurements import Loss, Measurements, Verdict
from swarm_loc_estimator.filter.models import CARTESIAN
from swarm_loc_estimator.filter.state import IN_MAP, SwarmState
from swarm_loc_estimator.mapping.map_file import load_map
from swarm_loc_estimator.mapping.map_matching import BLOCKED, OFF_MAP, WallMap, match, wall_map
from swarm_loc_estimator.mapping.sweeps import LidarSweep
from swarm_loc_estimator.odometry.tracks import OdometryTracks
from swarm_loc_estimator.sensors.fix import about_robots
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimate import TrackedLimits, estimate_at
from swarm_loc_estimator.timeline.settings import Settings

_SYSTEMATIC_SHARE = 0.7
"""Share of a match's variance that the next scans have, too: what is wrong with the map at a place."""
_MAX_MISSED, _MAX_AT_START = 10.0, 3.0
"""Fault scores at which a robot is lost whose scans contradict the map, and before its start is confirmed."""
_ALL, _SURE_FIT = 3, 0.65
"""Number of directions and share of fitting beams with which a scan confirms a start: elsewhere, walls like
those at home are seen now and then."""
Sweeps = Mapping[tuple[int, int], LidarSweep]  # Sweeps by robot and stamp of the first beam [ns]


def walls_of(swarm: Swarm) -> WallMap | None:
    """Read the map of a swarm, if it has one, and compile the matching before data come.

    Raises:
        UserError: The map cannot be read, or has no walls or no free space.
    """
    if swarm.map is None:
        return None
    walls = wall_map(load_map(swarm.map), swarm.map)
    match(walls, np.zeros((0, 2)), np.zeros(2), np.zeros(0), np.zeros(3), np.eye(3))
    return walls


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
        self._limits = TrackedLimits.of(swarm, settings)
        self._walls = walls_of(swarm)

    def fix_of(self, state: SwarmState, one: Measurements) -> tuple[Measurements | None, Verdict]:
        """Match a scan; returns its fix (1,), or None and why there is none.

        Args:
            state: Its fault scores are changed.
            one: Row of the scan, whose robot is initialized if its start is known.
        """
        robot, stamp_ns = int(one.target), int(one.stamp_ns)
        sweep = self._sweeps.get((robot, int(one.reading)))
        if self._walls is None or sweep is None or state.origin != IN_MAP or not state.tracked[robot]:
            return None, Verdict.NOT_LOCALIZED
        estimate = estimate_at(state, self._tracks.arrays, self._limits, stamp_ns)
        beams = self._beams(robot, stamp_ns, sweep)
        walls = self._walls._replace(variance=self._walls.variance + self._lidars[robot].map_sigma ** 2)
        found = match(walls, *beams, estimate.poses[robot], estimate.covariances[robot])
        if found.outcome == OFF_MAP:
            confirmed = state.integrity.confirmations[robot] >= CONFIRMED
            if count_missed(state.integrity, robot, 1.0) >= (_MAX_MISSED if confirmed else _MAX_AT_START):
                state.deinitialize(robot, Loss.OFF_MAP, stamp_ns)  # later ones may fit by chance, elsewhere
            return None, Verdict.OFF_MAP
        if found.outcome == BLOCKED:
            return None, Verdict.BLOCKED
        count_seen(state.integrity, robot)
        if found.determined < _ALL or found.fitting < _SURE_FIT:  # does not confirm a start
            state.integrity.confirmed_ns[robot] = stamp_ns
        fix = about_robots(robot, stamp_ns, found.pose[None], found.covariance[None], CARTESIAN)
        fix.systematic_share[:] = _SYSTEMATIC_SHARE
        # with a second solution it locates no robot alone: it was sought near the pose that may be wrong
        fix.has_second[:], fix.second[:] = True, fix.value
        return fix, Verdict.OPEN

    def _beams(
        self, robot: int, stamp_ns: int, sweep: LidarSweep
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Beams of a sweep that met something, from the robot's pose at an instant, see `match`."""
        lidar, seen = self._lidars[robot], sweep.seen
        at_ns = np.append(sweep.beam_ns, stamp_ns)
        poses = self._tracks.at(np.full(at_ns.size, robot), at_ns).pose
        ends = sweep.ends(lidar, between(poses[-1], poses[:-1]))[seen]
        sigma = lidar.range_sigma + lidar.range_sigma_per_m * sweep.distance[seen]
        return ends, np.array([lidar.x, lidar.y]), sigma**2
