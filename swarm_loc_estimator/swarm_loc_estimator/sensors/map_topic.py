"""Maps of walls by topic, as of map_server or a SLAM system, which may change at run time."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.messages.cdr import OCCUPANCY_GRID
from swarm_loc_estimator.common.messages.streams import Messages
from swarm_loc_estimator.filter.measurements import select
from swarm_loc_estimator.mapping.map_file import MAX_CELLS, PLACE, RESOLUTION, MapFileError, map_of_message
from swarm_loc_estimator.mapping.messages import grid_message
from swarm_loc_estimator.sensors.sensor import Sensor
from swarm_loc_estimator.swarm.swarm import Robot


class MapRows(NamedTuple):
    """Maps (k,)."""

    robot: IntArray  #: (k,) always -1, the whole swarm
    stamp_ns: IntArray  #: (k,) times of the maps
    map: NDArray[Any]  #: (k,) of `GridMessage`, and of `OccupancyMap` after `MapSensor.measure`
    arrival_ns: IntArray  #: (k,) arrival times, from which on they count


class MapSensor(Sensor):
    """The map of a swarm whose description says `map: topic`."""

    name, topic, message_type = "map", "map", OCCUPANCY_GRID
    of_each, in_map, needs_map, unit = False, True, True, None

    @classmethod
    def fault_of(cls, message: Any, map_frame: str) -> str:
        """Reason to drop a map, "" if there is none."""
        about, count = message.info, message.data.size
        wrong = "" if 0 < count == about.width * about.height else "map_size"
        return super().fault_of(message, map_frame) or wrong

    @classmethod
    def expected_of(cls, robot: Robot) -> bool:
        """Whether the robot has a lidar, which needs the map."""
        return robot.lidar.is_used

    @classmethod
    def columns(cls, messages: Messages[Any]) -> MapRows:
        """Keep the decoded messages (n,)."""
        maps = np.empty(len(messages.decoded), dtype=object)
        maps[:] = [grid_message(one) for one in messages.decoded]
        return MapRows(messages.robot, messages.stamp_ns, maps, messages.arrival_ns)

    def measure(self, rows: MapRows) -> MapRows:
        """Make the maps, and count those that cannot be used."""
        maps = rows.map.copy()
        for k, grid in enumerate(rows.map):
            x, y, yaw = grid.origin
            faults = {
                "map_too_large": grid.cells.size > MAX_CELLS,
                "map_resolution": not RESOLUTION.allows(grid.resolution),
                "map_origin": not (PLACE.allows(x) and PLACE.allows(y) and math.isfinite(yaw)),
            }
            try:
                why = next((reason for reason, bad in faults.items() if bad), "")
                maps[k] = None if why else map_of_message(grid)
            except MapFileError:
                why, maps[k] = "map_unusable", None
            if why:
                self.drops.add(why, rows.robot[k : k + 1])
        return select(rows._replace(map=maps), np.array([one is not None for one in maps], dtype=bool))
