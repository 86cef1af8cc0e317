"""Polled exchanges of infrared brightness: a Droplet asks one neighbour after the other to emit.

As in the Droplet paper, the receiver asks a certain robot to emit, and asks anew when nothing came of it.
What is asked by infrared may be lost on the way, the command to change the power as well: then both matrices
of an exchange would be equally bright, and neither is used.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from swarm_loc_drivers.droplet import protocol
from swarm_loc_drivers.droplet.console_session import MARGIN_NS, ConsoleTalk, Talk, relay
from swarm_loc_drivers.droplet.hardware import (
    EMITTED_AFTER_NS,
    PRINTED_AFTER_NS,
    SET_POWER_DELAY_NS,
)
from swarm_loc_drivers.droplet.protocol import Matrix, Said, SendAborted

_BRIGHTER = 1.5
"""So much brighter in all is the far matrix of a pair than the near one, at any distance up to 30 cm."""
_PATIENCE_NS = 100_000_000
"""So much later than reckoned a matrix may come."""
_MAX_SKIPPED = 32
"""A robot that cannot be reached is asked again at the latest after so many turns."""
_MAX_BACKOFF_S = 0.3


class Power(IntEnum):
    """How bright the emitters shone, numbered as in BrightnessMatrix."""

    FAR = 0
    NEAR = 1


@dataclass(frozen=True)
class Brightness:
    """What one robot's sensors read of another one's emitters.

    Attributes:
        stamp_ns: Middle of the exchange [ns]; of both powers, where both were measured.
        transmitter: Id of the robot that emitted.
        power: How bright.
        readings: (n, n) [count], sensors by emitters.
    """

    stamp_ns: int
    transmitter: int
    power: Power
    readings: NDArray[np.int64]


Publish = Callable[[Brightness], None]


@dataclass(frozen=True)
class PollingSettings:
    """How to ask.

    Attributes:
        partners: Ids of whom to ask, in turn.
        period_s: Between the begins of two exchanges [s]; 0: only on request.
        retries: How often to ask anew.
        powers: What to set for FAR and for NEAR; with one of them the power is left as it is.
        least_brightness: A far matrix without any brighter reading shows nobody [count].
    """

    partners: tuple[int, ...]
    period_s: float
    retries: int
    powers: tuple[int, ...]
    least_brightness: int


class MatrixValidator:
    """Tells which matrices can be used, and counts the others by reason.

    Args:
        known: Ids that may emit; empty for any.
        counts: Gets `no_clock`, `self_heard`, `foreign_receiver`, `unknown_ids`, `overheard`.
    """

    def __init__(self, known: Collection[int], counts: Counter[str]) -> None:
        self._known = frozenset(known)
        self._counts = counts
        self.robot: int | None = None
        """The own id."""

    def transmitter(self, said: Said, matrix: Matrix, asked: int | None) -> int | None:
        """Who emitted; None if the matrix cannot be used.

        Args:
            said: When it was printed.
            matrix: What was printed.
            asked: Who was asked to emit, if anybody: old formats do not tell.
        """
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
    """A matrix, emitters by sensors, as sensors by emitters."""
    return Brightness(stamp_ns, transmitter, power, np.array(matrix.brightness, dtype=np.int64).T)


def publish_pair(ones: list[Brightness], publish: Publish) -> None:
    """Publish the matrices of one exchange with one stamp, their middle."""
    stamp_ns = sum(one.stamp_ns for one in ones) // len(ones)
    for one in ones:
        publish(Brightness(stamp_ns, one.transmitter, one.power, one.readings))


class PollingExchange:
    """Asks one robot after the other to emit.

    Args:
        console: Of the receiver.
        settings: How to ask.
        interlude: Does what cannot wait; whether to go on asking.
        publish: Gets the matrices of exchanges.
        counts: Gets `exchanges`, `retries`, `failed_exchanges`, `busy_sends`, `dark_matrices`,
            `equal_powers`, and what the validator counts.
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
        """Have one exchange with every partner soon."""
        self._skips.clear()
        self._requested = len(self._partners)

    def note(self, said: Said) -> None:
        """The console has printed a line."""
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
            else:  # nobody here knows how bright it shone
                self._counts["overheard"] += 1

    def is_quiet(self, _now_ns: int) -> bool:
        """Whether nobody emits now; when others ask is not known."""
        return True

    def is_due(self, now_ns: int) -> bool:
        """Whether to ask somebody now."""
        if not self._partners or not now_ns:
            return False
        period_ns = round(self._settings.period_s * 1e9)
        if now_ns < self._due_ns - period_ns:  # time has jumped back
            self._due_ns = now_ns
        return self._requested > 0 or (period_ns > 0 and now_ns >= self._due_ns)

    def talk(self) -> Talk[None]:
        """An exchange with the partner whose turn it is."""
        self._due_ns = max(self._console.now_ns, self._due_ns) + round(self._settings.period_s * 1e9)
        self._requested = max(0, self._requested - 1)
        partner = self._next_partner()
        if partner is None:
            return
        ones: list[Brightness] = []
        for power in (Power.NEAR, Power.FAR)[-len(self._settings.powers) :]:  # far comes last, and stays
            one = yield from self._measure(partner, power)
            if one is None:
                self._note_failure(partner)
                return
            ones.append(one)
        if len(ones) == 2 and not _differ(*ones):
            self._counts["equal_powers"] += 1
            return
        self._counts["exchanges"] += 1
        publish_pair(ones, self._publish)

    def _next_partner(self) -> int | None:
        """Whose turn it is, of those that can be reached; None: all others have to wait."""
        for _ in range(len(self._partners)):
            self._partners.rotate(-1)
            partner = self._partners[-1]
            if self._skips[partner] <= 0:
                return partner
            self._skips[partner] -= 1
        return None

    def _note_failure(self, partner: int) -> None:
        """Ask a robot that was asked in vain less and less often."""
        self._counts["failed_exchanges"] += 1
        self._failures[partner] += 1
        self._skips[partner] = min(2 ** self._failures[partner] - 1, _MAX_SKIPPED)

    def _measure(self, partner: int, power: Power) -> Talk[Brightness | None]:
        """A matrix of one power; None when all attempts fail, or something else is to be done."""
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
        """Ask once; the middle of the exchange [ns] and the matrix."""
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


def _differ(near: Brightness, far: Brightness) -> bool:
    """Whether the far matrix is brighter: else the command to change the power was lost, or ignored."""
    return bool(far.readings.sum() > _BRIGHTER * near.readings.sum())
