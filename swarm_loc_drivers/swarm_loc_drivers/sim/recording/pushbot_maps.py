"""What a mapper tells besides poses, as messages of a bag: its map now and then, and the robots' goals."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarm_loc_drivers.sim.recording.bag import Stream
from swarm_loc_drivers.sim.recording.pushbot_events import header_at
from swarm_loc_estimator.common.messages.encoders import encode_pose_stamped
from swarm_loc_estimator.common.messages.typestore import POSE_STAMPED, encode, typestore
from swarm_loc_estimator.mapping.exploration.goal import Goal
from swarm_loc_estimator.mapping.grid.occupancy import OccupancyMap
from swarm_loc_estimator.mapping.grid_messages import OCCUPANCY_GRID

_PERIOD_NS = 30_000_000_000
"""Of maps: often enough to see them grow."""


class MapNotes:
    """Maps, noted every half minute.

    Args:
        begin_ns: Stamp at the time zero of the mapper [ns].
    """

    def __init__(self, begin_ns: int) -> None:
        self._begin_ns = begin_ns
        self._stamps: list[int] = []
        self._data: list[bytes] = []

    def note(self, time_ns: int, occupancy: OccupancyMap) -> None:
        """Note the map at a time of the mapper [ns], if one is due."""
        stamp_ns = self._begin_ns + time_ns
        if self._stamps and stamp_ns < self._stamps[-1] + _PERIOD_NS:
            return
        self._stamps.append(stamp_ns)
        self._data.append(encode_map(stamp_ns, occupancy))

    def stream(self) -> Stream:
        """The messages of `map`."""
        return Stream("map", OCCUPANCY_GRID, np.array(self._stamps, dtype=np.int64), self._data)


def encode_map(stamp_ns: int, occupancy: OccupancyMap) -> bytes:
    """The map as the mapper's node publishes it: -1 unknown, else the probability of an obstacle [%]."""
    types = typestore().types
    cells = np.ascontiguousarray(np.round(occupancy.percent).astype(np.int8).T)
    point, turn = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    header = header_at(stamp_ns, "map")
    x, y = map(float, occupancy.corner)
    origin = types["geometry_msgs/msg/Pose"](position=point(x, y, 0.0), orientation=turn(0.0, 0.0, 0.0, 1.0))
    about = types["nav_msgs/msg/MapMetaData"](
        map_load_time=header.stamp,
        resolution=occupancy.cell,
        width=cells.shape[1],
        height=cells.shape[0],
        origin=origin,
    )
    message = types[OCCUPANCY_GRID](header=header, info=about, data=cells.ravel())
    return encode(message, OCCUPANCY_GRID)


def goal_stream(name: str, begin_ns: int, goals: Sequence[Goal]) -> Stream:
    """The messages of `<robot>/goal`."""
    stamp_ns = begin_ns + np.array([goal.stamp_ns for goal in goals], dtype=np.int64)
    ways = [goal.position - goal.pose[:2] for goal in goals]
    poses = [
        [*goal.position.tolist(), math.atan2(way[1], way[0])] for goal, way in zip(goals, ways, strict=True)
    ]
    table = np.array(poses).reshape(-1, 3)
    return Stream(f"{name}/goal", POSE_STAMPED, stamp_ns, encode_pose_stamped("map", stamp_ns, table))
