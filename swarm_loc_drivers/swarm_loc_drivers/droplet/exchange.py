"""Exchanges of infrared brightness: polled, or in time slots.

Polled, as in the Droplet paper: the receiver asks one robot after the other to emit, and asks again if no
matrix arrives. A request by infrared may be lost, also the command to change the power: then both matrices of
an exchange are equally bright, and neither is used.

Time-division exchanges (TDMA): each Droplet at a cable emits in its time slot, all others measure. Time is
divided into turns by a clock that all drivers share. In its turn a robot emits at near power in the first
half and at far power in the second half. So the time of a matrix gives its power, one emission serves all
robots around, and emissions do not collide.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from swarm_loc_drivers.droplet import protocol
from swarm_loc_drivers.droplet.hardware import (
    EMITTED_AFTER_NS,
    PRINTED_AFTER_NS,
    SET_POWER_DELAY_NS,
    DropletModel,
)
from swarm_loc_drivers.droplet.protocol import MARGIN_NS, ConsoleTalk, Matrix, Said, SendAborted, Talk, relay
from swarm_loc_estimator.common.arrays import IntArray

_BRIGHTER = 1.5  # Least ratio of the sums of the far and the near matrix of a pair, up to 30 cm apart
_PATIENCE_NS = 100_000_000  # Tolerance for the arrival of a matrix [ns]
_MAX_SKIPPED = 32  # Most turns after which an unreachable robot is asked again
_MAX_BACKOFF_S = 0.3


class Power(IntEnum):
    """Power of the emitters, numbered as in BrightnessMatrix."""

    FAR = 0
    NEAR = 1


@dataclass(frozen=True)
class Brightness:
    """Readings of one robot's sensors for another robot's emitters."""

    stamp_ns: int  # Middle of the exchange [ns]; of both powers, where both were measured
    transmitter: int  # Id of the robot that emitted
    power: Power  # Power of the emitters
    readings: IntArray  # (n, n) [count], sensors by emitters


Publish = Callable[[Brightness], None]


@dataclass(frozen=True)
class PollingSettings:
    """Settings of polled exchanges."""

    partners: tuple[int, ...]  # Ids of the robots to ask, in turn
    period_s: float  # Time between the beginnings of two exchanges [s]; 0: only on request
    retries: int  # Number of repeated requests
    powers: tuple[int, ...]  # Powers for FAR and NEAR; with one of them the power is not changed
    least_brightness: int  # A far matrix without a brighter reading shows no robot [count]


class MatrixValidator:
    """Selects usable matrices, of any robots or of those with known ids.

    Counts the others by reason: `no_clock`, `self_heard`, `foreign_receiver`, `unknown_ids`, `overheard`.
    """

    def __init__(self, known: Collection[int], counts: Counter[str]) -> None:
        self._known = frozenset(known)
        self._counts = counts
        self.robot: int | None = None  # Id of the robot at the cable

    def transmitter(self, said: Said, matrix: Matrix, asked: int | None) -> int | None:
        """Id of the emitting robot; None if the matrix cannot be used."""
        # old formats lack it: then it is the robot that was asked to emit, if any
        emitter = asked if matrix.emitter is None else matrix.emitter
        if not said.stamp_ns:
            reason = "no_clock"
        elif matrix.receiver is not None and matrix.receiver != self.robot:
            reason = "foreign_receiver"
        elif emitter is None:
            reason = "overheard"
        elif emitter == self.robot:
            reason = "self_heard"
        elif self._known and emitter not in self._known:
            reason = "unknown_ids"
        else:
            return emitter
        self._counts[reason] += 1
        return None


def brightness_of(matrix: Matrix, stamp_ns: int, transmitter: int, power: Power) -> Brightness:
    """Transpose a matrix of emitters by sensors."""
    return Brightness(stamp_ns, transmitter, power, np.array(matrix.brightness, dtype=np.int64).T)


def publish_pair(ones: list[Brightness], publish: Publish) -> None:
    """Publish the matrices of one exchange with their mean stamp."""
    stamp_ns = sum(one.stamp_ns for one in ones) // len(ones)
    for one in ones:
        publish(Brightness(stamp_ns, one.transmitter, one.power, one.readings))


class PollingExchange:
    """Asks one robot after the other to emit.

    `interlude` handles urgent work, and says whether to continue. Counts `exchanges`, `retries`,
    `failed_exchanges`, `busy_sends`, `dark_matrices`, `equal_powers`, and what the validator counts.
    """

    def __init__(
        self,
        console: ConsoleTalk,
        settings: PollingSettings,
        interlude: Callable[[], Talk[bool]],
        publish: Publish,
        counts: Counter[str],
    ) -> None:
        self.validator = MatrixValidator(settings.partners, counts)
        self._console = console
        self._settings = settings
        self._interlude = interlude
        self._publish = publish
        self._counts = counts
        self._rng = np.random.default_rng(settings.partners)
        self._partners = deque(settings.partners)
        self._skips: Counter[int] = Counter()
        self._failures: Counter[int] = Counter()
        self._requested = 0
        self._due_ns = 0
        self._asked: int | None = None
        self._answer: tuple[int, Matrix] | None = None
        self._aborted = False

    def request(self) -> None:
        """Request one exchange with every partner."""
        self._skips.clear()
        self._requested = len(self._partners)

    def observe(self, said: Said) -> None:
        """Process a printed line."""
        if isinstance(said.event, SendAborted):
            self._counts["busy_sends"] += 1
            self._aborted = True
        elif isinstance(said.event, Matrix):
            transmitter = self.validator.transmitter(said, said.event, self._asked)
            if transmitter is None:
                return
            self._failures[transmitter] = self._skips[transmitter] = 0  # it is in reach
            if transmitter == self._asked:
                self._answer = said.stamp_ns - PRINTED_AFTER_NS, said.event
            else:  # its power is unknown
                self._counts["overheard"] += 1

    def is_quiet(self, _now_ns: int) -> bool:
        """Whether no robot emits now; unknown here, so always true."""
        return True

    def is_due(self, now_ns: int) -> bool:
        """Whether to ask a partner now."""
        if not self._partners or not now_ns:
            return False
        period_ns = round(self._settings.period_s * 1e9)
        if now_ns < self._due_ns - period_ns:  # time has jumped back
            self._due_ns = now_ns
        return self._requested > 0 or (period_ns > 0 and now_ns >= self._due_ns)

    def talk(self) -> Talk[None]:
        """Make an exchange with the next partner."""
        self._due_ns = max(self._console.now_ns, self._due_ns) + round(self._settings.period_s * 1e9)
        self._requested = max(0, self._requested - 1)
        partner = self._next_partner()
        if partner is None:
            return
        ones: list[Brightness] = []
        for power in (Power.NEAR, Power.FAR)[-len(self._settings.powers) :]:  # far comes last, and stays
            one = yield from self._measure(partner, power)
            if one is None:
                # ask a robot that does not answer less and less often
                self._counts["failed_exchanges"] += 1
                self._failures[partner] += 1
                self._skips[partner] = min(2 ** self._failures[partner] - 1, _MAX_SKIPPED)
                return
            ones.append(one)
        # if the far matrix is not brighter, the command to change the power had no effect
        if len(ones) == 2 and not ones[1].readings.sum() > _BRIGHTER * ones[0].readings.sum():
            self._counts["equal_powers"] += 1
            return
        self._counts["exchanges"] += 1
        publish_pair(ones, self._publish)

    def _next_partner(self) -> int | None:
        """The next reachable partner; None: all have to wait."""
        for _ in range(len(self._partners)):
            self._partners.rotate(-1)
            partner = self._partners[-1]
            if self._skips[partner] <= 0:
                return partner
            self._skips[partner] -= 1
        return None

    def _measure(self, partner: int, power: Power) -> Talk[Brightness | None]:
        """A matrix of one power; None if all attempts fail or the session ends."""
        for attempt in range(self._settings.retries + 1):
            if not (yield from self._interlude()):
                return None
            if attempt:
                self._counts["retries"] += 1
                yield from self._console.pause(round(self._rng.uniform(0.0, _MAX_BACKOFF_S) * 1e9))
            answer = yield from self._attempt(partner, power)
            if answer is None:
                continue
            one = brightness_of(answer[1], answer[0], partner, power)
            if power is Power.NEAR or one.readings.max() > self._settings.least_brightness:
                return one
            self._counts["dark_matrices"] += 1
        return None

    def _attempt(self, partner: int, power: Power) -> Talk[tuple[int, Matrix] | None]:
        """Ask once; returns the middle of the exchange [ns] and the matrix."""
        self._asked, self._answer, self._aborted = partner, None, False
        try:
            if len(self._settings.powers) > 1:
                line = protocol.set_power(self._settings.powers[power])
                yield from relay(self._console, partner, line)
                yield from self._console.pause(SET_POWER_DELAY_NS)
                if self._aborted:
                    return None
            heard_ns = yield from relay(self._console, partner, protocol.EMIT)
            end_ns = heard_ns + EMITTED_AFTER_NS + MARGIN_NS + _PATIENCE_NS
            left_ns = end_ns - self._console.now_ns
            yield from self._console.until(lambda: self._answer is not None or self._aborted, left_ns)
            return self._answer
        finally:
            self._asked = None


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
        self._turn_ns = 2 * self._half_ns
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
        # matrices of both powers of one turn are an exchange
        stamp_ns = said.stamp_ns - PRINTED_AFTER_NS
        power = Power.FAR if stamp_ns // self._half_ns % 2 else Power.NEAR
        one = brightness_of(said.event, stamp_ns, transmitter, power)
        near = self._kept.pop(transmitter, None)
        if (
            near is not None
            and power is Power.FAR
            and near.stamp_ns // self._turn_ns == stamp_ns // self._turn_ns
        ):
            self._counts["exchanges"] += 1
            publish_pair([near, one], self._publish)
            return
        if near is not None:
            self._publish_alone(near)
        if power is Power.NEAR:
            self._kept[transmitter] = one
        else:
            self._publish_alone(one)

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
        latest = (now_ns - _LATE_NS) // self._turn_ns
        return [robot for robot, near in self._kept.items() if near.stamp_ns // self._turn_ns < latest]

    def talk(self) -> Talk[None]:
        """Publish unpaired matrices, and emit in this robot's turn."""
        begin_ns = self._console.now_ns
        for robot in self._expired(begin_ns):
            self._publish_alone(self._kept.pop(robot))
        if not self._is_mine(begin_ns):
            return
        # emit once in this half of the turn
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


@dataclass(frozen=True)
class SessionSettings:
    """Settings of a session."""

    model: DropletModel  # Type of the robot
    elements: int  # Number of emitters and of sensors of all robots
    reply_timeout_s: float  # Timeout of an echo or an answer [s]
    exchanges: PollingSettings | TdmaSettings  # Method of measuring brightness
