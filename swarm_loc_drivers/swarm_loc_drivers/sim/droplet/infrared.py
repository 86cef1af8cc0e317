"""Infrared channel between Droplets: messages that get lost or collide, exchanges that take a while."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.droplet import infrared_timing as timing
from swarm_loc_drivers.sim.common.body import Command, Measured
from swarm_loc_drivers.sim.droplet.light import DropletLight, distance_to_segments
from swarm_loc_drivers.sim.droplet.transmissions import Exchange, Message, overlap
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.swarm.ir_board import IrPlatform

_REMEMBERED_NS = 1_000_000_000
"""So long messages and exchanges that are over are kept: longer than any message takes."""
_BASELINE_PERIOD_NS = 5_407_000_000
_DRIFT_NS = 100_000_000
_RECEIVING, _TRANSMITTING, _TIMED, _BLOCKED = 1, 2, 4, 8


@dataclass(frozen=True)
class InfraredSettings:
    """How infrared fails; messages make no light in measurements.

    Attributes:
        reach: How far messages reach [m].
        loss: Share of messages that a robot in reach does not understand, each robot by itself.
        ambient: Largest light that sensors read without any emitter [count].
        ambient_walk: How it changes, one standard deviation after a second [count].
    """

    reach: float
    loss: float
    ambient: float
    ambient_walk: float


class DropletInfrared:
    """Carries messages and light.

    Args:
        platform: The board of all robots.
        light: What falls on sensors.
        ids: (N,) of the robots.
        settings: How it fails.
        rng: Source of what is random.
        now_ns: First moment.

    Attributes:
        heard: Per robot what has come and was not fetched.
        deaf_until_ns: Per robot the end of its last exchange [ns].
        counts: What happened how often.
    """

    def __init__(
        self,
        platform: IrPlatform,
        light: DropletLight,
        ids: NDArray[np.int64],
        settings: InfraredSettings,
        rng: np.random.Generator,
        now_ns: int,
    ) -> None:
        self._platform, self._light, self._ids, self._settings = platform, light, ids, settings
        self._rng = rng
        self._now_ns = now_ns
        self._messages: list[Message] = []
        self._exchanges: list[Exchange] = []
        self._ambient = rng.uniform(0.0, settings.ambient, (len(ids), platform.n))
        self._baseline = np.rint(self._ambient).astype(np.int64)
        self._drift_due_ns = now_ns
        self._baseline_due_ns = now_ns + rng.integers(0, _BASELINE_PERIOD_NS, len(ids))
        self.heard: list[list[Command | Measured]] = [[] for _ in ids]
        self.deaf_until_ns = [0 for _ in ids]
        self.counts: Counter[str] = Counter()

    def send(self, sender: int, line: str, target: int, poses: FloatArray) -> None:
        """A robot begins to send a command."""
        end_ns = self._now_ns + timing.message_ns(len(line))
        self._messages.append(
            Message(sender, self._now_ns, end_ns, self._in_reach(sender, poses), line, target)
        )

    def emit(self, emitter: int, power: int, poses: FloatArray) -> None:
        """A robot begins an exchange."""
        end_ns = self._now_ns + timing.CALL_NS
        self._messages.append(Message(emitter, self._now_ns, end_ns, self._in_reach(emitter, poses)))
        self._exchanges.append(Exchange(emitter, self._now_ns, power))
        self.deaf_until_ns[emitter] = self._exchanges[-1].end_ns

    def status(self, robot: int) -> int:
        """What keeps a robot's infrared busy, see `DropletBody.infrared_status`."""
        status = 0
        for message in self._messages:
            if message.end_ns > self._now_ns:
                status |= _TRANSMITTING if message.sender == robot else 0
                status |= _RECEIVING if robot in message.hearers else 0
        if any(not one.done and one.has(robot) for one in self._exchanges):
            status |= _TIMED | _BLOCKED
        return status

    def step(self, now_ns: int, poses: FloatArray) -> None:
        """Let time pass."""
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

    def _in_reach(self, sender: int, poses: FloatArray) -> NDArray[np.int64]:
        """Indices of the robots to which messages of a robot come through."""
        places = poses[:, :2]
        near = np.linalg.norm(places - places[sender], axis=1) <= self._settings.reach
        between = distance_to_segments(places, places[sender], places) < self._platform.radius
        between[:, sender] = False
        np.fill_diagonal(between, val=False)
        near &= ~between.any(axis=1)
        near[sender] = False
        return np.flatnonzero(near)

    def _deliver(self, message: Message) -> None:
        """A message is through: to those who could hear and understand it."""
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
                self.heard[robot].append(Command(message.line, message.end_ns))

    def _is_clear(self, robot: int, message: Message) -> bool:
        """Whether a robot listens all the time of a message, and hears nothing else."""
        if any(
            one.has(robot) and overlap(one, message) and one.emitter != message.sender
            for one in self._exchanges
        ):
            return False
        return not any(
            other is not message and other.reaches(robot) and overlap(other, message)
            for other in self._messages
        )

    def _begin_to_measure(self, call: Message, receivers: NDArray[np.int64]) -> None:
        """Robots have heard a call."""
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
        for one in self._exchanges:  # others may emit at the same time
            lit = one.lit(at_ns)
            if lit is not None and len(receivers):
                light = light + self._light.falling_on(poses, receivers, one.emitter, lit, one.power)
        noise = np.hypot(self._platform.noise, self._platform.relative_noise * light)
        raw = np.rint(light + noise * self._rng.standard_normal(light.shape))
        counts = np.clip(raw, 0.0, self._platform.saturation).astype(np.int64)
        exchange.readings[:, emitter] = counts - self._baseline[receivers]

    def _finish(self, exchange: Exchange) -> None:
        """The readings are there."""
        self.counts["exchanges"] += 1
        emitter = int(self._ids[exchange.emitter])
        for robot, readings in zip(exchange.receivers.tolist(), exchange.readings, strict=True):
            self.heard[robot].append(Measured(emitter, readings, exchange.end_ns))

    def _drift(self) -> None:
        """The ambient light changes; robots measure it now and then."""
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
