"""PushBots that explore a floor plan without firmware: truth, odometry, distances, and a mapper's goals.

Unlike the firmware emulator, which processes single bytes, each call simulates a whole turn or drive, so that
hundreds of hours of mapping can be simulated.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlan, clearance, is_visible, ray_distance
from swarm_loc_estimator import SCAN_TURN, UNSEEN, CooperativeMapper, LightSightings, Readings
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.se2 import wrap_angle

PERIOD_S = 0.02  # Between two reports of the event tracker
TURN_RATE, SPEED = 1.0, 0.2  # [rad/s], [m/s]
BODY_RADIUS = 0.06
FOCAL_BASELINE = 90.0 * 0.07  # Focal length times distance of laser and lens [px m]
_MAX_PX = 40.0
_NEAREST, _FARTHEST = 0.10, 2.5  # Minimum and maximum distance of a reflection [m]
_LED_RADIUS = 0.045
_LED_RANGE = 3.0
_HALF_FIELD = math.radians(35.0)


@dataclass(frozen=True)
class PushBotNoise:
    """Imperfections; standard deviations."""

    slip: float = 0.0  # Share of every turn that is lost
    turn: float = math.radians(0.64)  # Of a turn, per square root of a full turn [rad]
    distance: float = 0.015  # Of a drive, per path
    heading: float = math.radians(0.3)  # While driving, per square root of a metre [rad]
    pixel: float = 0.1  # Of the tracked row of the laser spot [px]
    dropout: float = 0.01  # Share of readings without reflection
    outlier: float = 0.003  # Share of readings that are outliers
    bearing: float = math.radians(1.0)  # Of the bearing of a light [rad]
    held: float = 0.0  # Share of drives in which something holds the body while its wheels turn on


class KinematicPushBot:
    """One robot in a floor plan, from a pose (3,) on."""

    def __init__(
        self, plan: FloorPlan, pose: FloatArray, noise: PushBotNoise, rng: np.random.Generator
    ) -> None:
        self._plan = plan
        self._noise = noise
        self._rng = rng
        self._traces = [np.asarray(pose, dtype=float)[None]]
        self._odometry = np.zeros(3)
        self._steps = 0
        self.bumps = 0  # Number of stops by obstacles

    @property
    def pose(self) -> FloatArray:
        """True pose (3,) now."""
        pose: FloatArray = self._traces[-1][-1]
        return pose

    @property
    def time_s(self) -> float:
        """Time of this robot [s]."""
        return self._steps * PERIOD_S

    @property
    def trace(self) -> FloatArray:
        """(n, 3) true poses, one every `PERIOD_S`."""
        if len(self._traces) > 1:
            self._traces = [np.concatenate(self._traces)]
        return self._traces[0]

    def positions_at(self, steps: IntArray) -> FloatArray:
        """True positions (n, 2) at steps of time (n,); the last known ones beyond."""
        trace = self.trace
        positions: FloatArray = trace[np.minimum(steps, len(trace) - 1)]
        return positions

    def turn(self, angle: float, others: list[KinematicPushBot], rate: float = TURN_RATE) -> Readings:
        """Turn on the spot by an angle of the odometry [rad] at a rate [rad/s]; returns the readings."""
        count = max(1, round(abs(angle) / (rate * PERIOD_S)))
        step = angle / count
        noise = self._noise.turn * math.sqrt(abs(step) / (2.0 * math.pi))
        true = np.cumsum(step * (1.0 - self._noise.slip) + noise * self._rng.standard_normal(count))
        poses = np.tile(self.pose, (count, 1))
        poses[:, 2] += true
        reported = np.tile(self._odometry, (count, 1))
        reported[:, 2] += step * np.arange(1, count + 1)
        return self._moved(poses, reported, others)

    def rest(self, duration_s: float, others: list[KinematicPushBot]) -> Readings:
        """Stand still for a time [s]; returns the readings."""
        count = round(duration_s / PERIOD_S)
        return self._moved(np.tile(self.pose, (count, 1)), np.tile(self._odometry, (count, 1)), others)

    def drive(self, length: float, others: list[KinematicPushBot]) -> Readings:
        """Drive ahead by a length of the odometry [m] or up to an obstacle; returns the readings."""
        count = max(1, round(length / (SPEED * PERIOD_S)))
        step = length / count
        scale = 1.0 + self._noise.distance * self._rng.standard_normal()
        noise = self._noise.heading * math.sqrt(step)
        headings = self.pose[2] + np.cumsum(noise * self._rng.standard_normal(count))
        moves = step * scale * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
        poses = np.column_stack([self.pose[:2] + np.cumsum(moves, axis=0), headings])
        discs = self._discs(others, count)
        free = _free_steps(self._plan.walls, discs, self.pose, poses)
        self.bumps += free < count
        ahead = np.array([math.cos(self._odometry[2]), math.sin(self._odometry[2]), 0.0])
        if self._noise.held and self._rng.random() < self._noise.held:  # half of them from the beginning
            last = max(0, min(free, int(self._rng.uniform(-count, count))))
            poses = np.vstack([self.pose, poses])[np.minimum(np.arange(1, count + 1), last)]
            free = count
        poses = poses[: max(free, 1)] if free else self.pose[None]
        reported = self._odometry + step * np.arange(1, len(poses) + 1)[:, None] * ahead * (free > 0)
        return self._moved(poses, reported, others)

    def step(self, speed: float, rate: float, others: list[KinematicPushBot]) -> Readings:
        """Move for `PERIOD_S` at a speed [m/s] and a rate [rad/s]; a body that is held only turns."""
        noise, length, turn = self._noise, speed * PERIOD_S, rate * PERIOD_S
        sigma = noise.turn * math.sqrt(abs(turn) / (2.0 * math.pi)) + noise.heading * math.sqrt(abs(length))
        pose, reported = self.pose.copy(), self._odometry.copy()
        true_turn = (1.0 - noise.slip) * turn + sigma * self._rng.standard_normal()
        for moved, angle in ((pose, true_turn), (reported, turn)):
            moved[:2] += length * np.array([math.cos(moved[2]), math.sin(moved[2])])
            moved[2] += angle
        if not _free_steps(self._plan.walls, self._discs(others, 1), self.pose, pose[None]):
            pose[:2] = self.pose[:2]
        return self._moved(pose[None], reported[None], others)

    def restart_odometry(self) -> None:
        """Begin odometry at zero, as a new driver does."""
        self._odometry = np.zeros(3)

    def lights(self, stamp_ns: IntArray, others: dict[int, KinematicPushBot]) -> LightSightings:
        """Sightings of the lights of other robots, by number, at times (n,) that all robots have lived."""
        steps = np.round(stamp_ns / (1e9 * PERIOD_S)).astype(np.int64)
        own = self.positions_at(steps)
        rows: list[tuple[int, int, float]] = []
        for number, other in others.items():
            there = other.positions_at(steps)
            seen, bearing = _seen_lights(self._plan.walls, own, there)
            chosen = np.flatnonzero(seen)
            rows += [(int(stamp_ns[k]), number, float(bearing[k])) for k in chosen]
        rows.sort()
        seen_ns, target, bearings = (np.array(c) for c in zip(*rows, strict=True)) if rows else ([], [], [])
        count = len(rows)
        noisy = np.asarray(bearings, dtype=float) + self._noise.bearing * self._rng.standard_normal(count)
        return LightSightings(
            np.asarray(seen_ns, dtype=np.int64),
            np.asarray(target, dtype=np.int64),
            noisy,
            np.full(count, self._noise.bearing),
        )

    def _discs(self, others: list[KinematicPushBot], count: int) -> FloatArray:
        """Positions (count, others, 2) of other robots in the next steps."""
        steps = self._steps + 1 + np.arange(count)
        return (
            np.stack([one.positions_at(steps)[:, :2] for one in others], axis=1)
            if others
            else np.zeros((count, 0, 2))
        )

    def _moved(self, poses: FloatArray, odometry: FloatArray, others: list[KinematicPushBot]) -> Readings:
        """Move through poses (n, 3) with odometry (n, 3); returns the readings."""
        count = len(poses)
        distances = _distances(self._plan.walls, self._discs(others, count), poses)
        self._traces.append(poses)
        stamp_ns = np.round((self._steps + 1 + np.arange(count)) * PERIOD_S * 1e9).astype(np.int64)
        self._steps += count
        self._odometry = odometry[-1].copy()
        reported = odometry.copy()
        reported[:, 2] = wrap_angle(odometry[:, 2])
        return Readings(stamp_ns, reported, self._inverse(distances), self._noise.pixel / FOCAL_BASELINE)

    def _inverse(self, distances: FloatArray) -> FloatArray:
        """Inverse distances (n,) that the tracker reports of true distances (n,)."""
        count, rng, noise = len(distances), self._rng, self._noise
        pixels = FOCAL_BASELINE / np.maximum(distances, _NEAREST) + noise.pixel * rng.standard_normal(count)
        lowest = FOCAL_BASELINE / _FARTHEST
        nonsense = rng.random(count) < noise.outlier
        pixels = np.where(nonsense, rng.uniform(lowest, _MAX_PX, count), pixels)
        seen: BoolArray = (distances > _NEAREST) & (distances < _FARTHEST) & (pixels > lowest)
        seen &= rng.random(count) >= noise.dropout
        return np.where(seen, pixels / FOCAL_BASELINE, UNSEEN)


@cached_njit
def _distances(walls: FloatArray, discs: FloatArray, poses: FloatArray) -> FloatArray:
    """Distances (n,) ahead of poses (n, 3), with other robots at (n, r, 2)."""
    out = np.zeros(len(poses))
    for k in range(len(poses)):
        out[k] = ray_distance(walls, discs[k], BODY_RADIUS, poses[k, 0], poses[k, 1], poses[k, 2])
    return out


@cached_njit
def _free_steps(walls: FloatArray, discs: FloatArray, start: FloatArray, poses: FloatArray) -> int:
    """Number of steps along poses (n, 3) before a collision."""
    before = clearance(walls, discs[0], BODY_RADIUS, start[0], start[1])
    for k in range(len(poses)):
        room = clearance(walls, discs[k], BODY_RADIUS, poses[k, 0], poses[k, 1])
        if room < BODY_RADIUS and room < before:
            return k
        before = room
    return len(poses)


@cached_njit
def _seen_lights(walls: FloatArray, own: FloatArray, there: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Whether each of (n, 3) poses sees a light of a robot at (n, 3), and its bearing.

    A robot has a light at the front and one at the back; the nearer one is seen.
    """
    seen, bearing = np.zeros(len(own), dtype=np.bool_), np.zeros(len(own))
    for k in range(len(own)):
        nearest = math.inf
        for side in (-1.0, 1.0):
            x = there[k, 0] + side * _LED_RADIUS * math.cos(there[k, 2])
            y = there[k, 1] + side * _LED_RADIUS * math.sin(there[k, 2])
            distance = math.hypot(x - own[k, 0], y - own[k, 1])
            if distance < nearest:
                nearest = distance
                angle = math.atan2(y - own[k, 1], x - own[k, 0]) - own[k, 2]
                bearing[k] = (angle + math.pi) % (2.0 * math.pi) - math.pi
                seen[k] = is_visible(walls, own[k, 0], own[k, 1], x, y)
        seen[k] = seen[k] and nearest < _LED_RANGE and abs(bearing[k]) < _HALF_FIELD
    return seen, bearing


START_SIGMA = np.array([0.10, 0.10, math.radians(5.0)])
"""Of the starts of all robots but the first, whose start is the origin of the map."""
FIRST_SIGMA = np.full(3, 1e-3)
START_TURNS = ((0.25 * math.pi, 1.0 / 6.0), (0.25 * math.pi, 1.0 / 6.0), (4.0 * math.pi, 0.5))
"""Turns of a first scan [rad] and their rates [rad/s]."""
_REST_S = 1.2


@dataclass(frozen=True)
class Arrival:
    """One stop of a robot."""

    robot: int  # Its number
    time_s: float  # End of its scan [s]
    truth: FloatArray  # (3,) true pose then
    online: FloatArray  # (3,) the mapper's estimate then
    count: int  # Number of earlier arrivals of all robots


@dataclass
class Exploration:
    """Robots that explore a floor plan with one mapper."""

    plan: FloorPlan  # The hall
    mapper: CooperativeMapper  # Makes the map
    rng: np.random.Generator  # Source of all noise
    use_lights: bool = True  # Whether the mapper gets sightings of lights
    robots: dict[int, KinematicPushBot] = field(default_factory=dict)  # Those that have joined, by number
    arrivals: list[Arrival] = field(default_factory=list)  # All stops so far
    cpu_s: float = 0.0  # CPU time of the mapper [s]
    # By robot, the start pose (3,) that the mapper was given
    starts: dict[int, FloatArray] = field(default_factory=dict)
    # Called with the number and readings of a robot
    on_readings: Callable[[int, Readings], None] | None = None
    # Called with the number and light sightings of a robot
    on_lights: Callable[[int, LightSightings], None] | None = None
    _odometry: dict[int, FloatArray] = field(default_factory=dict)
    _unlooked_ns: dict[int, IntArray] = field(default_factory=dict)

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
        self._unlooked_ns[robot] = np.zeros(0, dtype=np.int64)
        return robot

    def run(self, until_s: float, on_arrival: Callable[[Arrival], None] | None = None) -> None:
        """Explore until a time [s]; the robot with the smallest time acts next."""
        while True:
            robot = min(self.robots, key=lambda one: self.robots[one].time_s)
            if self.robots[robot].time_s >= until_s:
                return
            self._act(robot)
            if on_arrival is not None:
                on_arrival(self.arrivals[-1])

    def _act(self, robot: int) -> None:
        """Drive a robot to its goal, unless this is its first scan, and let it scan."""
        body = self.robots[robot]
        others = [one for key, one in self.robots.items() if key != robot]
        if not body.time_s:
            for angle, rate in START_TURNS:
                self._feed(robot, body.turn(angle, others, rate))
        else:
            self._go(robot, body, others)
            self._feed(robot, body.turn(SCAN_TURN, others))
        if self.mapper.goal(robot) is None:  # after much slip, a rest ends the scan
            self._feed(robot, body.rest(_REST_S, others))
        self._arrive(robot)

    def _arrive(self, robot: int) -> None:
        """Note a stop."""
        body, online = self.robots[robot], self.mapper.pose(robot)
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
        """Pass readings to the mapper, and the lights that robots have seen until now."""
        self._odometry[robot] = readings.odometry[-1]
        self._unlooked_ns[robot] = np.concatenate([self._unlooked_ns[robot], readings.stamp_ns])
        if self.on_readings is not None:
            self.on_readings(robot, readings)
        begin_s = time.process_time()
        self.mapper.add_readings(robot, readings)
        self.cpu_s += time.process_time() - begin_s
        if self.use_lights and len(self.robots) > 1:
            for one in self.robots:
                self._look_for_lights(one)

    def _look_for_lights(self, robot: int) -> None:
        """Pass sightings of other robots to the mapper, once it is known where these were at the time."""
        others = {key: one for key, one in self.robots.items() if key != robot}
        until_ns = round(1e9 * min(one.time_s for one in others.values()))
        waiting_ns = self._unlooked_ns[robot]
        count = int(np.searchsorted(waiting_ns, until_ns, side="right"))
        self._unlooked_ns[robot] = waiting_ns[count:]
        sightings = self.robots[robot].lights(waiting_ns[:count], others)
        if self.on_lights is not None and len(sightings.stamp_ns):
            self.on_lights(robot, sightings)
        self.mapper.add_lights(robot, sightings)
