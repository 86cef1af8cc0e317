"""Playback schedule: publish messages of a bag in time, each after a /clock not behind it. No ROS here."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain, dropwhile, islice
from typing import Protocol

from swarm_loc_estimator.common.bags.bag_file import RawMessage

_SECOND = 1_000_000_000
STEP_S = 0.005
"""Messages go out in steps of this much wall time, each after a /clock that none of them is ahead of."""
LONGEST_STEP_NS = 20_000_000
"""A step is never longer than this much bag time, at any rate and however far behind."""


def clock_step_ns(rate: float) -> int:
    """By how much /clock goes on at a time, where a bag is played at `rate` seconds per second."""
    return max(1, min(round(STEP_S * rate * _SECOND), LONGEST_STEP_NS))


@dataclass
class PlayedSoFar:
    """What went out.

    Attributes:
        messages: How many.
        bag_ns: Bag time that has passed.
        wall_s: Wall time that has passed.
        latest_s: How late the latest message was, in wall time.
    """

    messages: int = 0
    bag_ns: int = 0
    wall_s: float = 0.0
    latest_s: float = 0.0

    def summary(self) -> str:
        """One line for people."""
        bag_s = self.bag_ns / _SECOND
        rate = f" ({bag_s / self.wall_s:.3g} x)" if self.wall_s > 0.0 else ""
        return (
            f"played {self.messages} messages of {bag_s:.1f} s in {self.wall_s:.1f} s{rate},"
            f" at most {1e3 * self.latest_s:.1f} ms late"
        )


class Output(Protocol):
    """Where messages go, and the steady clock that they keep to."""

    def publish(self, message: RawMessage) -> None:
        """Send a message out."""

    def publish_clock(self, now_ns: int) -> None:
        """Send /clock out; every message follows one that is not behind it."""

    def now_s(self) -> float:
        """The steady clock."""

    def wait_until(self, instant_s: float) -> None:
        """Return when that clock has come to an instant."""


def play(
    messages: Iterable[RawMessage], begin_ns: int, rate: float, output: Output, so_far: PlayedSoFar
) -> None:
    """Publish messages in time with a steady clock; being late once does not shift what follows.

    Args:
        messages: In order of log time; earlier ones than `begin_ns` are left out.
        begin_ns: Log time that stands for now.
        rate: Bag seconds per second.
        output: Where they go.
        so_far: Is kept up to date.
    """
    step_ns = clock_step_ns(rate)
    # finding the first one takes a while in a large bag: not after the clock has begun to run
    left = dropwhile(lambda message: message[2] < begin_ns, messages)
    first = list(islice(left, 1))
    begin_s, clock_ns = output.now_s(), begin_ns
    bag_before_ns, wall_before_s = so_far.bag_ns, so_far.wall_s
    output.publish_clock(begin_ns)
    for message in chain(first, left):
        log_ns = message[2]
        while log_ns > clock_ns:
            clock_ns += step_ns
            output.wait_until(begin_s + (clock_ns - begin_ns) / (rate * _SECOND))
            output.publish_clock(clock_ns)
        late_s = output.now_s() - begin_s - (log_ns - begin_ns) / (rate * _SECOND)
        output.publish(message)
        so_far.messages += 1
        so_far.bag_ns = bag_before_ns + log_ns - begin_ns
        so_far.wall_s = wall_before_s + output.now_s() - begin_s
        so_far.latest_s = max(so_far.latest_s, late_s)
