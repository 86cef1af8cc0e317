"""Infrared channel between Droplets: messages with losses and collisions, and brightness exchanges."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from swarm_loc_drivers.droplet import hardware as timing
from swarm_loc_drivers.droplet.hardware import ELEMENTS, FULL_POWER
from swarm_loc_estimator import expected_brightness
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.swarm.ir_board import IrPlatform, PairGains


class InfraredCommand(NamedTuple):
    """A command received by infrared."""

    line: str  # The command
    end_ns: int  # Arrival time of its last byte


class ExchangeReadings(NamedTuple):
    """An exchange in which this robot measured."""

    emitter: int  # Id of the robot that emitted
    readings: IntArray  # (n, n) emitters by sensors, baseline taken off [count]
    end_ns: int  # End of the exchange


def overlap(one: InfraredMessage | Exchange, other: InfraredMessage | Exchange) -> bool:
    """Whether two transmissions overlap in time."""
    return one.begin_ns < other.end_ns and one.end_ns > other.begin_ns


@dataclass
class InfraredMessage:
    """An infrared message in transit."""

    sender: int  # Index of the robot
    begin_ns: int  # Start of the transmission
    end_ns: int  # End of the transmission
    hearers: IntArray  # Indices of the robots in range at its start
    line: str = ""  # The command; "" for the call that starts an exchange
    target: int = 0  # Id of the receiver; 0: all
    done: bool = False

    def reaches(self, robot: int) -> bool:
        """Whether a robot is its sender or in range."""
        return robot == self.sender or robot in self.hearers


@dataclass
class Exchange:
    """An exchange."""

    emitter: int  # Index of the robot
    begin_ns: int  # Start of the call
    power: int  # Power of the emitters
    # (k,) indices of the robots that received the call
    receivers: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    # (k, n, n) emitters by sensors, measured so far
    readings: IntArray = field(default_factory=lambda: np.zeros((0, 0, 0), dtype=np.int64))
    flashes: int = 0  # Number of flashes
    done: bool = False  # Whether its readings have been delivered

    @property
    def end_ns(self) -> int:
        """End of the last flash [ns]."""
        return self.begin_ns + timing.EXCHANGE_NS

    def has(self, robot: int) -> bool:
        """Whether a robot emits or measures."""
        return robot == self.emitter or robot in self.receivers

    def lit(self, now_ns: int) -> int | None:
        """The emitter that is lit now."""
        since_ns = now_ns - self.begin_ns - timing.LEAD_NS
        flash, within = divmod(since_ns, timing.FLASH_NS + timing.GAP_NS)
        return flash if since_ns >= 0 and flash < ELEMENTS and within < timing.FLASH_NS else None


class DropletLight:
    """Light from one emitter on the sensors of other robots.

    `gains` (2, N, n) are true factors of the sensors and of the emitters of all robots. Emitters follow the
    board's near model at `near_power`, below 256.
    """

    def __init__(self, platform: IrPlatform, gains: FloatArray, near_power: int) -> None:
        self._platform = platform
        self._gains = gains
        self._powers = (0.0, float(near_power), float(FULL_POWER))
        angles = np.array(platform.angles)
        self._elements = platform.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    def falling_on(
        self, poses: FloatArray, receivers: IntArray, transmitter: int, emitter: int, power: int
    ) -> FloatArray:
        """Counts (k, n) that the sensors of receivers (k,) would read without noise.

        Robots are at poses (N, 3) in map. One of the transmitter's emitters is lit, with a power of 0 to 256.
        """
        seen = se2.between(poses[receivers], poses[transmitter])
        distance, bearing = np.hypot(seen[:, 0], seen[:, 1]), np.arctan2(seen[:, 1], seen[:, 0])
        relative = np.stack([distance, bearing, seen[:, 2]], axis=-1)
        count = len(receivers)
        gains = PairGains(
            self._gains[0, receivers],
            np.repeat(self._gains[1, [transmitter]], count, axis=0),
            np.zeros((count, 4)),
        )
        far_near = expected_brightness(self._platform, relative, gains)[..., emitter]  # (k, modes, n)
        levels = np.stack([np.zeros_like(far_near[:, 0]), far_near[:, -1], far_near[:, 0]])
        share = np.array([np.interp(power, self._powers, corner) for corner in np.eye(3)])
        light: FloatArray = np.einsum("l,lkn->kn", share, levels)
        return np.where(self._blocked(poses, receivers, transmitter, emitter), 0.0, light)

    def _blocked(self, poses: FloatArray, receivers: IntArray, transmitter: int, emitter: int) -> BoolArray:
        """Sensors (k, n) with another robot between them and the emitter."""
        sensors = se2.transform_points(poses[receivers, None], self._elements)
        lit = se2.transform_points(poses[transmitter], self._elements[emitter])
        others = np.ones((len(receivers), len(poses)), dtype=bool)
        others[:, transmitter] = False
        others[np.arange(len(receivers)), receivers] = False
        near = distance_to_segments(sensors, lit, poses[:, :2]) < self._platform.radius
        return np.asarray((near & others[:, None]).any(axis=-1))


def distance_to_segments(begins: FloatArray, end: FloatArray, points: FloatArray) -> FloatArray:
    """Distances (..., N) of points (N, 2) from the segments from `begins` (..., 2) to one `end` (2,)."""
    way = end - begins
    square = np.maximum((way**2).sum(axis=-1, keepdims=True), 1e-18)
    there = points - begins[..., None, :]
    along = np.clip((there * way[..., None, :]).sum(axis=-1) / square, 0.0, 1.0)
    nearest = begins[..., None, :] + along[..., None] * way[..., None, :]
    distance: FloatArray = np.linalg.norm(points - nearest, axis=-1)
    return distance


_REMEMBERED_NS = 1_000_000_000
"""Time for which messages and exchanges are kept after their end; exceeds the longest message."""
_BASELINE_PERIOD_NS = 5_407_000_000
_DRIFT_NS = 100_000_000
_RECEIVING, _TRANSMITTING, _TIMED, _BLOCKED = 1, 2, 4, 8


@dataclass(frozen=True)
class InfraredSettings:
    """Losses and ambient light of infrared; messages do not disturb measurements."""

    reach: float  # Maximum range of messages [m]
    loss: float  # Probability that a robot in range loses a message, independent per robot
    ambient: float  # Maximum ambient light [count]
    ambient_walk: float  # Standard deviation of the change of ambient light in one second [count]


class DropletInfrared:
    """Transmits messages and light between robots with ids (N,)."""

    def __init__(
        self,
        platform: IrPlatform,
        light: DropletLight,
        ids: IntArray,
        settings: InfraredSettings,
        rng: np.random.Generator,
        now_ns: int,
    ) -> None:
        self._platform, self._light, self._ids, self._settings = platform, light, ids, settings
        self._rng = rng
        self._now_ns = now_ns
        self._messages: list[InfraredMessage] = []
        self._exchanges: list[Exchange] = []
        self._ambient = rng.uniform(0.0, settings.ambient, (len(ids), platform.n))
        self._baseline = np.rint(self._ambient).astype(np.int64)
        self._drift_due_ns = now_ns
        self._baseline_due_ns = now_ns + rng.integers(0, _BASELINE_PERIOD_NS, len(ids))
        # Per robot the commands and readings not fetched yet
        self.heard: list[list[InfraredCommand | ExchangeReadings]] = [[] for _ in ids]
        self.deaf_until_ns = [0 for _ in ids]  # Per robot the end of its last exchange [ns]
        self.counts: Counter[str] = Counter()  # Events by name

    def send(self, sender: int, line: str, target: int, poses: FloatArray) -> None:
        """Start the transmission of a command."""
        end_ns = self._now_ns + timing.message_ns(len(line))
        self._messages.append(
            InfraredMessage(sender, self._now_ns, end_ns, self._in_reach(sender, poses), line, target)
        )

    def emit(self, emitter: int, power: int, poses: FloatArray) -> None:
        """Start an exchange."""
        end_ns = self._now_ns + timing.CALL_NS
        self._messages.append(InfraredMessage(emitter, self._now_ns, end_ns, self._in_reach(emitter, poses)))
        self._exchanges.append(Exchange(emitter, self._now_ns, power))
        self.deaf_until_ns[emitter] = self._exchanges[-1].end_ns

    def status(self, robot: int) -> int:
        """Status bits of a robot's infrared, see `DropletBody.infrared_status`."""
        status = 0
        for message in self._messages:
            if message.end_ns > self._now_ns:
                status |= _TRANSMITTING if message.sender == robot else 0
                status |= _RECEIVING if robot in message.hearers else 0
        if any(not one.done and one.has(robot) for one in self._exchanges):
            status |= _TIMED | _BLOCKED
        return status

    def step(self, now_ns: int, poses: FloatArray) -> None:
        """Advance the time."""
        self._now_ns = now_ns
        if now_ns >= self._drift_due_ns:
            self._drift()
        for message in self._messages:
            if not message.done and message.end_ns <= now_ns:
                message.done = True
                self._deliver(message)
        for exchange in self._exchanges:
            if exchange.done:
                continue
            while (
                exchange.flashes < self._platform.n
                and exchange.begin_ns + timing.flash_ns(exchange.flashes) <= now_ns
            ):
                self._measure(exchange, poses)
            if exchange.end_ns <= now_ns:
                exchange.done = True
                self._finish(exchange)
        self._exchanges = [one for one in self._exchanges if one.end_ns > now_ns - _REMEMBERED_NS]
        self._messages = [one for one in self._messages if one.end_ns > now_ns - _REMEMBERED_NS]

    def _in_reach(self, sender: int, poses: FloatArray) -> IntArray:
        """Indices of the robots in range of a robot that no other robot occludes."""
        places = poses[:, :2]
        near = np.linalg.norm(places - places[sender], axis=1) <= self._settings.reach
        between = distance_to_segments(places, places[sender], places) < self._platform.radius
        between[:, sender] = False
        np.fill_diagonal(between, val=False)
        near &= ~between.any(axis=1)
        near[sender] = False
        return np.flatnonzero(near)

    def _deliver(self, message: InfraredMessage) -> None:
        """Deliver a message to the robots that received it without loss or collision."""
        understood = self._rng.random(len(message.hearers)) >= self._settings.loss
        clear = np.array([self._is_clear(robot, message) for robot in message.hearers.tolist()], dtype=bool)
        self.counts["lost"] += int(np.count_nonzero(~understood & clear))
        self.counts["collided"] += int(np.count_nonzero(~clear))
        reached = message.hearers[understood & clear]
        if not message.line:
            self._begin_to_measure(message, reached)
            return
        for robot in reached.tolist():
            if message.target in (0, self._ids[robot]):
                self.heard[robot].append(InfraredCommand(message.line, message.end_ns))

    def _is_clear(self, robot: int, message: InfraredMessage) -> bool:
        """Whether a robot was idle during a whole message and received no other one."""
        if any(
            one.has(robot) and overlap(one, message) and one.emitter != message.sender
            for one in self._exchanges
        ):
            return False
        return not any(
            other is not message and other.reaches(robot) and overlap(other, message)
            for other in self._messages
        )

    def _begin_to_measure(self, call: InfraredMessage, receivers: IntArray) -> None:
        """Register the robots that received a call as receivers of its exchange."""
        for exchange in self._exchanges:
            if exchange.emitter == call.sender and exchange.begin_ns == call.begin_ns:
                exchange.receivers = receivers
                for robot in receivers.tolist():
                    self.deaf_until_ns[robot] = exchange.end_ns
                exchange.readings = np.zeros((len(receivers), self._platform.n, self._platform.n), np.int64)

    def _measure(self, exchange: Exchange, poses: FloatArray) -> None:
        """All receivers read their sensors, in the middle of a flash."""
        emitter, receivers = exchange.flashes, exchange.receivers
        exchange.flashes += 1
        at_ns = exchange.begin_ns + timing.flash_ns(emitter)
        light = self._ambient[receivers]
        for one in self._exchanges:  # other robots may emit at the same time
            lit = one.lit(at_ns)
            if lit is not None and len(receivers):
                light = light + self._light.falling_on(poses, receivers, one.emitter, lit, one.power)
        noise = np.hypot(self._platform.noise, self._platform.relative_noise * light)
        raw = np.rint(light + noise * self._rng.standard_normal(light.shape))
        counts = np.clip(raw, 0.0, self._platform.saturation).astype(np.int64)
        exchange.readings[:, emitter] = counts - self._baseline[receivers]

    def _finish(self, exchange: Exchange) -> None:
        """Deliver the readings of an exchange."""
        self.counts["exchanges"] += 1
        emitter = int(self._ids[exchange.emitter])
        for robot, readings in zip(exchange.receivers.tolist(), exchange.readings, strict=True):
            self.heard[robot].append(ExchangeReadings(emitter, readings, exchange.end_ns))

    def _drift(self) -> None:
        """Let the ambient light drift; robots measure it periodically."""
        self._drift_due_ns += _DRIFT_NS
        walk = self._settings.ambient_walk * np.sqrt(_DRIFT_NS * 1e-9)
        self._ambient = np.abs(self._ambient + walk * self._rng.standard_normal(self._ambient.shape))
        due = np.flatnonzero(self._baseline_due_ns <= self._now_ns)
        self._baseline_due_ns[due] += _BASELINE_PERIOD_NS
        free = due[[not self.status(robot) for robot in due.tolist()]] if len(due) else due
        measured = self._ambient[free] + self._platform.noise / 3.0 * self._rng.standard_normal(
            (len(free), self._platform.n)
        )
        self._baseline[free] = (self._baseline[free] + np.rint(measured).astype(np.int64)) // 2
