"""Decoding of the raw messages of all inputs to columns, for live nodes and for replay.

Malformed messages are counted and dropped.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.jit import cached_njit
from swarm_loc_estimator.common.messages.detections import swarm_key
from swarm_loc_estimator.common.messages.streams import MessageBatch
from swarm_loc_estimator.sensors.registry import Batch, InputTopic, input_topics, kinds
from swarm_loc_estimator.sensors.sensor import Guard, Known, in_order_of_arrival
from swarm_loc_estimator.swarm.error_models import MAX_OFFSET_S
from swarm_loc_estimator.swarm.swarm import Swarm

MAX_PAUSE_NS = 3_600_000_000_000
"""Maximum time between arrivals; beyond it the clock was set, as on a robot without a hardware clock."""

CLOCKS_APART_S = 0.2  # Difference between the clock of a robot and those of the others that is named [s]

_STATISTICS_DTYPE = np.dtype(
    [
        (name, np.float64 if name == "late_sum_ns" else np.int64)  # a sum of absurd delays exceeds int64
        for name in (
            "received",
            "malformed",
            "last_stamp_ns",
            "first_arrival_ns",
            "last_arrival_ns",
            "late_sum_ns",
            "late_min_ns",
            "late_max_ns",
            "late_count",
        )
    ]
)


class InputStatistics:
    """Message statistics of one topic.

    Args:
        row: (1,) of _STATISTICS_DTYPE, the counters.
    """

    def __init__(self, row: NDArray[np.void]) -> None:
        self._row = row

    @property
    def received(self) -> int:
        """Number of messages, malformed ones included."""
        return int(self._row["received"][0])

    @property
    def malformed(self) -> int:
        """Number of malformed messages."""
        return int(self._row["malformed"][0])

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the newest valid message; None before the first."""
        return int(self._row["last_stamp_ns"][0]) if self.received > self.malformed else None

    @property
    def last_arrival_ns(self) -> int | None:
        """Arrival of the newest valid message; None before the first."""
        return int(self._row["last_arrival_ns"][0]) if self.received > self.malformed else None

    @property
    def mean_period_ns(self) -> float | None:
        """Mean period of valid messages; None before the second."""
        row, count = self._row[0], self.received - self.malformed
        return float(row["last_arrival_ns"] - row["first_arrival_ns"]) / (count - 1) if count > 1 else None

    @property
    def late_count(self) -> int:
        """Number of valid messages since `restart`."""
        return int(self._row["late_count"][0])

    @property
    def late_sum_ns(self) -> int:
        """Sum of delays (arrival minus stamp) since `restart`."""
        return int(self._row["late_sum_ns"][0])

    @property
    def late_min_ns(self) -> int | None:
        """Minimum delay since `restart`; None without messages."""
        return int(self._row["late_min_ns"][0]) if self.late_count else None

    @property
    def late_max_ns(self) -> int | None:
        """Maximum delay since `restart`; None without messages."""
        return int(self._row["late_max_ns"][0]) if self.late_count else None

    def restart(self) -> None:
        """Start a new interval for the delays."""
        for name in ("late_sum_ns", "late_min_ns", "late_max_ns", "late_count"):
            self._row[name] = 0


class WrongClock(NamedTuple):
    """A robot's clock that is not that of the other robots."""

    apart_s: float  # Its time minus theirs [s], as its description corrects it
    offset_s: float  # `clock.offset_s` of its description that corrects it

    @property
    def problem(self) -> str:
        """What is wrong, the rest of a sentence."""
        which = "ahead of" if self.apart_s > 0.0 else "behind"
        return f"has a clock {abs(self.apart_s):.2g} s {which} those of the other robots"

    @property
    def remedy(self) -> str:
        """What to do, a sentence without its full stop."""
        synchronize = "Synchronize it with the others (chrony)"
        if abs(self.offset_s) > MAX_OFFSET_S:  # such as a clock that began in 1970
            return synchronize
        return f"{synchronize}, or set clock.offset_s to {round(self.offset_s, 3)}"


class Ingest:
    """Decodes the messages of a swarm's topics.

    Args:
        swarm: Swarm with the topics.
        map_frame: Name of the frame `map` in messages.
        topics: Input topics; None: all possible topics of the swarm.

    Attributes:
        topics: Input topics; the index is the topic's number in a batch.
        handle_of: Topic number by name.
        statistics: Statistics of each topic.
        map_frame: Name of the frame `map`.
    """

    def __init__(
        self, swarm: Swarm, map_frame: str = "map", topics: tuple[InputTopic, ...] | None = None
    ) -> None:
        self.topics = input_topics(swarm) if topics is None else topics
        self.map_frame = map_frame
        self.handle_of: Mapping[str, int] = {topic.name: handle for handle, topic in enumerate(self.topics)}
        self._robot = np.array([topic.robot for topic in self.topics], dtype=np.int64)
        self._kinds = [*kinds().values()]
        place = {kind.name: number for number, kind in enumerate(self._kinds)}
        self._kind = np.array([place[topic.kind.name] for topic in self.topics], dtype=np.int64)
        offsets_s = [robot.clock.offset_s for robot in swarm.robots] + [0.0] * (len(swarm.cameras) + 1)
        self._clock_offset_ns = np.round(1e9 * np.array(offsets_s)).astype(np.int64)  # the last: the swarm
        self._corrects_clocks = bool(self._clock_offset_ns.any())
        self._known = Known(map_frame, len(swarm.robots), swarm_key(robot.name for robot in swarm.robots))
        self._readers = [kind.create_reader(len(self.topics), self._known) for kind in self._kinds]
        self._counted = np.zeros(len(self.topics), dtype=_STATISTICS_DTYPE)
        self.statistics = [InputStatistics(self._counted[k : k + 1]) for k in range(len(self.topics))]

    def read(self, batch: MessageBatch) -> Iterator[Batch]:
        """Decode messages in order of arrival, with topic numbers as in `topics`.

        Yields:
            One part per interval in which time neither jumps back nor ahead.
        """
        passed_ns = np.diff(batch.log_ns)
        jumps = np.flatnonzero((passed_ns < 0) | (passed_ns > MAX_PAUSE_NS)) + 1
        for begin, end in itertools.pairwise([0, *jumps.tolist(), batch.size]):
            if begin < end:
                yield self._read_forwards(batch.chosen(slice(begin, end)))

    def received(self) -> dict[str, int]:
        """Number of messages by kind of topic, such as `<robot>/odom`; kinds without any are omitted."""
        received = np.bincount(self._kind, weights=self._counted["received"], minlength=len(self._kinds))
        counts = {kind.pattern: int(received[number]) for number, kind in enumerate(self._kinds)}
        return {topic: count for topic, count in counts.items() if count}

    def frame_id(self, handle: int) -> str:
        """Frame of the newest message on a topic, "" before the first."""
        frame_ids: list[str] = self._readers[self._kind[handle]].frame_ids
        return frame_ids[handle]

    def clocks_apart(self) -> dict[int, WrongClock]:
        """Clocks of robots, by index, that are not those of the other robots.

        They are compared by the least delays of odometry. Which of two robots is wrong cannot be seen, so
        there must be three. Shared topics are not compared, since their messages have one stamp.
        """
        delay_ns = {
            topic.robot: statistics.late_min_ns
            for topic, statistics in zip(self.topics, self.statistics, strict=True)
            if topic.kind.rows == "odometry" and topic.kind.of_each and statistics.late_min_ns is not None
        }
        if len(delay_ns) < 3:
            return {}
        usual_ns = float(np.median([*delay_ns.values()]))
        apart_s = {robot: 1e-9 * (usual_ns - one_ns) for robot, one_ns in delay_ns.items()}
        return {
            robot: WrongClock(one_s, one_s + 1e-9 * float(self._clock_offset_ns[robot]))
            for robot, one_s in apart_s.items()
            if abs(one_s) > CLOCKS_APART_S
        }

    def _read_forwards(self, batch: MessageBatch) -> Batch:
        of_message = self._kind[batch.topic]
        present = np.bincount(of_message, minlength=len(self._kinds))
        rows: dict[str, Any] = {}
        dropped: Counter[str] = Counter()
        for number, (kind, reader) in enumerate(zip(self._kinds, self._readers, strict=True)):
            if not present[number]:
                continue
            part = batch if present[number] == batch.size else batch.chosen(of_message == number)
            with Guard(kind.name, part.size, dropped):
                found = reader.read(part)
                robot, corrects = self._robot[part.topic], self._corrects_clocks and not kind.in_map
                stamp_ns = found.stamp_ns - self._clock_offset_ns[robot] if corrects else found.stamp_ns
                _count(self._counted, part.topic, part.log_ns, stamp_ns, found.valid)
                read, unused = kind.columns_of(found, part, robot, self._known)
                if corrects:
                    read = read._replace(stamp_ns=read.stamp_ns - self._clock_offset_ns[read.robot])
                # a sensor may have both topics of single robots and shared ones
                before = rows.get(kind.rows)
                rows[kind.rows] = read if before is None else in_order_of_arrival([before, read])
                dropped.update(unused)
                dropped["bad_message"] += int(np.sum(~found.valid))
        return Batch(int(batch.log_ns[0]), int(batch.log_ns[-1]), rows, +dropped)


@cached_njit
def _count(
    counted: NDArray[np.void],
    topic: IntArray,
    arrival_ns: IntArray,
    stamp_ns: IntArray,
    valid: NDArray[np.bool_],
) -> None:
    """Add messages (n,) to the statistics (t,) of their topics."""
    for k in range(topic.size):
        one = counted[topic[k]]
        one.received += 1
        if not valid[k]:
            one.malformed += 1
            continue
        if one.received - one.malformed == 1:
            one.first_arrival_ns = arrival_ns[k]
        late_ns = arrival_ns[k] - stamp_ns[k]
        one.last_stamp_ns, one.last_arrival_ns = stamp_ns[k], arrival_ns[k]
        one.late_min_ns = min(one.late_min_ns, late_ns) if one.late_count else late_ns
        one.late_max_ns = max(one.late_max_ns, late_ns) if one.late_count else late_ns
        one.late_sum_ns += late_ns
        one.late_count += 1
