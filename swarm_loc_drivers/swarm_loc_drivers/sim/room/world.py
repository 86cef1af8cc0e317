"""One world of robots with two wheels in a room, stepped in simulated time. No ROS here.

Robots wander by themselves, unless they are commanded. The room is a floor plan, the map of the description,
or the rectangle of its anchors, landmarks and ceiling cameras. The parameters of `room_world_node` are at
the end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from swarm_loc_drivers.sim.differential_drive import Drive, integrate, roll, twist_of, wheel_paths
from swarm_loc_drivers.sim.pushbot.floor_plan import floor_plan, kept_clear, polygon, ray_distance
from swarm_loc_drivers.sim.run import START_NS
from swarm_loc_drivers.sim.worlds import WorldError, WorldParameters, start_of
from swarm_loc_estimator import LOG_ODDS_CAP, OccupancyMap, load_map, save_map
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.parameters import choice, text
from swarm_loc_estimator.swarm.swarm import Robot, Swarm

STEP_NS = 10_000_000
ROOM_WORLDS = {"w2": 1.0, "w0": 0.0}
"""Error models -> hidden errors that last, in standard deviations of the description; noise is in both."""
VIEW = (math.tan(math.radians(30.0)), math.tan(math.radians(23.4)))
"""Half of what a ceiling camera sees across and along, per distance."""
_IN_VIEW = 0.9  # Share of it that lies within the walls: robots are seen up to there
_CELL = 0.05  # Of drawn maps [m]
_RADIUS = 0.75  # Radius of a body per distance of its wheels
_SPEED, _TURN_RATE, _SWERVE = 1.2, 0.8, 0.3  # When driving [radii/s], turning, driving straight on [rad/s]
_FEELERS = (-0.7, 0.0, 0.7)
_ROOM_AHEAD = 3.0  # Radii before a wall at which a robot turns
_COMMAND_NS, _DECIDE_NS = 500_000_000, 100_000_000  # How long a command holds, and between decisions


@dataclass(frozen=True)
class Room:
    """Walls, and where it is free between them."""

    walls: FloatArray  # (S, 4) segments x0, y0, x1, y1 [m]
    map: OccupancyMap


def room_of(swarm: Swarm, plan: str) -> Room:
    """The room of a swarm: that of a plan, if one is given.

    Raises UserError if the plan or the map cannot be used.
    """
    path = swarm.map if isinstance(swarm.map, Path) else None
    if path is not None and path.exists():
        return Room(floor_plan(plan or str(path)).walls, load_map(path))
    named = plan or ("office" if swarm.map else "")
    walls = floor_plan(named).walls if named else _rectangle(swarm)
    return Room(walls, drawn(walls))


def draw_missing_map(swarm: Swarm, room: Room) -> None:
    """Write the map that a description names, if there is none yet."""
    if isinstance(swarm.map, Path) and not swarm.map.exists():
        save_map(room.map, swarm.map)


def _rectangle(swarm: Swarm) -> FloatArray:
    """Walls around the origin, all anchors and landmarks, and most of what ceiling cameras see."""
    places = [(one.x, one.y) for one in swarm.anchors]
    places += [(one.x, one.y) for one in swarm.landmarks]
    for one in swarm.cameras:
        across, along = (_IN_VIEW * one.z * view for view in VIEW)
        corners = [(a * along, b * across) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
        places += se2.transform_points(np.array([one.x, one.y, one.yaw]), np.array(corners)).tolist()
    x, y = np.abs(np.array(places or [(1.2, 0.8)])).max(axis=0).tolist()
    return polygon([(-x, -y), (x, -y), (x, y), (-x, y)])


def drawn(walls: FloatArray) -> OccupancyMap:
    """The map of closed walls (S, 4): cells that they cross are occupied, and those inside are free."""
    corner = (np.floor(walls.reshape(-1, 2).min(axis=0) / _CELL) - 1.5) * _CELL
    nx, ny = (np.ceil((walls.reshape(-1, 2).max(axis=0) - corner) / _CELL).astype(int) + 2).tolist()
    x, y = (corner[k] + (np.arange(n) + 0.5) * _CELL for k, n in enumerate((nx, ny)))
    inside, crossed = np.zeros((2, nx, ny), dtype=bool)
    for x0, y0, x1, y1 in walls.tolist():
        pieces = np.linspace(0.0, 1.0, 2 + int(4.0 * math.hypot(x1 - x0, y1 - y0) / _CELL))[:, None]
        on_wall = np.array([x0, y0]) + pieces * [x1 - x0, y1 - y0]
        crossed[tuple(np.floor((on_wall - corner) / _CELL).astype(int).T)] = True
        if y0 != y1:  # a line from the left enters or leaves the room where it meets a wall
            inside ^= ((y0 > y) != (y1 > y)) & (x[:, None] > x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    odds = np.where(crossed, LOG_ODDS_CAP, np.where(inside, -LOG_ODDS_CAP, 0.0))
    return OccupancyMap(corner, _CELL, odds)


def radius_of(robot: Robot) -> float:
    """Radius of the body of a robot [m]."""
    return _RADIUS * robot.odometry.wheel_separation


def room_starts(swarm: Swarm, room: Room, seed: int) -> FloatArray:
    """Poses (N, 3) in the room, off its walls and each other; raises WorldError if the room is too small."""
    rng = np.random.default_rng([seed, len(swarm.robots)])
    radius = max(radius_of(robot) for robot in swarm.robots)
    free = np.pad(room.map.free, 1).astype(np.uint8)
    away = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1] * room.map.cell
    places = rng.permutation(room.map.centres(away > 2.0 * radius))
    chosen: list[FloatArray] = []
    for place in places:
        if len(chosen) < len(swarm.robots) and all(math.dist(place, one) > 4.0 * radius for one in chosen):
            chosen.append(place)
    if len(chosen) < len(swarm.robots):
        raise WorldError(f"the room has places for {len(chosen)} robots, not {len(swarm.robots)}.")
    return np.column_stack([chosen, rng.uniform(-math.pi, math.pi, len(chosen))])


class RoomWorld:
    """Robots of a swarm in a room; each needs a start.

    Args:
        swarm: As described.
        room: Where they are.
        seed: Fixes hidden errors and noise.
        spread: Hidden errors that last, in standard deviations of the description.

    Raises:
        WorldError: A robot has no start.
    """

    def __init__(self, swarm: Swarm, room: Room, seed: int, spread: float) -> None:
        self.swarm, self.walls, self.seed, self.spread = swarm, room.walls, seed, spread
        self._rng = np.random.default_rng([seed, 0])
        self.now_ns = START_NS
        self.poses: FloatArray = np.array([start_of(robot) for robot in swarm.robots], dtype=float)
        """(N, 3) true poses of the robots in map."""
        self.reported: FloatArray = np.zeros_like(self.poses)
        """(N, 3) poses by odometry, each robot's own frame."""
        self.radii = np.array([radius_of(robot) for robot in swarm.robots])  # (N,) of the bodies [m]
        models = [robot.odometry for robot in swarm.robots]
        scales = [[one.distance_scale, one.turn_scale] for one in models]
        sigmas = [[one.distance_scale_sigma, one.turn_scale_sigma] for one in models]
        self._scales = np.array(scales) * (1.0 + self.hidden(self._rng, sigmas))
        self._separation = np.array([one.wheel_separation for one in models])
        self._noise = np.sqrt([one.wheel_noise for one in models])
        self.velocities: FloatArray = np.zeros((len(models), 2))
        """(N, 2) speed [m/s] and turn rate [rad/s] as commanded and as odometry reports them."""
        self._commanded_ns = np.full(len(models), -_COMMAND_NS)
        self._turning = np.zeros(len(models))

    def hidden(self, rng: np.random.Generator, sigma: object) -> FloatArray:
        """Errors that last, of standard deviations of any shape."""
        sigmas = np.array(sigma, dtype=float)
        return self.spread * sigmas * rng.standard_normal(sigmas.shape)

    def command(self, robot: int, speed: float, turn_rate: float) -> None:
        """Drive a robot by a command [m/s], [rad/s] in place of its own will."""
        self.velocities[robot] = speed, turn_rate
        self._commanded_ns[robot] = self.now_ns

    def step(self) -> None:
        """Step by STEP_NS."""
        if self.now_ns % _DECIDE_NS == 0:
            for robot in np.flatnonzero(self.now_ns - self._commanded_ns >= _COMMAND_NS).tolist():
                self.velocities[robot] = self._wish(robot)
        step_s = STEP_NS * 1e-9
        speed, turn_rate = (self._scales * self.velocities).T
        noise = self._noise[:, None] * self._rng.standard_normal((len(speed), 2))
        model = Drive(self._separation, 0.0)
        rolled = roll(self.poses, speed, turn_rate, model, step_s, noise)
        before, self.poses = self.poses, kept_clear(self.walls, self.radii, self.poses, rolled)
        paths = wheel_paths(self.velocities[:, 0], self.velocities[:, 1], self._separation, step_s)
        said = twist_of(paths, self._separation)
        said[(self.poses[:, :2] == before[:, :2]).all(axis=1), 0] = 0.0  # wheels stall, too
        self.reported = se2.compose(self.reported, integrate(said[None])[1])
        self.now_ns += STEP_NS

    def _wish(self, robot: int) -> tuple[float, float]:
        """Drive on, with turns to where there is more room."""
        x, y, theta = self.poses[robot].tolist()
        radius = float(self.radii[robot])
        others = np.delete(self.poses[:, :2], robot, axis=0)
        free = [ray_distance(self.walls, others, radius, x, y, theta + one) for one in _FEELERS]
        if min(free) < _ROOM_AHEAD * radius:
            self._turning[robot] = self._turning[robot] or math.copysign(_TURN_RATE, free[2] - free[0])
            return 0.0, float(self._turning[robot])
        self._turning[robot] = 0.0
        return _SPEED * radius, self._rng.uniform(-_SWERVE, _SWERVE)


@dataclass(frozen=True)
class RoomWorldParameters(WorldParameters):
    """Parameters of `room_world_node`."""

    world: str = choice("w2", tuple(ROOM_WORLDS), "which hidden errors robots and sensors have")
    plan: str = text("", "floor plan of the room; empty: the map of the description, or a rectangle")
