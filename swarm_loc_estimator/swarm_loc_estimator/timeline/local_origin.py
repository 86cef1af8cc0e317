"""Coordinates about a local origin: far from that of `map`, as in UTM, numbers lose what covariances need."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.mapping.map_file import load_map
from swarm_loc_estimator.swarm.swarm import Swarm

_GRID_M = 1e4  # Local origins are multiples of it [m]; nearer to that of `map`, there is none
_FARTHEST_M = 1e8  # Places farther away are absurd
_FAR_M, _IN_A_ROW = 5e5, 3  # Distance of fixes from the origin that are far [m], and how many in a row count
PLACING = ("fixes", "aerial")  # Sensors whose readings are in `map`


def is_placed(swarm: Swarm) -> bool:
    """Whether the description says any place in `map`."""
    return bool(swarm.surveyed) or isinstance(swarm.map, Path) or any(one.start for one in swarm.robots)


def local_origin(places: FloatArray) -> FloatArray:
    """The local origin (2,) of places (n, 2) [m]."""
    return np.round(np.median(places, axis=0) / _GRID_M) * _GRID_M + 0.0


def described_origin(swarm: Swarm) -> FloatArray:
    """The local origin (2,) of a swarm by what it says of places in `map` [m].

    Raises UserError if its map is needed for that and cannot be read.
    """
    places: list[Any] = [robot.start[:2] for robot in swarm.robots if robot.start is not None]
    places += [(one.x, one.y) for one in swarm.surveyed]
    if not places and isinstance(swarm.map, Path):
        places = [load_map(swarm.map).corner]
    return local_origin(np.array(places)) if places else np.zeros(2)


def about(swarm: Swarm, origin: FloatArray) -> Swarm:
    """The swarm with all places about an origin (2,) [m]."""
    x, y = origin.tolist()
    if not (x or y):
        return swarm
    moved: dict[str, Any] = {
        name: tuple(replace(one, x=one.x - x, y=one.y - y) for one in getattr(swarm, name))
        for name in ("landmarks", "cameras", "anchors")
    }
    robots = [
        robot
        if robot.start is None
        else replace(robot, start=(robot.start[0] - x, robot.start[1] - y, robot.start[2]))
        for robot in swarm.robots
    ]
    error, there = swarm.map_error, (swarm.origin[0] + x, swarm.origin[1] + y)
    moved["map_error"] = replace(error, x=error.x - x, y=error.y - y)
    return replace(swarm, robots=tuple(robots), origin=there, **moved)


def readings_about(rows: Mapping[str, Any], origin: FloatArray) -> dict[str, Any]:
    """Readings by sensor, with poses in `map` about an origin (2,)."""
    found = dict(rows)
    for name in PLACING:
        if name in rows:
            found[name] = rows[name]._replace(pose=rows[name].pose - [*origin, 0.0])
    return found


class OriginOfFixes:
    """The local origin where no description says one: the first fix tells it.

    A source whose first fix is far from all others must not keep them out. So the origin moves where more
    robots have their newest fixes than near it.
    """

    def __init__(self) -> None:
        # By robot, its newest fixes in a row that are far, the last ones
        self._far: defaultdict[int, deque[FloatArray]] = defaultdict(lambda: deque(maxlen=_IN_A_ROW))
        self._near: set[int] = set()  # Robots with their newest fixes near the origin

    def moved(self, rows: Mapping[str, Any], origin: FloatArray | None) -> FloatArray | None:
        """Another local origin (2,) by readings by sensor; None: it stays."""
        for name in PLACING:
            if name not in rows or not rows[name].pose.size:
                continue
            robots, places = getattr(rows[name], "robot", None), rows[name].pose[:, :2]
            usable = np.flatnonzero((np.abs(places) <= _FARTHEST_M).all(axis=1))  # false for NaN
            if origin is None and usable.size:
                return local_origin(places[usable[:1]])
            if origin is None or robots is None:
                continue
            is_far = (np.abs(places[usable] - origin) > _FAR_M).any(axis=1)
            for robot in np.unique(robots[usable[~is_far]]).tolist():
                self._near.add(robot)
                self._far.pop(robot, None)
            for row in usable[is_far].tolist():
                self._far[int(robots[row])].append(places[row])
        lost = [robot for robot, found in self._far.items() if len(found) == _IN_A_ROW]
        if len(lost) <= len(self._near - set(lost)):
            return None
        found = np.array([self._far[robot][-1] for robot in lost])
        self._far.clear()
        self._near.clear()
        return local_origin(found)
