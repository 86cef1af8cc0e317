"""Polled exchanges of infrared brightness: a Droplet asks one neighbour after the other to emit.

As in the Droplet paper, the receiver asks a robot to emit, and asks again if no matrix arrives. A request by
infrared may be lost, also the command to change the power: then both matrices of an exchange are equally
bright, and neither is used.
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
from swarm_loc_drivers.droplet.hardware import EMITTED_AFTER_NS, PRINTED_AFTER_NS, SET_POWER_DELAY_NS
from swarm_loc_drivers.droplet.protocol import Matrix, Said, SendAborted

_BRIGHTER = 1.5
"""Least ratio of the sums of the far and the near matrix of a pair, at any distance up to 30 cm."""
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
    readings: NDArray[np.int64]  # (n, n) [count], sensors by emitters


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
        self.robot: int | None = None
        """Id of the robot at the cable."""

    def transmitter(self, said: Said, matrix: Matrix, asked: int | None) -> int | None:
        """Id of the emitting robot; None if the matrix cannot be used.

        Old formats lack it: then it is the robot that was asked to emit, if any.
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
                self._note_failure(partner)
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

    def _note_failure(self, partner: int) -> None:
        """Ask a robot that does not answer less and less often."""
        self._counts["failed_exchanges"] += 1
        self._failures[partner] += 1
        self._skips[partner] = min(2 ** self._failures[partner] - 1, _MAX_SKIPPED)

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
