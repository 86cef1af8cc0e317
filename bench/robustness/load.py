"""Fifty robots at three times the load that fits: what the estimator's node sheds, keeps and says.

The load is the rate of the robots' images. It fits as long as the node leaves nothing out: the capacity is
found by raising the rate. Latency is that of a pose at reception since its stamp.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data

from bench.robustness.source import Circles, Sent, Source, SourceSettings, running
from bench.shared.common import OUT, ProgressLine
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import BoolArray
from swarm_loc_estimator.common.launch import GraphOptions, graph_nodes
from swarm_loc_estimator.common.messages.cdr import nanoseconds
from swarm_loc_estimator.nodes.load import SHED_REASONS
from swarm_loc_estimator.offline.live_run import (
    ESTIMATOR,
    START_PATIENCE_S,
    LiveGraph,
    cpu_seconds,
    read_poses,
    resident_mb,
)
from swarm_loc_estimator.offline.metrics import is_misleading
from swarm_loc_estimator.swarm.swarm_file import save_swarm
from swarm_loc_estimator.timeline.estimator import Status
from swarm_loc_msgs.msg import SwarmPoses

ROBOTS, TIMES = 50, 3.0
_FIRST_HZ, _RAISE, _MOST_HZ = 20.0, 1.5, 60.0
_TRIAL_S, _SETTLING_S = 15.0, 10.0
_PATIENCE_S = 60.0
BREAK_NS = 500_000_000  # Stamps of poses that follow each other differ by less unless the clock jumps
_OF_DETECTIONS = ("duplicate", "too_old", "gated", "not_localized", "future_stamp", "reset", *SHED_REASONS)
"""Reasons for which the detections of this swarm are dropped."""


@dataclass
class Heard:
    """Poses of a graph as they come, what its diagnostics say, and the memory of its estimator."""

    circles: Circles
    counts: list[int] = field(default_factory=lambda: [0, 0])  # TRACKED poses, and those that are misleading
    worst_m: float = 0.0  # Largest error of a TRACKED pose
    tracked: BoolArray = field(
        default_factory=lambda: np.zeros(0, dtype=np.bool_)
    )  # (N,) in the newest message
    untracked: set[str] = field(default_factory=set)  # Robots that were not TRACKED at the newest status
    latency_s: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)  # Once a second
    stamp_ns: int = 0  # Of the newest message
    tracked_ns: int = 0  # Newest instant at which all robots are TRACKED, since the stamps have jumped
    shift_ns: int = 0  # By which the source's stamps have been shifted
    next_shift_ns: int = 0  # The same, once the stamps have jumped
    measured_ns: int = 0  # Stamp of the newest odometry of the last robot
    values: dict[str, str] = field(default_factory=dict)  # Of the estimator's newest status
    statuses: int = 0  # Of robots, since robots have been TRACKED
    silent: int = 0  # Of these, the ones that are OK although a robot is not TRACKED, and was not before

    def take(self, data: bytes) -> None:
        """Compare a message's poses with the truth."""
        poses = read_poses(data)
        if abs(poses.stamp_ns - self.stamp_ns) > BREAK_NS:
            self.shift_ns, self.tracked_ns = self.next_shift_ns, 0
        self.stamp_ns = poses.stamp_ns
        self.latency_s.append(time.time() - 1e-9 * poses.stamp_ns)
        tracked = poses.status == Status.TRACKED
        error = poses.pose - self.circles.at(np.array([poses.stamp_ns - self.shift_ns]))[0]
        error[:, 2] = se2.wrap_angle(error[:, 2])
        self.counts[0] += int(tracked.sum())
        self.counts[1] += int(is_misleading(error[tracked], poses.covariance[tracked]).sum())
        self.worst_m = max([self.worst_m, *np.hypot(*error[tracked][:, :2].T).tolist()])
        self.tracked = tracked
        if tracked.all():
            self.tracked_ns = poses.stamp_ns

    def note_odometry(self, message: Odometry) -> None:
        """Keep its stamp."""
        self.measured_ns = nanoseconds(message.header.stamp)

    def note_values(self, message: DiagnosticArray) -> None:
        """Keep what the estimator's statuses say."""
        level_of = {status.name.removeprefix(f"{ESTIMATOR}: "): status.level for status in message.status}
        for status in message.status:
            if status.name == ESTIMATOR:
                self.values = {pair.key: pair.value for pair in status.values}
        names = [robot.name for robot in self.circles.swarm.robots]
        if not self.counts[0] or names[0] not in level_of:
            return
        untracked = {name for name, is_tracked in zip(names, self.tracked, strict=True) if not is_tracked}
        self.statuses += len(names)
        self.silent += sum(level_of[name] == DiagnosticStatus.OK for name in untracked & self.untracked)
        self.untracked = untracked


@dataclass
class Run:
    """A graph and its source."""

    graph: LiveGraph
    source: Source
    heard: Heard

    def go(self, seconds: float, say: Callable[[str], None] = lambda _: None) -> None:
        """Let time pass; memory is noted once a second."""
        begin_s, noted = time.monotonic(), 0

        def is_over() -> bool:
            nonlocal noted
            passed_s = time.monotonic() - begin_s
            if passed_s > noted:
                noted += 1
                self.heard.memory_mb.append(resident_mb(self.graph.process(ESTIMATOR).pid))
                say(f"{passed_s:.0f} of {seconds:.0f} s")
            return passed_s > seconds

        self.graph.wait_for(is_over, "go on publishing poses", _PATIENCE_S)

    def end(self) -> Sent:
        """Stop the source, and wait until the estimator's counts no longer change."""
        sent = self.source.stop()
        recorder, before = self.graph.recorder, [-1, -1]

        def is_settled() -> bool:
            if recorder.diagnostics != before[0]:
                is_same = before[1] == recorder.inputs
                before[:] = recorder.diagnostics, recorder.inputs
                return is_same
            return False

        self.graph.wait_for(is_settled, "settle", _PATIENCE_S)
        return sent


@contextmanager
def started(settings: SourceSettings, name: str) -> Iterator[Run]:
    """A graph of an estimator and a source whose robots have begun to drive."""
    circles = Circles(settings)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "swarm.yaml")
        save_swarm(circles.swarm, path)
        nodes = graph_nodes(GraphOptions(str(path), use_sim_time=settings.is_clock))
        with (
            LiveGraph(nodes, OUT / "robustness" / f"{name}.log") as graph,
            running(settings) as source,
        ):
            heard = Heard(circles)
            graph.recorder.create_subscription(SwarmPoses, "swarm/poses", heard.take, 1000, raw=True)
            graph.recorder.create_subscription(DiagnosticArray, "/diagnostics", heard.note_values, 100)
            last = f"{circles.swarm.robots[-1].name}/odom"
            graph.recorder.create_subscription(Odometry, last, heard.note_odometry, qos_profile_sensor_data)
            graph.wait_for(source.has_begun, "hear the source", START_PATIENCE_S)
            yield Run(graph, source, heard)


def accounted(run: Run) -> int:
    """Detections that were used or are said to have been dropped, while the clock has not jumped."""
    drops = run.graph.recorder.drops
    used = int(run.heard.values["measurements used"]) + int(run.heard.values.get("constraints kept", "0"))
    return used + sum(drops.get(reason, 0) for reason in _OF_DETECTIONS)


def fits(image_rate_hz: float) -> bool:
    """Whether nothing is left out at a rate of images."""
    with started(SourceSettings(ROBOTS, image_rate_hz), "capacity") as run:
        run.go(_SETTLING_S)
        before = _shed(run)
        run.go(_TRIAL_S)
        return _shed(run) == before and not run.graph.recorder.drops.get("overload", 0)


def _shed(run: Run) -> int:
    return sum(run.graph.recorder.drops.get(reason, 0) for reason in SHED_REASONS)


def capacity_hz(say: ProgressLine) -> float:
    """Highest rate of images that fits, in steps of half of it."""
    rate_hz = _FIRST_HZ
    while rate_hz < _MOST_HZ:
        say(f"images at {rate_hz:.1f} Hz")
        if not fits(rate_hz):
            return rate_hz / _RAISE
        rate_hz *= _RAISE
    return rate_hz


def measure(minutes: float, say: ProgressLine, rate_hz: float = 0.0) -> dict[str, float]:
    """Figures of so many minutes at three times the load that fits, or at a rate of images."""
    fitting_hz = rate_hz / TIMES or capacity_hz(say)
    rate_hz = rate_hz or TIMES * fitting_hz
    with started(SourceSettings(ROBOTS, rate_hz), "load") as run:
        pid = run.graph.process(ESTIMATOR).pid
        cpu_s, begin_s = cpu_seconds(pid), time.monotonic()
        run.go(60.0 * minutes, say)
        heard = run.heard
        statuses, silent, tracked, poses = heard.statuses, heard.silent, heard.counts[0], len(heard.latency_s)
        core = (cpu_seconds(pid) - cpu_s) / (time.monotonic() - begin_s)
        source_core = cpu_seconds(run.source.pid) / (time.monotonic() - begin_s)
        sent = run.end()
        recorder = run.graph.recorder
        memory = heard.memory_mb[min(60, len(heard.memory_mb) // 2) :]
        used = int(heard.values["measurements used"])
    dropped = sum(recorder.drops.get(reason, 0) for reason in _OF_DETECTIONS)
    return {
        "load.fitting_hz": fitting_hz,
        "load.minutes": minutes,
        "load.memory_growth": max(memory) / memory[0] - 1.0,
        "load.memory_mb": memory[-1],
        "load.misleading_share": heard.counts[1] / max(heard.counts[0], 1),
        "load.worst_m": heard.worst_m,
        "load.tracked_share": tracked / (poses * ROBOTS),
        "load.poses_hz": poses / (60.0 * minutes),
        "load.silent_share": silent / max(statuses, 1),
        "load.time_jumps": float(heard.values["time jumps"]),
        "load.shed_share": 1.0 - used / sent.detections,
        "load.shed_reported": dropped / sent.detections,
        "load.lost_share": 1.0 - recorder.inputs / (sent.odometry + sent.images),
        "load.lost_reported": recorder.drops.get("overload", 0) / (sent.odometry + sent.images),
        "load.latency_s": float(np.percentile(heard.latency_s, 95.0)),
        "load.latency_max_s": max(heard.latency_s),
        "load.core": core,
        "load.source_core": source_core,
        "load.source_late_s": sent.late_s,
    }
