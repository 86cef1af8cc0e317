"""Replay: a bag in, poses out, through the very code that runs live.

Messages are handed to the estimator in the order in which they arrived (log time), and it ticks as it would
have ticked then: what was late is late again. A bag therefore gives the same poses, byte for byte, every
time. Memory does not grow with the bag: poses and ground truth are collected in a temporary file.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.core.arrivals import Arrivals
from swarm_loc_estimator.core.estimator import SwarmEstimator
from swarm_loc_estimator.core.learned import learns
from swarm_loc_estimator.core.metrics import Track
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.io.bags import BagReader
from swarm_loc_estimator.io.ingest import LONGEST_PAUSE_NS, Ingest
from swarm_loc_estimator.io.spool import Spool
from swarm_loc_estimator.io.truth import TruthReader
from swarm_loc_estimator.replay_result import ReplayResult

TICK_S = 0.1
"""Default time between two outputs [s]."""
_TICKS_AT_ONCE = 256

Progress = Callable[[float, str], None]


def replay(
    bag: Path,
    swarm: Swarm,
    settings: EstimatorSettings | None = None,
    *,
    tick_s: float = TICK_S,
    stamp_ns: npt.NDArray[np.int64] | None = None,
    progress: Progress | None = None,
) -> ReplayResult:
    """Estimate all poses from a bag and compare them with the ground truth that it may hold.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file.
        swarm: Who is in it.
        settings: Of the estimator.
        tick_s: Time between two outputs [s].
        stamp_ns: (T,) increasing, when to give poses instead, such as when a live estimator gave them.
        progress: Called now and then with the share done and what is being done.

    Raises:
        BagError: Nothing in the bag can be read.
    """
    estimator, ingest, truth = SwarmEstimator(swarm, settings), Ingest(swarm), TruthReader(swarm)
    period_ns = round(tick_s * 1e9)
    schedule = _Periodic(period_ns) if stamp_ns is None else _Listed(stamp_ns)
    recorder = _Recorder(estimator, schedule)
    inputs = len(ingest.topics)
    began = time.perf_counter()
    with BagReader(bag) as reader:
        first_ns, last_ns = reader.time_range_ns
        for batch in reader.batches([*ingest.handle_of, *truth.topics]):
            is_input = batch.topic < inputs
            for messages in ingest.read(batch.chosen(is_input)):
                recorder.take(estimator.screen(messages), messages.begin_ns, messages.end_ns)
            others = batch.chosen(~is_input)
            truth.add(others._replace(topic=others.topic - inputs))
            if progress is not None:
                progress(reader.progress, "replaying")
        recorder.tick_until(last_ns + period_ns if stamp_ns is None else int(stamp_ns.max(initial=0)))
        remarks = (*reader.losses, *_missing(ingest), *truth.remarks(), *schedule.remarks())
    data_s = (last_ns - first_ns) * 1e-9
    return recorder.result(bag.name, ingest.received(), truth.tracks(), remarks, data_s, began)


class _Schedule(Protocol):
    """When to give poses."""

    def due(self, now_ns: int) -> Iterator[int]:
        """The instants until now that were not due before."""

    def remarks(self) -> tuple[str, ...]:
        """What else must be said."""


class _Periodic:
    """At every whole multiple of a period, but where time jumps ahead."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._next_ns: int | None = None
        self._jumps = 0

    def due(self, now_ns: int) -> Iterator[int]:
        """The instants until now that were not due before."""
        if self._next_ns is None:
            self._next_ns = (now_ns // self._period_ns + 1) * self._period_ns
        if now_ns - self._next_ns > LONGEST_PAUSE_NS:
            self._next_ns = (now_ns // self._period_ns + 1) * self._period_ns
            self._jumps += 1
        while self._next_ns <= now_ns:
            yield self._next_ns
            self._next_ns += self._period_ns

    def remarks(self) -> tuple[str, ...]:
        """What else must be said."""
        if not self._jumps:
            return ()
        return (
            f"The log time jumps ahead by more than an hour, {self._jumps} x; no poses are given meanwhile.",
        )


class _Listed:
    """At given instants."""

    def __init__(self, stamp_ns: npt.NDArray[np.int64]) -> None:
        self._stamp_ns: list[int] = stamp_ns.tolist()
        self._place = 0

    def due(self, now_ns: int) -> Iterator[int]:
        """The instants until now that were not due before."""
        while self._place < len(self._stamp_ns) and self._stamp_ns[self._place] <= now_ns:
            yield self._stamp_ns[self._place]
            self._place += 1

    def remarks(self) -> tuple[str, ...]:
        """What else must be said."""
        return ()


class _Recorder:
    """Ticks the estimator by a schedule and keeps what it says."""

    def __init__(self, estimator: SwarmEstimator, schedule: _Schedule) -> None:
        self._estimator = estimator
        self._schedule = schedule
        self._spool = Spool()
        robots = len(estimator.swarm.robots)
        self._stamp_ns = np.zeros(_TICKS_AT_ONCE, dtype=np.int64)
        self._pose = np.zeros((_TICKS_AT_ONCE, robots, 3))
        self._covariance = np.zeros((_TICKS_AT_ONCE, robots, 3, 3))
        self._filled = 0

    def take(self, arrivals: Arrivals, begin_ns: int, end_ns: int) -> None:
        """Hand in what arrived between two instants, and do all ticks that were due meanwhile."""
        stamps_ns = [*self._schedule.due(begin_ns), *self._schedule.due(end_ns)]
        parts = arrivals.until_each(np.array(stamps_ns, dtype=np.int64))
        for now_ns in stamps_ns:
            self._estimator.add(next(parts))
            self._tick(now_ns)
        self._estimator.add(next(parts))

    def tick_until(self, now_ns: int) -> None:
        """Do all ticks due by an instant."""
        for due_ns in self._schedule.due(now_ns):
            self._tick(due_ns)

    def result(
        self,
        title: str,
        received: Mapping[str, int],
        truth: Mapping[str, Track],
        remarks: tuple[str, ...],
        data_s: float,
        began: float,
    ) -> ReplayResult:
        """Everything together."""
        self._flush()
        robots = len(self._estimator.swarm.robots)
        return ReplayResult(
            title=title,
            swarm=self._estimator.swarm,
            stamp_ns=self._spool.array("stamp_ns", np.int64),
            pose=self._spool.array("pose", np.float64, robots, 3),
            covariance=self._spool.array("covariance", np.float64, robots, 3, 3),
            learned=self._estimator.learned() if learns(self._estimator.swarm) else None,
            truth=truth,
            counters={
                **{f"messages on {topic}": count for topic, count in received.items()},
                **self._estimator.counters,
                **self._estimator.drops,
            },
            remarks=remarks,
            data_s=data_s,
            wall_s=time.perf_counter() - began,
        )

    def _tick(self, now_ns: int) -> None:
        estimate, k = self._estimator.tick(now_ns), self._filled
        self._stamp_ns[k], self._pose[k], self._covariance[k] = now_ns, estimate.poses, estimate.covariances
        self._filled += 1
        if self._filled == _TICKS_AT_ONCE:
            self._flush()

    def _flush(self) -> None:
        """Write what is kept to the spool."""
        filled, self._filled = slice(self._filled), 0
        for name in ("stamp_ns", "pose", "covariance"):
            self._spool.append(name, getattr(self, f"_{name}")[filled])


def _missing(ingest: Ingest) -> tuple[str, ...]:
    """One sentence for every input that the bag does not have."""
    return tuple(
        f"The bag holds no message on {topic.name}."
        for topic, statistics in zip(ingest.topics, ingest.statistics, strict=True)
        if topic.expected and not statistics.received
    )
