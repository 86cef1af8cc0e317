"""A run of PushBots that make a map, for the page: poses, goals and the map as the mapper told them."""

from __future__ import annotations

import numpy as np

from bench.pushbot.exploration import Arrival, Exploration, PushBotNoise
from bench.pushbot.runs import RunSettings
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan
from swarm_loc_estimator.common.messages.poses import EstimateMessage
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.messages import GridMessage
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimate import Status
from swarm_loc_estimator.watch.page import Frame, about, map_frame, places_frame, poses_frame, recording

_MAP_EVERY_S = 20.0


def mapping_run(settings: RunSettings) -> str:
    """Explore, and record for the page."""
    mapper = CooperativeMapper()
    rng = np.random.default_rng([settings.seed, round(1e3 * settings.slip), settings.robots])
    exploration = Exploration(floor_plan(settings.plan), mapper, rng, use_lights=settings.lights)
    for _ in range(settings.robots):
        exploration.join(PushBotNoise(slip=settings.slip, pixel=settings.pixel))
    notes = _Notes(mapper, settings.robots)
    exploration.run(60.0 * settings.minutes, notes.add)
    swarm = Swarm(tuple(Robot(name, camera=None) for name in notes.names))
    told = about(swarm, f"{settings.robots} PushBots, {settings.plan}", commands=False)
    return recording(told, sorted(notes.frames, key=lambda frame: frame.stamp_ns))


class _Notes:
    """Frames of what the mapper tells whenever a robot has looked around.

    Args:
        mapper: Is asked.
        robots: How many there are.
    """

    def __init__(self, mapper: CooperativeMapper, robots: int) -> None:
        self._mapper = mapper
        self._truth = np.full((robots, 3), np.nan)
        self._goals: dict[int, list[float]] = {}
        self._next_map_s = 0.0
        self.names = tuple(f"pushbot{k + 1}" for k in range(robots))
        self.frames: list[Frame] = []

    def add(self, arrival: Arrival) -> None:
        """A robot has looked around."""
        stamp_ns, mapper = round(1e9 * arrival.time_s), self._mapper
        robots = range(len(self.names))
        poses = [mapper.pose(k) for k in robots]
        pose = np.array([np.full(3, np.nan) if one is None else one for one in poses])
        covariance = np.array([mapper.covariance(k) for k in robots])
        status = np.where(np.isfinite(pose[:, 0]), Status.TRACKED, Status.WAITING).astype(np.uint8)
        age = np.full(len(pose), np.nan)
        self.frames.append(
            poses_frame(
                EstimateMessage(stamp_ns, "map", self.names, pose, covariance, age, status, status > 0)
            )
        )
        self._truth[arrival.robot] = arrival.truth
        known = np.flatnonzero(np.isfinite(self._truth[:, 0]))
        self.frames.append(places_frame("truth", stamp_ns, known.tolist(), self._truth[known]))
        goal = mapper.goal(arrival.robot)
        if goal is not None:
            self._goals[arrival.robot] = [*goal.position, 0.0]
            places = np.array([*self._goals.values()])
            self.frames.append(places_frame("goals", stamp_ns, [*self._goals], places))
        if arrival.time_s >= self._next_map_s:
            self._next_map_s = arrival.time_s + _MAP_EVERY_S
            self.frames.append(map_frame(stamp_ns, self._grid(stamp_ns)))

    def _grid(self, stamp_ns: int) -> GridMessage:
        """The map as the mapper's node publishes it."""
        occupancy = self._mapper.occupancy()
        cells = occupancy.percent.round().astype(np.int8)
        x, y = map(float, occupancy.corner)
        return GridMessage(stamp_ns, "map", occupancy.cell, (x, y, 0.0), np.ascontiguousarray(cells.T))
