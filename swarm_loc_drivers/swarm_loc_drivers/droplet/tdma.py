"""Time-division exchanges (TDMA): each Droplet at a cable emits in its time slot, all others measure.

Time is cut into turns, the same for all by the clock that they share. The robot whose turn it is emits at
near power in the first half of its turn and at far power in the second. So everybody knows by the time how
bright a matrix is, one emission serves all robots around, and nobody speaks at the same time.
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
from swarm_loc_drivers.droplet.hardware import (
    EMITTED_AFTER_NS,
    PRINTED_AFTER_NS,
    SET_POWER_DELAY_NS,
)
from swarm_loc_drivers.droplet.protocol import Matrix, Said

_LATEST = 0.5
"""Later in a half than this share of it no emission begins: it might end in the next one."""
_LATE_START_NS = 60_000_000
"""So much later than its half begins an emission usually begins."""
_LATE_NS = 500_000_000
"""So long after its turn a matrix may be read."""
MIN_TURN_S = 4.0 * EMITTED_AFTER_NS * 1e-9
"""In half of half a turn an emission must be through."""


@dataclass(frozen=True)
class TdmaSettings:
    """How turns are taken.

    Attributes:
        turn: Which one is this robot's, from 0 on.
        turns: How many there are.
        turn_s: How long each lasts [s].
        powers: What to set for FAR and for NEAR; with one of them only the second half is used.
        known: Ids that may emit; empty for any.
    """

    turn: int
    turns: int
    turn_s: float
    powers: tuple[int, ...]
    known: tuple[int, ...]


class TdmaExchange:
    """Emits when it is this robot's turn, and knows when others do.

    Args:
        console: Of the robot.
        settings: Whose turn is when.
        interlude: Does what cannot wait; whether to go on.
        publish: Gets the matrices of exchanges.
        counts: Gets `emissions`, `late_turns`, `exchanges`, `half_exchanges`, and what the validator counts.
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
        """Nobody asks where turns are taken."""

    def note(self, said: Said) -> None:
        """The console has printed a line."""
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
        """Whether nobody emits now: else the robot is deaf, or prints what an echo would break."""
        return now_ns % self._half_ns > EMITTED_AFTER_NS + _LATE_START_NS

    def is_due(self, now_ns: int) -> bool:
        """Whether to emit now, or to wait no longer for the second matrix of an exchange."""
        return now_ns > 0 and (self._is_mine(now_ns) or bool(self._expired(now_ns)))

    def _is_mine(self, now_ns: int) -> bool:
        """Whether this half of a turn is this robot's, and it has not emitted in it."""
        half = now_ns // self._half_ns
        mine = half // 2 % self._settings.turns == self._settings.turn
        lit = len(self._settings.powers) > 1 or half % 2 == 1
        return mine and lit and half != self._emitted

    def _expired(self, now_ns: int) -> list[int]:
        """The robots whose far matrix will not come any more."""
        latest = (now_ns - _LATE_NS) // (2 * self._half_ns)
        return [robot for robot, near in self._kept.items() if self._turn(near) < latest]

    def talk(self) -> Talk[None]:
        """Publish what came alone, and emit if it is this robot's turn."""
        begin_ns = self._console.now_ns
        for robot in self._expired(begin_ns):
            self._publish_alone(self._kept.pop(robot))
        if self._is_mine(begin_ns):
            yield from self._emit(begin_ns)

    def _emit(self, begin_ns: int) -> Talk[None]:
        """Emit, once in every half of the turn."""
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
