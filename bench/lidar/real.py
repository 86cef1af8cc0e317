"""A real TurtleBot 4 in the map of its floor: no start, no mount, no order of its beams in the description.

There is no ground truth, so the scans judge: how far their beams end from walls of the map, by the poses that
are published. A robot at a wrong place leaves residuals of several decimetres.
"""

from __future__ import annotations

import numpy as np
import scipy

from bench.shared.common import SHARED
from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.reader import BagReader
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN
from swarm_loc_estimator.common.se2 import compose, transform_points
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.mapping.grid import OccupancyMap
from swarm_loc_estimator.mapping.map_file import load_map
from swarm_loc_estimator.mapping.messages import decode_scan
from swarm_loc_estimator.offline.replay import replay
from swarm_loc_estimator.swarm.error_models import LidarModel, OdometryModel
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimate import Status

FOLDER = SHARED / "data" / "turtlebot4_map"
MAP = FOLDER / "mac_1st_floor_final.yaml"
_REMAP = {"tb4/odom": "/odom", "tb4/scan": "/scan"}
_TICK_S, _LATE_S, _MOUNT = 0.05, 0.175, (0.004, 0.0, 0.5 * np.pi)
"""Time between poses; age of the beams at their stamps, and mount of the lidar, as tf_static has it."""
_WRONG_M, _FAR_M = 0.2, 1.0
"""Median residual of a place that is wrong, and distance from walls beyond which beams are not compared."""


def measure() -> dict[str, float]:
    """Figures of the recording."""
    odometry, lidar = OdometryModel(wheel_separation=0.233), LidarModel(range_sigma=0.01)
    swarm = Swarm((Robot("tb4", odometry=odometry, lidar=lidar, camera=None),), map=MAP)
    result = replay(FOLDER, swarm, tick_s=_TICK_S, remap=_REMAP)
    tracked = result.status[:, 0] == Status.TRACKED
    figures = {"located": float(tracked.any()), "wrong": 0.0, "run_s": result.wall_s}
    if tracked.any():
        first = int(np.flatnonzero(tracked)[0])
        residual = residuals(result.stamp_ns[tracked], result.poses[tracked, 0], load_map(MAP))
        figures |= {
            "found_s": 1e-9 * float(result.stamp_ns[first] - result.stamp_ns[0]),
            "tracked_share": float(tracked[first:].mean()),
            "residual_cm": 100.0 * float(np.median(residual)),
            "wrong": float((residual > _WRONG_M).mean() > 0.05),
        }
    return {f"turtlebot4_map.{key}": value for key, value in figures.items()}


def residuals(stamp_ns: IntArray, poses: FloatArray, walls: OccupancyMap) -> FloatArray:
    """Median distance (s,) of the beams of each scan from walls, by poses (n, 3) at times (n,) [m]."""
    tree = scipy.spatial.cKDTree(walls.centres(walls.occupied))
    track, found = Trajectory(stamp_ns, poses), []
    with BagReader(FOLDER) as bag:
        for _, _, _, data in bag.messages([one.name for one in bag.topics if one.type == LASER_SCAN]):
            scan = decode_scan(data)
            beams = np.flatnonzero(np.isfinite(scan.ranges) & (scan.ranges > 0.0))
            # the last beam is measured first
            times = 1e9 * (scan.time_increment * (len(scan.ranges) - 1 - beams) - _LATE_S)
            at_ns = scan.stamp_ns + times.astype(np.int64)
            at, known = interpolate(track, at_ns, DEFAULT_GAP_NS)
            if not known.all():
                continue
            turns = scan.angle_min + scan.angle_increment * beams
            ends = scan.ranges[beams, None] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
            near, _ = tree.query(transform_points(compose(at, _MOUNT), ends))
            found.append(float(np.median(near[near < _FAR_M])) if (near < _FAR_M).any() else _FAR_M)
    return np.array(found)
