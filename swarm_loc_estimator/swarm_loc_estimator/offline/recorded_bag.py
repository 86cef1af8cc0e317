"""Read a bag of a swarm once: inputs in order of arrival, ground truth, maps and goals.

Ground truth is used only by evaluation and calibration.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np

from swarm_loc_estimator.common.arrays import IntArray
from swarm_loc_estimator.common.bags.reader import BagError, BagReader, BagTopic
from swarm_loc_estimator.common.health import Health, listed
from swarm_loc_estimator.common.messages.cdr import (
    ODOMETRY,
    POSE_STAMPED,
    POSE_WITH_COVARIANCE,
    TRANSFORM_STAMPED,
    TRANSFORMS,
    CdrError,
    decode,
    nanoseconds,
)
from swarm_loc_estimator.common.messages.poses import (
    PoseMessage,
    decode_fix,
    decode_odometry,
    decode_pose_stamped,
    yaw_of,
)
from swarm_loc_estimator.common.messages.streams import MessageBatch, PoseReader, SerializedMessage, merged
from swarm_loc_estimator.common.parameters import UserError, number, number_specs
from swarm_loc_estimator.common.trajectory import Trajectory
from swarm_loc_estimator.mapping.messages import decode_occupancy_grid
from swarm_loc_estimator.offline.result import RecordedMap, Spool
from swarm_loc_estimator.sensors.inputs import TRUTH, Batch, Ingest, kinds
from swarm_loc_estimator.sensors.localizers import SOURCES, LocalizedRobots
from swarm_loc_estimator.sensors.map_topic import MapSensor
from swarm_loc_estimator.sensors.mounts import TF_STATIC, Mounts
from swarm_loc_estimator.swarm.swarm import Swarm


def _decode_transform(data: bytes) -> PoseMessage:
    message = decode(data, TRANSFORM_STAMPED)
    place, turn = message.transform.translation, message.transform.rotation
    pose = place.x, place.y, yaw_of(turn.x, turn.y, turn.z, turn.w)
    return PoseMessage(nanoseconds(message.header.stamp), message.header.frame_id, pose)


_READ: Mapping[str, tuple[Callable[[bytes], PoseMessage], int]] = {
    POSE_STAMPED: (decode_pose_stamped, 1),
    POSE_WITH_COVARIANCE: (decode_fix, 1),
    ODOMETRY: (decode_odometry, 2),
    TRANSFORM_STAMPED: (_decode_transform, 2),
}
"""Type of a message -> its reader, and the number of frame names before its pose."""


def truth_topics(swarm: Swarm) -> list[str]:
    """The topic of the ground truth of each robot."""
    return [swarm.topic(robot.name, TRUTH) for robot in swarm.robots]


class BagLocalizer:
    """Turns messages of the localizer of a swarm into fixes or ground truth, as `localizer_bridge` does live.

    The swarm describes the localizer, or none; `recorded` are the topics of the bag.
    """

    def __init__(self, swarm: Swarm, recorded: Iterable[BagTopic]) -> None:
        self.topics: list[str] = []  # Topics of the localizer that are recorded
        self.outputs: dict[str, BagTopic] = {}  # Topics of the robots that it locates
        self._missing: list[str] = []
        self._health = Health(lambda _: None)
        if (localizer := swarm.localizer) is None:
            return
        self._robots = LocalizedRobots(localizer, [*swarm.index_of], self._health)
        self._type = SOURCES[localizer.source].message_type
        self._body_of = {topic.lstrip("/"): body for topic, body in self._robots.topics.items()}
        types = {topic.name: topic.type for topic in recorded}
        self.topics = [name for name in self._body_of if same_type(types.get(name, ""), self._type)]
        self._missing = [name for name in self._body_of if name not in self.topics]
        kind = POSE_WITH_COVARIANCE if localizer.output == "fix" else POSE_STAMPED
        names = {robot: swarm.topic(robot, localizer.output) for robot in self._robots.robot_of.values()}
        self.outputs = {robot: BagTopic(name, kind) for robot, name in names.items()}

    def read(self, topic: str, log_ns: int, data: bytes) -> Iterator[tuple[BagTopic, bytes]]:
        """The messages in place of one of the localizer."""
        try:
            message = decode(data, self._type)
        except CdrError:
            self._health.drop("malformed")
            return
        for robot, serialized in self._robots.serialized(message, self._body_of[topic], log_ns):
            yield self.outputs[robot], serialized

    def converted(self, batch: MessageBatch, names: Sequence[str]) -> MessageBatch:
        """Messages of topics by their numbers in `names`, with those in place of the localizer's."""
        number_of = {name: number for number, name in enumerate(names)}
        of_localizer = np.isin(batch.topic, [number_of[name] for name in self.topics])
        if not of_localizer.any():
            return batch
        made = [
            SerializedMessage(number_of[topic.name], serialized, log_ns)
            for number, log_ns, data in batch.chosen(of_localizer).messages()
            for topic, serialized in self.read(names[number], log_ns, data)
        ]
        return merged([batch.chosen(~of_localizer), *([MessageBatch.of(made)] if made else [])])

    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user."""
        drops = [f"{count} {reason}" for reason, count in sorted(self._health.drops.items())]
        said = (f"Dropped messages of the localizer: {', '.join(drops)}.",) if drops else ()
        return said + tuple(
            f"The bag holds no {self._type} of the localizer on {one}." for one in self._missing
        )


class TruthReader:
    """Collects `<robot>/ground_truth`: PoseStamped, PoseWithCovarianceStamped, Odometry or TransformStamped.

    The recorded topics declare the types.
    """

    def __init__(self, swarm: Swarm, recorded: Iterable[BagTopic]) -> None:
        self.topics = truth_topics(swarm)  # The index of a topic is its number in a batch
        self._names = [robot.name for robot in swarm.robots]
        declared = {topic.name: topic.type for topic in recorded}
        self._types = [declared.get(topic, "") for topic in self.topics]
        count = len(self.topics)
        self._readers = {name: PoseReader(count, *_READ[name]) for name in {*self._types} & {*_READ}}
        self._spool = Spool()
        self._malformed: Counter[int] = Counter()

    def add(self, batch: MessageBatch) -> None:
        """Add messages."""
        for message_type, reader in self._readers.items():
            typed = np.array([name == message_type for name in self._types])
            part = batch.chosen(typed[batch.topic])
            if part.size:
                self._add(part, reader)

    def tracks(self) -> dict[str, Trajectory]:
        """Robot name -> ground truth, for robots that have any; may be called once."""
        return {name: track for index, name in enumerate(self._names) if (track := self._track(index))}

    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user."""
        return (
            *(
                f"{topic} has the type {found}, which is no ground truth; allowed are {', '.join(_READ)}."
                for topic, found in zip(self.topics, self._types, strict=True)
                if found and found not in _READ
            ),
            *(
                f"{count} messages on {self.topics[index]} are malformed: no {self._types[index]} of ROS 2."
                for index, count in sorted(self._malformed.items())
            ),
        )

    def _add(self, batch: MessageBatch, reader: PoseReader) -> None:
        columns = reader.read(batch)
        self._malformed.update(batch.topic[~columns.valid].tolist())
        usable = np.flatnonzero(columns.valid & np.isfinite(columns.pose).all(axis=1))
        robot = batch.topic[usable]
        order = usable[np.lexsort([columns.stamp_ns[usable], robot])]
        ends = np.searchsorted(batch.topic[order], np.arange(len(self.topics) + 1))
        for index in np.flatnonzero(np.diff(ends)).tolist():
            rows = order[ends[index] : ends[index + 1]]
            self._spool.append((index, "stamp_ns"), columns.stamp_ns[rows])
            self._spool.append((index, "pose"), columns.pose[rows])

    def _track(self, index: int) -> Trajectory | None:
        stamp_ns: IntArray = self._spool.array((index, "stamp_ns"), np.int64)
        pose = self._spool.array((index, "pose"), np.float64, 3)
        if np.any(stamp_ns[1:] < stamp_ns[:-1]):
            order = np.argsort(stamp_ns, kind="stable")
            stamp_ns, pose = stamp_ns[order], pose[order]
        return Trajectory(stamp_ns, pose) if stamp_ns.size else None


Progress = Callable[[float, str], None]  # Called with the share done, 0 to 1, and the present step


def unwatched(_share: float, _what: str) -> None:
    """Ignore the progress."""


class LossError(UserError):
    """A loss that cannot be used."""


@dataclass(frozen=True)
class Loss:
    """Messages that are dropped at random before the estimator, as on a bad network.

    Whether a message is lost depends on the seed, its topic and its place among the messages of this topic;
    with a greater share the same messages are lost, and more.

    Raises:
        LossError: A number is out of range.
    """

    share: float = number(0.0, "1", 0.0, 0.99, "share of the messages that are lost")
    seed: int = number(0, "1", 0, 2**32 - 1, "chooses which ones")

    def __post_init__(self) -> None:
        for name, spec in number_specs(type(self)).items():
            if not spec.allows(value := getattr(self, name)):
                raise LossError(f"{name} = {value} of a loss must lie in {spec.range_text}.")


NOTHING_LOST = Loss()


class Network:
    """Passes on the messages that are not lost; the index of a topic is its number in a batch."""

    def __init__(self, loss: Loss, topics: Sequence[str]) -> None:
        self.lost = 0  # Number of messages that were lost
        self._share = loss.share
        self._draws = [np.random.default_rng([loss.seed, zlib.crc32(name.encode())]) for name in topics]

    def passed(self, batch: MessageBatch) -> MessageBatch:
        """The messages of a batch, in order of arrival, that are not lost."""
        if not self._share:
            return batch
        keeps = np.ones(batch.size, dtype=np.bool_)
        for topic in np.unique(batch.topic).tolist():
            rows = np.flatnonzero(batch.topic == topic)
            keeps[rows] = self._draws[topic].random(rows.size) >= self._share
        self.lost += int(np.sum(~keeps))
        return batch.chosen(keeps)


@dataclass(frozen=True)
class BagSummary:
    """Contents of a bag other than the inputs of the estimator."""

    range_ns: tuple[int, int]  # First and last log time
    truth: Mapping[str, Trajectory]  # Robot name -> ground truth; robots without are missing
    received: Mapping[str, int]  # Messages for the estimator by kind of topic
    remarks: tuple[str, ...]  # Unreadable or unused contents, one sentence each
    # Why no message can be used, one sentence each; empty if some can or none is expected
    unusable: tuple[str, ...]
    maps: tuple[RecordedMap, ...] = ()  # Messages of `map`, thinned out to `MAX_MAP_BYTES`
    goals: Mapping[str, Trajectory] = field(default_factory=dict)  # Robot name -> its goals by their stamps


def read_bag(
    bag: Path,
    swarm: Swarm,
    take: Callable[[Batch], None],
    progress: Progress,
    remap: Mapping[str, str] = MappingProxyType({}),
    loss: Loss = NOTHING_LOST,
) -> BagSummary:
    """Read a bag once: a rosbag2 folder, .mcap or .db3 file.

    `take` is called with the inputs, in order of arrival, less those that `loss` drops; ground truth, maps
    and goals are complete. `remap` is as in `renamed_topics`. Raises BagError if nothing in the bag can be
    read, or a topic cannot be mapped.
    """
    ingest, maps = Ingest(swarm), MapReader(swarm)
    network = Network(loss, [*ingest.handle_of])
    known = [*ingest.handle_of, *truth_topics(swarm), *maps.topics]
    with BagReader(bag, renamed_topics(remap, swarm, known)) as reader:
        localizer = BagLocalizer(swarm, reader.topics)
        if both := [name for name in localizer.topics if name in known]:
            raise BagError(f"localizer.topic: {both[0]} is already a topic of another input.")
        truth = TruthReader(swarm, [*reader.topics, *localizer.outputs.values()])
        first_truth = len(ingest.topics)
        first_map = first_truth + len(truth.topics)
        range_ns = reader.time_range_ns
        foreign = _foreign(reader.topics, ingest)
        names = ["" if name in foreign else name for name in known] + localizer.topics
        if (map_here := ingest.handle_of.get(MapSensor.topic)) is not None:
            names[first_map] = ""  # it is read once, for the estimator and for display
        for recorded in reader.batches(names):
            batch = localizer.converted(recorded, [*known, *localizer.topics])
            for inputs in ingest.read(network.passed(batch.chosen(batch.topic < first_truth))):
                take(inputs)
            truth.add(_from(batch.chosen(batch.topic < first_map), first_truth))
            if map_here is not None:
                batch.topic[batch.topic == map_here] = first_map
            maps.add(_from(batch, first_map))
            progress(reader.progress, "reading")
        unusable = _unusable(reader.topics, ingest, swarm)
        found = (*foreign.values(), *_strangers(reader.topics, ingest), *_missing(ingest, foreign), *unusable)
        clocks = (
            f"{swarm.robots[robot].name} {one.problem}. {one.remedy}."
            for robot, one in ingest.clocks_apart().items()
        )
        if network.lost:
            found = (f"{network.lost} messages were dropped at random: {loss.share:g} of all.", *found)
        remarks = (*reader.losses, *found, *clocks, *localizer.remarks())
        remarks += (*truth.remarks(), *maps.remarks())
        unusable = () if any(one.received > one.malformed for one in ingest.statistics) else unusable
        tracks, shown = truth.tracks(), (maps.maps(), maps.goals())
        return BagSummary(range_ns, tracks, ingest.received(), remarks, unusable, *shown)


def mounts_of_bag(
    bag: Path,
    swarm: Swarm,
    remap: Mapping[str, str] = MappingProxyType({}),
    heard: Collection[str] = (),
) -> Mounts:
    """Mounts of sensors by the static transforms of a bag; `remap` as in `renamed_topics`.

    `heard` are topics that may be mapped beside those of the estimator. Raises BagError if nothing in the bag
    can be read, or a topic cannot be mapped.
    """
    mounts = Mounts(swarm)
    known = [*Ingest(swarm).handle_of, *truth_topics(swarm), *MapReader(swarm).topics, *heard]
    with BagReader(bag, renamed_topics(remap, swarm, known)) as reader:
        types = {topic.name: topic.type for topic in reader.topics}
        static = [name for name in types if name.endswith(TF_STATIC) and same_type(types[name], TRANSFORMS)]
        waiting = {
            name for name, topic in mounts.topics.items() if types.get(name) == topic.kind.message_type
        }
        for name, _, _, data in reader.messages(static):
            mounts.add_message(name, data)
        for name, _, _, data in reader.messages([*sorted(waiting)] if static else []):
            if name in waiting:
                waiting.remove(name)
                mounts.add_message(name, data)
            if not waiting:
                break
    return mounts


def _from(batch: MessageBatch, first: int) -> MessageBatch:
    """The messages of topics from number `first` on, renumbered from 0."""
    others = batch.chosen(batch.topic >= first)
    return others._replace(topic=others.topic - first)


def renamed_topics(remap: Mapping[str, str], swarm: Swarm, known: Collection[str]) -> dict[str, str]:
    """Topic of a bag -> the topic as which it is read, by rules expected topic -> topic of the bag.

    An example is robot1/odom -> /robot1/odometry/filtered; `<robot>` in both stands for each robot. `known`
    are the expected topics. Raises BagError if an expected topic is unknown, or two of them have the same
    topic of the bag.
    """
    renamed: dict[str, str] = {}
    for own, stored in remap.items():
        names = [robot.name for robot in swarm.robots] if "<robot>" in own else [""]
        for name in names:
            target, source = (text.replace("<robot>", name).lstrip("/") for text in (own, stored))
            if target not in known:
                raise BagError(f"remap {own}:={stored}: {target} is none of the topics {listed([*known])}.")
            if renamed.setdefault(source, target) != target:
                raise BagError(f"remap {own}:={stored}: {source} is mapped to {renamed[source]} already.")
    return renamed


def same_type(one: str, other: str) -> bool:
    """Whether two names of types are the same; some writers of bags leave /msg/ out."""
    return one.replace("/msg/", "/") == other.replace("/msg/", "/")


def _foreign(topics: Sequence[BagTopic], ingest: Ingest) -> dict[str, str]:
    """Topics of another type than expected, which are not read, with a sentence each."""
    expected = {topic.name: topic.kind.message_type for topic in ingest.topics}
    return {
        topic.name: f"{topic.name} has the type {topic.type}, expected is {expected[topic.name]}: not read."
        for topic in topics
        if topic.type and topic.name in expected and not same_type(topic.type, expected[topic.name])
    }


def _missing(ingest: Ingest, foreign: Collection[str]) -> list[str]:
    """One sentence for every expected topic without messages, unless a topic that robots share has some."""
    pairs = [*zip(ingest.topics, ingest.statistics, strict=True)]
    shared = {topic.kind.stands_for for topic, statistics in pairs if statistics.received}
    return [
        f"The bag holds no message on {topic.name}."
        for topic, statistics in pairs
        if topic.expected and not statistics.received and topic.name not in foreign
        if topic.kind.rows not in shared
    ]


def _strangers(topics: Sequence[BagTopic], ingest: Ingest) -> list[str]:
    """One sentence if the bag holds inputs of robots that the swarm does not have."""
    types = {kind.topic: kind.message_type for kind in kinds().values()}
    names = [t.name for t in topics if types.get(t.name.rpartition("/")[2]) == t.type]
    strange = sorted(set(names) - set(ingest.handle_of))
    return [f"No robot of the swarm description has the topics {', '.join(strange)}."] if strange else []


def _unusable(topics: Sequence[BagTopic], ingest: Ingest, swarm: Swarm) -> tuple[str, ...]:
    """One sentence for each expected kind of input without a usable message, with topics that the bag has."""
    pairs = [*zip(ingest.topics, ingest.statistics, strict=True)]
    used = {topic.kind.rows for topic, statistics in pairs if statistics.received > statistics.malformed}
    read = {topic.kind.name for topic in ingest.topics}
    sentences = []
    for kind in kinds().values():
        if not kind.of_each or kind.name not in read or kind.rows in used or not kind.is_expected_of(swarm):
            continue
        own = {topic.name: one.malformed for topic, one in pairs if topic.kind.rows == kind.rows}
        others = [
            topic
            for topic in topics
            if same_type(topic.type, kind.message_type)
            and topic.name not in ingest.handle_of
            and not topic.name.endswith("/ground_truth")
        ]
        here = [topic for topic in topics if topic.name in own]
        if malformed := sum(own.values()):
            found = f"none of the {malformed} messages on {_listed(here)} is one as ROS 2 serializes it"
        elif here:
            found = f"the bag has another type on {_listed(here)}"
        elif others:
            remedy = "correct range_topic, and the name or address of each radio"
            if not kind.of_pairs:
                remedy = f"map topics, such as --remap '{_rule(kind.pattern, others[0].name, swarm)}'"
            found = f"the bag has this type on {_listed(others)}: {remedy}"
        elif not used:
            found = "the bag has no topic of this type"
        else:
            continue
        pattern = kind.pattern
        if kind.of_pairs:
            pattern = f"{swarm.range_topic}, such as {next(iter(own))}"
        sentences.append(f"Expected {kind.message_type} on {pattern}; {found}.")
    return tuple(sentences)


def _rule(pattern: str, stored: str, swarm: Swarm) -> str:
    """A rule that maps an expected topic to one of the bag, for all robots if its name begins with one."""
    first, _, rest = stored.partition("/")
    if first in (robot.name for robot in swarm.robots):
        return f"{pattern}:=<robot>/{rest}"
    return f"{pattern.replace('<robot>', swarm.robots[0].name)}:={stored}"


def _listed(topics: Sequence[BagTopic]) -> str:
    return listed([f"{topic.name} ({topic.type or 'no type'})" for topic in topics])


MAX_MAP_BYTES = 48_000_000  # Size from which maps are thinned out evenly over time
MAX_GOALS = 20_000  # Maximum number of stored goals per robot


class MapReader:
    """Collects the maps and goals of a bag for display; the estimator does not see them."""

    def __init__(self, swarm: Swarm, max_bytes: int = MAX_MAP_BYTES) -> None:
        self._names = [robot.name for robot in swarm.robots]
        # The index of a topic is its number in a batch
        self.topics = ["map", *(f"{name}/goal" for name in self._names)]
        self._max_bytes = max_bytes
        self._maps: list[RecordedMap] = []
        self._newest: RecordedMap | None = None
        self._spacing_ns = 0
        self._goals: dict[str, list[tuple[int, tuple[float, float, float]]]] = {}
        self._malformed = 0

    def add(self, batch: MessageBatch) -> None:
        """Add messages."""
        for topic, log_ns, data in batch.messages():
            try:
                if topic:
                    self._add_goal(self._names[topic - 1], data)
                else:
                    decode_occupancy_grid(data)
                    self._add_map(RecordedMap(log_ns, data))
            except CdrError:
                self._malformed += 1

    def maps(self) -> tuple[RecordedMap, ...]:
        """In the order of time, with the newest."""
        newest = [self._newest] if self._newest and self._newest not in self._maps[-1:] else []
        return (*self._maps, *newest)

    def goals(self) -> dict[str, Trajectory]:
        """Robot name -> its goals, for robots that have any."""
        found = {}
        for name, goals in self._goals.items():
            stamps, poses = zip(*sorted(goals), strict=True)
            found[name] = Trajectory(np.array(stamps, dtype=np.int64), np.array(poses))
        return found

    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user."""
        return (f"{self._malformed} messages of maps or goals are malformed.",) if self._malformed else ()

    def _add_goal(self, name: str, data: bytes) -> None:
        goal = decode_pose_stamped(data)
        if not np.isfinite(goal.pose).all():
            raise CdrError("a goal is not finite.")
        goals = self._goals.setdefault(name, [])
        if len(goals) < MAX_GOALS:
            goals.append((goal.stamp_ns, goal.pose))

    def _add_map(self, recorded: RecordedMap) -> None:
        self._newest = recorded
        if self._maps and recorded.log_ns < self._maps[-1].log_ns + self._spacing_ns:
            return
        self._maps.append(recorded)
        while len(self._maps) > 1 and sum(len(one.data) for one in self._maps) > self._max_bytes:
            self._maps = self._maps[::2]
            span_ns = recorded.log_ns - self._maps[0].log_ns
            self._spacing_ns = max(2 * self._spacing_ns, span_ns // len(self._maps))
