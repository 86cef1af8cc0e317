"""Conversion of messages to mapper input, and of its poses to fixes with covariance.

Pairing of what lasers measure with odometry: single distances, and sweeps of lidars.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from types import MappingProxyType

import numpy as np

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import LASER, LASER_SCAN, LIGHTS, ODOMETRY, CdrError
from swarm_loc_estimator.common.messages.poses import decode_odometry
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.se2 import between, compose, inverse, transform_points
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.mapping.mapper import CooperativeMapper
from swarm_loc_estimator.mapping.messages import (
    LidarSweep,
    ScanMessage,
    decode_laser,
    decode_lights,
    decode_scan,
    described_delay,
    learned_delay,
    read_sweep,
)
from swarm_loc_estimator.mapping.scans import UNSEEN, LightSightings, Readings, Scan, ScanStop
from swarm_loc_estimator.swarm.error_models import LidarModel
from swarm_loc_estimator.swarm.swarm import Robot

MAX_WAITING = 500  # Maximum numbers of queued odometry messages and distances; the oldest are dropped
MAX_GAP_NS = 500_000_000  # Maximum gap over which odometry is interpolated
_MAX_SWEEPS = 50  # Maximum number of queued scans
_ROBOT_MARGIN = 0.1  # Around another robot, within which beams are left out [m]
_SIGMAS = 301  # Number of distances over which the median sigma is taken


class OdometryQueue:
    """The newest odometry of one robot.

    Attributes:
        drops: Reason -> number of dropped messages.
        dropped_beams: Reason -> number of dropped beams of scans.
    """

    def __init__(self) -> None:
        self.drops: Counter[str] = Counter()
        self.dropped_beams: Counter[str] = Counter()
        self._odometry: deque[tuple[int, FloatArray]] = deque(maxlen=MAX_WAITING)

    @property
    def newest_ns(self) -> float:
        """Stamp of the newest odometry; -inf before the first."""
        return self._odometry[-1][0] if self._odometry else -math.inf

    @property
    def newest(self) -> FloatArray:
        """The newest pose (3,) by odometry."""
        return self._odometry[-1][1]

    def add_odometry(self, stamp_ns: int, pose: FloatArray) -> None:
        """Add a pose (3,) by odometry."""
        if not np.isfinite(pose).all():
            self.drops["odometry_not_finite"] += 1
        elif stamp_ns <= self.newest_ns:
            self.drops["odometry_too_old"] += 1
        else:
            self._odometry.append((stamp_ns, np.asarray(pose, dtype=float)))

    def poses_at(self, stamp_ns: IntArray) -> tuple[FloatArray, BoolArray]:
        """Poses (n, 3) by odometry at times (n,) up to the newest stamp, and whether they are known.

        No later call may ask for a time before the earliest of these.
        """
        while len(self._odometry) > 1 and self._odometry[1][0] <= stamp_ns.min():
            self._odometry.popleft()
        stamps, poses = zip(*self._odometry, strict=True)
        return interpolate(Trajectory(np.array(stamps), np.array(poses)), stamp_ns, MAX_GAP_NS)


class ReadingPairer(OdometryQueue):
    """Interpolates odometry at the stamp of each distance of one robot."""

    def __init__(self) -> None:
        super().__init__()
        self._distances: deque[tuple[int, float]] = deque()
        self._sigmas: deque[float] = deque(maxlen=_SIGMAS)

    def add_distance(self, stamp_ns: int, distance: float, sigma: float) -> None:
        """Add a distance [m] with its standard deviation; NaN: no reflection."""
        seen = math.isfinite(distance) and distance > 0.0 and math.isfinite(sigma) and sigma > 0.0
        if self._distances and stamp_ns <= self._distances[-1][0]:
            self.drops["laser_too_old"] += 1
            return
        if not seen and not math.isnan(distance):
            self.drops["laser_bad_value"] += 1
            return
        if seen:
            self._sigmas.append(sigma / (distance * distance))
        if len(self._distances) == MAX_WAITING:
            self._distances.popleft()
            self.drops["laser_without_odometry"] += 1
        self._distances.append((stamp_ns, 1.0 / distance if seen else UNSEEN))

    def ready(self) -> Readings | None:
        """The readings with known odometry, in order; None if there are none."""
        rows: list[tuple[int, float]] = []
        while self._distances and self._distances[0][0] <= self.newest_ns:
            rows.append(self._distances.popleft())
        if not rows:
            return None
        stamps, inverses = (np.array(column) for column in zip(*rows, strict=True))
        poses, known = self.poses_at(stamps)
        if not known.all():
            self.drops["laser_without_odometry"] += int((~known).sum())
        if not known.any():
            return None
        sigma = float(np.median(self._sigmas)) if self._sigmas else math.nan
        return Readings(stamps[known], poses[known], inverses[known], sigma)


class SweepPairer(OdometryQueue):
    """Takes a robot's motion during each sweep of its lidar out of it, and learns how old sweeps are.

    Args:
        lidar: Mount and noise of the lidar.

    Attributes:
        delay: What is known of the times of its beams.
    """

    def __init__(self, lidar: LidarModel) -> None:
        super().__init__()
        self._sweeps: deque[LidarSweep] = deque()
        self.mount(lidar)
        self._track: FloatArray | None = None  # (L, 3) by odometry in the middle of the newest sweep, at lags
        self._seen: tuple[int, FloatArray] | None = None  # Node of `delay.seen`, and this pose from it
        self._newest_ns = -math.inf

    def mount(self, lidar: LidarModel) -> None:
        """Take the lidar, also for sweeps that wait for odometry, from another description."""
        self.lidar, self.delay = lidar, described_delay(lidar.delay_s)
        self._sweeps = deque(sweep._replace(lidar=lidar) for sweep in self._sweeps)

    def add_scan(self, scan: ScanMessage) -> None:
        """Add a scan; what cannot be used of it is counted."""
        sweep = read_sweep(scan, self.lidar, self.drops, self.dropped_beams)
        if sweep is None:
            return
        if scan.stamp_ns <= self._newest_ns:
            self.drops["scan_too_old"] += 1
            return
        self._newest_ns = scan.stamp_ns
        if len(self._sweeps) == _MAX_SWEEPS:
            self._sweeps.popleft()
            self.drops["scan_without_odometry"] += 1
        self._sweeps.append(sweep)

    def ready(self) -> Iterator[ScanStop]:
        """The sweeps with known odometry, in order, at the median lag."""
        while self._sweeps:
            sweep, lag_ns = self._sweeps[0], np.round(1e9 * self.delay.lag_s).astype(np.int64)
            beams = slice(1, 1 + sweep.beam_ns.size)
            beam_ns = sweep.beam_ns - lag_ns[self.delay.median]
            middle_ns = sweep.stamp_ns + sweep.duration_ns // 2
            at_ns = np.concatenate([[sweep.stamp_ns], beam_ns, middle_ns - lag_ns])
            if at_ns.max() > self.newest_ns:
                return
            self._sweeps.popleft()
            poses, known = self.poses_at(at_ns)
            if known[: beams.stop].all():
                self._track = poses[beams.stop :] if known.all() else None
                yield self._stop(sweep, poses[0], between(poses[0], poses[beams]))
            else:
                self.drops["scan_without_odometry"] += 1

    def learn(self, sweep: ScanStop, node: int, poses: FloatArray, covariance: FloatArray) -> None:
        """Learn the delay by the node of the newest sweep, of all nodes (n, 3), and its covariance (3, 3)."""
        if self._track is None:
            return
        back = between(sweep.arrival, self._track[self.delay.median])
        if self._seen is not None:  # the graph may have moved since
            self.delay = self.delay._replace(seen=compose(poses[self._seen[0]], self._seen[1]))
        seen, self._seen = compose(poses[node], back), (node, back)
        self.delay = learned_delay(self.delay, int(sweep.stamp_ns[0]), seen, covariance, self._track)

    def _stop(self, sweep: LidarSweep, pose: FloatArray, motion: FloatArray) -> ScanStop:
        """The sweep from a pose (3,) of the robot, which had moved by `motion` (n, 3) at each beam."""
        lidar, seen = sweep.lidar, sweep.seen
        distance = np.where(seen, sweep.distance, sweep.reach)
        x, y = sweep.ends(motion).T
        noise = (lidar.range_sigma + lidar.range_sigma_per_m * distance) / distance**2
        sigma = (lidar.range_sigma + lidar.range_sigma_per_m * sweep.reach) / sweep.reach**2
        scan = Scan(
            motion[:, 2],
            np.where(seen, 1.0 / np.hypot(x, y), UNSEEN),
            np.arctan2(y, x) - motion[:, 2],
            (sigma / noise) ** 2,
        )
        return ScanStop.of_sweep(sweep.stamp_ns, pose, scan, sigma, sweep.reach)


_LEAST_SIGMA = np.array([0.02, 0.02, 0.01])
"""Minimum standard deviations of a fix, for errors of the map that all fixes share [m, m, rad]."""
_OPTIMISM = 2.5  # Factor on variances of the graph, which assumes rigid scans although wheels slip unevenly


def fix_covariance(covariance: FloatArray) -> FloatArray:
    """Covariance (3, 3) of a fix, inflated from that of its stop in the graph (3, 3) [m, rad].

    Successive fixes share most of their errors, which the estimator knows by `systematic_share`. The graph is
    linear in the heading: a way d is off by t J d if the heading is off by t. Of this way, which follows from
    the covariance of position and heading, the error is t^2 d / 2 along it, with a second moment of 3/4 of
    the squared variance of t.
    """
    whole: FloatArray = _OPTIMISM * covariance + np.diag(_LEAST_SIGMA**2)
    cross = _OPTIMISM * covariance[:2, 2]
    whole[:2, :2] += 0.75 * np.outer((cross[1], -cross[0]), (cross[1], -cross[0]))
    return whole


ORIGIN_SIGMA = np.full(3, 1e-3)
"""Start uncertainty of the first robot if undescribed: its start defines the origin of the map."""
_FREQUENCY_TOLERANCE_HZ = 5.0


class MapperInput(Enum):
    """Input topics of the mapper.

    Attributes:
        topic: Topic in the robot's namespace.
        message_type: Message type.
    """

    ODOMETRY = ("odom", ODOMETRY)
    LASER = ("laser", LASER)
    SCAN = ("scan", LASER_SCAN)
    LIGHTS = ("lights", LIGHTS)

    def __init__(self, topic: str, message_type: str) -> None:
        self.topic = topic
        self.message_type = message_type


def inputs_of(robot: Robot, *, lights: bool = False) -> tuple[MapperInput, ...]:
    """The inputs without which a robot cannot map; with `lights`, those of robots with event cameras, too."""
    if robot.lidar.is_used:
        return (MapperInput.ODOMETRY, MapperInput.SCAN)
    return (MapperInput.ODOMETRY, MapperInput.LASER, *([MapperInput.LIGHTS] if lights else []))


class MapperInputError(UserError):
    """The mapper cannot start with these robots."""


class MapperFeed:
    """Decodes messages and passes them to the mapper; a robot joins with its first reading.

    Args:
        robots: All robots that may join.
        mapper: The mapper.
        frequencies: Robot -> frequency of its LEDs [Hz], for robots with tracked lights.
        begin: That of an earlier feed, of robots that have moved since.

    Raises:
        MapperInputError: The start of more than one robot is unknown.

    Attributes:
        drops: Reason -> number of dropped messages.
        received: (robot, input) -> number of received messages.
        begin: Robot -> (3,) its pose by odometry at its start.
    """

    def __init__(
        self,
        robots: Sequence[Robot],
        mapper: CooperativeMapper,
        frequencies: Mapping[str, float],
        begin: Mapping[int, FloatArray] = MappingProxyType({}),
    ) -> None:
        unknown = [robot.name for robot in robots if robot.start is None and not robot.lidar.is_used]
        if len(unknown) > (len(robots) == 1):
            raise MapperInputError(
                f"robot '{unknown[-1]}' has no start in the swarm description: where several robots map, all"
                " without a lidar must have one."
            )
        self.drops: Counter[str] = Counter()
        self.received: Counter[tuple[int, MapperInput]] = Counter()
        self._robots = robots
        self._mapper = mapper
        self._pairers: list[ReadingPairer | SweepPairer] = [
            SweepPairer(robot.lidar) if robot.lidar.is_used else ReadingPairer() for robot in robots
        ]
        self._number: dict[int, int] = {}
        self._swept: dict[int, FloatArray] = {}  # (3,) by odometry at the newest sweep
        self.begin: dict[int, FloatArray] = dict(begin)
        index_of = {robot.name: k for k, robot in enumerate(robots) if not robot.lidar.is_used}
        self._light_of = [(hz, index_of[name]) for name, hz in frequencies.items() if name in index_of]
        self._readers: dict[MapperInput, Callable[[int, bytes], None]] = {
            MapperInput.ODOMETRY: self._read_odometry,
            MapperInput.LASER: self._read_laser,
            MapperInput.SCAN: self._read_laser,
            MapperInput.LIGHTS: self._read_lights,
        }

    def describe(self, robots: Sequence[Robot]) -> None:
        """Take the mounts of lidars from another description, before any sweep has reached the mapper."""
        self._robots = robots
        for pairer, robot in zip(self._pairers, robots, strict=True):
            if isinstance(pairer, SweepPairer):
                pairer.mount(robot.lidar)

    def add(self, robot: int, kind: MapperInput, data: bytes) -> None:
        """Process a message of a robot, by its index."""
        self.received[robot, kind] += 1
        try:
            self._readers[kind](robot, data)
        except CdrError:
            self.drops["bad_message"] += 1
            return
        pairer = self._pairers[robot]
        if isinstance(pairer, SweepPairer):
            for sweep in pairer.ready():
                number = self._joined(robot, sweep.arrival)
                self._mapper.add_sweep(number, self._without_robots(robot, sweep))
                self._swept[robot] = sweep.arrival
                node, covariance = self._mapper.sweeps.matched.get(number, (-1, np.eye(3)))
                if self._mapper.begin_ns.get(node) == sweep.stamp_ns[0]:
                    pairer.learn(sweep, node, self._mapper.graph.poses, covariance)
        elif (readings := pairer.ready()) is not None:
            self._mapper.add_readings(self._joined(robot, readings.odometry[0]), readings)

    def _without_robots(self, robot: int, sweep: ScanStop) -> ScanStop:
        """A sweep without the beams that end at other robots whose places are known."""
        radius, own = self._robots[robot].lidar.robot_radius, self._place(robot, sweep.arrival)
        others = [
            there
            for other in self._number
            if other != robot and (there := self._place(other, self._pairers[other].newest)) is not None
        ]
        if not radius or own is None or not others:
            return sweep
        centres = transform_points(inverse(own), np.array(others)[:, :2])
        away = np.hypot(*(sweep.ends[:, None] - centres[None]).transpose(2, 0, 1)).min(axis=1)
        kept = away > radius + _ROBOT_MARGIN
        return sweep.chosen(kept) if kept.any() else sweep

    def _place(self, robot: int, odometry: FloatArray) -> FloatArray | None:
        """Where a robot is in map (3,) at a pose by odometry; None: nobody knows."""
        pose, swept = self._mapper.pose(self._number[robot]), self._swept.get(robot)
        return pose if pose is None or swept is None else compose(pose, between(swept, odometry))

    @property
    def all_drops(self) -> Counter[str]:
        """Reason -> number of dropped messages of all robots."""
        total = Counter(self.drops)
        for pairer in self._pairers:
            total.update(pairer.drops)
        return total

    @property
    def late(self) -> list[str]:
        """A sentence for each lidar whose scans are older, or newer, than described."""
        pairs = zip(self._robots, self._pairers, strict=True)
        lidars = [(robot, one.delay) for robot, one in pairs if isinstance(one, SweepPairer)]
        return [delay.sentence(robot) for robot, delay in lidars if delay.is_refuted]

    @property
    def dropped_beams(self) -> Counter[str]:
        """Reason -> number of dropped beams of all lidars."""
        return sum((pairer.dropped_beams for pairer in self._pairers), Counter())

    def number(self, robot: int) -> int | None:
        """The mapper's number of a robot by its index; None: not joined yet."""
        return self._number.get(robot)

    def missing(self) -> Iterator[str]:
        """Required topics without a message so far."""
        for index, robot in enumerate(self._robots):
            for kind in inputs_of(robot):
                if not self.received[index, kind]:
                    yield f"{robot.name}/{kind.topic}"

    def _joined(self, robot: int, odometry: FloatArray) -> int:
        """The mapper's number of a robot, which first joins at its start moved by odometry (3,)."""
        if robot not in self._number:
            described = self._robots[robot]
            start, sigma = described.start, described.start_sigma
            since: FloatArray = between(self.begin[robot], odometry)
            pose: FloatArray = since if start is None else compose(np.array(start), since)
            known = np.array([sigma.x, sigma.y, sigma.theta])
            if start is None:  # the first one begins the map, and is looked for in no other
                known = np.full(3, np.inf) if self._number else ORIGIN_SIGMA
            self._number[robot] = self._mapper.join(pose, np.maximum(known, ORIGIN_SIGMA))
        return self._number[robot]

    def _read_odometry(self, robot: int, data: bytes) -> None:
        message = decode_odometry(data)
        pose = np.array(message.pose)
        if robot not in self.begin and np.isfinite(pose).all():
            self.begin[robot] = pose
        self._pairers[robot].add_odometry(message.stamp_ns, pose)

    def _read_laser(self, robot: int, data: bytes) -> None:
        pairer = self._pairers[robot]
        if isinstance(pairer, SweepPairer):
            pairer.add_scan(decode_scan(data))
        else:
            message = decode_laser(data)
            pairer.add_distance(message.stamp_ns, message.distance, message.sigma)

    def _read_lights(self, robot: int, data: bytes) -> None:
        rows = []
        for light in decode_lights(data):
            target = self._seen(light.frequency)
            if target is None or target == robot or target not in self._number or robot not in self._number:
                self.drops["light_of_nobody"] += 1
            else:
                rows.append((light.stamp_ns, self._number[target], light.bearing, light.sigma))
        if rows:
            stamp, target_number, bearing, sigma = zip(*rows, strict=True)
            sightings = LightSightings(
                np.array(stamp, dtype=np.int64),
                np.array(target_number, dtype=np.int64),
                np.array(bearing),
                np.array(sigma),
            )
            self._mapper.add_lights(self._number[robot], sightings)

    def _seen(self, frequency: float) -> int | None:
        """The robot whose LEDs have this frequency [Hz]; None if there is none or several."""
        near = [
            index
            for hz, index in self._light_of
            if math.isclose(hz, frequency, abs_tol=_FREQUENCY_TOLERANCE_HZ)
        ]
        return near[0] if len(near) == 1 else None
