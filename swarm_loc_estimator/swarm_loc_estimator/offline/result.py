"""Result of a run of the estimator: poses, covariances, errors against ground truth, counters.

Long arrays grow in a temporary file and are memory-mapped at the end.
"""

from __future__ import annotations

import mmap
import tempfile
import weakref
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from swarm_loc_estimator.common.arrays import BoolArray, FloatArray, IntArray
from swarm_loc_estimator.common.files import naming
from swarm_loc_estimator.common.health import listed
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.filter.measurements import LossReason
from swarm_loc_estimator.mapping.messages import GridMessage, decode_occupancy_grid
from swarm_loc_estimator.offline.metrics import Errors, ErrorSummary, compare, pool, summarise
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimate import LossReport, Status
from swarm_loc_estimator.timeline.sightings import Sightings

_MAX_LOST = 20  # Maximum number of robots whose losses are listed


class Spool:
    """Rows by key in one temporary file, which is deleted with the last array that maps it.

    The rows take no memory of the process, only pages of the file that the system may drop.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="replay_")  # noqa: SIM115 # for as long as this lives
        weakref.finalize(self, self._file.raw.close)  # what is not written is not needed
        self._place = Path(tempfile.gettempdir())
        self._end = 0
        self._blocks: dict[Hashable, list[tuple[int, int]]] = {}

    def append(self, key: Hashable, rows: npt.NDArray[Any]) -> None:
        """Append rows (k, ...) to those of the same key."""
        data = np.ascontiguousarray(rows).tobytes()
        blocks = self._blocks.setdefault(key, [])
        blocks.append((self._end, len(data)))
        with naming(self._place):
            self._file.write(data)
        self._end += len(data)

    def array(self, key: Hashable, dtype: npt.DTypeLike, *shape: int) -> npt.NDArray[Any]:
        """All rows of a key (k, *shape), read-only; the key is then empty."""
        blocks = self._blocks.pop(key, [])
        size = sum(length for _, length in blocks)
        begin = -(-self._end // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        if not size:
            return np.zeros((0, *shape), dtype=dtype)
        with naming(self._place):  # already this `seek` writes what is buffered
            self._file.seek(begin)
            self._end = begin
            for offset, length in blocks:
                self._file.seek(offset)
                data = self._file.read(length)
                self._file.seek(self._end)
                self._file.write(data)
                self._end += length
            self._file.flush()
        mapped = mmap.mmap(self._file.fileno(), size, access=mmap.ACCESS_READ, offset=begin)
        return np.frombuffer(mapped, dtype=dtype).reshape(-1, *shape)


class RecordedMap(NamedTuple):
    """A message of `map` and its log time."""

    log_ns: int
    data: bytes

    @property
    def grid(self) -> GridMessage:
        """The decoded message."""
        return decode_occupancy_grid(self.data)


class AerialImage(NamedTuple):
    """Detections of an aerial image."""

    stamp_ns: int  # Of the image
    position: FloatArray  # (n, 2) of its detections in map [m]
    robot: IntArray  # (n,) index of the most probable robot of each; -1: unknown
    probability: FloatArray  # (n,) of these identities


@dataclass(frozen=True)
class ReplayResult:
    """Estimated poses of all robots over time, with ground truth and statistics of the run."""

    title: str  #: Such as the name of the bag
    swarm: Swarm  #: Robots and landmarks
    stamp_ns: IntArray  #: (T,) times of the poses
    #: (T, N, 3) x [m], y [m], theta [rad] in map; NaN while a robot is not located
    poses: FloatArray
    covariances: FloatArray  #: (T, N, 3, 3) of x, y, theta
    status: npt.NDArray[np.uint8]  #: (T, N) of `Status`
    heading_known: BoolArray = field(kw_only=True)  #: (T, N) whether the heading is known, too
    #: Robot name -> ground truth; robots without are missing
    truth: Mapping[str, Trajectory] = field(default_factory=dict)
    #: Counts by name, such as dropped inputs by reason
    counters: Mapping[str, int] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  #: Sentences for the user, such as unreadable parts of the bag
    data_s: float = 0.0  #: Duration of the data [s]
    wall_s: float = 0.0  #: Duration of the replay [s]
    #: The swarm with the estimated calibration parameters; None if none were estimated
    self_calibrated: Swarm | None = None
    #: Time [ns] and sightings, every half second; empty: not kept
    sightings: tuple[tuple[int, Sightings], ...] = ()
    #: Aerial images with the identities of their detections; empty: none, or not kept
    images: tuple[AerialImage, ...] = ()
    maps: tuple[RecordedMap, ...] = ()  #: Recorded messages of `map`
    #: Robot name -> its recorded goals; robots without are missing
    goals: Mapping[str, Trajectory] = field(default_factory=dict)
    #: (T,) True while poses are relative to a robot instead of in map, and have no errors; empty: never
    is_local: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    #: The same with poses smoothed by the whole recording; None: not asked for
    smoothed: ReplayResult | None = None
    losses: tuple[LossReport, ...] = ()  #: Losses of robots, as known at the stamps; robot by robot

    @property
    def speed_factor(self) -> float:
        """Duration of the data divided by that of the replay."""
        return self.data_s / self.wall_s if self.wall_s > 0.0 else float("nan")

    @property
    def loss_remarks(self) -> list[str]:
        """One sentence for each robot that was lost, with causes and times since the first output."""
        begin_ns = int(self.stamp_ns[0]) if self.stamp_ns.size else 0
        found: dict[int, dict[str, list[str]]] = {}
        for one in (one for one in self.losses if one.why is not LossReason.FRAME):
            times = found.setdefault(one.robot, {}).setdefault(one.cause, [])
            times.append(f"{max(0, one.stamp_ns - begin_ns) * 1e-9:.1f} s")
        remarks = []
        for robot, times_of in list(found.items())[:_MAX_LOST]:
            count = sum(map(len, times_of.values()))
            causes = "; ".join(f"{cause} (at {listed(times)})" for cause, times in times_of.items())
            often = "once" if count == 1 else f"{count} times"
            remarks.append(f"{self.swarm.robots[robot].name} was lost {often}: {causes}.")
        more = len(found) - _MAX_LOST
        return [*remarks, f"{more} more robots were lost."] if more > 0 else remarks

    def select(self, rows: BoolArray) -> ReplayResult:
        """The result with only the poses at some of the stamps (T,)."""
        names = ["stamp_ns", "poses", "covariances", "status", "heading_known"]
        names += ["is_local"] * bool(self.is_local.size)
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def track(self, index: int) -> Trajectory:
        """The estimated poses of a robot (index) while it is located."""
        known = np.isfinite(self.poses[:, index]).all(axis=1)
        return Trajectory(self.stamp_ns[known], self.poses[known, index])

    @cached_property
    def errors(self) -> Mapping[str, Errors]:
        """Robot name -> estimate minus ground truth, for robots that have any.

        Only TRACKED poses mislead; an unknown heading has no error (NaN).
        """
        found = {}
        for index, robot in enumerate(self.swarm.robots):
            if robot.name in self.truth:
                known = np.isfinite(self.poses[:, index]).all(axis=1)
                if self.is_local.size:
                    known &= ~self.is_local
                track = Trajectory(self.stamp_ns[known], self.poses[known, index])
                errors = compare(track, self.covariances[known, index], self.truth[robot.name])
                states = self.status[:, index] == Status.TRACKED, self.heading_known[:, index]
                tracked, turned = (np.interp(errors.stamp_ns, self.stamp_ns, one) > 0.5 for one in states)
                errors.error[~turned, 2] = np.nan
                found[robot.name] = replace(errors, misleading=errors.misleading & tracked)
        return found

    @cached_property
    def summaries(self) -> Mapping[str, ErrorSummary]:
        """Robot name -> RMSE, median, NEES and others of its errors."""
        return {name: summarise(errors) for name, errors in self.errors.items()}

    @cached_property
    def overall(self) -> ErrorSummary:
        """RMSE, median, NEES and others of the errors of all robots; NaN without ground truth."""
        return summarise(pool([*self.errors.values()]))
