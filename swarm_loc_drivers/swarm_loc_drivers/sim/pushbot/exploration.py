"""Simulated PushBots that explore a floor plan: they look around, and go where a mapper sends them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlan
from swarm_loc_drivers.sim.pushbot.kinematics import KinematicPushBot, PushBotNoise
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.se2 import wrap_angle
from swarm_loc_estimator.mapping.exploration.goal import Goal
from swarm_loc_estimator.mapping.mapper import SCAN_TURN
from swarm_loc_estimator.mapping.readings import LightSightings, Readings

START_SIGMA = np.array([0.10, 0.10, math.radians(5.0)])
"""How well the starts of all robots but the first are known; that one's is the origin of the map."""
FIRST_SIGMA = np.full(3, 1e-3)
START_TURNS = ((0.25 * math.pi, 1.0 / 6.0), (0.25 * math.pi, 1.0 / 6.0), (4.0 * math.pi, 0.5))
"""Turns of a first scan [rad] and their rates [rad/s]."""
_REST_S = 1.2


class Mapper(Protocol):
    """What makes a map of readings and says where to go."""

    def join(self, pose: FloatArray, sigma: FloatArray) -> int:
        """Let a robot join; its number."""

    def add_readings(self, robot: int, readings: Readings) -> None:
        """Take readings."""

    def add_lights(self, robot: int, sightings: LightSightings) -> None:
        """Take sightings of lights."""

    def pose(self, robot: int) -> FloatArray | None:
        """The pose of a robot now."""

    def goal(self, robot: int) -> Goal | None:
        """Where it should go."""


@dataclass(frozen=True)
class Arrival:
    """One stop of a robot.

    Attributes:
        robot: Its number.
        time_s: When it had looked around.
        truth: (3,) true pose then.
        online: (3,) what the mapper believed then.
        count: How many arrivals came before, of all robots.
    """

    robot: int
    time_s: float
    truth: FloatArray
    online: FloatArray
    count: int


@dataclass
class Exploration:
    """Robots in a floor plan with one mapper.

    Attributes:
        plan: The hall.
        mapper: Makes the map.
        rng: Source of all noise.
        use_lights: Whether the mapper gets sightings of lights.
        robots: Those that have joined, by number.
        arrivals: All stops so far.
        cpu_s: Time that the mapper needed.
        starts: (3,) where the mapper was told that each robot starts.
        on_readings: Is told of all that each robot reads.
    """

    plan: FloorPlan
    mapper: Mapper
    rng: np.random.Generator
    use_lights: bool = True
    robots: dict[int, KinematicPushBot] = field(default_factory=dict)
    arrivals: list[Arrival] = field(default_factory=list)
    cpu_s: float = 0.0
    starts: dict[int, FloatArray] = field(default_factory=dict)
    on_readings: Callable[[int, Readings, LightSightings | None], None] | None = None
    _odometry: dict[int, FloatArray] = field(default_factory=dict)

    def join(self, noise: PushBotNoise) -> int:
        """Let another robot join at the plan's next start, with a random heading; its number."""
        count = len(self.robots)
        pose = np.array([*self.plan.starts[count], self.rng.uniform(-math.pi, math.pi)])
        sigma = START_SIGMA if count else FIRST_SIGMA
        known = pose + sigma * self.rng.standard_normal(3) if count else pose
        robot = self.mapper.join(known, sigma)
        self.starts[robot] = known
        self.robots[robot] = KinematicPushBot(self.plan, pose, noise, self.rng)
        self._odometry[robot] = np.zeros(3)
        return robot

    def run(self, until_s: float, on_arrival: Callable[[Arrival], None] | None = None) -> None:
        """Let all robots explore until a time [s]; the one whose time is least acts next."""
        while True:
            robot = min(self.robots, key=lambda one: self.robots[one].time_s)
            if self.robots[robot].time_s >= until_s:
                return
            self._act(robot)
            if on_arrival is not None:
                on_arrival(self.arrivals[-1])

    def _act(self, robot: int) -> None:
        """Let a robot go to its goal, if it has looked around before, and look around."""
        body = self.robots[robot]
        others = self._others(robot)
        if not body.time_s:
            for angle, rate in START_TURNS:
                self._feed(robot, body.turn(angle, others, rate))
        else:
            self._go(robot, body, others)
            self._feed(robot, body.turn(SCAN_TURN, others))
        if self.mapper.goal(robot) is None:  # it has slipped a lot: a rest says that this is all
            self._feed(robot, body.rest(_REST_S, others))
        online = self.mapper.pose(robot)
        known = np.full(3, np.nan) if online is None else online
        self.arrivals.append(Arrival(robot, body.time_s, body.pose.copy(), known, len(self.arrivals)))

    def _go(self, robot: int, body: KinematicPushBot, others: list[KinematicPushBot]) -> None:
        goal = self.mapper.goal(robot)
        if goal is None:
            return
        way = goal.odometry - self._odometry[robot][:2]
        length = math.hypot(way[0], way[1])
        if length > 1e-3:
            turn = float(wrap_angle(math.atan2(way[1], way[0]) - self._odometry[robot][2]))
            self._feed(robot, body.turn(turn, others))
            self._feed(robot, body.drive(length, others))

    def _feed(self, robot: int, readings: Readings) -> None:
        """Give readings to the mapper, and what was seen of others."""
        self._odometry[robot] = readings.odometry[-1]
        others = {key: one for key, one in self.robots.items() if key != robot}
        sightings = self.robots[robot].lights(readings, others) if self.use_lights and others else None
        if self.on_readings is not None:
            self.on_readings(robot, readings, sightings)
        begin_s = time.process_time()
        self.mapper.add_readings(robot, readings)
        if sightings is not None:
            self.mapper.add_lights(robot, sightings)
        self.cpu_s += time.process_time() - begin_s

    def _others(self, robot: int) -> list[KinematicPushBot]:
        return [one for key, one in self.robots.items() if key != robot]
