"""A bag keeps its time: with a clock of the test's own, so without waiting."""

from collections.abc import Iterator

import pytest

from swarm_loc_estimator.common.bags.bag_file import RawMessage
from swarm_loc_estimator.nodes.playback import LONGEST_STEP_NS, STEP_S, PlayedSoFar, play

SECOND = 1_000_000_000
T0_NS = 500 * SECOND


class Player:
    """What is published, and when; `slow_s` passes with the first message."""

    def __init__(self, slow_s: float = 0.0) -> None:
        self._now_s = 0.0
        self.told_ns = 0
        self.sent: list[tuple[int, float]] = []
        self.clock: list[int] = []
        self._slow_s = slow_s

    def publish(self, message: RawMessage) -> None:
        """Keep log time and wall time; the clock is never behind."""
        assert message[2] <= self.told_ns
        self.sent.append((message[2], self._now_s))
        self._now_s += self._slow_s
        self._slow_s = 0.0

    def publish_clock(self, now_ns: int) -> None:
        """Keep the clock."""
        self.told_ns = now_ns
        self.clock.append(now_ns)

    def pass_time(self, seconds: float) -> None:
        """Something takes so long."""
        self._now_s += seconds

    def now_s(self) -> float:
        """The test's own clock."""
        return self._now_s

    def wait_until(self, instant_s: float) -> None:
        """Let time pass."""
        self._now_s = max(self._now_s, instant_s)


def bag(*offsets_s: float) -> list[RawMessage]:
    return [("t", "x", T0_NS + round(offset * SECOND), b"") for offset in offsets_s]


def played(player: Player, messages: list[RawMessage], rate: float, begin_s: float = 0.0) -> PlayedSoFar:
    so_far = PlayedSoFar()
    begin_ns = T0_NS + round(begin_s * SECOND)
    play(messages, begin_ns, rate, player, so_far)
    return so_far


@pytest.mark.parametrize("rate", [0.5, 1.0, 7.0, 300.0])
def test_messages_go_out_in_time_at_any_rate(rate: float) -> None:
    player = Player()
    offsets = [0.0, 0.1, 0.1, 0.35, 20.0, 20.0001]
    so_far = played(player, bag(*offsets), rate)
    for (_, wall_s), offset in zip(player.sent, offsets, strict=True):
        assert offset / rate - 1e-9 <= wall_s <= offset / rate + STEP_S + 1e-9
    assert so_far.messages == 6
    assert so_far.latest_s <= STEP_S + 1e-9


def test_time_is_told_in_small_steps_also_where_the_bag_is_silent() -> None:
    player = Player()
    played(player, bag(0.0, 30.0), 300.0)
    steps = [b - a for a, b in zip(player.clock, player.clock[1:], strict=False)]
    assert player.clock[0] == T0_NS
    assert min(steps) > 0
    assert max(steps) <= LONGEST_STEP_NS


def test_the_clock_starts_when_the_first_message_has_been_found() -> None:
    player = Player()

    def slow_to_open(messages: list[RawMessage]) -> Iterator[RawMessage]:
        player.pass_time(1.0)
        yield from messages

    so_far = PlayedSoFar()
    play(slow_to_open(bag(-0.5, 0.1, 0.3)), T0_NS, 1.0, player, so_far)
    assert [wall_s for _, wall_s in player.sent] == pytest.approx([1.1, 1.3], abs=STEP_S + 1e-9)
    assert so_far.latest_s <= STEP_S + 1e-9


def test_being_late_once_does_not_shift_what_follows() -> None:
    player = Player(slow_s=1.0)
    so_far = played(player, bag(0.0, 0.2, 0.9, 3.0), 1.0)
    wall_s = [wall_s for _, wall_s in player.sent]
    assert wall_s[1] == wall_s[2] == 1.0
    assert wall_s[3] == pytest.approx(3.0, abs=STEP_S)
    assert so_far.latest_s == pytest.approx(0.8)
    assert "at most 800.0 ms late" in so_far.summary()


def test_the_beginning_can_be_left_out() -> None:
    player = Player()
    so_far = played(player, bag(0.0, 1.0, 2.0), 1.0, begin_s=0.5)
    assert [log_ns - T0_NS for log_ns, _ in player.sent] == [SECOND, 2 * SECOND]
    assert player.sent[0][1] == pytest.approx(0.5, abs=STEP_S)
    assert so_far.bag_ns == round(1.5 * SECOND)
