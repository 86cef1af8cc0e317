"""Playback schedule: publish messages of a bag in time, each after its /clock. No ROS here."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain, dropwhile, islice
from typing import Protocol

from swarm_loc_estimator.common.bags.bag_file import RawMessage

_SECOND = 1_000_000_000
STEP_S = 0.005  # Wall time of a playback step [s]; the messages of a step follow a /clock that is not earlier
LONGEST_STEP_NS = 20_000_000  # Longest bag time of a step, at any rate and lag


def clock_step_ns(rate: float) -> int:
    """Step of /clock in bag time, at a rate of `rate` bag seconds per second."""
    return max(1, min(round(STEP_S * rate * _SECOND), LONGEST_STEP_NS))


@dataclass
class PlayedSoFar:
    """Progress of the playback."""

    messages: int = 0  # Number of messages published
    bag_ns: int = 0  # Elapsed bag time
    wall_s: float = 0.0  # Elapsed wall time
    latest_s: float = 0.0  # Maximum delay of a message, in wall time

    def summary(self) -> str:
        """One line for people."""
        bag_s = self.bag_ns / _SECOND
        rate = f" ({bag_s / self.wall_s:.3g} x)" if self.wall_s > 0.0 else ""
        played = f"played {self.messages} messages of {bag_s:.1f} s in {self.wall_s:.1f} s{rate}"
        return f"{played}, at most {1e3 * self.latest_s:.1f} ms late"


class Output(Protocol):
    """Publishes messages, and has the steady clock that schedules them."""

    def publish(self, message: RawMessage) -> None:
        """Publish a message."""

    def publish_clock(self, now_ns: int) -> None:
        """Publish /clock; every message follows a /clock that is not earlier."""

    def now_s(self) -> float:
        """The steady clock."""

    def wait_until(self, instant_s: float) -> None:
        """Wait until an instant of that clock."""


def play(
    messages: Iterable[RawMessage], begin_ns: int, rate: float, output: Output, so_far: PlayedSoFar
) -> None:
    """Publish messages in time with a steady clock; a delay does not shift later messages.

    They are in order of log time; those before `begin_ns` are skipped. `rate` is bag seconds per second, and
    `so_far` is updated during playback.
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
