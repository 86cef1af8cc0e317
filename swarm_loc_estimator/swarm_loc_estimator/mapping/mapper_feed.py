"""From messages to the mapper, and from its poses to fixes with covariance."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple
from enum import Enum
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.messages.cdr import CdrError, decode_odometry
from swarm_loc_estimator.common.messages.typestore import ODOMETRY
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.se2 import between, compose
from swarm_loc_estimator.filter.process_noise import OdometryStep, add_step_noise
from swarm_loc_estimator.mapping.exploration import Goal
from swarm_loc_estimator.mapping.mapper import SCAN_TURN, CooperativeMapper
from swarm_loc_estimator.mapping.messages import LASER, LIGHTS, BadMessageError, decode_laser, decode_lights
from swarm_loc_estimator.mapping.pairing import ReadingPairer
from swarm_loc_estimator.mapping.scans import LightSightings
from swarm_loc_estimator.odometry.preintegration import MODEL_DTYPE
from swarm_loc_estimator.swarm.swarm import OdometryModel, Robot

_LEAST_SIGMA = np.array([0.02, 0.02, 0.01])
"""Errors of the map that all fixes share are no noise: no fix is told better than this [m, m, rad]."""
_OPTIMISM = 2.5
"""Variances over what the graph says: wheels slip unevenly during a scan, which it takes for rigid."""
_LEAST_SIGMA_MOVED = 0.003
_LEAST_NEW = 0.02
"""Share of what the mapper knows that each fix counts for at least, however little it adds."""


class FixCovariances:
    """Covariances of the fixes of one robot, one after the other.

    What is wrong with a map is wrong with all poses in it, so successive fixes err alike. Whoever fuses them
    as independent takes the same scans into account again and again. So each is told with the information by
    which the mapper's pose exceeds that of the fix before carried on by odometry (what is known to both is
    subtracted, as in the information graphs of Chong, Mori and Chang, "Distributed multitarget multisensor
    tracking", 1990): together they make as sure as the mapper is.

    The odometry is that of whoever fuses the fixes: the coarser it takes that to be, the more it has
    forgotten of the fix before.

    Args:
        odometry: Of the robot, as the swarm description has it.
    """

    def __init__(self, odometry: OdometryModel) -> None:
        self._odometry: Any = np.array(astuple(odometry), MODEL_DTYPE)[()]  # as the compiled code takes it
        self._last: tuple[Goal, FloatArray] | None = None

    def told(self, goal: Goal, covariance: FloatArray) -> FloatArray:
        """Covariance (3, 3) to be told of the newest fix.

        Args:
            goal: With pose and stamp.
            covariance: (3, 3) of its stop in the graph [m, rad].
        """
        now = pose_covariance(covariance)
        before, self._last = self._last, (goal, now)
        if before is None or goal.number == 1:  # the first, or the first since odometry began anew
            return now
        known = self._carried_on(*before, goal)
        return _new_alone(now, known)

    def _carried_on(self, before: Goal, covariance: FloatArray, goal: Goal) -> FloatArray:
        """Covariance (3, 3) at a goal by that at the one before, the drive between and the scan after it."""
        dx, dy = (goal.pose - before.pose)[:2].tolist()
        path, duration_s = math.hypot(dx, dy), 1e-9 * (goal.stamp_ns - before.stamp_ns)
        effect = np.eye(3)
        effect[0, 2], effect[1, 2] = -dy, dx
        carried: FloatArray = effect @ covariance @ effect.T + _LEAST_SIGMA_MOVED**2 * np.diag(
            [1.0, 1.0, 0.0]
        )
        drive = OdometryStep(path, 0.0, 0.0, 0.0, 0.0, -0.5 * dx, -0.5 * dy, math.atan2(dy, dx))
        scan = OdometryStep(0.0, 0.0, SCAN_TURN, 0.0, duration_s, 0.0, 0.0, 0.0)
        for step in (drive, scan):
            add_step_noise(self._odometry, step, carried)
        return carried


def pose_covariance(covariance: FloatArray) -> FloatArray:
    """Covariance (3, 3) of a pose whose stop has this one (3, 3) in the graph [m, rad]."""
    whole: FloatArray = _OPTIMISM * covariance + np.diag(_LEAST_SIGMA**2)
    return whole


def _new_alone(now: FloatArray, known: FloatArray) -> FloatArray:
    """The covariance (3, 3) that turns what was known (3, 3) into what is known now (3, 3)."""
    root = np.linalg.cholesky(now)
    inverse = np.linalg.inv(root)
    ratio, axes = np.linalg.eigh(inverse @ known @ inverse.T)  # of variances: known over now
    new = np.maximum(1.0 - 1.0 / ratio, _LEAST_NEW)
    basis = root @ axes
    told = (basis / new) @ basis.T
    symmetric: FloatArray = 0.5 * (told + told.T)
    return symmetric


ORIGIN_SIGMA = np.full(3, 1e-3)
"""Of the first robot where its start is not described: that place is the origin of the map."""
_FREQUENCY_TOLERANCE_HZ = 5.0


class MapperInput(Enum):
    """What a robot sends to the mapper.

    Attributes:
        topic: Below the robot's name.
        message_type: Of its messages.
    """

    ODOMETRY = ("odom", ODOMETRY)
    LASER = ("laser", LASER)
    LIGHTS = ("lights", LIGHTS)

    def __init__(self, topic: str, message_type: str) -> None:
        self.topic = topic
        self.message_type = message_type


class MapperInputError(UserError):
    """The mapper cannot start with such robots; the message is one sentence."""


class MapperFeed:
    """Gives the mapper what comes; a robot joins with its first reading.

    Args:
        robots: Those that may come.
        mapper: Makes the map.
        frequencies: Robot -> frequency of its LEDs [Hz], for those whose lights are looked for.

    Raises:
        MapperInputError: The start of more than one robot is unknown.

    Attributes:
        drops: Reason -> how many messages were not used.
        received: (robot, input) -> how many messages came.
    """

    def __init__(
        self, robots: Sequence[Robot], mapper: CooperativeMapper, frequencies: Mapping[str, float]
    ) -> None:
        unknown = [robot.name for robot in robots if robot.start is None]
        if len(unknown) > (len(robots) == 1):
            raise MapperInputError(
                f"robot '{unknown[-1]}' has no start in the swarm description: where several robots map, all"
                " must have one."
            )
        self.drops: Counter[str] = Counter()
        self.received: Counter[tuple[int, MapperInput]] = Counter()
        self._robots = robots
        self._mapper = mapper
        self._pairers = [ReadingPairer() for _ in robots]
        self._number: dict[int, int] = {}
        self._begin: dict[int, FloatArray] = {}
        index_of = {robot.name: index for index, robot in enumerate(robots)}
        self._light_of = [(hz, index_of[name]) for name, hz in frequencies.items() if name in index_of]
        self._readers: dict[MapperInput, Callable[[int, bytes], None]] = {
            MapperInput.ODOMETRY: self._read_odometry,
            MapperInput.LASER: self._read_laser,
            MapperInput.LIGHTS: self._read_lights,
        }

    def add(self, robot: int, kind: MapperInput, data: bytes) -> None:
        """Take a message of a robot, by its index."""
        self.received[robot, kind] += 1
        try:
            self._readers[kind](robot, data)
        except (CdrError, BadMessageError):
            self.drops["bad_message"] += 1
            return
        readings = self._pairers[robot].ready()
        if readings is not None:
            self._mapper.add_readings(self._joined(robot, readings.odometry[0]), readings)

    @property
    def all_drops(self) -> Counter[str]:
        """Reason -> how many messages of all robots were not used."""
        total = Counter(self.drops)
        for pairer in self._pairers:
            total.update(pairer.drops)
        return total

    def number(self, robot: int) -> int | None:
        """The mapper's number of a robot by its index; None: it has not joined."""
        return self._number.get(robot)

    def missing(self) -> Iterator[str]:
        """Topics from which nothing has come that the mapper cannot do without."""
        for index, robot in enumerate(self._robots):
            for kind in (MapperInput.ODOMETRY, MapperInput.LASER):
                if not self.received[index, kind]:
                    yield f"{robot.name}/{kind.topic}"

    def _joined(self, robot: int, odometry: FloatArray) -> int:
        """The mapper's number of a robot; it joins where odometry (3,) since its first message has it."""
        if robot not in self._number:
            described = self._robots[robot]
            start, sigma = described.start, described.start_sigma
            since: FloatArray = between(self._begin[robot], odometry)
            pose: FloatArray = since if start is None else compose(np.array(start), since)
            known = ORIGIN_SIGMA if start is None else np.array([sigma.x, sigma.y, sigma.theta])
            self._number[robot] = self._mapper.join(pose, np.maximum(known, ORIGIN_SIGMA))
        return self._number[robot]

    def _read_odometry(self, robot: int, data: bytes) -> None:
        message = decode_odometry(data)
        pose = np.array(message.pose)
        if robot not in self._begin and np.isfinite(pose).all():
            self._begin[robot] = pose
        self._pairers[robot].add_odometry(message.stamp_ns, pose)

    def _read_laser(self, robot: int, data: bytes) -> None:
        message = decode_laser(data)
        self._pairers[robot].add_distance(message.stamp_ns, message.distance, message.sigma)

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
        """The robot whose LEDs blink so; None: no one's, or those of several."""
        near = [
            index
            for hz, index in self._light_of
            if math.isclose(hz, frequency, abs_tol=_FREQUENCY_TOLERANCE_HZ)
        ]
        return near[0] if len(near) == 1 else None
