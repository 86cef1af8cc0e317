"""Replay a bag: the estimator receives inputs at their recorded arrival times, and poses follow a schedule.

Replay, calibration and benchmarks run the estimator like the live node, with the recorded delays. The same
inputs give the same poses, byte for byte.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.bags.bag_file import BagError
from swarm_loc_estimator.common.command_line import swarm_beside
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.identification.memory import Identities
from swarm_loc_estimator.offline.recorded_bag import (
    NOTHING_LOST,
    Loss,
    Progress,
    mounts_of_bag,
    read_bag,
    unwatched,
)
from swarm_loc_estimator.offline.result import AerialImage, ReplayResult, Spool
from swarm_loc_estimator.sensors.aerial import AerialRows
from swarm_loc_estimator.sensors.inputs import MAX_PAUSE_NS, Batch
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import load_swarm
from swarm_loc_estimator.timeline.estimate import Contradicted, LossReport
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.self_calibration import swapped_signs
from swarm_loc_estimator.timeline.settings import Settings
from swarm_loc_estimator.timeline.sightings import Sightings, newest_sightings

TICK_S = 0.1  # Default time between two outputs [s]
TICKS_S = (1e-3, 3600.0)  # Range of it [s]


_NOTE_PERIOD_NS, _MAX_NOTES = 1_000_000_000, 20


def replay(
    bag: Path | str,
    swarm: Swarm | None = None,
    settings: Settings | None = None,
    *,
    tick_s: float = TICK_S,
    stamp_ns: IntArray | None = None,
    remap: Mapping[str, str] = MappingProxyType({}),
    loss: Loss = NOTHING_LOST,
    truth: Mapping[str, Trajectory] = MappingProxyType({}),
    keep_sightings: bool = False,
    progress: Progress = unwatched,
) -> ReplayResult:
    """Estimate all poses from a bag, and compare them with the bag's ground truth, if any.

    Args:
        bag: rosbag2 folder, .mcap or .db3 file.
        swarm: Robots and landmarks; None: those of the `swarm.yaml` in its folder.
        settings: Of the estimator.
        tick_s: Time between two outputs [s].
        stamp_ns: (T,) increasing; outputs at these instants instead, such as those of a live run.
        remap: Expected topic -> topic of the bag to read instead; `<robot>` in both stands for each robot.
        loss: Messages that are dropped at random before the estimator; ground truth is complete.
        truth: Robot name -> ground truth that replaces that of the bag, such as from `read_truth`.
        keep_sightings: Whether sightings and aerial images are kept for display, too.
        progress: Called now and then with the share done and what is being done.

    Raises:
        BagError: Nothing in the bag can be read, or no message of it can be used.
        ScheduleError: `tick_s` is out of range, or `stamp_ns` are not increasing whole numbers.
        SwarmFileError: The swarm description cannot be used.
    """
    bag = Path(bag)
    swarm = load_swarm(swarm_beside(bag)) if swarm is None else swarm
    given: object = tick_s
    low, high = TICKS_S
    if not isinstance(given, int | float) or not low <= given <= high:
        raise ScheduleError(f"tick_s = {tick_s!r} must be a number in [{low:g}, {high:g}] s.")
    schedule: ListedSchedule = PeriodicSchedule(round(tick_s * 1e9))
    if stamp_ns is not None:
        stamps = np.asarray(stamp_ns)
        if stamps.ndim != 1 or stamps.dtype.kind not in "iu" or np.any(stamps[1:] <= stamps[:-1]):
            raise ScheduleError("stamp_ns must be increasing whole numbers (T,) [ns].")
        schedule = ListedSchedule(stamps.astype(np.int64))
    estimator = Estimator(swarm, settings)
    mounts = mounts_of_bag(bag, swarm, remap)
    if mounts.remarks():
        estimator.describe(mounts.described())
    runner = Runner(estimator, schedule, keep_sightings=keep_sightings)
    summary = read_bag(bag, estimator.swarm, runner.take, progress, remap, loss)
    if summary.unusable:
        raise BagError(
            "\n".join([f"'{bag}' holds no message that the estimator can use.", *summary.unusable])
        )
    runner.finish(summary.range_ns[1])
    remarks = [*mounts.remarks(), *summary.remarks]
    if schedule.jumps:
        jumps = f"The log time jumps ahead by more than an hour, {schedule.jumps} x"
        remarks.append(f"{jumps}; no poses are given meanwhile.")
    remarks += runner.notes(summary.range_ns)
    result = runner.result(bag.name, summary.range_ns, {**summary.truth, **truth}, summary.received)
    compared, said = _compared(result.truth, result.stamp_ns)
    remarks += said
    if estimator.origin:
        remarks.append(
            f"No start, landmark or fix: poses are relative to {estimator.origin}, without errors."
        )
    elif result.is_local.any():
        remarks.append("Poses before the first landmark or fix are relative to a robot, without errors.")
    if result.self_calibrated:
        remarks += swapped_signs(result.self_calibrated)
    remarks += result.loss_remarks
    found = replace(result, truth=compared, remarks=tuple(remarks))
    return replace(found, maps=summary.maps, goals=summary.goals)


def _compared(truth: Mapping[str, Trajectory], stamp_ns: IntArray) -> tuple[dict[str, Trajectory], list[str]]:
    """The ground truth that overlaps poses (T,) in time, and sentences about all that is not used."""
    said = [
        f"Ground truth of {name}: {track.left_out} poses that are not finite are left out."
        for name, track in truth.items()
        if track.left_out
    ]
    early, late = (stamp_ns[0], stamp_ns[-1]) if stamp_ns.size else (0, 0)
    apart = [name for name, one in truth.items() if one.stamp_ns[-1] < early or one.stamp_ns[0] > late]
    if apart and stamp_ns.size:
        off_s = 1e-9 * int(truth[apart[0]].stamp_ns[0] - early)
        where = f"begins {abs(off_s):.1f} s {'after' if off_s > 0.0 else 'before'} the first pose"
        said.append(f"Ground truth of {listed(apart)} is of another time, {where}, and is not used.")
    return {name: track for name, track in truth.items() if name not in apart}, said


class ScheduleError(UserError):
    """Outputs that cannot be scheduled."""


MAX_DETECTIONS = 200_000
"""Maximum number of aerial detections stored for display; later ones of a long run are not stored."""
_TICKS_AT_ONCE = 256
_COLUMNS = ("stamp_ns", "pose", "covariance", "status", "heading_known", "is_local")
_SIGHTINGS_PERIOD_NS = 500_000_000
_MAX_SIGHTINGS = 500_000  # Sightings stored for display; later ones of a long run are not stored

_MAX_LOSSES = 100_000  # Losses of robots that are stored; later ones of a long run are not


class ListedSchedule:
    """Outputs at given times (T,) [ns], increasing."""

    def __init__(self, stamp_ns: IntArray) -> None:
        self.jumps = 0  # Number of forward jumps of the clock by more than `MAX_PAUSE_NS`
        self._stamp_ns = stamp_ns
        self._done = 0

    def begin(self, now_ns: int) -> None:
        """Start at the first input after a long pause."""

    def due(self, now_ns: int) -> list[int]:
        """Output times until now that were not due before."""
        first, self._done = self._done, int(self._stamp_ns.searchsorted(now_ns, side="right"))
        stamps_ns: list[int] = self._stamp_ns[first : self._done].tolist()
        return stamps_ns

    def rest(self, last_ns: int) -> list[int]:
        """Output times after the last inputs of a recording that ends at `last_ns`: all that remain."""
        return self.due(max(last_ns, int(self._stamp_ns.max(initial=0))))


class PeriodicSchedule(ListedSchedule):
    """Outputs at every whole multiple of a period, except while the clock jumps ahead."""

    def __init__(self, period_ns: int) -> None:
        super().__init__(np.zeros(0, dtype=np.int64))
        self._period_ns = period_ns
        self._next_ns: int | None = None

    def begin(self, now_ns: int) -> None:
        """Start at the first input after a long pause, in which no output is due."""
        jumps = self._next_ns is not None and now_ns - self._next_ns > MAX_PAUSE_NS
        if self._next_ns is None or jumps:
            self._next_ns = (now_ns // self._period_ns + 1) * self._period_ns
            self.jumps += jumps

    def due(self, now_ns: int) -> list[int]:
        """Output times until now that were not due before."""
        if self._next_ns is None:
            return []
        stamps_ns = list(range(self._next_ns, now_ns + 1, self._period_ns))
        self._next_ns += len(stamps_ns) * self._period_ns
        return stamps_ns

    def rest(self, last_ns: int) -> list[int]:
        """Output times until one after the end; none without inputs."""
        if self._next_ns is not None:
            self.begin(last_ns)
        return self.due(last_ns + self._period_ns)


class Runner:
    """Feeds an estimator, ticks it, and keeps its estimates in a temporary file: memory does not grow."""

    def __init__(
        self, estimator: Estimator, schedule: ListedSchedule, *, keep_sightings: bool = False
    ) -> None:
        self._estimator = estimator
        self._schedule = schedule
        self._began_s = time.perf_counter()
        self._spool = Spool()
        self._ticks: list[tuple[Any, ...]] = []  # Rows of `_COLUMNS` that are not spooled yet
        self._sightings_left = _MAX_SIGHTINGS if keep_sightings else 0
        self._sightings: list[tuple[int, Sightings]] = []
        self._images = AerialImages() if keep_sightings else None
        self._losses: dict[int, list[LossReport]] = {}
        self._losses_left = _MAX_LOSSES
        self._notes: dict[tuple[str, Contradicted], tuple[int, str]] = {}
        self._noted_ns = 0

    def take(self, inputs: Batch) -> None:
        """Feed inputs, and run all ticks that are due until the last of them."""
        self._schedule.begin(inputs.begin_ns)
        if self._images is not None:
            self._images.add(inputs["aerial"])
        stamps_ns = self._schedule.due(inputs.end_ns)
        parts = self._estimator.convert(inputs).until_each(np.array(stamps_ns, dtype=np.int64))
        for now_ns in stamps_ns:
            self._estimator.receive_in_parts(next(parts))
            self._tick(now_ns)
        self._estimator.receive_in_parts(next(parts))

    def finish(self, last_ns: int) -> None:
        """Run the ticks after the last inputs of a recording that ends at `last_ns`."""
        for now_ns in self._schedule.rest(last_ns):
            self._tick(now_ns)

    def result(
        self,
        title: str,
        range_ns: tuple[int, int],
        truth: Mapping[str, Trajectory],
        received: Mapping[str, int],
    ) -> ReplayResult:
        """The poses of all ticks with ground truth, between first and last arrival; may be called once."""
        self._flush()
        estimator, robots = self._estimator, len(self._estimator.swarm.robots)
        return ReplayResult(
            title=title,
            swarm=estimator.swarm,
            stamp_ns=self._spool.array("stamp_ns", np.int64),
            is_local=self._spool.array("is_local", np.bool_),
            poses=self._spool.array("pose", np.float64, robots, 3),
            covariances=self._spool.array("covariance", np.float64, robots, 3, 3),
            status=self._spool.array("status", np.uint8, robots),
            heading_known=self._spool.array("heading_known", np.bool_, robots),
            sightings=tuple(self._sightings),
            losses=tuple(one for _, losses in sorted(self._losses.items()) for one in losses),
            images=self._images.images() if self._images is not None else (),
            self_calibrated=estimator.learned() if estimator.is_self_calibrated else None,
            truth=truth,
            counters={
                **{f"messages on {topic}": count for topic, count in received.items()},
                **estimator.counters,
                **estimator.drops,
            },
            data_s=(range_ns[1] - range_ns[0]) * 1e-9,
            wall_s=time.perf_counter() - self._began_s,
        )

    def notes(self, range_ns: tuple[int, int]) -> list[str]:
        """A remark on each source that was named in a recording, with the time after its first message."""
        self._note(range_ns[1])
        begin_ns, notes = range_ns[0], [*self._notes.values()]
        said = [f"Note: {text} (at {max(0, at - begin_ns) * 1e-9:.1f} s)." for at, text in notes[:_MAX_NOTES]]
        return said + [f"... and {len(notes) - _MAX_NOTES} more."] * (len(notes) > _MAX_NOTES)

    def _note(self, now_ns: int) -> None:
        """Keep the sentences about sources that are named now; a contradicted pose is a symptom."""
        self._noted_ns = now_ns
        for one in self._estimator.contradictions(now_ns):
            if one.kind != Contradicted.POSE:
                key = one.about, one.kind
                self._notes[key] = self._notes.get(key, (now_ns, ""))[0], one.text

    def _tick(self, now_ns: int) -> None:
        estimate = self._estimator.tick(now_ns)
        if now_ns - self._noted_ns >= _NOTE_PERIOD_NS:
            self._note(now_ns)
        states = estimate.status, estimate.heading_known, bool(self._estimator.origin)
        self._ticks.append((now_ns, estimate.poses, estimate.covariances, *states))
        self._note_losses()
        if self._images is not None:
            self._images.note(self._estimator.identities)
        if self._sightings_left > 0 and now_ns % _SIGHTINGS_PERIOD_NS == 0:
            seen = newest_sightings(self._estimator.recent(), now_ns)
            self._sightings.append((now_ns, seen))
            self._sightings_left -= len(seen.observer)
        if len(self._ticks) == _TICKS_AT_ONCE:
            self._flush()

    def _note_losses(self) -> None:
        """Store the newest losses; one that late data move back replaces those after it."""
        for one in self._estimator.losses:
            mine = self._losses.setdefault(one.robot, [])
            while mine and mine[-1].stamp_ns > one.stamp_ns:
                mine.pop()
            if self._losses_left and (not mine or mine[-1].stamp_ns < one.stamp_ns):
                mine.append(one)
                self._losses_left -= 1

    def _flush(self) -> None:
        for name, column in zip(_COLUMNS, zip(*self._ticks, strict=True), strict=False):
            self._spool.append(name, np.array(column))
        self._ticks.clear()


class AerialImages:
    """Collects aerial images and the identities of their detections."""

    def __init__(self) -> None:
        self._positions: dict[int, FloatArray] = {}
        self._identities: dict[int, Identities] = {}
        self._left = MAX_DETECTIONS

    def add(self, rows: AerialRows) -> None:
        """Add the detections of images."""
        for stamp_ns in np.unique(rows.stamp_ns).tolist():
            if self._left <= 0:
                return
            here = rows.stamp_ns == stamp_ns
            position = np.full((int(rows.number[here].max()) + 1, 2), np.nan)
            position[rows.number[here]] = rows.pose[here, :2]
            self._positions[stamp_ns] = position
            self._left -= len(position)

    def note(self, identities: Identities | None) -> None:
        """Set the identities in an image; late data may change them."""
        if identities is not None and identities.stamp_ns in self._positions:
            self._identities[identities.stamp_ns] = identities

    def images(self) -> tuple[AerialImage, ...]:
        """All images in the order of their stamps."""
        images = []
        for stamp_ns, position in sorted(self._positions.items()):
            robot, probability = np.full(len(position), -1), np.zeros(len(position))
            if (identities := self._identities.get(stamp_ns)) is not None:
                found = np.flatnonzero((identities.place >= 0) & (identities.place < len(position)))
                robot[identities.place[found]] = found
                probability[identities.place[found]] = identities.probability[found]
            images.append(AerialImage(stamp_ns, position, robot, probability))
        return tuple(images)
