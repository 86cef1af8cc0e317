"""A recording in memory: what the robots reported and saw, and where they truly were.

A fit runs the estimator over the same data a hundred times and looks at parts of it; reading the bag once is
enough for that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.core.metrics import Track, interpolate
from swarm_loc_estimator.core.swarm import Robot, Swarm
from swarm_loc_estimator.io.bags import BagReader
from swarm_loc_estimator.io.cdr import decode_pose_batch
from swarm_loc_estimator.io.ingest import Ingest

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Progress = Callable[[float, str], None]

START_GAP_NS = 500_000_000
"""A robot's true start is interpolated over no longer gap."""


class CalibrationError(ValueError):
    """There is nothing to fit to; the message is one sentence."""


@dataclass(frozen=True)
class Rows:
    """Messages of one kind, in order of arrival.

    Attributes:
        robot: (M,) whose.
        stamp_ns: (M,).
        arrival_ns: (M,) not decreasing.
        data: One per message: a raw pose (x, y, theta), or detections (d,) of `DETECTION_DTYPE`.
    """

    robot: IntArray
    stamp_ns: IntArray
    arrival_ns: IntArray
    data: tuple[Any, ...]

    def chosen(self, rows: BoolArray) -> Rows:
        """The messages (M,) that are marked."""
        kept = np.flatnonzero(rows)
        data = tuple(self.data[row] for row in kept.tolist())
        return Rows(self.robot[kept], self.stamp_ns[kept], self.arrival_ns[kept], data)


@dataclass(frozen=True)
class Recording:
    """What a bag holds about a swarm.

    Attributes:
        name: Of the bag.
        odometry: Raw poses.
        detections: Of all cameras.
        truth: Robot name -> ground truth; robots without are missing.
        remarks: What could not be read, one sentence each.
    """

    name: str
    odometry: Rows
    detections: Rows
    truth: Mapping[str, Track]
    remarks: tuple[str, ...] = ()

    @property
    def range_ns(self) -> tuple[int, int]:
        """First and last arrival; (0, 0) when nothing came."""
        arrivals = np.concatenate([self.odometry.arrival_ns, self.detections.arrival_ns])
        return (int(arrivals.min()), int(arrivals.max())) if arrivals.size else (0, 0)

    def between(self, from_ns: int, to_ns: int) -> Recording:
        """What arrived from `from_ns` on and before `to_ns`, and the whole ground truth."""
        odometry, detections = (
            rows.chosen((rows.arrival_ns >= from_ns) & (rows.arrival_ns < to_ns))
            for rows in (self.odometry, self.detections)
        )
        return replace(self, odometry=odometry, detections=detections)

    def masked(self, keep: Callable[[int, npt.NDArray[np.void]], BoolArray]) -> Recording:
        """The recording as if some markers had not been seen.

        Args:
            keep: From a robot's index and its detections (d,) which of them stay.
        """
        rows = self.detections
        data = tuple(
            found[keep(robot, found)] for robot, found in zip(rows.robot.tolist(), rows.data, strict=True)
        )
        return replace(self, detections=replace(rows, data=data))

    def messages(self) -> Iterator[tuple[int, bool, int, int, object]]:
        """All messages in order of arrival: arrival [ns], whether odometry, robot, stamp [ns], data."""
        odometry, detections = self.odometry, self.detections
        arrival_ns = np.concatenate([odometry.arrival_ns, detections.arrival_ns])
        robot = np.concatenate([odometry.robot, detections.robot]).tolist()
        stamp_ns = np.concatenate([odometry.stamp_ns, detections.stamp_ns]).tolist()
        data = (*odometry.data, *detections.data)
        for row in np.argsort(arrival_ns, kind="stable").tolist():
            yield int(arrival_ns[row]), row < len(odometry.data), robot[row], stamp_ns[row], data[row]

    def track(self, robot: int) -> Track:
        """A robot's raw odometry in the order of its stamps, each stamp once."""
        rows = np.flatnonzero(self.odometry.robot == robot)
        stamp_ns, first = np.unique(self.odometry.stamp_ns[rows], return_index=True)
        pose = np.array([self.odometry.data[row] for row in rows[first].tolist()], dtype=float).reshape(-1, 3)
        return Track(stamp_ns, pose)


def read_recording(bag: Path, swarm: Swarm, progress: Progress | None = None) -> Recording:
    """Read a bag once.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file.
        swarm: Whose messages are wanted.
        progress: Called now and then with the share read and what is being done.

    Raises:
        BagError: Nothing in the bag can be read.
    """
    collector = _Collector()
    ingest = Ingest(swarm, collector)
    truth_of = {f"{robot.name}/ground_truth": robot.name for robot in swarm.robots}
    truth: dict[str, list[bytes]] = {topic: [] for topic in truth_of}
    with BagReader(bag) as reader:
        for count, (topic, _, log_ns, data) in enumerate(reader.messages({*ingest.handle_of, *truth_of})):
            if topic in truth:
                truth[topic].append(data)
            else:
                ingest.receive(ingest.handle_of[topic], data, log_ns)
            if progress is not None and count % 5000 == 0:
                progress(reader.progress, "reading")
        remarks = tuple(reader.losses)
    tracks = {truth_of[topic]: _track(messages) for topic, messages in truth.items() if messages}
    return Recording(bag.name, collector.rows(0), collector.rows(1), tracks, remarks)


def start_of(recording: Recording, robot: Robot, track: Track) -> tuple[float, float, float] | None:
    """The true pose where a robot's odometry begins; None when the ground truth does not tell."""
    truth = recording.truth.get(robot.name)
    if truth is None or not track.stamp_ns.size:
        return None
    begin_ns = np.array([track.stamp_ns[0] + round(robot.odometry.delay_s * 1e9)])
    pose, known = interpolate(truth, begin_ns, START_GAP_NS)
    x, y, theta = (float(value) for value in pose[0])
    return (x, y, theta) if known[0] else None


def started_at_truth(swarm: Swarm, recording: Recording) -> Swarm:
    """The swarm with every robot that the ground truth knows at the start starting there; others unknown."""
    robots = [
        replace(robot, start=start_of(recording, robot, recording.track(index)))
        for index, robot in enumerate(swarm.robots)
    ]
    return replace(swarm, robots=tuple(robots))


def _track(messages: list[bytes]) -> Track:
    """Ground truth in the order of its stamps."""
    batch = decode_pose_batch(messages)
    good = batch.valid & np.isfinite(batch.pose).all(axis=1)
    stamp_ns, first = np.unique(batch.stamp_ns[good], return_index=True)
    return Track(stamp_ns, batch.pose[good][first])


class _Collector:
    """Keeps what would go into an estimator."""

    def __init__(self) -> None:
        self._rows: tuple[list[tuple[int, int, int, object]], ...] = ([], [])

    def add_odometry(
        self, robot: int, stamp_ns: int, pose: tuple[float, float, float], now_ns: int, /
    ) -> None:
        """Keep a raw pose."""
        self._rows[0].append((robot, stamp_ns, now_ns, pose))

    def add_detections(
        self, robot: int, stamp_ns: int, detections: npt.NDArray[np.void], now_ns: int, /
    ) -> None:
        """Keep what a camera saw."""
        self._rows[1].append((robot, stamp_ns, now_ns, detections))

    def drop(self, reason: str, count: int = 1, /) -> None:
        """A message that cannot be read fits nothing."""

    def rows(self, kind: int) -> Rows:
        """What was kept of odometry (0) or detections (1)."""
        robot, stamp_ns, arrival_ns, data = (
            zip(*self._rows[kind], strict=True) if self._rows[kind] else ((),) * 4
        )
        return Rows(
            np.array(robot, dtype=np.int64),
            np.array(stamp_ns, dtype=np.int64),
            np.array(arrival_ns, dtype=np.int64),
            tuple(data),
        )
