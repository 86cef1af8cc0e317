"""A recording in memory: odometry, detections, other inputs and ground truth of a swarm.

A fit runs the estimator over the same data a hundred times; the bag is read only once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.trajectory import DEFAULT_GAP_NS, Trajectory, interpolate
from swarm_loc_estimator.filter.measurements import concatenate, select
from swarm_loc_estimator.offline.recorded_bag import Progress, read_bag, unwatched
from swarm_loc_estimator.offline.replay import PeriodicSchedule, Runner
from swarm_loc_estimator.offline.result import ReplayResult
from swarm_loc_estimator.sensors.camera import NO_DETECTIONS, DetectionRows
from swarm_loc_estimator.sensors.fix import NO_FIXES, FixRows
from swarm_loc_estimator.sensors.imu import NO_TURN_RATES, TurnRateRows
from swarm_loc_estimator.sensors.infrared import NO_BRIGHTNESS, BrightnessRows
from swarm_loc_estimator.sensors.inputs import Batch, InputConverter, gathered
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.sensors.ranges import NO_RANGES, RangeRows
from swarm_loc_estimator.swarm.swarm import Pose2, Robot, Swarm
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings

_INPUTS = ("odometry", "detections", "brightness", "fixes", "turn_rates", "ranges")
DENSE_GAP_NS = 200_000_000  # Longest gap of ground truth that is interpolated
_PAUSE_NS = 60_000_000_000  # Between recordings, in which robots may get anywhere


class CalibrationError(UserError):
    """A recording that cannot be used for calibration."""


@dataclass(frozen=True)
class Recording:
    """Inputs and ground truth of a bag."""

    name: str  # Of the bag
    odometry: OdometryRows  # Of all robots
    detections: DetectionRows  # Of all cameras
    truth: Mapping[str, Trajectory]  # Robot name -> ground truth; robots without are missing
    brightness: BrightnessRows = NO_BRIGHTNESS  # Of all infrared boards
    fixes: FixRows = NO_FIXES  # Of all robots
    turn_rates: TurnRateRows = NO_TURN_RATES  # Of all IMUs
    ranges: RangeRows = NO_RANGES  # Of all UWB radios, as they arrived
    dropped: Mapping[str, int] = field(default_factory=dict)  # Number of dropped inputs by reason
    remarks: tuple[str, ...] = ()  # Unreadable contents, one sentence each
    bags_ns: tuple[tuple[int, int], ...] = ()  # First and last arrival of each of several joined bags

    def sentences(self, expected: Collection[str] = ()) -> list[str]:
        """The remarks, and what was dropped for other reasons than the expected ones."""
        unused = (
            f"{count} inputs are not used: {why}."
            for why, count in self.dropped.items()
            if why not in expected
        )
        return [*self.remarks, *unused]

    @property
    def inputs(self) -> dict[str, Any]:
        """All inputs by name."""
        return {name: getattr(self, name) for name in _INPUTS}

    @property
    def range_ns(self) -> tuple[int, int]:
        """First and last arrival; (0, 0) without any."""
        arrivals = np.concatenate([rows.arrival_ns for rows in self.inputs.values()])
        return (int(arrivals.min()), int(arrivals.max())) if arrivals.size else (0, 0)

    @property
    def longest_pause_ns(self) -> int:
        """The longest time between consecutive stamps or arrivals."""
        times = (
            np.concatenate([getattr(rows, name) for rows in self.inputs.values()])
            for name in ("stamp_ns", "arrival_ns")
        )
        return max(int(np.diff(np.sort(column)).max(initial=0)) for column in times)

    def between(self, *spans_ns: tuple[int, int]) -> Recording:
        """The recording with only the inputs that arrived in one of the spans [from, to)."""
        parts = {}
        for name, rows in self.inputs.items():
            arrived = [(rows.arrival_ns >= first) & (rows.arrival_ns < last) for first, last in spans_ns]
            parts[name] = select(rows, np.any(arrived, axis=0))
        return replace(self, **parts)

    @property
    def halves_ns(self) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """The first half [from, to) of each bag, and the second."""
        ends = [(a, (a + b) // 2, b + 1) for a, b in self.bags_ns or (self.range_ns,)]
        return [(begin, middle) for begin, middle, _ in ends], [(middle, end) for _, middle, end in ends]

    @property
    def messages(self) -> Batch:
        """Odometry, turn rates, detections and ranges as inputs of the estimator."""
        return Batch.of(
            *self.range_ns,
            odometry=self.odometry,
            imu=self.turn_rates,
            detections=self.detections,
            ranges=self.ranges,
        )

    def track(self, robot: int) -> Trajectory:
        """A robot's raw odometry in the order of its stamps, each stamp once."""
        rows = select(self.odometry, self.odometry.robot == robot)
        return _each_stamp_once(rows.stamp_ns, rows.pose)


def read_recording(
    bag: Path,
    swarm: Swarm,
    progress: Progress = unwatched,
    remap: Mapping[str, str] = MappingProxyType({}),
    truth: Mapping[str, Trajectory] = MappingProxyType({}),
) -> Recording:
    """Read a bag once: a rosbag2 folder, .mcap or .db3 file.

    `remap` is as in `renamed_topics`; `truth` by robot name replaces the ground truth of the bag. Raises
    BagError if nothing in the bag can be read, or a topic cannot be mapped.
    """
    parts: list[Batch] = []
    summary = read_bag(bag, swarm, parts.append, progress, remap)
    tracks = {**summary.truth, **truth}
    known = {name: _each_stamp_once(track.stamp_ns, track.pose) for name, track in tracks.items()}
    return replace(recording_of(bag.name, parts, swarm), truth=known, remarks=summary.remarks)


def recording_of(name: str, parts: Sequence[Batch], swarm: Swarm) -> Recording:
    """The recording of inputs as they came."""
    converter = InputConverter(swarm, Settings())
    moved = [converter.convert(part) for part in parts]
    detections = [part["detections"] for part in parts if part["detections"].robot.size]
    return Recording(
        name,
        gathered(moved, "odometry"),
        concatenate(detections or [NO_DETECTIONS]),
        {},
        gathered(parts, "brightness"),
        gathered(parts, "fixes"),
        gathered(moved, "imu"),
        gathered(parts, "ranges"),
        converter.drops.total,
    )


def joined(recordings: Sequence[Recording]) -> Recording:
    """Recordings of one swarm, one after the other.

    Nobody knows how robots moved in the pauses between them.
    """
    whole, *others = recordings
    bags_ns = [whole.range_ns]
    for other in others:
        later_ns = whole.range_ns[1] + _PAUSE_NS - other.range_ns[0]
        bags_ns.append((other.range_ns[0] + later_ns, other.range_ns[1] + later_ns))
        parts = {}
        for name, rows in other.inputs.items():
            late = rows._replace(stamp_ns=rows.stamp_ns + later_ns, arrival_ns=rows.arrival_ns + later_ns)
            parts[name] = concatenate([getattr(whole, name), late])
        truth = dict(whole.truth)
        for name, one in other.truth.items():
            before = truth.get(name, Trajectory(one.stamp_ns[:0], one.pose[:0]))
            stamp_ns = np.concatenate([before.stamp_ns, one.stamp_ns + later_ns])
            truth[name] = Trajectory(stamp_ns, np.concatenate([before.pose, one.pose]))
        dropped = Counter(whole.dropped) + Counter(other.dropped)
        name, remarks = f"{whole.name}, {other.name}", whole.remarks + other.remarks
        whole = Recording(name=name, truth=truth, dropped=dropped, remarks=remarks, **parts)
    return replace(whole, bags_ns=tuple(bags_ns))


def started_at_truth(swarm: Swarm, recording: Recording) -> Swarm:
    """The swarm with the true pose of each robot at its first odometry as start; unknown without truth."""
    robots = [
        replace(robot, start=_start_of(recording, robot, recording.track(index)))
        for index, robot in enumerate(swarm.robots)
    ]
    return replace(swarm, robots=tuple(robots))


def _start_of(recording: Recording, robot: Robot, track: Trajectory) -> Pose2 | None:
    """The true pose at a robot's first odometry."""
    truth = recording.truth.get(robot.name)
    if truth is None or not track.stamp_ns.size:
        return None
    begin_ns = np.array([track.stamp_ns[0] + round(robot.odometry.delay_s * 1e9)])
    pose, known = interpolate(truth, begin_ns, DEFAULT_GAP_NS)
    x, y, theta = pose[0].tolist()
    return (x, y, theta) if known[0] else None


def _each_stamp_once(stamp_ns: IntArray, pose: FloatArray) -> Trajectory:
    """Poses sorted by their stamps, the first of each stamp."""
    stamp_ns, first = np.unique(stamp_ns, return_index=True)
    return Trajectory(stamp_ns, pose[first])


def rerun(
    recording: Recording, swarm: Swarm, tick_s: float, settings: Settings | None = None
) -> ReplayResult:
    """Run the estimator over a recording, with poses at every whole multiple of `tick_s`, as `replay`."""
    runner = Runner(Estimator(swarm, settings), PeriodicSchedule(round(tick_s * 1e9)))
    runner.take(recording.messages)
    runner.finish(recording.range_ns[1])
    return runner.result(recording.name, recording.range_ns, recording.truth, {})
