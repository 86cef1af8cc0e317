"""Time-division exchanges (TDMA): each Droplet at a cable emits in its time slot, all others measure.

Time is divided into turns by a clock that all drivers share. In its turn a robot emits at near power in the
first half and at far power in the second half. So the time of a matrix gives its power, one emission serves
all robots around, and emissions do not collide.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from swarm_loc_drivers.droplet import protocol
from swarm_loc_drivers.droplet.console_session import MARGIN_NS, ConsoleTalk, Talk
from swarm_loc_drivers.droplet.exchange import (
    Brightness,
    MatrixValidator,
    Power,
    Publish,
    brightness_of,
    publish_pair,
)
from swarm_loc_drivers.droplet.hardware import EMITTED_AFTER_NS, PRINTED_AFTER_NS, SET_POWER_DELAY_NS
from swarm_loc_drivers.droplet.protocol import Matrix, Said

_LATEST = 0.5  # Share of a half after which no emission begins, since it might end in the next half
_LATE_START_NS = 60_000_000  # Usual delay of an emission after the beginning of its half [ns]
_LATE_NS = 500_000_000  # Longest delay of a matrix after its turn [ns]
MIN_TURN_S = 4.0 * EMITTED_AFTER_NS * 1e-9  # Shortest turn: an emission must fit into half of its half [s]


@dataclass(frozen=True)
class TdmaSettings:
    """Settings of time-division exchanges."""

    turn: int  # Turn of this robot, from 0
    turns: int  # Number of turns
    turn_s: float  # Duration of a turn [s]
    powers: tuple[int, ...]  # Powers for FAR and NEAR; with one of them only the second half is used
    known: tuple[int, ...]  # Ids that may emit; empty: any


class TdmaExchange:
    """Emits in this robot's turn, and assigns matrices to the turns of others.

    `interlude` handles urgent work, and says whether to continue. Counts `emissions`, `late_turns`,
    `exchanges`, `half_exchanges`, and what the validator counts.
    """

    def __init__(
        self,
        console: ConsoleTalk,
        settings: TdmaSettings,
        interlude: Callable[[], Talk[bool]],
        publish: Publish,
        counts: Counter[str],
    ) -> None:
        self.validator = MatrixValidator(settings.known, counts)
        self._console = console
        self._settings = settings
        self._half_ns = round(0.5e9 * settings.turn_s)
        self._interlude = interlude
        self._publish = publish
        self._counts = counts
        self._power: int | None = None
        self._emitted = -1
        self._kept: dict[int, Brightness] = {}  # near matrices

    def request(self) -> None:
        """Does nothing: robots are not asked."""

    def observe(self, said: Said) -> None:
        """Process a printed line."""
        if not isinstance(said.event, Matrix):
            return
        transmitter = self.validator.transmitter(said, said.event, None)
        if transmitter is None:
            return
        stamp_ns = said.stamp_ns - PRINTED_AFTER_NS
        power = Power.FAR if stamp_ns // self._half_ns % 2 else Power.NEAR
        one = brightness_of(said.event, stamp_ns, transmitter, power)
        near = self._kept.pop(transmitter, None)
        if near is not None and power is Power.FAR and self._turn(near) == self._turn(one):
            self._counts["exchanges"] += 1
            publish_pair([near, one], self._publish)
            return
        if near is not None:
            self._publish_alone(near)
        if power is Power.NEAR:
            self._kept[transmitter] = one
        else:
            self._publish_alone(one)

    def _turn(self, one: Brightness) -> int:
        """The number of the turn in which a matrix was measured."""
        return one.stamp_ns // self._half_ns // 2

    def _publish_alone(self, one: Brightness) -> None:
        """Publish the only matrix of its exchange."""
        self._counts["half_exchanges"] += 1
        publish_pair([one], self._publish)

    def is_quiet(self, now_ns: int) -> bool:
        """Whether no robot emits now; during an exchange the robot ignores its console or prints a matrix."""
        return now_ns % self._half_ns > EMITTED_AFTER_NS + _LATE_START_NS

    def is_due(self, now_ns: int) -> bool:
        """Whether to emit now, or to publish a matrix whose pair is overdue."""
        return now_ns > 0 and (self._is_mine(now_ns) or bool(self._expired(now_ns)))

    def _is_mine(self, now_ns: int) -> bool:
        """Whether this half of a turn is this robot's and still unused."""
        half = now_ns // self._half_ns
        mine = half // 2 % self._settings.turns == self._settings.turn
        lit = len(self._settings.powers) > 1 or half % 2 == 1
        return mine and lit and half != self._emitted

    def _expired(self, now_ns: int) -> list[int]:
        """Robots whose far matrix is overdue."""
        latest = (now_ns - _LATE_NS) // (2 * self._half_ns)
        return [robot for robot, near in self._kept.items() if self._turn(near) < latest]

    def talk(self) -> Talk[None]:
        """Publish unpaired matrices, and emit in this robot's turn."""
        begin_ns = self._console.now_ns
        for robot in self._expired(begin_ns):
            self._publish_alone(self._kept.pop(robot))
        if self._is_mine(begin_ns):
            yield from self._emit(begin_ns)

    def _emit(self, begin_ns: int) -> Talk[None]:
        """Emit once in this half of the turn."""
        half = begin_ns // self._half_ns
        self._emitted = half
        if begin_ns % self._half_ns > _LATEST * self._half_ns:
            self._counts["late_turns"] += 1
            return
        power = self._settings.powers[Power.FAR if half % 2 else Power.NEAR]
        if power != self._power:
            self._power = None
            yield from self._console.enter(protocol.set_power(power))
            yield from self._console.pause(SET_POWER_DELAY_NS + MARGIN_NS)
            self._power = power
        if (yield from self._interlude()):
            yield from self._console.enter(protocol.EMIT)
            self._counts["emissions"] += 1
            yield from self._console.pause(EMITTED_AFTER_NS)
