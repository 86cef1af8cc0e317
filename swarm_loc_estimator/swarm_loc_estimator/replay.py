"""Replay: a bag in, poses out, through the very code that runs live.

Messages are handed to the estimator in the order in which they arrived (log time), and it ticks as it would
have ticked then: what was late is late again. A bag therefore gives the same poses, byte for byte, every time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from swarm_loc_estimator.core.estimator import SwarmEstimate, SwarmEstimator
from swarm_loc_estimator.core.metrics import Track
from swarm_loc_estimator.core.settings import EstimatorSettings
from swarm_loc_estimator.core.swarm import Swarm
from swarm_loc_estimator.io.bags import BagReader
from swarm_loc_estimator.io.cdr import CdrError, decode_pose_stamped
from swarm_loc_estimator.io.ingest import Ingest
from swarm_loc_estimator.replay_result import ReplayResult

TICK_S = 0.1
"""Default time between two outputs [s]."""

Progress = Callable[[float, str], None]


def replay(
    bag: Path,
    swarm: Swarm,
    settings: EstimatorSettings | None = None,
    *,
    tick_s: float = TICK_S,
    progress: Progress | None = None,
) -> ReplayResult:
    """Estimate all poses from a bag and compare them with the ground truth that it may hold.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file.
        swarm: Who is in it.
        settings: Of the estimator.
        tick_s: Time between two outputs [s].
        progress: Called now and then with the share done and what is being done.

    Raises:
        BagError: Nothing in the bag can be read.
    """
    estimator = SwarmEstimator(swarm, settings)
    ingest = Ingest(swarm, estimator)
    truth = _Truth(swarm)
    recorder = _Recorder(estimator, round(tick_s * 1e9))
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
        recorder.tick_until(last_ns + recorder.period_ns)
        remarks = (*reader.losses, *_missing(ingest), *truth.remarks())
    return recorder.result(bag.name, truth.tracks(), remarks, (last_ns - first_ns) * 1e-9, began)


class _Recorder:
    """Ticks the estimator at every whole multiple of a period and keeps what it says."""

    def __init__(self, estimator: SwarmEstimator, period_ns: int) -> None:
        self.period_ns = period_ns
        self._estimator = estimator
        self._next_ns: int | None = None
        self._estimates: list[SwarmEstimate] = []

    def tick_until(self, now_ns: int) -> bool:
        """Do all ticks due by an instant, before what arrives then is handed in; return whether there were any."""
        if self._next_ns is None or now_ns < self._next_ns - 2 * self.period_ns:  # the start, or a jump back
            self._next_ns = (now_ns // self.period_ns + 1) * self.period_ns
        due = now_ns >= self._next_ns
        while self._next_ns <= now_ns:
            self._estimates.append(self._estimator.tick(self._next_ns))
            self._next_ns += self.period_ns
        return due

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


class _Truth:
    """Collects ground truth; nothing of it reaches the estimator."""

    def __init__(self, swarm: Swarm) -> None:
        self.topics = {f"{robot.name}/ground_truth": robot.name for robot in swarm.robots}
        self._rows: dict[str, list[tuple[int, float, float, float]]] = {r.name: [] for r in swarm.robots}
        self._malformed = 0

    def add(self, topic: str, data: bytes) -> None:
        """Take one message in."""
        try:
            message = decode_pose_stamped(data)
        except CdrError:
            self._malformed += 1
            return
        self._rows[self.topics[topic]].append((message.stamp_ns, *message.pose))

    def tracks(self) -> dict[str, Track]:
        """Per robot that has ground truth."""
        tracks = {}
        for name, rows in self._rows.items():
            ordered = sorted(row for row in rows if np.isfinite(row[1:]).all())
            if ordered:
                stamps = np.array([row[0] for row in ordered], dtype=np.int64)
                tracks[name] = Track(stamps, np.array([row[1:] for row in ordered]))
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
