"""A robot with a 2-D lidar that drives through a hall, and the mapper that reads its messages.

The robot is like a TurtleBot 3 Burger: a sweep of 360 beams takes 0.2 s, 0.12 to 3.5 m, noise 1 cm + 1 %, one
beam in a hundred is lost. It drives at 0.2 m/s and does not stop for scans. Its wheels lose a share of every
path and turn, and its course wanders as that of a PushBot. It is steered by the truth to places where it has
not been for long, as by a person with a joystick.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np

from bench.pushbot.exploration import PERIOD_S, SPEED, Arrival, PushBotNoise
from bench.shared.bags import message_header
from swarm_loc_drivers.sim.pushbot.floor_plan import FloorPlan, clearance, is_visible, wall_distance
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages.cdr import LASER_SCAN, encode
from swarm_loc_estimator.common.messages.poses import UNKNOWN_COVARIANCE, encode_odometry
from swarm_loc_estimator.common.se2 import compose, wrap_angle
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.mapper_feed import MapperFeed, MapperInput
from swarm_loc_estimator.swarm.error_models import LidarModel
from swarm_loc_estimator.swarm.swarm import Robot, StartSigma

LIDAR = LidarModel(range_sigma=0.01, range_sigma_per_m=0.01, x=-0.032)
"""The mount is that of burger.urdf in ROBOTIS-GIT/turtlebot3."""
SWEEP_S = 0.2
BEAMS = 360
NEAREST, FARTHEST = 0.12, 3.5
NAME = "turtlebot"
_DROPOUT = 0.01
SWEEP_STEPS, ODOMETRY_STEPS = round(SWEEP_S / PERIOD_S), 2
_TURN_RATE, _STEER, _TURN_ON_SPOT = 0.8, 2.0, 0.6
_CLEAR, _ARRIVED = 0.2, 0.15
_TRIES, _MIN_HOP, _MAX_HOP = 600, 0.6, 5.0
_NO_DISCS = np.zeros((0, 2))


@cached_njit
def _sweep_distances(walls: FloatArray, poses: FloatArray) -> FloatArray:
    """Distances (n,) ahead of poses (n, 3)."""
    out = np.zeros(len(poses))
    for k in range(len(poses)):
        out[k] = wall_distance(walls, poses[k, 0], poses[k, 1], poses[k, 2])
    return out


@cached_njit
def _has_room(walls: FloatArray, here: FloatArray, place: FloatArray) -> bool:
    """Whether the straight way between points (2,) keeps clear of walls (S, 4), but for its begin."""
    if not is_visible(walls, here[0], here[1], place[0], place[1]):
        return False
    count = math.ceil(math.hypot(place[0] - here[0], place[1] - here[1]) / 0.05)
    for k in range(4, count + 1):
        x, y = here + k / count * (place - here)
        if clearance(walls, _NO_DISCS, 0.0, x, y) < _CLEAR:
            return False
    return True


@dataclass
class LidarBody:
    """The robot's truth and odometry."""

    plan: FloorPlan  # Where it is
    pose: FloatArray  # (3,) true pose
    noise: PushBotNoise  # Errors of its wheels; `slip` is of paths, too
    rng: np.random.Generator  # Source of all noise
    odometry: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,) pose by odometry
    trace: list[FloatArray] = field(default_factory=list)  # True poses (3,), one every `PERIOD_S`
    bumps: int = 0  # Always 0: it is steered around walls
    _target: FloatArray | None = None

    def step(self) -> None:
        """Drive for `PERIOD_S`."""
        self.trace.append(self.pose.copy())
        if self._target is None or math.dist(self._target, self.pose[:2]) < _ARRIVED:
            self._target = self._next_target()
        way = self._target - self.pose[:2]
        error = float(wrap_angle(math.atan2(way[1], way[0]) - self.pose[2]))
        turn = PERIOD_S * min(_TURN_RATE, max(-_TURN_RATE, _STEER * error))
        path = PERIOD_S * SPEED * (abs(error) < _TURN_ON_SPOT)
        self.odometry = compose(self.odometry, [path, 0.0, turn])
        noise, drawn = self.noise, self.rng.standard_normal(3)
        wander = noise.turn * math.sqrt(abs(turn) / (2.0 * math.pi)) * drawn[0]
        wander += noise.heading * math.sqrt(path) * drawn[1]
        true = (1.0 - noise.slip) * path + noise.distance * math.sqrt(path) * drawn[2]
        self.pose = compose(self.pose, [true, 0.0, (1.0 - noise.slip) * turn + wander])

    def _next_target(self) -> FloatArray:
        """Of random places straight ahead of the way there, the one farthest from where it has been."""
        walls, here = self.plan.walls, self.pose[:2]
        been = np.array(self.trace[:: round(1.0 / PERIOD_S)])[:, :2]
        low, high = walls.reshape(-1, 2).min(axis=0), walls.reshape(-1, 2).max(axis=0)
        best, target = -1.0, here
        while best < 0.0:
            for place in self.rng.uniform(low, high, (_TRIES, 2)):
                if not _MIN_HOP < math.dist(place, here) < _MAX_HOP or not _has_room(walls, here, place):
                    continue
                score = float(np.hypot(*(been - place).T).min())
                if score > best:
                    best, target = score, place
        return target

    def beams(self, begin: int) -> FloatArray:
        """Poses (BEAMS, 3) of the beams of the sweep that began at a step."""
        share = np.arange(BEAMS) / BEAMS * SWEEP_STEPS
        poses = np.array([*self.trace[begin : begin + SWEEP_STEPS], self.pose])
        poses[:, 2] = np.unwrap(poses[:, 2])
        at = np.stack([np.interp(share, np.arange(len(poses)), column) for column in poses.T], axis=-1)
        turns = 2.0 * math.pi / BEAMS * np.arange(BEAMS)
        return compose(at, np.stack([np.full(BEAMS, LIDAR.x), np.zeros(BEAMS), turns], axis=-1))

    def ranges(self, begin: int) -> FloatArray:
        """Ranges (BEAMS,) of the sweep that began at a step, as the lidar reports them [m]."""
        true = _sweep_distances(self.plan.walls, self.beams(begin))
        noise = LIDAR.range_sigma + LIDAR.range_sigma_per_m * np.minimum(true, FARTHEST)
        found = true + noise * self.rng.standard_normal(BEAMS)
        found = np.where((found > FARTHEST) | (true > FARTHEST), math.inf, found)
        lost = (found < NEAREST) | (self.rng.random(BEAMS) < _DROPOUT)
        return np.where(lost, 0.0, found)


def scan_message(stamp_ns: int, ranges: FloatArray) -> bytes:
    """A sensor_msgs/LaserScan of a sweep, as the driver of the LDS-01 fills it."""
    numbers = {"angle_max": 2.0 * math.pi, "angle_increment": 2.0 * math.pi / BEAMS}
    numbers |= {"time_increment": SWEEP_S / BEAMS, "scan_time": SWEEP_S}
    numbers |= {"range_min": NEAREST, "range_max": FARTHEST}
    header = message_header(stamp_ns, f"{NAME}/base_scan")
    return encode({"header": header, **numbers, "ranges": ranges.astype(np.float32)}, LASER_SCAN)


@dataclass
class LidarDrive:
    """One robot whose messages go to one mapper."""

    mapper: CooperativeMapper  # Makes the map
    robots: dict[int, LidarBody]  # The robot by its number in the mapper
    arrivals: list[Arrival] = field(default_factory=list)  # A pose for each sweep in the graph
    sweeps: int = 0  # Number of sweeps
    cpu_s: float = 0.0  # CPU time of decoding and mapping [s]

    @classmethod
    def starting(
        cls, plan: FloorPlan, mapper: CooperativeMapper, slip: float, rng: np.random.Generator
    ) -> LidarDrive:
        """A robot at the first start of a hall, with a random heading."""
        pose = np.array([*plan.starts[0], rng.uniform(-math.pi, math.pi)])
        return cls(mapper, {0: LidarBody(plan, pose, PushBotNoise(slip=slip), rng)})

    def run(self, until_s: float) -> None:
        """Drive and map until a time [s]."""
        body = self.robots[0]
        sigma = StartSigma(1e-3, 1e-3, 1e-3)
        robot = Robot(NAME, start=tuple(body.pose.tolist()), start_sigma=sigma, lidar=LIDAR)
        feed = MapperFeed([robot], self.mapper, {})
        known = np.diag([1e-4] * 6)
        for step in range(round(until_s / PERIOD_S) + 1):
            stamp_ns = round(step * PERIOD_S * 1e9)
            if step % ODOMETRY_STEPS == 0:
                stamps, pose = np.array([stamp_ns]), body.odometry[None]
                frames = (f"{NAME}/odom", f"{NAME}/base_link")
                data = encode_odometry(*frames, stamps, pose, np.zeros((1, 3)), known, UNKNOWN_COVARIANCE)[0]
                self._feed(feed, MapperInput.ODOMETRY, data)
            if step and step % SWEEP_STEPS == 0:
                begin = step - SWEEP_STEPS
                data = scan_message(round(begin * PERIOD_S * 1e9), body.ranges(begin))
                self._feed(feed, MapperInput.SCAN, data)
                self.sweeps += 1
                self._note(body)
            body.step()

    def _feed(self, feed: MapperFeed, kind: MapperInput, data: bytes) -> None:
        begin_s = time.process_time()
        feed.add(0, kind, data)
        self.cpu_s += time.process_time() - begin_s

    def _note(self, body: LidarBody) -> None:
        """Note the pose of a sweep that has entered the graph."""
        located = self.mapper.tracks[0].located
        if located is None:
            return
        time_s = located.stamp_ns * 1e-9
        if not self.arrivals or time_s > self.arrivals[-1].time_s:
            truth = body.trace[round(time_s / PERIOD_S)]
            self.arrivals.append(Arrival(0, time_s, truth, located.pose, len(self.arrivals)))
