"""Replay: a bag in, poses out, through the very code that runs live.

Messages are handed to the estimator in the order in which they arrived (log time), and it ticks as it would
have ticked then: what was late is late again. A bag therefore gives the same poses, byte for byte, every
time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.core.estimator import SwarmEstimate, SwarmEstimator
from swarm_loc_estimator.core.metrics import Track
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.io.bags import BagReader
from swarm_loc_estimator.io.cdr import decode_pose_batch
from swarm_loc_estimator.io.ingest import Ingest
from swarm_loc_estimator.replay_result import ReplayResult

TICK_S = 0.1
"""Default time between two outputs [s]."""
_TRUTH_BATCH = 4096

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
    estimator = SwarmEstimator(swarm, settings)
    ingest = Ingest(swarm, estimator)
    truth = TruthReader(swarm)
    period_ns = round(tick_s * 1e9)
    schedule = _Periodic(period_ns) if stamp_ns is None else _Listed(stamp_ns)
    recorder = _Recorder(estimator, schedule)
    began = time.perf_counter()
    with BagReader(bag) as reader:
        first_ns, last_ns = reader.time_range_ns
        for topic, _, log_ns, data in reader.messages({*ingest.handle_of, *truth.topics}):
            if topic in truth.topics:
                truth.add(topic, data)
                continue
            if recorder.tick_until(log_ns) and progress is not None:
                progress(reader.progress, "replaying")
            ingest.receive(ingest.handle_of[topic], data, log_ns)
        recorder.tick_until(last_ns + period_ns if stamp_ns is None else int(stamp_ns.max(initial=0)))
        tracks = truth.tracks()
        remarks = (*reader.losses, *_missing(ingest), *truth.remarks())
    return recorder.result(bag.name, tracks, remarks, (last_ns - first_ns) * 1e-9, began)


class _Schedule(Protocol):
    """When to give poses."""

    def due(self, now_ns: int) -> Iterator[int]:
        """The instants until now that were not due before."""


class _Periodic:
    """At every whole multiple of a period, anew from where time has jumped back to."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._next_ns: int | None = None

    def due(self, now_ns: int) -> Iterator[int]:
        """The instants until now that were not due before."""
        if self._next_ns is None or now_ns < self._next_ns - 2 * self._period_ns:  # the start, or a jump back
            self._next_ns = (now_ns // self._period_ns + 1) * self._period_ns
        while self._next_ns <= now_ns:
            yield self._next_ns
            self._next_ns += self._period_ns


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


class _Recorder:
    """Ticks the estimator by a schedule and keeps what it says."""

    def __init__(self, estimator: SwarmEstimator, schedule: _Schedule) -> None:
        self._estimator = estimator
        self._schedule = schedule
        self._estimates: list[SwarmEstimate] = []

    def tick_until(self, now_ns: int) -> bool:
        """Do all ticks due by an instant, before what arrives then is handed in; return whether any were."""
        before = len(self._estimates)
        self._estimates += map(self._estimator.tick, self._schedule.due(now_ns))
        return len(self._estimates) > before

    def result(
        self, title: str, truth: Mapping[str, Track], remarks: tuple[str, ...], data_s: float, began: float
    ) -> ReplayResult:
        """Everything together."""
        robots = len(self._estimator.swarm.robots)
        estimates = self._estimates
        return ReplayResult(
            title=title,
            swarm=self._estimator.swarm,
            stamp_ns=np.array([e.stamp_ns for e in estimates], dtype=np.int64),
            pose=np.array([e.poses for e in estimates]).reshape(-1, robots, 3),
            covariance=np.array([e.covariances for e in estimates]).reshape(-1, robots, 3, 3),
            truth=truth,
            counters={"measurements used": self._estimator.used, **self._estimator.drops},
            remarks=remarks,
            data_s=data_s,
            wall_s=time.perf_counter() - began,
        )


class TruthReader:
    """Collects ground truth; nothing of it reaches the estimator.

    Args:
        swarm: Whose.

    Attributes:
        topics: Topic -> robot name.
    """

    def __init__(self, swarm: Swarm) -> None:
        self.topics = {f"{robot.name}/ground_truth": robot.name for robot in swarm.robots}
        self._raw: dict[str, list[bytes]] = {name: [] for name in self.topics.values()}
        self._rows: dict[str, list[Track]] = {name: [] for name in self.topics.values()}
        self._malformed = 0

    def add(self, topic: str, data: bytes) -> None:
        """Take one message in."""
        name = self.topics[topic]
        self._raw[name].append(data)
        if len(self._raw[name]) == _TRUTH_BATCH:
            self._read(name)

    def _read(self, name: str) -> None:
        """Turn messages into numbers, many at once."""
        batch = decode_pose_batch(self._raw[name])
        self._raw[name].clear()
        self._malformed += int(np.sum(~batch.valid))
        usable = np.flatnonzero(batch.valid & np.isfinite(batch.pose).all(axis=1))
        order = usable[np.argsort(batch.stamp_ns[usable], kind="stable")]
        self._rows[name].append(Track(batch.stamp_ns[order], batch.pose[order]))

    def tracks(self) -> dict[str, Track]:
        """Per robot that has ground truth."""
        tracks = {}
        for name, parts in self._rows.items():
            self._read(name)
            stamps = np.concatenate([part.stamp_ns for part in parts])
            order = np.argsort(stamps, kind="stable")
            if len(order):
                tracks[name] = Track(stamps[order], np.concatenate([part.pose for part in parts])[order])
        return tracks

    def remarks(self) -> tuple[str, ...]:
        """What else must be said."""
        return (f"{self._malformed} messages of ground truth are malformed.",) if self._malformed else ()


def _missing(ingest: Ingest) -> tuple[str, ...]:
    """One sentence for every input that the bag does not have."""
    return tuple(
        f"The bag holds no message on {topic.name}."
        for topic, statistics in zip(ingest.topics, ingest.statistics, strict=True)
        if topic.expected and not statistics.received
    )
