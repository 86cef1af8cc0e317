"""What was heard of a swarm for some seconds, from the live graph or from a bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from swarm_loc_estimator.common.arrays import FloatArray, IntArray
from swarm_loc_estimator.common.messages.cdr import RANGE, CdrError, decode
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.offline.recorded_bag import same_type
from swarm_loc_estimator.sensors import inputs as sensors
from swarm_loc_estimator.sensors.imu import TurnRateRows
from swarm_loc_estimator.sensors.inputs import Ingest, InputTopic
from swarm_loc_estimator.sensors.odometry import OdometryRows
from swarm_loc_estimator.sensors.ranges import decode_pair
from swarm_loc_estimator.sensors.sensor import DropCounts
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.timeline.estimate import Contradicted, Contradiction, Status
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Settings

SETTINGS = Settings()  # Of the estimator
_TICK_NS = 500_000_000
_AT_ZERO = 0.05  # Odometry begins at zero if x and y [m] and the heading [rad] are smaller
_LASTING_TICKS, _LASTING_SHARE = 4, 0.2  # Contradictions of fewer ticks, or smaller shares, are not named


Wanted = Callable[[str], bool]  # Whether messages of a type are kept


class Finding(NamedTuple):
    """Something that is wrong."""

    about: str  # A topic, robot, marker or node
    problem: str  # What is wrong with it, the rest of a sentence
    remedy: str  # What to do, a sentence without its full stop


class Publisher(NamedTuple):
    """A publisher in the live graph."""

    node: str  # Full name of its node
    is_reliable: bool = True  # Whether it sends lost messages again
    is_latched: bool = False  # Whether late subscribers get its last messages


class Message(NamedTuple):
    """A serialized message, and when it arrived [ns]."""

    arrival_ns: int
    data: bytes


@dataclass(frozen=True)
class Heard:
    """A topic that was found."""

    type: str  # Of its messages
    messages: Sequence[Message] = ()  # In order of arrival; of images only some
    publishers: tuple[Publisher, ...] = ()  # In the live graph; of a bag they are not known


class Estimated(NamedTuple):
    """What the estimator made of all readings."""

    status: IntArray  # (N,) of the robots at the end
    contradictions: list[Contradiction]  # Those that lasted, each as it was last
    begin_ns: IntArray  # (N,) when a robot was tracked first; -1: never
    begin_pose: FloatArray  # (N, 3) its pose then


@dataclass(frozen=True)
class Evidence:
    """All that the checks look at."""

    swarm: Swarm  # The description
    topics: Mapping[str, Heard]  # By name, without a leading slash
    is_live: bool = False  # Whether it comes from the live graph
    remarks: Sequence[str] = ()  # What could not be read, one sentence each
    is_cut: bool = False  # Whether there was more in the bag

    @cached_property
    def inputs(self) -> tuple[InputTopic, ...]:
        """Topics that the estimator reads: shared ones where there are messages on them."""
        shared = any(
            topic.kind.is_shared and topic.name in self.topics and self.topics[topic.name].messages
            for topic in sensors.live_topics(self.swarm, shared=True)
        )
        return sensors.live_topics(self.swarm, shared=shared)

    @property
    def end_ns(self) -> int:
        """Arrival of the last message of all."""
        return max((one.messages[-1].arrival_ns for one in self.topics.values() if one.messages), default=0)

    def usable(self, topic: InputTopic) -> Heard | None:
        """The topic where it was found with the right type."""
        heard = self.topics.get(topic.name)
        return heard if heard is not None and same_type(heard.type, topic.kind.message_type) else None

    @cached_property
    def read(self) -> tuple[list[sensors.Batch], list[sensors.InputStatistics], Ingest]:
        """The estimator's inputs, and statistics by topic of `inputs`."""
        ingest = Ingest(self.swarm, topics=self.inputs)
        found = [self.usable(topic) or Heard("") for topic in self.inputs]
        messages = [
            SerializedMessage(k, *one[::-1]) for k, heard in enumerate(found) for one in heard.messages
        ]
        messages.sort(key=lambda one: one.log_ns)
        parts = [*ingest.read(MessageBatch.of(messages))] if messages else []
        return parts, ingest.statistics, ingest

    def rows(self, sensor: str) -> Any:
        """All readings of a sensor, see `sensors/inputs.py`."""
        return self._gathered[sensor]

    @cached_property
    def _gathered(self) -> dict[str, Any]:
        return {name: sensors.gathered(self.read[0], name) for name in sensors.SENSORS}

    @cached_property
    def converted(self) -> tuple[list[sensors.Batch], DropCounts]:
        """The measurements of all readings, and numbers of readings that cannot be used."""
        converter = sensors.InputConverter(self.swarm, SETTINGS)
        return [converter.convert(part) for part in self.read[0]], converter.drops

    @cached_property
    def odometry(self) -> OdometryRows:
        """All valid odometry."""
        rows: OdometryRows = sensors.gathered(self.converted[0], "odometry")
        return rows

    @cached_property
    def turn_rates(self) -> TurnRateRows:
        """All valid turn rates of gyroscopes."""
        rows: TurnRateRows = sensors.gathered(self.converted[0], "imu")
        return rows

    @cached_property
    def estimated(self) -> Estimated:
        """What the estimator makes of all readings.

        A description is contradicted only if each half of the recording contradicts it, too: what repeats
        for a while, as the error of a camera from one place, looks like another place of a landmark.
        """
        parts, kind = self.converted[0], Contradicted.DESCRIPTION
        begin_ns, end_ns = (parts[0].begin_ns, parts[-1].end_ns) if parts else (0, 0)
        # without starts that robots had left before they were heard
        starts = [self.is_at_start(index) for index in range(len(self.swarm.robots))]
        whole = self._estimated(begin_ns, end_ns, starts)
        middle_ns, named = (begin_ns + end_ns) // 2, whole.contradictions
        for half in ((begin_ns, middle_ns, starts), (middle_ns, end_ns, [False] * len(starts))):
            if any(one.kind is kind for one in named):
                agreed = {one.about for one in self._estimated(*half).contradictions if one.kind is kind}
                named = [one for one in named if one.kind is not kind or one.about in agreed]
        return whole._replace(contradictions=named)

    def _estimated(self, from_ns: int, until_ns: int, starts: Sequence[bool]) -> Estimated:
        """What the estimator makes of what arrived between two instants, with some of the starts (N,)."""
        described = [
            robot if is_there else replace(robot, start=None)
            for robot, is_there in zip(self.swarm.robots, starts, strict=True)
        ]
        estimator, robots = Estimator(replace(self.swarm, robots=tuple(described)), SETTINGS), len(described)
        ticks, lasting = Counter[tuple[str, Contradicted]](), dict[tuple[str, Contradicted], Contradiction]()
        begin_ns, begin_pose = np.full(robots, -1), np.full((robots, 3), np.nan)
        status, count = np.full(robots, int(Status.WAITING)), 0
        for part in self.converted[0]:
            stamps_ns = np.arange(part.begin_ns + _TICK_NS, part.end_ns, _TICK_NS)
            ends_ns = [*stamps_ns.tolist(), part.end_ns]
            for now_ns, arrived in zip(ends_ns, part.until_each(stamps_ns), strict=True):
                if not from_ns < now_ns <= until_ns:
                    continue
                count += 1
                estimator.receive(arrived)
                estimate = estimator.tick(now_ns)
                status = estimate.status.astype(np.int64)
                new = (begin_ns < 0) & (status == Status.TRACKED) & estimate.heading_known
                begin_ns[new], begin_pose[new] = now_ns, estimate.poses[new]
                for one in estimator.contradictions(now_ns):
                    ticks[one.about, one.kind] += 1
                    lasting[one.about, one.kind] = one
        least = max(_LASTING_TICKS, _LASTING_SHARE * count)
        found = [one for key, one in lasting.items() if ticks[key] >= least]
        return Estimated(status, found, begin_ns, begin_pose)

    def is_at_start(self, index: int) -> bool:
        """Whether a robot was heard from its start on: its odometry began at zero."""
        first = self.odometry.pose[self.odometry.robot == index][:1]
        return bool((np.abs(first) < _AT_ZERO).all())

    def source_name(self, index: int) -> str:
        """Name of a robot or a fixed camera."""
        return self.swarm.sources[index].name


def decoded(heard: Heard, most: int | None = None) -> tuple[list[tuple[int, Any]], int]:
    """The first messages of a topic with their arrivals [ns], and how many are malformed."""
    messages, malformed = [], 0
    kind = heard.type if "/msg/" in heard.type else heard.type.replace("/", "/msg/")
    for arrival_ns, data in heard.messages[:most]:
        try:
            messages.append((arrival_ns, decode_pair(data) if kind == RANGE else decode(data, kind)))
        except CdrError:
            malformed += 1
    return messages, malformed
