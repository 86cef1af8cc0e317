"""Compile the mapper before data arrive, so that it keeps up with the robots. No ROS here."""

from __future__ import annotations

import math

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import note_precompiled
from swarm_loc_estimator.common.messages.poses import yaw_of
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.mapping.mapper import SCAN_TURN, START_TURN, CooperativeMapper
from swarm_loc_estimator.mapping.matching import Lattice, search_offsets
from swarm_loc_estimator.mapping.relocation import Search
from swarm_loc_estimator.mapping.scans import Readings, Scan, ScanStop
from swarm_loc_estimator.mapping.settings import MapperSettings

_ROOM = (1.7, 1.1)  # Distances of the walls from the centre of the room, east and west, north and south [m]
_PERIOD_NS, _TURN_RATE, _SPEED = 20_000_000, 1.0, 0.2
_STOPS = 4
_SIGMA = 0.016  # Noise of an inverse distance [1/m]


def precompile() -> None:
    """Map a simulated room several times; takes a minute unless `is_precompiled`, then a second."""
    mapper = CooperativeMapper(MapperSettings())
    robot = mapper.join(np.zeros(3), np.array([0.01, 0.01, 0.01]))
    pose, stamp_ns = np.zeros(3), 0
    for stop in range(_STOPS):
        turn = np.array([0.0, 0.0, START_TURN if stop == 0 else SCAN_TURN])
        aside = np.array([0.0, 0.0, 0.5 * math.pi - wrap_angle(pose[2] + turn[2])])
        ahead = np.array([0.0, 0.4 if stop % 2 == 0 else -0.4, 0.0])
        for way, speed in ((turn, _TURN_RATE), (aside, _TURN_RATE), (ahead, _SPEED)):
            count = max(2, round(float(np.abs(way).max()) / (speed * _PERIOD_NS * 1e-9)))
            poses = pose + way * (np.arange(1, count + 1)[:, None] / count)  # one for each reading
            poses[:, 2] = wrap_angle(poses[:, 2])
            stamps = stamp_ns + _PERIOD_NS * np.arange(1, len(poses) + 1)
            mapper.add_readings(robot, Readings(stamps, poses, _inverse_distances(poses), _SIGMA))
            pose, stamp_ns = poses[-1], int(stamps[-1])
            mapper.goal(robot)
        mapper.covariance(robot)
        mapper.visits.on(mapper.occupancy())
    # what is called where a robot comes to an old stop again
    search_offsets(mapper.graph.scans, np.array([1]), np.array([0]), Lattice(0.06, 0.06, 0.03, 0.03))
    # what is called where odometry has restarted
    view = ScanStop(pose)
    view.turn = np.linspace(0.0, 7.0, 9)
    view.inverse = np.ones(9)
    Search(pose, 1.0).add(view, 1.0, mapper.occupancy())
    # what is called where robots have lidars
    mapper, around = CooperativeMapper(MapperSettings()), np.linspace(-3.0, 3.0, 200)
    robot = mapper.join(np.zeros(3), np.array([0.01, 0.01, 0.01]))
    for ahead_m in (0.0, 0.4):
        pose = np.array([ahead_m, 0.0, 0.0])
        inverse = _inverse_distances(np.column_stack([np.tile(pose[:2], (len(around), 1)), around]))
        scan = Scan(np.zeros(len(around)), inverse, around)
        mapper.add_sweep(robot, ScanStop.of_sweep(round(1e10 * ahead_m), pose, scan, _SIGMA, 12.0))
    mapper.sweeps.doubts()
    mapper.occupancy()
    yaw_of(0.0, 0.0, 0.0, 1.0)  # what reads odometry
    note_precompiled(precompile)


def _inverse_distances(poses: FloatArray) -> FloatArray:
    """Inverse distances (n,) of the walls ahead of poses (n, 3) [1/m]."""
    direction = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=-1)
    ways = (np.copysign(_ROOM, direction) - poses[:, :2]) / np.where(direction == 0.0, 1e-12, direction)
    inverse: FloatArray = 1.0 / ways.min(axis=1)
    return inverse
