"""A recording in memory: odometry, detections, other inputs and ground truth of a swarm.

A fit runs the estimator over the same data a hundred times and looks at parts of it; reading the bag once is
enough for that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.common.arrays import BoolArray, IntArray
from swarm_loc_estimator.common.errors import UserError
from swarm_loc_estimator.common.messages.cdr import DETECTION_DTYPE
from swarm_loc_estimator.common.trajectory import Trajectory, interpolate
from swarm_loc_estimator.offline.recorded_bag import Progress, read_bag, unwatched
from swarm_loc_estimator.offline.replay import PeriodicSchedule, Runner
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.messages import (
    NO_BRIGHTNESS,
    NO_FIXES,
    NO_ODOMETRY,
    BrightnessRows,
    DetectionRows,
    FixRows,
    OdometryRows,
    RawInputs,
    joined,
)
from swarm_loc_estimator.sensors.validation import InputValidator
from swarm_loc_estimator.swarm.swarm import Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings

_NONE = np.zeros(0, dtype=np.int64)
START_GAP_NS = 500_000_000
"""A robot's true start is interpolated over no longer gap."""


class CalibrationError(UserError):
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

    @cached_property
    def poses(self) -> npt.NDArray[np.float64]:
        """Raw poses (M, 3) of odometry."""
        return np.array(self.data, dtype=float).reshape(-1, 3)

    @cached_property
    def detections(self) -> npt.NDArray[np.void]:
        """Detections of all messages one after the other (d,)."""
        joined = b"".join(found.tobytes() for found in self.data)  # concatenating structured arrays is slow
        return np.frombuffer(joined, dtype=DETECTION_DTYPE)


@dataclass(frozen=True)
class Recording:
    """What a bag holds about a swarm.

    Attributes:
        name: Of the bag.
        odometry: Raw poses.
        detections: Of all cameras.
        truth: Robot name -> ground truth; robots without are missing.
        brightness: Of all infrared boards.
        fixes: Of all robots.
        remarks: What could not be read, one sentence each.
    """

    name: str
    odometry: Rows
    detections: Rows
    truth: Mapping[str, Trajectory]
    brightness: BrightnessRows = NO_BRIGHTNESS
    fixes: FixRows = NO_FIXES
    remarks: tuple[str, ...] = ()

    @property
    def range_ns(self) -> tuple[int, int]:
        """First and last arrival; (0, 0) when nothing came."""
        arrivals = np.concatenate([self.odometry.arrival_ns, self.detections.arrival_ns])
        return (int(arrivals.min()), int(arrivals.max())) if arrivals.size else (0, 0)

    @property
    def longest_pause_ns(self) -> int:
        """The longest time between two neighbouring stamps, or between two arrivals."""
        parts = (self.odometry, self.detections)
        times = (
            np.concatenate([part.stamp_ns for part in parts]),
            np.concatenate([part.arrival_ns for part in parts]),
        )
        return max(int(np.diff(np.sort(column)).max(initial=0)) for column in times)

    def between(self, from_ns: int, to_ns: int) -> Recording:
        """What wheels and cameras said from `from_ns` on and before `to_ns`; all else is whole."""
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

    @cached_property
    def messages(self) -> RawInputs:
        """What wheels and cameras said, in columns, in order of arrival."""
        odometry, detections, (begin_ns, end_ns) = self.odometry, self.detections, self.range_ns
        counts = [found.size for found in detections.data]
        columns = (detections.robot, detections.stamp_ns, detections.arrival_ns)
        robot, stamp_ns, arrival_ns = (np.repeat(column, counts) for column in columns)
        return RawInputs(
            begin_ns,
            end_ns,
            OdometryRows(odometry.robot, odometry.stamp_ns, odometry.poses, odometry.arrival_ns),
            DetectionRows(robot, stamp_ns, detections.detections, arrival_ns),
        )

    def track(self, robot: int) -> Trajectory:
        """A robot's raw odometry in the order of its stamps, each stamp once."""
        rows = np.flatnonzero(self.odometry.robot == robot)
        stamp_ns, first = np.unique(self.odometry.stamp_ns[rows], return_index=True)
        return Trajectory(stamp_ns, self.odometry.poses[rows[first]])


def read_recording(bag: Path, swarm: Swarm, progress: Progress = unwatched) -> Recording:
    """Read a bag once.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file.
        swarm: Whose messages are wanted.
        progress: Called now and then.

    Raises:
        BagError: Nothing in the bag can be read.
    """
    parts: list[RawInputs] = []
    summary = read_bag(bag, swarm, parts.append, progress)
    validator = InputValidator(swarm, Settings())
    odometry = joined([NO_ODOMETRY, *(validator.validate(part).odometry for part in parts)])
    detections = [_per_message(part.detections) for part in parts]
    unused = (f"{count} inputs are not used: {reason}." for reason, count in validator.drops.items())
    return Recording(
        bag.name,
        Rows(
            odometry.robot, odometry.stamp_ns, odometry.arrival_ns, tuple(map(tuple, odometry.pose.tolist()))
        ),
        _joined(detections),
        {name: _each_stamp_once(track) for name, track in summary.truth.items()},
        joined([NO_BRIGHTNESS, *(part.brightness for part in parts)]),
        joined([NO_FIXES, *(part.fixes for part in parts)]),
        (*summary.remarks, *unused),
    )


def start_of(recording: Recording, robot: Robot, track: Trajectory) -> tuple[float, float, float] | None:
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


def _each_stamp_once(track: Trajectory) -> Trajectory:
    """The track with the first of the poses that share a stamp."""
    stamp_ns, first = np.unique(track.stamp_ns, return_index=True)
    return Trajectory(stamp_ns, track.pose[first])


def _per_message(rows: DetectionRows) -> Rows:
    """Detections (d,) as messages (m,), each with all that a camera saw at once."""
    columns = (rows.robot, rows.stamp_ns, rows.arrival_ns)
    new = np.logical_or.reduce([column[1:] != column[:-1] for column in columns])
    starts = np.flatnonzero(np.concatenate([np.ones(min(rows.robot.size, 1), dtype=bool), new]))
    ends = [*starts[1:].tolist(), rows.robot.size][: starts.size]
    data = tuple(rows.detection[a:b] for a, b in zip(starts.tolist(), ends, strict=True) if b > a)
    robot, stamp_ns, arrival_ns = (column[starts] for column in columns)
    return Rows(robot, stamp_ns, arrival_ns, data)


def _joined(parts: list[Rows]) -> Rows:
    """All messages of parts, one after the other."""
    names = ("robot", "stamp_ns", "arrival_ns")
    columns = (np.concatenate([_NONE, *(getattr(part, name) for part in parts)]) for name in names)
    robot, stamp_ns, arrival_ns = columns
    return Rows(robot, stamp_ns, arrival_ns, tuple(message for part in parts for message in part.data))


def rerun(
    recording: Recording, swarm: Swarm, tick_s: float, settings: Settings | None = None
) -> ReplayResult:
    """Poses at every whole multiple of `tick_s`, each from what had arrived by then."""
    runner = Runner(Estimator(swarm, settings), PeriodicSchedule(round(tick_s * 1e9)))
    runner.take(recording.messages)
    runner.finish(recording.range_ns[1])
    return runner.result(recording.name, recording.range_ns, recording.truth, {})
