"""Health of a node, for its log and for /diagnostics: drops, silent topics, lasting problems. No ROS here."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

PATIENCE_S = 5.0  # Time without messages after which a topic is logged as silent [s]
THROTTLE_S = 30.0  # The same warning is logged at most once in this time
_MAX_LINES = 8  # Maximum number of new problems of a kind that are logged one by one
_MAX_NAMES = 8


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass
class Report:
    """One status of /diagnostics."""

    name: str  # Name of the status
    message: str  # One sentence
    level: Level = Level.OK  # How bad it is
    values: dict[str, object] = field(default_factory=dict)  # Figures; their names hold the units
    hardware_id: str = ""  # Address of the hardware that it is about, "" for none

    @property
    def warning(self) -> bool:
        """Whether something is wrong."""
        return self.level is not Level.OK


def level_of(trouble: object) -> Level:
    """WARN where there is trouble, else OK."""
    return Level.WARN if trouble else Level.OK


def drop_values(drops: Mapping[str, int]) -> dict[str, object]:
    """Counts of dropped data as values of a report."""
    return {f"dropped: {reason}": count for reason, count in sorted(drops.items()) if count}


def listed(names: Sequence[str]) -> str:
    """Names in one line; of many only the first ones and the number of the others."""
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return ", ".join(names[:_MAX_NAMES]) + more


class Health:
    """Counts drops, records when topics were received last, and limits the rate of log messages.

    `warn` logs a sentence as a warning; `now_s` is a steady clock [s].
    """

    def __init__(self, warn: Callable[[str], object], now_s: Callable[[], float] = time.monotonic) -> None:
        self.drops: Counter[str] = Counter()  # Count of dropped data by reason
        self._warn = warn
        self._now_s = now_s
        self._details: dict[str, str] = {}
        self._warned_drops: Counter[str] = Counter()
        self._warned_s: dict[tuple[str, object], float] = {}
        self._begun_s: dict[str, dict[object, float]] = {}
        self._received_s: dict[str, float] = {}

    def drop(self, reason: str, detail: str = "") -> None:
        """Count one dropped message or datum; `detail` explains the reason in the log."""
        self.drops[reason] += 1
        self._details[reason] = detail

    def warn_of_drops(self, drops: Mapping[str, int] | None = None, what: str = "dropped") -> None:
        """Log the reasons whose counts have grown since they were logged last: of `drop`, or of `drops`.

        `what` says what the counts are.
        """
        drops = self.drops if drops is None else drops
        grown = [reason for reason, count in drops.items() if count > self._warned_drops[reason]]
        due = [reason for reason in grown if self._is_due("drops", reason)]
        if due:
            details = [f" ({detail})" if (detail := self._details.get(reason)) else "" for reason in due]
            said = [f"{drops[reason]} {reason}{detail}" for reason, detail in zip(due, details, strict=True)]
            self._warn(f"{what} so far: {', '.join(said)}")
            self._warned_drops.update({reason: drops[reason] - self._warned_drops[reason] for reason in due})

    def received(self, topic: str) -> None:
        """Note that a message of a topic has been received."""
        self._received_s[topic] = self._now_s()

    def silence(self, topic: str) -> str:
        """A sentence if no message of a topic has been received yet, or none recently; else ""."""
        received_s = self._received_s.get(topic)
        if received_s is None:
            return f"no messages received on {topic}"
        silent_s = self._now_s() - received_s
        return f"no messages received on {topic} for {silent_s:.0f} s" if silent_s > PATIENCE_S else ""

    def warn(self, problem: str, sentence: str) -> None:
        """Log a problem, unless it was logged a short while ago."""
        if self._is_due("", problem):
            self._warn(sentence)

    def warn_of(self, kind: str, problems: Mapping[Any, str], patience_s: float = 0.0) -> None:
        """Log each problem of a kind once; again only if it has disappeared in between.

        `problems` are all present ones, each with its sentence; each must last for `patience_s` before.
        """
        now_s, begun_s = self._now_s(), self._begun_s.setdefault(kind, {})
        for gone in begun_s.keys() - problems.keys():
            del begun_s[gone]
        self._warned_s = {key: at_s for key, at_s in self._warned_s.items() if now_s - at_s < THROTTLE_S}
        lasting = [one for one in problems if now_s - begun_s.setdefault(one, now_s) >= patience_s]
        due = [one for one in lasting if self._is_due(kind, one)]
        begun_s.update(dict.fromkeys(due, math.inf))  # logged
        for one in due[:_MAX_LINES]:
            self._warn(problems[one])
        if len(due) > _MAX_LINES:
            self._warn(f"{len(due) - _MAX_LINES} more warnings of this kind, see /diagnostics")

    def _is_due(self, kind: str, problem: object) -> bool:
        """Whether a problem was not logged recently; if so, records that it is logged now."""
        now_s = self._now_s()
        if now_s - self._warned_s.get((kind, problem), -math.inf) < THROTTLE_S:
            return False
        self._warned_s[kind, problem] = now_s
        return True
