"""The log of a node: each problem once in a while, drops with their reasons, and silent topics."""

from typing import Any

from swarm_loc_estimator.common.health import PATIENCE_S, THROTTLE_S, Health, drop_values, listed


class Log:
    """Warnings of a `Health` on a clock that a test sets."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.lines: list[str] = []
        self.health = Health(self.lines.append, lambda: self.now_s)

    def new(self) -> list[str]:
        """Warnings since the last call."""
        lines, self.lines[:] = self.lines.copy(), []
        return lines


def test_eight_new_problems_are_logged_one_by_one_and_more_in_a_sentence() -> None:
    """Each once, until it has gone."""
    log, texts = Log(), [f"robot{k} is kidnapped" for k in range(19)]
    all_of: dict[Any, str] = {(k, "pose"): text for k, text in enumerate(texts)}
    part = [dict(list(all_of.items())[:count]) for count in range(20)]
    other = {key: text for key, text in part[18].items() if key != (0, "pose")} | {(0, "noise"): "noisy"}
    for problems, expected in (
        (part[8], texts[:8]),
        (part[9], texts[8:9]),
        (part[18], [*texts[9:17], "1 more warnings of this kind, see /diagnostics"]),
        (other, ["noisy"]),
        (all_of, [texts[0], texts[18]]),
    ):
        log.health.warn_of("contradictions", problems)
        assert log.new() == expected
        log.now_s += THROTTLE_S


def test_a_problem_that_comes_and_goes_is_logged_once_per_throttle() -> None:
    log = Log()
    for now_s in range(int(2 * THROTTLE_S) + 1):
        log.now_s = now_s
        log.health.warn_of("link", {"": "no answer"} if now_s % 2 == 0 else {})
    assert log.new() == 3 * ["no answer"]


def test_a_problem_must_last_before_it_is_logged() -> None:
    log = Log()
    for log.now_s, problems, expected in (
        (0.0, {1: "late"}, []),
        (4.9, {1: "late"}, []),
        (5.0, {1: "late"}, ["late"]),
        (99.0, {1: "late"}, []),
        (100.0, {2: "later"}, []),
        (104.0, {}, []),
        (105.0, {2: "later"}, []),
    ):
        log.health.warn_of("missing", problems, PATIENCE_S)
        assert log.new() == expected


def test_drops_are_counted_and_logged_with_their_details() -> None:
    log = Log()
    log.health.drop("size", "the image has 3 x 2 pixels")
    log.health.drop("size", "the image has 4 x 2 pixels")
    log.health.drop("corrupt")
    log.health.warn_of_drops()
    assert log.new() == ["dropped so far: 2 size (the image has 4 x 2 pixels), 1 corrupt"]
    log.health.warn_of_drops()
    log.health.drop("size", "the image has 5 x 2 pixels")
    log.health.warn_of_drops()
    assert log.new() == []
    log.now_s = THROTTLE_S
    log.health.warn_of_drops()
    assert log.new() == ["dropped so far: 3 size (the image has 5 x 2 pixels)"]
    assert drop_values({**log.health.drops, "never": 0}) == {"dropped: corrupt": 1, "dropped: size": 3}


def test_a_topic_is_silent_before_its_first_message_and_after_a_while_without_any() -> None:
    log = Log()
    assert log.health.silence("odom") == "no messages received on odom"
    log.health.received("odom")
    assert not log.health.silence("odom")
    log.now_s = 7.0
    assert log.health.silence("odom") == "no messages received on odom for 7 s"


def test_long_lists_are_cut() -> None:
    assert listed([*"abcdefgh"]) == "a, b, c, d, e, f, g, h"
    assert listed([*"abcdefghij"]) == "a, b, c, d, e, f, g, h and 2 more"
